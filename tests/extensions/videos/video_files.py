"""Videos as tests see them: the frames of a file, and the values that colours stand for."""

from __future__ import annotations

from pathlib import Path

import av
import matplotlib as mpl
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8]


def decoded(path: Path) -> list[Image]:
    """Return the frames of a video."""
    with av.open(str(path)) as video:
        return [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]


def part(colour: npt.NDArray[np.generic], palette: str = "viridis") -> float:
    """Return the place on a scale of colours, from 0 to 1, whose colour is nearest."""
    table = mpl.colormaps[palette](np.linspace(0, 1, 256))[:, :3] * 255
    return float(np.abs(table - colour.astype(float)).sum(axis=1).argmin() / 255)


def is_grey(colour: npt.NDArray[np.generic]) -> bool:
    """Return whether a colour is that of missing values or of a panel without data."""
    return bool(np.ptp(colour.astype(int)) < 12 and 150 < colour.mean() < 245)

"""The painter of pictures that runs left: each fills its panel, without distortion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image as Pillow

if TYPE_CHECKING:
    from sierra.extensions.videos.encode import Image
    from sierra.extensions.videos.painting.text_strip import Box
    from sierra.extensions.videos.pictures import PictureTrack
    from sierra.extensions.videos.tracks import State


class PicturePainter:
    """Paints the pictures of one track in each panel."""

    def __init__(self, tracks: Sequence[PictureTrack]) -> None:
        self._sizes = [track.size for track in tracks]
        self._readers = [track.reader() for track in tracks]

    def prepare(self, figure: Figure, plots: Sequence[Axes]) -> None:
        del figure
        for plot, (wide, high) in zip(plots, self._sizes, strict=True):
            plot.set_xlim(0, wide)
            plot.set_ylim(high, 0)
            plot.set_aspect("equal")
            plot.set_xticks([])
            plot.set_yticks([])
            for spine in plot.spines.values():
                spine.set_visible(False)

    def paint(self, image: Image, panel: int, box: Box, state: State) -> None:
        picture = self._readers[panel].read(int(state[1][0]))
        size = box.right - box.left, box.bottom - box.top
        enlarged = size[0] >= 2 * picture.shape[1]
        how = Pillow.Resampling.BOX if enlarged else Pillow.Resampling.BICUBIC
        image[box.pixels] = np.asarray(Pillow.fromarray(picture).resize(size, how))

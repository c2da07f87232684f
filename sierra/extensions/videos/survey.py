"""The first pass over a video's states: their hash, their smallest and largest value, and what the viewer must know of them.

The second pass draws them. So colours mean the same in all frames, bad data are found before anything is written, and the
hash of the data is in the file.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import zip_longest
from typing import TYPE_CHECKING, Any

from sierra.extensions.videos.films import Film
from sierra.extensions.videos.tracks import Track, aligned

if TYPE_CHECKING:
    import numpy.typing as npt

    from sierra.extensions.videos.tracks import Floats, State

FEW = 4
VERSION = b"sierra video 1\n"


@dataclass
class Range:
    """The smallest and the largest finite value of some panels."""

    low: float = float("inf")
    high: float = float("-inf")

    @property
    def found(self) -> bool:
        return self.low <= self.high

    def joined(self, other: Range) -> Range:
        return Range(min(self.low, other.low), max(self.high, other.high))

    def add(self, state: State) -> None:
        import numpy as np

        values = state[0]
        finite = values[np.isfinite(values)]
        if len(finite):
            self.low, self.high = min(self.low, float(finite.min())), max(self.high, float(finite.max()))


@dataclass
class Survey:
    """The facts about the states of one film."""

    data: str = ""
    """The SHA-256 of times and states, in the order of frames."""
    values: Range = field(default_factory=Range)
    """The range of the panels that show values."""
    differences: Range = field(default_factory=Range)
    """The range of the panels that show differences."""
    columns: tuple[Range, ...] = ()
    """The ranges of the first `FEW` columns of each part of the states: for poses, of x, of y and of the heading."""
    empty: int = 0
    """The number of cells without a finite value, in all panels and frames."""
    gaps: int = 0
    """The number of frames in which a panel has no data."""

    def add_columns(self, state: State) -> None:
        """Add the values of a state to the ranges of its first columns."""
        columns = [part[:, place] for part in state if part.ndim > 1 for place in range(min(FEW, part.shape[1]))]
        self.columns = self.columns or tuple(Range() for _ in columns)
        for known, column in zip(self.columns, columns, strict=True):
            known.add((column,))

    def joined(self, other: Survey) -> Survey:
        """Return the facts about two films together; these have no hash."""
        return Survey(
            values=self.values.joined(other.values),
            differences=self.differences.joined(other.differences),
            columns=tuple(a.joined(b) for a, b in zip_longest(self.columns, other.columns, fillvalue=Range())),
            empty=self.empty + other.empty,
            gaps=self.gaps + other.gaps,
        )


def survey(
    film: Film, tracks: Sequence[Track], times: Floats, *, carry: bool, seen: Callable[[], None] = lambda: None
) -> Survey:
    """Return the facts about a film. Raises SierraError for data that cannot be shown. `seen` is called after each frame."""
    import numpy as np

    facts, digest = Survey(), hashlib.sha256(VERSION)
    for time, states in zip(times.tolist(), aligned(tracks, times, carry=carry), strict=True):
        digest.update(struct.pack("<d", time))
        gap = False
        for panel in film.panels:
            state, numbers = panel.state(states)
            digest.update(struct.pack(f"<{len(numbers) + 1}q", state is not None, *numbers))
            gap |= state is None
            if state is None:
                continue
            for part in state:
                digest.update(repr((part.dtype.str, part.shape)).encode())
                digest.update(np.ascontiguousarray(_plain(part)).data)
            if state[0].dtype.kind != "f":
                continue  # pictures have no limits
            facts.add_columns(state)
            (facts.differences if panel.minus else facts.values).add(state)
            facts.empty += int((~np.isfinite(state[0])).sum())
        facts.gaps += gap
        seen()
    facts.data = digest.hexdigest()
    return facts


def _plain(part: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return an array in which all NaN have the same bits."""
    import numpy as np

    return np.where(np.isnan(part), np.nan, part) if part.dtype.kind == "f" else part

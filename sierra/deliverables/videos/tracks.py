"""Tracks: the states of one run over time, and several of them side by side at common times."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

from sierra.errors import UsageError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    Floats: TypeAlias = npt.NDArray[np.float64]
    State: TypeAlias = tuple[npt.NDArray[Any], ...]
    """The state of a run at one time: a matrix; the poses of robots; edges and places; an image."""

ROUNDING = 1e-9
"""The largest relative difference of two times that are taken for the same."""
MOST = 1_000_000
"""The largest number of frames of one video."""


class Track(Protocol):
    """The states of one run, in the order of time."""

    @property
    def times(self) -> Floats:
        """Ascending and finite times; no time is there twice."""

    def states(self) -> Iterator[State]:
        """Yield the state at each of the times; only a few are in memory. May be called several times."""


def frame_times(tracks: Sequence[Track], step: float | None) -> Floats:
    """Return the times of frames: all times of the tracks, or every `step` from the first to the last of them.

    Raises UsageError if there are none, or too many.
    """
    import numpy as np

    every = np.unique(np.concatenate([track.times for track in tracks]))
    if not len(every):
        raise UsageError("there is no time with a value to show")
    if step is None:
        return _few(every, len(every))
    count = int((every[-1] - every[0]) / step * (1 + ROUNDING)) + 1
    return _few(every[0] + np.arange(min(count, MOST + 1)) * step, count)


def _few(times: Floats, count: int) -> Floats:
    if count > MOST:
        raise UsageError(f"{count} frames are too many for a video; at most {MOST} are possible (use a larger step)")
    return times


def uneven(times: Floats) -> tuple[float, float] | None:
    """Return the smallest and the largest distance of two frames in time; None if all are the same, up to rounding."""
    import numpy as np

    if len(times) < 3:
        return None
    steps = np.diff(times)
    tolerance = 1e-6 * float(np.median(steps)) + 4 * float(np.spacing(np.abs(times).max()))
    low, high = float(steps.min()), float(steps.max())
    return None if high - low <= tolerance else (low, high)


def digits(times: Floats) -> int:
    """Return the number of significant digits of ascending times whose rounding is small beside their distances; at least 6."""
    import numpy as np

    if len(times) < 2:
        return 6
    places = np.log10(np.abs(times).max() / np.diff(times).min())
    return int(np.clip(np.ceil(places) + 2, 6, 17))


def aligned(tracks: Sequence[Track], times: Floats, *, carry: bool) -> Iterator[list[State | None]]:
    """Yield for each time the state of each track at this time; None if it has none.

    With `carry`, a state holds until the next one of its track, but not beyond the last time of the track.
    """
    heads = [_Head(track) for track in tracks]
    for time in times.tolist():
        yield [head.at(time, carry=carry) for head in heads]


class _Head:
    """The place in a track up to which it has been read."""

    def __init__(self, track: Track) -> None:
        self._pairs = zip(track.times.tolist(), track.states(), strict=True)
        self._last: tuple[float, State] | None = None
        self._next = next(self._pairs, None)

    def at(self, time: float, *, carry: bool) -> State | None:
        reach = time + ROUNDING * abs(time) if carry else time
        while self._next is not None and self._next[0] <= reach:
            self._last, self._next = self._next, next(self._pairs, None)
        if self._last is None or (self._last[0] != time and not carry):
            return None
        ended = self._next is None and self._last[0] < time - ROUNDING * abs(time)
        return None if ended else self._last[1]

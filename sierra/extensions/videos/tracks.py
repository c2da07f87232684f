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

    Times that differ by `rounding` only are one, the first. Raises UsageError if there are none, or too many.
    """
    import numpy as np

    every = np.unique(np.concatenate([track.times for track in tracks]))
    if not len(every):
        raise UsageError("there is no time with a value to show")
    if step is None:
        apart = np.append(True, np.diff(every) > rounding(tracks) / len(tracks))  # then all of a group are near its first
        return _few(every[apart], int(apart.sum()))
    span = every[-1] - every[0] + 4 * np.spacing(np.abs(every).max())
    count = int(span / step * (1 + 1e-9)) + 1
    return _few(every[0] + np.arange(min(count, MOST + 1)) * step, count)


def _few(times: Floats, count: int) -> Floats:
    if count > MOST:
        raise UsageError(f"{count} frames are too many for a video; at most {MOST} are possible (use a larger step)")
    return times


def rounding(tracks: Sequence[Track]) -> float:
    """Return the largest difference of times of two tracks that are taken for the same.

    It is that of a few roundings, and 10⁻⁶ of the smallest distance of times in a track; so no track has two times that are
    the same, also if times are in seconds since 1970.
    """
    import numpy as np

    own = [track.times for track in tracks if len(track.times)]
    rounded = 4 * max((float(np.spacing(np.abs(times).max())) for times in own), default=0.0)
    nearest = min((float(np.diff(times).min()) for times in own if len(times) > 1), default=float("inf"))
    return min(rounded + 1e-6 * nearest, nearest / 2) if np.isfinite(nearest) else rounded


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
    same = rounding(tracks)
    heads = [_Head(track, same) for track in tracks]
    for time in times.tolist():
        yield [head.at(time, carry=carry) for head in heads]


class _Head:
    """The place in a track up to which it has been read."""

    def __init__(self, track: Track, same: float) -> None:
        self._same = same
        self._pairs = zip(track.times.tolist(), track.states(), strict=True)
        self._last: tuple[float, State] | None = None
        self._next = next(self._pairs, None)

    def at(self, time: float, *, carry: bool) -> State | None:
        while self._next is not None and self._next[0] <= time + self._same:
            self._last, self._next = self._next, next(self._pairs, None)
        if self._last is None:
            return None
        past = self._last[0] < time - self._same
        return None if past and (self._next is None or not carry) else self._last[1]

"""Videos of two batches: A, B and, for matrices, A − B, for each experiment that both batches have.

An experiment is the same if its variables have the same values. Both sides have the same limits, the same shape and the same
times; with `step`, times may differ.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from sierra.deliverables.gallery import Gallery
from sierra.errors import DamagedFile, SierraError, UsageError
from sierra.extensions.videos.films import Film, Members, Panel, file_names, film_of
from sierra.extensions.videos.subjects import Subject, subjects
from sierra.extensions.videos.survey import Survey
from sierra.extensions.videos.table import NUMERIC, Video

if TYPE_CHECKING:
    from sierra.extensions.videos.painting.scene import Painter
    from sierra.extensions.videos.tracks import Track

ONE_BATCH = ("tiles", "difference")
"""The values of `show` that need a single batch."""


class TwoSubjects:
    """The subjects of A and of B as one, which A's painter draws."""

    def __init__(self, labels: Sequence[str], sides: tuple[Subject, Subject], *, even: bool) -> None:
        """Raises UsageError if the sides differ in times, units or shape. `even`: frames have times of their own."""
        self._sides = sides
        a, b = sides
        _check_same(labels, "times", f"{a.time} {a.unit}", f"{b.time} {b.unit}")
        for name in a.units:
            _check_same(labels, f"units of {name!r}", a.units[name] or "none", b.units.get(name) or "none")
        for name in a.layout:
            if a.layout[name] != b.layout[name]:
                raise _different(labels, repr(name), _span(a.layout[name]), _span(b.layout[name]))
        if not even:
            _check_times(labels, a.tracks, b.tracks)
        self.tracks: Sequence[Track] = (*a.tracks, *b.tracks)
        self.time, self.unit, self.units, self.layout = a.time, a.unit, a.units, a.layout
        self.sql = "\n\n".join(f"-- batch {label}\n{subject.sql}" for label, subject in zip(labels, sides, strict=True))

    def left_out(self) -> Sequence[str]:
        return [f"{letter}: {note}" for letter, one in zip("AB", self._sides, strict=True) for note in one.left_out()]

    def notes(self, survey: Survey) -> Sequence[str]:
        return list(dict.fromkeys(note for one in self._sides for note in one.notes(survey)))

    def painter(self, film: Film, survey: Survey, tracks: Sequence[Track]) -> Painter:
        return self._sides[0].painter(film, survey, tracks)


def films_of_two(
    name: str, video: Video, galleries: Mapping[str, Gallery], notes: list[str], failed: list[str]
) -> Iterator[tuple[Film, Subject]]:
    """Yield the film of each experiment that both batches have, with its subject; add notes on those that only one has.

    The reasons why films cannot be made are added to `failed`. `galleries` are by label. Raises SierraError if there is none,
    or if batches cannot be compared.
    """
    if video.show in ONE_BATCH:
        raise UsageError(f'show = "{video.show}" shows one batch; "run" and "mean" can show two side by side')
    labels = list(galleries)
    a, b = (Members(shown.axes, shown.cells, shown.frame.cells(), tuple(shown.frame.runs())) for shown in galleries.values())
    _check_same(labels, "variables", *(", ".join(sorted(axis.name for axis in shown.axes)) or "none" for shown in (a, b)))
    of_a, of_b = (subjects(video, gallery) for gallery in galleries.values())
    pairs, alone = _pairs(a, b, video.experiments)
    notes += [f"video {name}: {what} is only in {labels[side]}" for side, what in alone]
    if not pairs:
        raise SierraError(f"batches {labels[0]!r} and {labels[1]!r} have no experiment with the same values of variables")
    called_by = file_names(name, a)
    for first, second in pairs:
        called = called_by[first]
        try:
            sides = film_of(called, video, a, first), film_of(called, video, b, second)
        except DamagedFile:
            raise
        except SierraError as error:
            failed.append(f"video {called}: {error}")
            continue
        joined = TwoSubjects(labels, (of_a(sides[0]), of_b(sides[1])), even=video.step is not None)
        yield _joined(sides, labels, numeric=video.kind in NUMERIC), joined
    if len(failed) == len(pairs):
        raise SierraError("; ".join(failed).replace(f"video {name}: ", ""))


def _pairs(a: Members, b: Members, chosen: str) -> tuple[list[tuple[int, int]], list[tuple[int, str]]]:
    """Return the positions of equal experiments in A and B; and the others: 0 (only in A) or 1, and the values."""
    of_a, of_b = a.matching(chosen, "experiments"), b.matching(chosen, "experiments")
    pairs = [(k, other) for k in of_a for other in of_b if a.cells[k] == b.cells[other]]
    only_a = [(0, a.label(k)) for k in of_a if k not in {one for one, _ in pairs}]
    only_b = [(1, b.label(k)) for k in of_b if k not in {other for _, other in pairs}]
    return pairs, only_a + only_b


def _joined(sides: tuple[Film, Film], labels: Sequence[str], *, numeric: bool) -> Film:
    """Return the film with the panels A, B and A − B."""
    first, second = sides
    a = first.panels[0].plus
    b = tuple(index + len(first.runs) for index in second.panels[0].plus)
    panels = [Panel(f"A: {labels[0]}", a), Panel(f"B: {labels[1]}", b)]
    notes = [f"{letter}: {note}" for letter, film in zip("AB", sides, strict=True) for note in film.notes]
    return replace(
        first,
        runs=(*first.runs, *second.runs),
        panels=(*panels, *([Panel("A − B", a, b)] if numeric else [])),
        notes=tuple(notes),
    )


def _check_same(labels: Sequence[str], what: str, first: str, second: str) -> None:
    if first != second:
        raise _different(labels, what, first, second)


def _different(labels: Sequence[str], what: str, first: str, second: str) -> UsageError:
    return UsageError(f"batches {labels[0]!r} and {labels[1]!r} have different {what}: {first} and {second}")


def _check_times(labels: Sequence[str], first: Sequence[Track], second: Sequence[Track]) -> None:
    """Raise UsageError if the runs of A and those of B have other times."""
    import numpy as np

    a, b = (np.unique(np.concatenate([track.times for track in tracks])).tolist() for tracks in (first, second))
    if a != b:
        raise _different(labels, "times", _span(a), f"{_span(b)}; with step, frames show the last values of each")


def _span(values: Sequence[float] | Sequence[str]) -> str:
    first, last = (f"{one:g}" if isinstance(one, float) else one for one in (values[0], values[-1])) if values else ("", "")
    return f"{len(values)} from {first} to {last}" if values else "none"

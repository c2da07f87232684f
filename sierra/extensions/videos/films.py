"""The files of a declared video: which runs each file shows, in which panels."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

from sierra.design.query import condition
from sierra.errors import DamagedFile, NotFound, SierraError
from sierra.extensions.videos.table import Video
from sierra.model import Axis, Value
from sierra.store.batch_data import ChosenRun
from sierra.util.lazy_definitions import dataclass, regex
from sierra.util.text import counted, few

if TYPE_CHECKING:
    from sierra.extensions.videos.tracks import Floats, State

MOST = 64
"""The largest number of panels."""
UNFIT = regex(r"[^\w.+=-]+")
"""Characters of values that names of files do not have."""


@dataclass(frozen=True, slots=True)
class Panel:
    """One panel: the mean of some runs, minus the mean of others. The runs are places in `Film.runs`."""

    label: str
    plus: tuple[int, ...]
    minus: tuple[int, ...] = ()

    def state(self, states: Sequence[State | None]) -> tuple[State | None, tuple[int, ...]]:
        """Return what the panel shows, and the number of runs in it: of each of its groups."""
        known = [[one for k in group if (one := states[k]) is not None] for group in (self.plus, self.minus)]
        numbers = tuple(len(group) for group, asked in zip(known, (self.plus, self.minus), strict=True) if asked)
        if not all(numbers):
            return None, numbers
        if not self.minus:
            return (known[0][0] if len(self.plus) == 1 else (_mean(known[0]),)), numbers
        return (_mean(known[0]) - _mean(known[1]),), numbers


def _mean(states: Sequence[State]) -> Floats:
    """Return the mean matrix. A cell without a value in one of the runs has none, since the other runs are another sample."""
    total: Floats = states[0][0].astype("f8")
    for (values,) in states[1:]:
        total = total + values
    return total / len(states)


@dataclass(frozen=True, slots=True)
class Film:
    """One file, apart from its format."""

    name: str
    """The name of the file, without its ending."""
    title: str
    runs: tuple[ChosenRun, ...]
    panels: tuple[Panel, ...]
    notes: tuple[str, ...] = ()
    """Notes for the viewer."""


@dataclass(frozen=True, slots=True)
class Members:
    """The runs of a batch by experiment, with the variables."""

    axes: tuple[Axis, ...]
    cells: Mapping[int, Mapping[str, Value]]
    """With the labels of controllers and scenarios."""
    names: Mapping[int, Mapping[str, Value]]
    """With their names."""
    runs: tuple[ChosenRun, ...]

    def of(self, experiment: int) -> list[ChosenRun]:
        """Return all runs of an experiment."""
        return [run for run in self.runs if run.experiment == experiment]

    def matching(self, text: str, origin: str) -> list[int]:
        """Return the positions of the experiments that a condition selects; all if it is empty."""
        return sorted(condition.among(text, [axis.name for axis in self.axes], self.names, self.cells, origin))

    def label(self, experiment: int) -> str:
        """Return the values of an experiment's variables."""
        from sierra.deliverables.figures import style

        return style.point(self.axes, self.cells[experiment])


def films(name: str, video: Video, members: Members) -> tuple[list[Film], list[str]]:
    """Return the files of a video, and the reasons why others cannot be made. Raises SierraError if nothing can be shown."""
    if video.show == "difference":
        return [_difference(name, video, members)], []
    experiments = members.matching(video.experiments, "experiments")
    called_by = file_names(name, members)
    complete: list[Film] = []
    failed: list[str] = []
    for experiment in experiments:
        called = called_by[experiment]
        try:
            complete.append(film_of(called, video, members, experiment))
        except DamagedFile:
            raise
        except SierraError as error:
            failed.append(f"video {called}: {error}")
    if not complete:
        raise SierraError("; ".join(failed).replace(f"video {name}: ", ""))
    return complete, failed


def file_names(name: str, members: Members) -> dict[int, str]:
    """Return the names of files by experiment, with the values of the variables: `heat-population_size=8`.

    A name that would be that of two experiments also has the number of the experiment.
    """
    if len(members.cells) == 1:
        return dict.fromkeys(members.cells, name)
    values = {
        experiment: "-".join([name, *(f"{axis.name}={members.names[experiment][axis.name]}" for axis in members.axes)])
        for experiment in members.cells
    }
    texts = {experiment: UNFIT.sub("_", text) for experiment, text in values.items()}
    counts = Counter(text.lower() for text in texts.values())
    return {k: text if counts[text.lower()] == 1 else f"{text}_experiment{k}" for k, text in texts.items()}


def film_of(name: str, video: Video, members: Members, experiment: int) -> Film:
    """Return the file of one experiment. Raises NotFound if it has no run with a result."""
    title = members.label(experiment)
    runs = members.of(experiment)
    if video.show == "run":
        number = video.run or 0
        run = _with_result([run for run in runs if run.number == number], f"run {number}")[0]
        return Film(name, ", ".join(filter(None, (title, f"run {number}"))), (run,), (Panel("", (0,)),))
    good = _with_result(runs, "its runs")
    lost = _lost(runs, good)
    if video.show == "mean":
        return Film(
            name, title, tuple(good), (Panel("", tuple(range(len(good)))),), (f"mean over {_number(runs, good)}", *lost)
        )
    shown = good[:MOST]
    rest = [f"the first {MOST} of {len(good)} runs"] if len(good) > MOST else []
    return Film(
        name, title, tuple(shown), tuple(Panel(f"run {run.number}", (k,)) for k, run in enumerate(shown)), (*rest, *lost)
    )


def _difference(name: str, video: Video, members: Members) -> Film:
    """Return a film of A, B and A − B."""
    chosen: list[ChosenRun] = []
    labels, notes, sides = [], [], []
    for letter, text in zip("AB", video.groups, strict=True):
        experiments = members.matching(text, "groups")
        if len(experiments) != 1:
            raise NotFound(
                f"groups: {text!r} selects {len(experiments)} experiments; a group of a difference is one experiment"
            )
        every = [run for run in members.of(experiments[0]) if video.run in (None, run.number)]
        good = _with_result(every, f"the runs of {letter}")
        sides.append(tuple(range(len(chosen), len(chosen) + len(good))))
        chosen += good
        labels.append(f"{letter}: {members.label(experiments[0])}")
        notes.append(f"{letter}: {f'run {video.run}' if video.run is not None else f'mean over {_number(every, good)}'}")
        notes += [f"{letter}: {note}" for note in _lost(every, good)]
    a, b = sides
    return Film(name, "", tuple(chosen), (Panel(labels[0], a), Panel(labels[1], b), Panel("A − B", a, b)), tuple(notes))


def _with_result(runs: Sequence[ChosenRun], what: str) -> list[ChosenRun]:
    """Return the runs with an effective execution. Raises NotFound if there is none."""
    found = [run for run in runs if run.judgement is not None]
    if not found:
        raise NotFound(
            f"{what} {'have' if runs and what.endswith('s') else 'has'} no successful execution, so there is nothing to show"
        )
    return found


def _number(runs: Sequence[ChosenRun], good: Sequence[ChosenRun]) -> str:
    return counted(len(runs), "run") if len(runs) == len(good) else f"{len(good)} of {counted(len(runs), 'run')}"


def _lost(runs: Iterable[ChosenRun], good: Sequence[ChosenRun]) -> list[str]:
    """Return a note on runs without a result."""
    lost = [str(run.number) for run in runs if run not in good]
    return [f"without a result: run{'s' * (len(lost) > 1)} {few(lost, 8)}"] if lost else []

"""`sierra reproduce`: verify a package, execute its runs again, compare the results, and decide the claims.

Nothing of the package is executed before all of its files are verified. Runs execute in the package's container without
network; for anything else, the user is asked first.

For a limited time, runs are chosen by their recorded durations: first the shortest run of each experiment that a claim rests
on, claim by claim in turn, then that of each other experiment. The rest of the time is filled with the other runs, in the order
of their numbers. With several slots, as many runs execute at the same time; the sum of the durations of the chosen runs is at
most the budget times the slots.

Also: the project of a received package, without the keys of its `sierra.toml` that reach outside the package.

A package must not choose where runs execute, what SIERRA starts on this machine besides the recorded commands, which of its
files containers can read, or which of its variables are recorded. Such keys are removed, also those of targets, and named.
Clusters and engines are those of the user's own configuration.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, zip_longest
from pathlib import Path, PurePosixPath
from typing import Any

from sierra import runners
from sierra.config import extensions, project_file, user
from sierra.config.find_project import ProjectFolder, settings
from sierra.config.project_file import LoadedProject
from sierra.deliverables.claims.model import Evaluated
from sierra.errors import Damaged, Missing, SierraError, UsageError
from sierra.execution.observer import Observer
from sierra.execution.progress_display import duration
from sierra.packages import manifest
from sierra.packages.layout import PACKAGE, PROGRAM, PROJECT
from sierra.packages.parts import verifier
from sierra.packages.reading import received
from sierra.packages.reproduction import claims, planned, report, workspace
from sierra.packages.reproduction.outcome import ReproducedBatch, Reproduction, Statement
from sierra.packages.reproduction.planned import PlannedBatch, RecordedRun
from sierra.replay.options import ReplayOptions
from sierra.replay.replay import replay
from sierra.store.layout import CONFIG, PYPROJECT, STORE
from sierra.store.segments import disk_errors
from sierra.store.store import Store
from sierra.util.fs import write_whole
from sierra.util.hashing import short
from sierra.util.regular_files import read_regular
from sierra.util.text import counted, one_line

PLUGINS = "plugins"
REMOVED = {
    ("runners",): "clusters are those of your own configuration",
    ("engines",): "engines are used with their own defaults",
    (PLUGINS,): "Python code of a package is never imported",
    ("programs",): "programs of this machine are asked for their versions as usual",
    ("store", "work_folder"): "runs execute below the given folder",
    ("environment", "record"): "your variables are not recorded",
}
"""Keys that are removed, with the reason."""


def load_confined(root: Path) -> tuple[LoadedProject, tuple[str, ...]]:
    """Return the project in `root` without these keys, and a line for each removed key. Raises ConfigError."""
    file = next((root / name for name in (CONFIG, PYPROJECT) if (root / name).is_file()), root / CONFIG)
    whole = settings(file) or {}
    table, absent = extensions.without_absent(whole)
    notes = [*absent, *_confine(table, "")]
    targets = table.get("targets")
    for name, target in targets.items() if isinstance(targets, dict) else ():
        if isinstance(target, dict):
            notes += _confine(target, f"targets.{name}.")
    if clusters := user.load().runners:
        table["runners"] = dict(clusters)
    project = project_file.of_table(ProjectFolder(root, file), table)
    return replace(project, received=True, lacking=extensions.lacking(whole)), tuple(notes)


def _confine(table: dict[str, Any], where: str) -> Iterator[str]:
    """Remove the keys from a table; yield a line for each."""
    for (*folders, key), reason in REMOVED.items():
        inner = _table(table, folders)
        if key in inner:
            if key != PLUGINS:  # their names are valid, but whatever uses one is refused
                del inner[key]
            yield f"sierra.toml: {where}{'.'.join((*folders, key))} of the package is ignored: {reason}"
    mounts = _table(table, ["container", "mounts"])
    for target, source in list(mounts.items()):
        if not isinstance(source, str) or _leads_out(source):
            del mounts[target]
            yield f"sierra.toml: {where}container.mounts {target} of the package is ignored: {source} is outside the package"
    yield from _without_templates(table, where)


def _without_templates(table: dict[str, Any], where: str) -> Iterator[str]:
    """Remove templates outside the package; recorded inputs are used anyway. Yield a line for each."""
    if isinstance(path := table.get("template"), str) and _leads_out(path):
        del table["template"]
        yield f"sierra.toml: {where}template of the package is ignored: {path} is outside the package"


def _table(table: dict[str, Any], names: list[str]) -> dict[str, Any]:
    """Return an inner table; an empty one if there is none."""
    for name in names:
        found = table.get(name)
        table = found if isinstance(found, dict) else {}
    return table


def _leads_out(path: str) -> bool:
    """Check whether a path leads out of the project. A package has no links."""
    return PurePosixPath(path).is_absolute() or path.startswith("~") or ".." in PurePosixPath(path).parts


@dataclass(frozen=True, slots=True)
class Options:
    """Options of a reproduction."""

    slots: int
    """Number of runs that execute at the same time on this machine."""
    claims: tuple[str, ...] = ()
    """Names of the claims to decide; none: all claims, and all batches."""
    budget: float | None = None
    """Time for the runs in seconds, by their recorded durations; None for all runs."""
    engine: str | None = None
    runner: str = "local"


def isolated_only(statement: Statement) -> None:
    """Raise Missing if anything would be executed outside of a container without network."""
    if statement.must_ask:
        raise Missing(f"programs of the package would not be isolated from this machine: {'; '.join(statement.lines)}")


def reproduce(
    package: Path, into: Path | None, options: Options, agree: Callable[[Statement], None], observer: Observer | None = None
) -> Reproduction:
    """Reproduce a package, a zip or a folder; the reports are in the folder `into`, or in one beside the package.

    `agree` receives what would be executed, and raises an error if it must not be. Raises Missing if the package cannot be read
    or the folder not written, Damaged if it is no package or not a safe one, UsageError for options that do not fit it.
    """
    observer = observer or Observer()
    folder = Path(os.path.abspath(into or workspace.default(package)))  # noqa: PTH100 - no link is followed
    with workspace.opened(package) as archive, workspace.alone(folder):
        workspace.copy_verified(archive, folder)
        observer.notice(f"verified: package {short(archive.id)}, copied to {folder / workspace.COPY}")
        described = manifest.read(read_regular(folder / workspace.COPY / PACKAGE))
        project, notes = load_confined(folder / workspace.COPY / PROJECT)
        if not verifier.is_ours(archive.hashes.get(PROGRAM)):
            notes = (*notes, received.OTHER)
        for note in notes:
            observer.notice(one_line(note))
        store = Store(project.root / STORE, project.rules).confined()
        earlier = workspace.replays_here(archive, store, observer)
        with project.plugins():
            batches, decided, left_out = _Work(project, store, options, observer, earlier).reproduce(agree)
            done = Reproduction(archive.id, described.title, folder, notes, batches, decided, left_out=left_out)
            done = _drawn(done, project, store, observer)
        report.write(done)
    return done


def _drawn(done: Reproduction, project: LoadedProject, store: Store, observer: Observer) -> Reproduction:
    """Make the deliverables of all batches that were executed again, and write the page that shows both; return them too."""
    complete = {batch.planned.batch: batch.replay for batch in done.batches if batch.replay and batch.complete}
    if not complete or done.interrupted:
        return done
    from sierra.packages.reproduction import drawn_again, page

    sessions = [session for replayed in complete.values() for session in replayed.sessions]
    sides = drawn_again.Sides(project, store, store.replayed(sessions), done.folder / workspace.COPY)
    observer.notice("drawing the figures from the reproduced runs")
    drawn = tuple(drawn_again.make(sides, list(complete)))
    texts, problem = drawn_again.numbers_of(sides, list(complete))
    done = replace(done, drawn=drawn, numbers=texts, notes=(*done.notes, *dict.fromkeys(sides.notes)))
    recorded = claims.recorded(project, store, [claim.name for claim in done.claims])
    shown = page.page(done, drawn, page.Numbers(texts, problem), recorded, project.config)
    with disk_errors(done.folder):
        write_whole(done.folder / workspace.PAGE, shown)
    return done


class _Work:
    """The work on a verified copy."""

    def __init__(
        self, project: LoadedProject, store: Store, options: Options, observer: Observer, earlier: frozenset[str]
    ) -> None:
        """`earlier`: sessions of replays that earlier calls made here."""
        self._project = project
        self._store = store
        self._options = options
        self._observer = observer
        self._earlier = earlier

    def reproduce(
        self, agree: Callable[[Statement], None]
    ) -> tuple[tuple[ReproducedBatch, ...], tuple[Evaluated, ...], tuple[str, ...]]:
        runners.find(self._options.runner, self._project.config.runners)
        names = claims.named(self._project, self._options.claims)
        rests = claims.rest(self._project, self._store, names)
        plans = [*self._plans(rests)]
        possible = [run for plan in plans if not plan.missing for run in plan.runs]
        chosen = set(possible)
        if self._options.budget is not None:
            chosen = within_budget(possible, rests, self._options.budget, self._options.slots)
        if possible:
            open_ = any(not plan.isolated for plan in plans if not plan.missing and not chosen.isdisjoint(plan.runs))
            agree(Statement(tuple(self._lines(plans, chosen)), open_))
        for line in (line for plan in plans if plan.missing for line in plan.lines):
            self._observer.notice(line)
        batches = tuple(self._executed(plans, chosen))
        complete = {batch.planned.batch: batch.replay for batch in batches if batch.replay and batch.complete}
        decided = claims.decide(self._project, self._store, rests, complete) if names else ()
        return batches, decided, tuple(_left_out(plans, chosen, rests))

    def _plans(self, rests: Mapping[str, Sequence[str]]) -> Iterator[PlannedBatch]:
        wanted = {batch for batches in rests.values() for batch in batches}
        for batch in planned.batches(self._store):
            if not self._options.claims or batch.batch in wanted:
                local = self._options.runner == "local"
                yield planned.plan(self._project, self._store, batch, self._options.engine, local=local)

    def _lines(self, plans: Sequence[PlannedBatch], chosen: set[RecordedRun]) -> Iterator[str]:
        """Yield a line for each batch with the runs that would be executed."""
        runner = "" if self._options.runner == "local" else f" on {self._options.runner}"
        for plan in plans:
            runs = [run for run in plan.runs if run in chosen]
            if not plan.missing and runs:
                took = duration(sum(run.seconds for run in runs))
                yield from plan.lines
                yield f"  {len(runs)} of {counted(plan.of, 'run')}{runner}; they took {took} in all when they were recorded"

    def _executed(self, plans: Sequence[PlannedBatch], chosen: set[RecordedRun]) -> Iterator[ReproducedBatch]:
        interrupted = False
        for plan in plans:
            runs = frozenset(run.run for run in plan.runs if run in chosen)
            if interrupted or plan.missing or not runs:
                reason = "; ".join(plan.missing) or ("interrupted" if interrupted else "the budget has no time for its runs")
                yield ReproducedBatch(plan, 0, None, one_line(reason))
                continue
            done = self._replayed(plan, runs)
            interrupted = bool(done.replay and done.replay.interrupted)
            yield done

    def _replayed(self, plan: PlannedBatch, runs: frozenset[str]) -> ReproducedBatch:
        local = self._options.runner == "local"
        only = None if len(runs) == len(plan.runs) else runs
        options = ReplayOptions(
            self._options.slots,
            only=only,
            runner=self._options.runner,
            engine=plan.engine,
            image=plan.image,
            earlier=self._earlier,
        )
        try:
            if local and (missing := planned.lacking_packages(self._project, self._store, plan)):
                return ReproducedBatch(plan, len(runs), None, "; ".join(missing))
            return ReproducedBatch(plan, len(runs), replay(self._project, self._store, plan.batch, options, self._observer))
        except Damaged:
            raise
        except SierraError as error:
            return ReproducedBatch(plan, len(runs), None, planned.reason(error))


def _left_out(plans: Sequence[PlannedBatch], chosen: set[RecordedRun], rests: Mapping[str, Sequence[str]]) -> Iterator[str]:
    """Yield a line for each batch of which runs are left out, and for each claim with experiments of which all are."""
    possible = [run for plan in plans if not plan.missing for run in plan.runs]
    for plan in plans:
        left = sum(run not in chosen for run in plan.runs)
        if left and not plan.missing:
            yield f"batch {short(plan.batch)}: the budget leaves out {left:,} of {counted(len(plan.runs), 'run')}"
    for name, batches in rests.items():
        if count := untouched(possible, chosen, batches):
            yield f"claim {name}: the budget leaves out all runs of {counted(count, 'experiment')}"


def within_budget(
    runs: Sequence[RecordedRun], rests: Mapping[str, Sequence[str]], budget: float, slots: int
) -> set[RecordedRun]:
    """Return the runs to execute within `budget` seconds on `slots` slots. `rests`: the batches of each claim.

    Raises UsageError if there is no time for any run.
    """
    chosen: set[RecordedRun] = set()
    left = budget * slots
    for run in _by_priority(runs, rests):
        if run not in chosen and run.seconds <= min(left, budget):
            chosen.add(run)
            left -= run.seconds
    if runs and not chosen:
        least = min(run.seconds for run in runs)
        raise UsageError(f"--budget: the shortest run took {duration(least)}, more than {duration(budget)}")
    return chosen


def _by_priority(runs: Sequence[RecordedRun], rests: Mapping[str, Sequence[str]]) -> Iterator[RecordedRun]:
    """Yield all runs in the order in which they are chosen; some are repeated."""
    shortest: dict[tuple[str, int], RecordedRun] = {}
    for run in sorted(runs, key=lambda run: (run.seconds, run.number)):
        shortest.setdefault((run.batch, run.ordinal), run)
    each = ([run for run in shortest.values() if run.batch in batches] for batches in rests.values())
    yield from _in_turn(each)
    yield from shortest.values()
    yield from sorted(runs, key=lambda run: (run.number, run.seconds))


def _in_turn(lists: Iterable[Sequence[RecordedRun]]) -> Iterator[RecordedRun]:
    return (run for run in chain.from_iterable(zip_longest(*lists)) if run is not None)


def untouched(runs: Sequence[RecordedRun], chosen: set[RecordedRun], batches: Sequence[str]) -> int:
    """Return the number of experiments of these batches without any chosen run."""
    return len(
        {(run.batch, run.ordinal) for run in runs if run.batch in batches} - {(run.batch, run.ordinal) for run in chosen}
    )

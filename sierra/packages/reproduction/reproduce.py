"""`sierra reproduce`: verify a package, execute its runs again, compare the results, and decide the claims.

Nothing of the package is executed before all of its files are verified. Runs execute in the package's container without
network; for anything else, the user is asked first.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from sierra import runners
from sierra.config.project_file import LoadedProject
from sierra.deliverables.claims.model import Evaluated
from sierra.errors import Damaged, Missing, SierraError
from sierra.execution.observer import Observer
from sierra.execution.progress_display import duration
from sierra.packages import manifest
from sierra.packages.layout import PACKAGE, PROGRAM, PROJECT
from sierra.packages.parts import verifier
from sierra.packages.reading import received
from sierra.packages.reproduction import budget, claims, confined_project, planned, report, workspace
from sierra.packages.reproduction.outcome import ReproducedBatch, Reproduction, Statement
from sierra.packages.reproduction.planned import PlannedBatch, RecordedRun
from sierra.replay.options import ReplayOptions
from sierra.replay.replay import replay
from sierra.store.layout import STORE
from sierra.store.segments import disk_errors
from sierra.store.store import Store
from sierra.util.fs import write_whole
from sierra.util.hashing import short
from sierra.util.regular_files import read_regular
from sierra.util.text import counted, one_line


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
    with workspace.opened(package) as found, workspace.alone(folder):
        workspace.copy_verified(found, folder)
        observer.notice(f"verified: package {short(found.id)}, copied to {folder / workspace.COPY}")
        described = manifest.read(read_regular(folder / workspace.COPY / PACKAGE))
        project, notes = confined_project.load(folder / workspace.COPY / PROJECT)
        if not verifier.is_ours(found.hashes.get(PROGRAM)):
            notes = (*notes, received.OTHER)
        for note in notes:
            observer.notice(one_line(note))
        store = Store(project.root / STORE, project.rules).confined()
        earlier = workspace.replays_here(found, store, observer)
        with project.plugins():
            batches, decided, left_out = _Work(project, store, options, observer, earlier).reproduce(agree)
            done = Reproduction(found.id, described.title, folder, notes, batches, decided, left_out=left_out)
            done = _drawn(done, project, store, observer)
        report.write(done)
    return done


def _drawn(done: Reproduction, project: LoadedProject, store: Store, observer: Observer) -> Reproduction:
    """Make the deliverables of all batches that were executed again, and write the page that shows both; return them too."""
    complete = {one.planned.batch: one.replay for one in done.batches if one.replay and one.complete}
    if not complete or done.interrupted:
        return done
    from sierra.packages.reproduction import drawn_again, page

    sessions = [session for replayed in complete.values() for session in replayed.sessions]
    sides = drawn_again.Sides(project, store, store.replayed(sessions), done.folder / workspace.COPY)
    observer.notice("drawing the figures from the reproduced runs")
    drawn = tuple(drawn_again.make(sides, list(complete)))
    texts, problem = drawn_again.numbers_of(sides, list(complete))
    done = replace(done, drawn=drawn, numbers=texts, notes=(*done.notes, *dict.fromkeys(sides.notes)))
    recorded = claims.recorded(project, store, [one.name for one in done.claims])
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
        possible = [run for one in plans if not one.missing for run in one.runs]
        chosen = set(possible)
        if self._options.budget is not None:
            chosen = budget.choose(possible, rests, self._options.budget, self._options.slots)
        if possible:
            open_ = any(not one.isolated for one in plans if not one.missing and not chosen.isdisjoint(one.runs))
            agree(Statement(tuple(self._lines(plans, chosen)), open_))
        for line in (line for one in plans if one.missing for line in one.lines):
            self._observer.notice(line)
        batches = tuple(self._executed(plans, chosen))
        complete = {one.planned.batch: one.replay for one in batches if one.replay and one.complete}
        decided = claims.decide(self._project, self._store, rests, complete) if names else ()
        return batches, decided, tuple(_left_out(plans, chosen, rests))

    def _plans(self, rests: Mapping[str, Sequence[str]]) -> Iterator[PlannedBatch]:
        wanted = {batch for batches in rests.values() for batch in batches}
        for batch in planned.batches(self._store):
            if not self._options.claims or batch.batch in wanted:
                local = self._options.runner == "local"
                yield planned.plan(self._project, self._store, batch, self._options.engine, local=local)

    def _lines(self, plans: Sequence[PlannedBatch], chosen: set[RecordedRun]) -> Iterator[str]:
        """Yield lines that say what would be executed."""
        place = "" if self._options.runner == "local" else f" on {self._options.runner}"
        for one in plans:
            runs = [run for run in one.runs if run in chosen]
            if not one.missing and runs:
                took = duration(sum(run.seconds for run in runs))
                yield from one.lines
                yield f"  {len(runs)} of {counted(one.of, 'run')}{place}; they took {took} in all when they were recorded"

    def _executed(self, plans: Sequence[PlannedBatch], chosen: set[RecordedRun]) -> Iterator[ReproducedBatch]:
        interrupted = False
        for one in plans:
            runs = frozenset(run.run for run in one.runs if run in chosen)
            if interrupted or one.missing or not runs:
                reason = "; ".join(one.missing) or ("interrupted" if interrupted else "the budget has no time for its runs")
                yield ReproducedBatch(one, 0, None, one_line(reason))
                continue
            done = self._replayed(one, runs)
            interrupted = bool(done.replay and done.replay.interrupted)
            yield done

    def _replayed(self, one: PlannedBatch, runs: frozenset[str]) -> ReproducedBatch:
        local = self._options.runner == "local"
        only = None if len(runs) == len(one.runs) else runs
        options = ReplayOptions(
            self._options.slots,
            only=only,
            runner=self._options.runner,
            engine=one.engine,
            image=one.image,
            earlier=self._earlier,
        )
        try:
            if local and (missing := planned.lacking_packages(self._project, self._store, one)):
                return ReproducedBatch(one, len(runs), None, "; ".join(missing))
            return ReproducedBatch(one, len(runs), replay(self._project, self._store, one.batch, options, self._observer))
        except Damaged:
            raise
        except SierraError as error:
            return ReproducedBatch(one, len(runs), None, planned.reason(error))


def _left_out(plans: Sequence[PlannedBatch], chosen: set[RecordedRun], rests: Mapping[str, Sequence[str]]) -> Iterator[str]:
    """Yield a line for each batch of which runs are left out, and for each claim with experiments of which all are."""
    possible = [run for one in plans if not one.missing for run in one.runs]
    for one in plans:
        left = sum(run not in chosen for run in one.runs)
        if left and not one.missing:
            yield f"batch {short(one.batch)}: the budget leaves out {left:,} of {counted(len(one.runs), 'run')}"
    for name, batches in rests.items():
        if count := budget.untouched(possible, chosen, batches):
            yield f"claim {name}: the budget leaves out all runs of {counted(count, 'experiment')}"

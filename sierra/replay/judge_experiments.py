"""Compare the outputs of replayed runs with the recorded ones, and experiments that differ by metrics."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from sierra.config.deliverable_tables import DerivedTable
from sierra.config.output_tables import Output
from sierra.config.project_file import LoadedProject
from sierra.errors import NotFound
from sierra.model import Status
from sierra.replay import equivalence
from sierra.replay.compare_outputs import compare_all
from sierra.replay.compare_values import Agreement, Verdict
from sierra.replay.equivalence import Metric
from sierra.replay.find_record import Record
from sierra.replay.verdicts import Compared, OfExperiment
from sierra.store.store import Store


def recorded_metrics(
    project: LoadedProject, store: Store, record: Record, declared: Mapping[str, Output]
) -> equivalence.Values | None:
    """Return the values of the recorded runs, by metric; None if experiments cannot be compared by metrics."""
    if not project.config.equivalence or record.found.kind not in ("batch", "experiment"):
        return None
    if not record.whole:
        record.notes.append("equivalence is tested only for whole experiments: replay without --runs")
        return None
    executions = {one.run: str(one.judgement) for one in record.runs}
    tables: dict[str, Output | DerivedTable] = {**project.config.tables, **declared}
    try:
        return equivalence.values(store, record.of.batch, executions, project.config.equivalence, tables)
    except NotFound as error:
        record.notes.append(f"[equivalence]: {error}; no experiment is tested for equivalence")
        return None


def compare_runs(
    record: Record, store: Store, made: Mapping[str, str], failed: Mapping[str, Status], declared: Mapping[str, Output]
) -> Iterator[Compared]:
    """Yield each run with the agreement of its outputs. `made`: the new executions; `failed`: the status of failed runs."""
    done = [one for one in record.runs if one.run not in failed]
    with store.snapshot() as snapshot:
        pairs = [(str(one.judgement), made[one.run]) for one in done]
        for taken, outputs in zip(done, compare_all(snapshot, pairs, declared), strict=True):
            yield Compared(taken, made[taken.run], outputs)
        snapshot.views.make(("executions",))
        for taken in (one for one in record.runs if one.run in failed):
            execution = made[taken.run]
            [(reason,)] = snapshot.run("SELECT reason FROM executions WHERE execution = $e", {"e": execution}) or [("",)]
            yield Compared(taken, execution, {None: Agreement(Verdict.FAILED, reason or failed[taken.run])})


def judge(
    project: LoadedProject,
    store: Store,
    record: Record,
    compared: Sequence[Compared],
    was: equivalence.Values | None,
    declared: Mapping[str, Output],
) -> Iterator[OfExperiment]:
    """Yield each experiment with its runs; by metrics, too, if its runs differ in values. `was`: the recorded metrics."""
    by_place: dict[int, list[Compared]] = {}
    for run in sorted(compared, key=lambda run: (run.taken.ordinal, run.taken.number)):
        by_place.setdefault(run.taken.ordinal, []).append(run)
    stochastic = {place: runs for place, runs in by_place.items() if was is not None and _wavers(runs)}
    now: equivalence.Values = {}
    if stochastic:
        executions = {run.taken.run: str(run.execution) for runs in stochastic.values() for run in runs}
        tables: dict[str, Output | DerivedTable] = {**project.config.tables, **declared}
        try:
            now = equivalence.values(store, record.of.batch, executions, project.config.equivalence, tables)
        except NotFound as error:
            record.notes.append(f"[equivalence]: {error}; the replay has no values to compare")
            now = {name: {} for name in project.config.equivalence}
    for place, runs in by_place.items():
        found: tuple[Metric, ...] = ()
        if place in stochastic and was is not None:
            names = [run.taken.run for run in runs]
            found = tuple(equivalence.compare(project.config.equivalence, was, now, place, names))
        yield OfExperiment(runs[0].taken.experiment, place, record.cells[place], tuple(runs), found)


def _wavers(runs: Sequence[Compared]) -> bool:
    """Check whether runs differ in values only: none failed, and their outputs have the same form."""
    different = [one for run in runs for one in run.outputs.values() if not one.verdict.fine]
    return bool(different) and all(one.verdict is Verdict.DIFFERENT and not one.form for one in different)

"""Compare the outputs of replayed runs with the recorded ones, and experiments that differ by metrics."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from sierra.config.deliverable_tables import DerivedTable
from sierra.config.output_tables import Output, both_spellings
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
    executions = {run.run: str(run.judgement) for run in record.runs if run.status == "ok"}
    tables: dict[str, Output | DerivedTable] = {**project.config.tables, **declared}
    try:
        return equivalence.values(store, record.of.batch, executions, project.config.equivalence, tables)
    except NotFound as error:
        record.notes.append(f"[equivalence]: {error}; no experiment is tested for equivalence")
        return None


class _End(NamedTuple):
    """The end of an execution, by one of its judgements."""

    judgement: str
    status: str
    reason: str | None
    exit_code: int | None
    signal: int | None

    @property
    def words(self) -> str:
        return "success" if self.status == Status.OK else str(self.reason or self.status)

    def is_like(self, other: _End) -> bool:
        """Return whether both ended in the same way; a shell or an engine tells a signal by 128 more."""
        return self.status == other.status and not self._numbers.isdisjoint(other._numbers)

    @property
    def _numbers(self) -> frozenset[int | None]:
        status = self.exit_code if self.signal is None else -self.signal
        return frozenset([status]) if status is None else both_spellings([status])


ENDS = "SELECT judgement, status, reason, exit_code, signal FROM all_judgements SEMI JOIN ends USING (judgement)"


def compare_runs(
    record: Record, store: Store, executions: Mapping[str, str], failed: Mapping[str, Status], declared: Mapping[str, Output]
) -> Iterator[Compared]:
    """Yield each run with the agreement of its outputs, and of its end if it was no success.

    `executions`: the new ones; `failed`: the status of runs that failed now.
    """
    with store.snapshot() as snapshot:
        names = [str(taken.judgement) for taken in record.runs] + [executions[taken.run] for taken in record.runs]
        snapshot.add_table("ends", judgement=names)
        snapshot.views.make(("all_judgements",))
        ends = {end.judgement: end for end in snapshot.select(_End, ENDS)}
        both = ((taken.run, ends[str(taken.judgement)], ends.get(executions[taken.run])) for taken in record.runs)
        whole = {run: _of_end(was, now, failed.get(run)) for run, was, now in both}
        done = [taken for taken in record.runs if (end := whole[taken.run]) is None or end.verdict is Verdict.IDENTICAL]
        pairs = [(str(taken.judgement), executions[taken.run]) for taken in done]
        compared = dict(zip((taken.run for taken in done), compare_all(snapshot, pairs, declared), strict=True))
        for taken in record.runs:
            end = whole[taken.run]
            of_end: dict[str | None, Agreement] = {} if end is None else {None: end}
            yield Compared(taken, executions[taken.run], of_end | compared.get(taken.run, {}))


def _of_end(was: _End, now: _End | None, failed: Status | None) -> Agreement | None:
    """Return how the ends of two executions of a run agree; None if both were successful."""
    if now is None or (failed is not None and Status(was.status).is_result):
        return Agreement(Verdict.FAILED, (now.reason if now else None) or str(failed or "it has no record"))
    if was.status == now.status == Status.OK:
        return None
    if was.is_like(now):
        return Agreement(Verdict.IDENTICAL, f"it ended as before: {now.words}")
    return Agreement(Verdict.DIFFERENT, f"it ended with {was.words} before, and with {now.words} now", form=True)


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
    stochastic = {ordinal: runs for ordinal, runs in by_place.items() if was is not None and _wavers(runs)}
    now: equivalence.Values = {}
    if stochastic:
        of_runs = (run for runs in stochastic.values() for run in runs if run.taken.status == "ok")
        executions = {run.taken.run: str(run.execution) for run in of_runs}
        tables: dict[str, Output | DerivedTable] = {**project.config.tables, **declared}
        try:
            now = equivalence.values(store, record.of.batch, executions, project.config.equivalence, tables)
        except NotFound as error:
            record.notes.append(f"[equivalence]: {error}; the replay has no values to compare")
            now = {name: {} for name in project.config.equivalence}
    for ordinal, runs in by_place.items():
        tested: tuple[Metric, ...] = ()
        if ordinal in stochastic and was is not None:
            names = [run.taken.run for run in runs if run.taken.status == "ok"]
            tested = tuple(equivalence.compare(project.config.equivalence, was, now, ordinal, names))
        yield OfExperiment(runs[0].taken.experiment, ordinal, record.cells[ordinal], tuple(runs), tested)


def _wavers(runs: Sequence[Compared]) -> bool:
    """Check whether runs differ in values only: none failed, and their outputs have the same form."""
    different = [one for run in runs for one in run.outputs.values() if not one.verdict.fine]
    return bool(different) and all(one.verdict is Verdict.DIFFERENT and not one.form for one in different)

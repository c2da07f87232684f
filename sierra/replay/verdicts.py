"""Verdicts of a replay for each output, run and experiment, and their rows in the store."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import asdict, fields
from pathlib import Path

from sierra.config.output_tables import Tolerance
from sierra.execution.build.recorded import Rebuilt
from sierra.model import Value
from sierra.replay.compare_values import Agreement, Verdict, worst
from sierra.replay.equivalence import Metric
from sierra.replay.same_files import UsedFiles
from sierra.stats.equivalence import Tested
from sierra.store.recorded_files import ChosenExecution
from sierra.store.row_types import EquivalenceRow, VerdictRow
from sierra.store.store import ResolvedId
from sierra.util.hashing import short
from sierra.util.lazy_definitions import dataclass

Tolerances = Mapping[str, Mapping[str, Tolerance]]
"""Tolerances by output (`*`: all) and column (`*`: all others)."""


@dataclass(frozen=True, slots=True)
class Compared:
    """One run that was executed again, with the comparison of each output by path. The key None is the run as a whole."""

    taken: ChosenExecution
    execution: str | None
    outputs: Mapping[str | None, Agreement]

    @property
    def verdict(self) -> Verdict:
        return worst(agreement.verdict for agreement in self.outputs.values())


@dataclass(frozen=True, slots=True)
class OfExperiment:
    """Result of one experiment: its runs and, if these are not deterministic, its metrics."""

    id: str
    ordinal: int
    values: Mapping[str, Value | None]
    runs: tuple[Compared, ...]
    metrics: tuple[Metric, ...] = ()

    @property
    def verdict(self) -> Verdict:
        """Return the verdict of the worst run.

        It is `equivalent` instead if values differ and all metrics are the same within their margins.
        """
        found = worst(run.verdict for run in self.runs)
        same = self.metrics and all(metric.equivalent for metric in self.metrics)
        return Verdict.EQUIVALENT if found is Verdict.DIFFERENT and same else found


@dataclass(frozen=True, slots=True)
class Replay:
    """Result of a replay."""

    id: str
    found: ResolvedId
    experiments: tuple[OfExperiment, ...]
    notes: tuple[str, ...]
    """Deviations from the record that were found before the comparison, and other notes."""
    interrupted: bool
    of: int = 0
    """Number of runs that the id names, compared or not."""
    kept: Path | None = None
    """Folder where the restored source and the folders of the runs are kept."""
    built: Rebuilt | None = None
    """The products that were built from the restored source; None without `[build]`."""
    files: UsedFiles | None = None
    """The files that the recorded executions used, compared with those now; None if an image has them."""
    used_gpu: bool = False
    """True if values differ, and the recorded executions used a GPU."""
    sessions: tuple[str, ...] = ()
    """The sessions of the compared executions: its own, and those of earlier replays whose executions count."""

    def _repr_html_(self) -> str:
        from sierra.util import html

        axes = tuple(self.experiments[0].values) if self.experiments else ()
        rows = ((*one.values.values(), len(one.runs), one.verdict) for one in self.experiments)
        title = f"replay of {self.found.kind} {short(self.found.id)}: {self.verdict}"
        return html.page(title, (*axes, "runs", "verdict"), rows, self.notes, total=len(self.experiments))

    @property
    def runs(self) -> tuple[Compared, ...]:
        return tuple(run for experiment in self.experiments for run in experiment.runs)

    @property
    def verdict(self) -> Verdict:
        """Return the verdict of the worst experiment.

        An interrupted replay has failed, because not everything was compared.
        """
        return Verdict.FAILED if self.interrupted else worst(experiment.verdict for experiment in self.experiments)

    @property
    def counts(self) -> Counter[Verdict]:
        """Return the number of runs by verdict."""
        return Counter(run.verdict for run in self.runs)

    @property
    def outputs(self) -> dict[str, Verdict]:
        """Return the worst verdict of each output."""
        found: dict[str, list[Verdict]] = {}
        for run in self.runs:
            for path, agreement in run.outputs.items():
                if path is not None:
                    found.setdefault(path, []).append(agreement.verdict)
        return {path: worst(verdicts) for path, verdicts in sorted(found.items())}


def plain(tolerances: Tolerances) -> dict[str, dict[str, dict[str, float]]]:
    """Return tolerances as JSON values."""
    return {name: {c: t.model_dump(exclude_defaults=True) for c, t in of.items()} for name, of in tolerances.items()}


def verdict_rows(replay: str, run: Compared) -> Iterator[VerdictRow]:
    """Yield the rows of `verdicts` for one run."""
    for path, agreement in run.outputs.items():
        yield VerdictRow(
            replay=replay,
            run=run.taken.run,
            recorded=str(run.taken.execution),
            execution=run.execution,
            path=path,
            verdict=agreement.verdict,
            reason=agreement.reason,
            row=agreement.row,
            column=agreement.column,
            recorded_value=agreement.recorded_value,
            replayed_value=agreement.replayed_value,
            max_abs=agreement.max_abs,
            max_rel=agreement.max_rel,
            max_ulp=agreement.max_ulp,
        )


def metric_rows(replay: str, experiment: OfExperiment) -> Iterator[EquivalenceRow]:
    """Yield the rows of `equivalences` for one experiment."""
    for metric in experiment.metrics:
        tested = asdict(metric.tested) if metric.tested else dict.fromkeys(field.name for field in fields(Tested))
        yield EquivalenceRow(
            replay=replay,
            experiment=experiment.id,
            metric=metric.name,
            output=metric.declared.table,
            column=metric.declared.column,
            measure=metric.declared.measure,
            recorded_mean=metric.recorded_mean,
            replayed_mean=metric.replayed_mean,
            reason=metric.reason,
            **tested | {"equivalent": metric.equivalent},
        )

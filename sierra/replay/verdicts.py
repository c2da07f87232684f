"""What a replay found: of each output, run and experiment, and as the store keeps it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from sierra.config.project_file import Tolerance
from sierra.replay.compare import Agreement, Verdict, worst
from sierra.replay.equivalence import Metric
from sierra.store.files import Taken
from sierra.store.store import Found

Tolerances = Mapping[str, Mapping[str, Tolerance]]
"""By output (`*`: all) and column (`*`: all others)."""


@dataclass(frozen=True, slots=True)
class Compared:
    """One run, executed again: its outputs by path, each with how far it agrees. The key None is the run as a whole."""

    taken: Taken
    execution: str | None
    outputs: Mapping[str | None, Agreement]

    @property
    def verdict(self) -> Verdict:
        return worst(agreement.verdict for agreement in self.outputs.values())


@dataclass(frozen=True, slots=True)
class OfExperiment:
    """What came of one experiment: its runs, and, where these are not deterministic, its metrics."""

    id: str
    ordinal: int
    values: Mapping[str, Any]
    runs: tuple[Compared, ...]
    metrics: tuple[Metric, ...] = ()

    @property
    def verdict(self) -> Verdict:
        """That of its worst run; or equivalent, where values differ and all metrics are the same within their margins."""
        found = worst(run.verdict for run in self.runs)
        same = self.metrics and all(metric.equivalent for metric in self.metrics)
        return Verdict.EQUIVALENT if found is Verdict.DIFFERENT and same else found


@dataclass(frozen=True, slots=True)
class Replay:
    """The answer to a replay."""

    id: str
    found: Found
    experiments: tuple[OfExperiment, ...]
    notes: tuple[str, ...]
    """What is other than it was recorded, before any verdict."""
    interrupted: bool
    of: int = 0
    """How many runs the id names, compared or not."""
    kept: Path | None = None
    """Where the restored source and the folders of the runs are left."""

    @property
    def runs(self) -> tuple[Compared, ...]:
        return tuple(run for experiment in self.experiments for run in experiment.runs)

    @property
    def verdict(self) -> Verdict:
        """That of the worst experiment. Nothing is said of what was not compared: a replay that was interrupted has failed."""
        return Verdict.FAILED if self.interrupted else worst(experiment.verdict for experiment in self.experiments)

    @property
    def counts(self) -> Counter[Verdict]:
        """Runs, by verdict."""
        return Counter(run.verdict for run in self.runs)

    @property
    def outputs(self) -> dict[str, Verdict]:
        """The worst verdict of each output."""
        found: dict[str, list[Verdict]] = {}
        for run in self.runs:
            for path, agreement in run.outputs.items():
                if path is not None:
                    found.setdefault(path, []).append(agreement.verdict)
        return {path: worst(verdicts) for path, verdicts in sorted(found.items())}


def plain(tolerances: Tolerances) -> dict[str, Any]:
    """Tolerances as JSON has them."""
    return {name: {c: t.model_dump(exclude_defaults=True) for c, t in of.items()} for name, of in tolerances.items()}


def verdict_rows(replay: str, run: Compared) -> Iterator[dict[str, Any]]:
    """The records of `verdicts` for one run."""
    for path, agreement in run.outputs.items():
        yield {
            "replay": replay,
            "run": run.taken.run,
            "recorded": run.taken.execution,
            "execution": run.execution,
            "path": path,
            "verdict": str(agreement.verdict),
            "why": agreement.why,
            "row": agreement.row,
            "column": agreement.column,
            "was": agreement.recorded,
            "found": agreement.found,
            "abs": agreement.abs,
            "rel": agreement.rel,
            "ulp": agreement.ulp,
        }


def metric_rows(replay: str, experiment: OfExperiment) -> Iterator[dict[str, Any]]:
    """The records of `equivalences` for one experiment."""
    for metric in experiment.metrics:
        yield {
            "replay": replay,
            "experiment": experiment.id,
            "metric": metric.name,
            "output": metric.declared.table,
            "column": metric.declared.column,
            "measure": metric.declared.measure,
            "was": metric.was,
            "found": metric.now,
            "why": metric.why,
            **({} if metric.tested is None else asdict(metric.tested)),
            "equivalent": metric.equivalent,
        }

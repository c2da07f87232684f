"""Recorded runs as lines of JSON that `sierra.worker.package_plan` reads: what to execute, and the hashes of the outputs."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from glob import escape
from pathlib import Path
from typing import Any, NamedTuple

from sierra.config.output_tables import Output
from sierra.config.project_file import LoadedProject
from sierra.containers import engines
from sierra.containers.images.image import Image
from sierra.execution import plan_from_record, run_limits
from sierra.execution.commands import CommandBuilder
from sierra.execution.plan_from_record import Recalled
from sierra.ingest.rewriting import is_compressed
from sierra.model import Run
from sierra.replay.pair_files import has_open_names
from sierra.runners import local
from sierra.store.recorded_files import ChosenExecution
from sierra.store.store import Store
from sierra.templates.base import Files
from sierra.worker import package_plan

AT_A_TIME = 2048
"""The number of runs whose hashes of outputs are in memory at a time."""
IN_A_PART = 20_000
"""The number of runs whose executions are determined at a time: DuckDB needs about 1 kB for each."""
AFTER = "g"
"""A text that comes after all ids."""
OF_SESSION = ("SIERRA_SESSION", "SIERRA_EXECUTION")
"""Variables of runs that are different in each execution."""
OLDER_PART = "[-._]*"
"""A pattern for the ends of the names of older parts of a rotated file."""
EFFECTIVE = """
SELECT * FROM (
    SELECT DISTINCT ON (f.run) f.ordinal, m.number, f.run, m.seed, f.judgement, e.wall_s,
        CASE WHEN f.status = 'ok' THEN NULL WHEN e.signal IS NULL THEN e.exit_code ELSE -e.signal END AS ended
    FROM ended f JOIN batch_runs m USING (batch, ordinal, run) JOIN all_judgements e ON e.judgement = f.judgement
    WHERE f.batch = $b AND f.run >= $first AND f.run < $end ORDER BY f.run, f.ordinal, m.number
) ORDER BY ordinal, number
"""
"""SQL: a part of the runs of a batch with an execution that can be repeated, each once, in order."""
COUNT = "SELECT count(DISTINCT run) FROM batch_runs WHERE batch = $b"
OUTPUTS = """
SELECT a.execution, a.path, a.sha256, a.output FROM all_artifacts a SEMI JOIN some_runs USING (execution)
WHERE a.kind <> 'log' QUALIFY row_number() OVER (PARTITION BY a.execution, a.path ORDER BY a.output) = 1 ORDER BY ALL
"""
"""SQL: the files that some executions left, without logs."""


class Taken(NamedTuple):
    """A run with an execution that can be repeated."""

    ordinal: int
    number: int
    run: str
    seed: int
    judgement: str
    wall_s: float
    ended: int | None
    """The exit status, negative for a signal, if it was no success; None if it was."""


class _Left(NamedTuple):
    execution: str
    path: str
    sha256: str
    output: str | None


def count(store: Store, batch: str) -> int:
    """Return the number of all runs of a batch."""
    [of] = store.values(int, COUNT, b=batch)
    return of


class Jobs:
    """Writer of the jobs of a batch."""

    def __init__(self, store: Store, project: LoadedProject, recalled: Recalled, image: Image | None) -> None:
        root = Path(package_plan.PROJECT_MARK)
        limits = run_limits.recorded(project.config, store, recalled.batch)
        self._store = store
        self._builder = CommandBuilder(
            recalled.spec,
            root,
            engines.find("none"),
            limits,  # execute_runs.py adds the variables for GPUs
            "",
            root,
            image=image,
            success=sorted(recalled.success.statuses),
            accept=sorted(recalled.success.accepted_statuses),
            timeouts={name: table.timeout for name, table in project.config.services.items()},
            python=package_plan.PYTHON_MARK,
            arch=package_plan.ARCH_MARK,
        )
        self.limits = local.limits(limits.most)
        """The largest limits of all runs; the lines have those that differ from them."""

        own_path = image is not None or "PATH" in recalled.spec.environment
        self._left_out = OF_SESSION if own_path else (*OF_SESSION, "PATH")
        self._declared = {**recalled.outputs, **project.config.outputs}
        self._equivalence = bool(project.config.equivalence)
        self.environment: Mapping[str, str] = {}
        """The variables of the first run; the lines have those that differ from them."""
        self.by_value: dict[str, str] = {}
        """The reason why an output's bytes may differ legitimately, by path."""

        self.runs = 0
        self.seconds = 0.0
        """The number of runs that were executed successfully, and the sum of their durations in seconds."""

    @property
    def patterns(self) -> dict[str, list[str]]:
        """Return the patterns of outputs whose names may differ, and the names that other outputs have."""
        declared = [out.model_copy(update={"file": out.archive}) if out.archive else out for out in self._declared.values()]
        unnumbered = [out for out in declared if has_open_names(out) and not out.ticks]
        patterns = [f"{escape(out.base)}{OLDER_PART}" if out.rotated else out.base for out in unnumbered]
        named = [out.base for out in declared if out.rotated or not has_open_names(out)]
        return {"patterns": patterns, "named": named} if patterns else {}

    def write(self, batch: str, path: Path) -> None:
        """Write the line of each run of a batch that can be repeated. Raises Damaged if the store lacks an input."""
        with path.open("w", encoding="utf-8", newline="\n") as file:
            for line in self._lines(batch):
                file.write(json.dumps(line, ensure_ascii=False, separators=(",", ":")) + "\n")
                self.runs += 1
                self.seconds += line["seconds"]

    def _lines(self, batch: str) -> Iterator[dict[str, Any]]:
        before: dict[str, str] = {}
        for some in _in_groups(self._store, batch):
            left = _outputs(self._store, some)
            for run, files in zip(some, _inputs(self._store, some), strict=True):
                texts = {name: content.decode("latin-1") for name, content in files}
                outputs = left.get(run.judgement, ())
                yield self._line(run, files) | {
                    "files": {name: package_plan.changes(before.get(name), text) for name, text in texts.items()},
                    "outputs": {each.path: each.sha256 for each in outputs},
                }
                before = texts
                self.by_value.update({each.path: reason for each in outputs if (reason := self._reason(each))})

    def _line(self, run: Taken, files: Files) -> dict[str, Any]:
        job = self._builder.job(Run(run.run, run.ordinal, run.number, run.seed, (), b""), files)
        variables = {name: value for name, value in job.environment.items() if name not in self._left_out}
        self.environment = self.environment or variables
        names = {*variables, *self.environment}
        line = {
            "run": run.run,
            "experiment": run.ordinal,
            "number": run.number,
            "seconds": round(run.wall_s, 3),
            "argv": job.argv,
            "environment": {
                name: variables.get(name) for name in sorted(names) if variables.get(name) != self.environment.get(name)
            },
        }
        limits = local.limits(job.limits)
        own = {name: limit for name, limit in limits.items() if limit != self.limits.get(name)}
        line |= {"limits": own} if own else {}
        line |= {"ended": run.ended} if run.ended is not None else {}
        return line | ({"folders": dict(job.folders)} if job.folders else {})

    def _reason(self, left: _Left) -> str:
        """Return why the bytes of an output may differ legitimately; "" if they may not."""
        rules = self._declared.get(left.output or "") or next(
            (output for output in self._declared.values() if output.matches(left.path)), None
        )
        if rules and (declared := _declared(rules)):
            return declared
        return "[equivalence] compares means" if self._equivalence else ""


def _declared(rules: Output) -> str:
    """Return the declaration by which different bytes of an output count as equal; "" if there is none."""
    if rules.lines:
        return "lines: other lines may differ"
    if rules.volatile:
        return f"volatile: {', '.join(rules.volatile)}"
    if rules.tolerance:
        return f"tolerance: {', '.join(rules.tolerance)}"
    if rules.archive or is_compressed(rules.base):
        return "compressed: the file may have the time when it was written"
    return "" if rules.ordered else "ordered = false"


def _in_groups(store: Store, batch: str) -> Iterator[list[Taken]]:
    """Yield the runs of a batch that can be repeated, some at a time."""
    for first, end in itertools.pairwise(_bounds(count(store, batch) // IN_A_PART + 1)):
        with store.snapshot() as snapshot:
            snapshot.views.make(("ended", "batch_runs", "all_judgements"))
            rows = snapshot.each(EFFECTIVE, {"b": batch, "first": first, "end": end})
            while some := [Taken(*row) for row in itertools.islice(rows, AT_A_TIME)]:
                yield some


def _bounds(parts: int) -> list[str]:
    """Return the bounds of so many parts of all ids. Ids are hashes, so that the parts are about equal.

    DuckDB uses bounds when it reads the records; a condition on a hash of the id would be checked after all runs are known.
    """
    return ["", *(f"{part * 16**4 // parts:04x}" for part in range(1, parts)), AFTER]


def _outputs(store: Store, some: Sequence[Taken]) -> dict[str, list[_Left]]:
    left: dict[str, list[_Left]] = {}
    with store.snapshot() as snapshot:
        snapshot.views.make(("all_artifacts",))
        snapshot.add_table("some_runs", execution=[run.judgement for run in some])
        for row in snapshot.select(_Left, OUTPUTS):
            left.setdefault(row.execution, []).append(row)
    return left


def _inputs(store: Store, some: Sequence[Taken]) -> Iterator[Files]:
    chosen = (ChosenExecution("", one.ordinal, one.number, one.run, None, None, "none") for one in some)
    for _, files in plan_from_record.inputs(store, chosen):
        yield files

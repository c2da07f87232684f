"""Recorded runs as lines of JSON that `sierra.packages.execute_runs` reads: what to execute, and the hashes of the outputs."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from sierra.config.output_tables import Output
from sierra.config.project_file import LoadedProject
from sierra.containers import engines
from sierra.containers.images.image import Image
from sierra.execution import commands, plan_from_record
from sierra.execution.commands import CommandBuilder
from sierra.execution.plan_from_record import Recalled
from sierra.model import Run
from sierra.packages import execute_runs
from sierra.store.recorded_files import ChosenExecution
from sierra.store.store import Snapshot, Store
from sierra.templates.base import Files

AT_A_TIME = 4096
"""The number of runs whose hashes of outputs are in memory at a time."""
OF_SESSION = ("SIERRA_SESSION", "SIERRA_EXECUTION")
"""Variables of runs that are different in each execution."""
EFFECTIVE = """
SELECT f.ordinal, m.number, f.run, m.seed, f.judgement, e.wall_s
FROM effective f JOIN batch_runs m USING (batch, ordinal, run) JOIN all_judgements e ON e.judgement = f.judgement
WHERE f.batch = $b ORDER BY ALL
"""
"""SQL: the runs of a batch with a successful execution, in order."""
RULES = """
SELECT DISTINCT e.programs, e.ingest_rules FROM effective f JOIN all_judgements e ON e.judgement = f.judgement
WHERE f.batch = $b ORDER BY ALL
"""
"""SQL: the sets of programs and rules of these executions."""
OUTPUTS = """
SELECT a.execution, a.path, a.sha256, a.output FROM all_artifacts a SEMI JOIN some_runs USING (execution)
WHERE a.kind <> 'log' ORDER BY ALL
"""
"""SQL: the files that some executions left, without logs."""


class Taken(NamedTuple):
    """A run with a successful execution."""

    ordinal: int
    number: int
    run: str
    seed: int
    judgement: str
    wall_s: float


class Rules(NamedTuple):
    """A set of programs, and the rules by which outputs were evaluated."""

    programs: str
    ingest_rules: str


class Runs(NamedTuple):
    """The runs of a batch that were executed successfully, with their programs and rules, and the number of all its runs."""

    taken: Sequence[Taken]
    rules: Sequence[Rules]
    of: int


class _Left(NamedTuple):
    execution: str
    path: str
    sha256: str
    output: str | None


def runs(store: Store, batch: str) -> Runs:
    """Return the runs of a batch, each once."""
    with store.snapshot() as snapshot:
        snapshot.views.make(("effective", "batch_runs", "all_judgements"))
        taken = {one.run: one for one in snapshot.select(Taken, EFFECTIVE, b=batch)}
        [of] = snapshot.values(int, "SELECT count(DISTINCT run) FROM batch_runs WHERE batch = $b", b=batch)
        rules = snapshot.select(Rules, RULES, b=batch)
    return Runs(list(taken.values()), rules, of)


class Jobs:
    """Writer of the jobs of a batch."""

    def __init__(self, store: Store, project: LoadedProject, recalled: Recalled, image: Image | None) -> None:
        place = Path(execute_runs.PROJECT_MARK)
        self._store = store
        self._builder = CommandBuilder(
            recalled.spec,
            place,
            engines.find("none"),
            commands.limits(project.config),
            "",
            place,
            image=image,
            success=recalled.success.exit_status,
            timeouts={name: table.timeout for name, table in project.config.services.items()},
            python=execute_runs.PYTHON_MARK,
        )
        own_path = image is not None or "PATH" in recalled.spec.environment
        self._left_out = OF_SESSION if own_path else (*OF_SESSION, "PATH")
        self._declared = {**recalled.outputs, **project.config.outputs}
        self._equivalence = bool(project.config.equivalence)
        self.environment: Mapping[str, str] = {}
        """The variables of the first run; the lines have those that differ from them."""
        self.by_value: dict[str, str] = {}
        """The reason why an output's bytes may differ legitimately, by path."""

    def write(self, taken: Sequence[Taken], path: Path) -> None:
        """Write the line of each run. Raises Damaged if the store lacks an input."""
        with path.open("w", encoding="utf-8", newline="\n") as file:
            for line in self._lines(taken):
                file.write(json.dumps(line, ensure_ascii=False, separators=(",", ":")) + "\n")

    def _lines(self, taken: Sequence[Taken]) -> Iterator[dict[str, Any]]:
        before: dict[str, str] = {}
        with self._store.snapshot() as snapshot:
            snapshot.views.make(("all_artifacts",))
            for some in (taken[place : place + AT_A_TIME] for place in range(0, len(taken), AT_A_TIME)):
                left = _outputs(snapshot, some)
                for one, files in zip(some, _inputs(self._store, some), strict=True):
                    texts = {name: content.decode("latin-1") for name, content in files}
                    yield self._line(one, files) | {
                        "files": {name: execute_runs.changes(before.get(name), text) for name, text in texts.items()},
                        "outputs": {each.path: each.sha256 for each in left.get(one.judgement, ())},
                    }
                    before = texts
                    for each in left.get(one.judgement, ()):
                        if reason := self._reason(each):
                            self.by_value[each.path] = reason

    def _line(self, one: Taken, files: Files) -> dict[str, Any]:
        job = self._builder.job(Run(one.run, one.ordinal, one.number, one.seed, (), b""), files)
        variables = {name: value for name, value in job.environment.items() if name not in self._left_out}
        self.environment = self.environment or variables
        names = {*variables, *self.environment}
        line = {
            "run": one.run,
            "experiment": one.ordinal,
            "number": one.number,
            "seconds": round(one.wall_s, 3),
            "argv": job.argv,
            "environment": {
                name: variables.get(name) for name in sorted(names) if variables.get(name) != self.environment.get(name)
            },
        }
        return line | ({"folders": dict(job.folders)} if job.folders else {})

    def _reason(self, left: _Left) -> str:
        """Return why the bytes of an output may differ legitimately; "" if they may not."""
        rules = self._declared.get(left.output or "") or next(
            (one for one in self._declared.values() if one.matches(left.path)), None
        )
        if rules and (declared := _declared(rules)):
            return declared
        return "[equivalence] compares means" if self._equivalence else ""


def _declared(rules: Output) -> str:
    """Return what an output declares so that different bytes may be equal; "" if nothing."""
    if rules.volatile:
        return f"volatile: {', '.join(rules.volatile)}"
    if rules.tolerance:
        return f"tolerance: {', '.join(rules.tolerance)}"
    return "" if rules.ordered else "ordered = false"


def _outputs(snapshot: Snapshot, some: Sequence[Taken]) -> dict[str, list[_Left]]:
    snapshot.add_table("some_runs", execution=[one.judgement for one in some])
    left: dict[str, list[_Left]] = {}
    for row in snapshot.select(_Left, OUTPUTS):
        left.setdefault(row.execution, []).append(row)
    return left


def _inputs(store: Store, some: Sequence[Taken]) -> Iterator[Files]:
    chosen = (ChosenExecution("", one.ordinal, one.number, one.run, None, None, "none") for one in some)
    for _, files in plan_from_record.inputs(store, chosen):
        yield files

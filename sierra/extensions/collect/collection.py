"""Collecting: the runs of a folder are compared with their plan, and those that have ended are recorded.

A run counts only if its input files and its command are, byte for byte, those that SIERRA would write now. Which programs have
executed it is unknown. Therefore its execution has a set of programs of its own, so that it is never reused for one that was
executed here: statistics use either the one or the other, by the last session of the batch. With `trust`, it has the programs
of this machine.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from sierra.api import Project
from sierra.api.execution import described, drawn
from sierra.api.noun import observer_for
from sierra.config.extensions import giving
from sierra.containers import engines
from sierra.design.query import query_request
from sierra.design.query.query_request import RequestFile
from sierra.errors import Missing, SierraError, UsageError
from sierra.execution import execute, shared_files
from sierra.execution.observer import Observer
from sierra.execution.plan import Plan, context, session_step
from sierra.execution.run_options import RunOptions
from sierra.execution.summary import Summary
from sierra.execution.write_inputs import ENDED, PLACES, REQUEST, command_builder, own_places, run_files, run_folder
from sierra.extensions.collect.folder import Ended, Refused, files_left, has_ended, read, read_ended
from sierra.extensions.collect.runner import NAME, EndedRun, Source, execution_of
from sierra.provenance.dependency_model import Kind, Program, Programs
from sierra.store.row_types import SharedFileRow
from sierra.store.store import Store
from sierra.util.hashing import sha256, short
from sierra.util.lazy_definitions import dataclass, replace
from sierra.util.text import size

MOST_REQUEST = 1 << 20
"""The size of `batch.json`, at most."""
ELSEWHERE = Programs((Program("programs of another system", "", "unknown", Kind.DISTRIBUTIONS),))
"""The programs of executions that are not trusted. This kind is not taken for a file of this machine."""
GOOD = "SELECT execution, status FROM executions WHERE list_contains($e, execution)"


@dataclass(frozen=True, slots=True)
class Collection:
    """The runs of a folder, by what became of them. Folders of runs are relative to it."""

    folder: Path
    batch: str
    runs: int
    """Number of runs in the folder."""
    ended: int
    """Number of runs among them that have ended, and whose inputs and commands are right."""
    known: int
    """Number of these that were recorded before."""
    failed: int
    """Number of these that were not successful, now or before."""
    waiting: tuple[str, ...]
    """The folders of runs that have not ended."""
    refused: Mapping[str, str]
    """The folders of runs that have ended but are not recorded, each with the reason."""
    summary: Summary | None
    """The summary of the session; None if there was nothing to record."""
    notes: tuple[str, ...] = ()


class _Recorded(NamedTuple):
    execution: str
    status: str


def collect(
    project: Project, folder: Path, *, trust: bool, figures: bool, observer: Observer | None, progress: bool | None
) -> Collection:
    """Record the runs of a folder that have ended: see `sierra.extensions.collect.collect`."""
    root = folder.absolute()
    asked, places = _request(root)
    observer = observer or observer_for(progress)
    plan = _plan(project, asked, root, observer)
    _check(plan)
    rows = _beside(plan, project.stored())
    examined = _Examined(root, plan, places, rows)
    executing = _executing(project, plan, observer, trust=trust)
    rules = context(executing).ingest_rules
    ended = {
        run: EndedRun(name, record, execution_of(run, record, executing.programs.id, rules))
        for run, (name, record) in examined.ended.items()
    }
    stored = project.stored()
    before = _recorded(stored, ended) if stored else {}
    new = {run: record for run, record in ended.items() if record.execution not in before}
    summary = None
    if ended:
        beside = frozenset(row.name for row in rows)
        source = Source(root, new, beside, _statuses(plan), plan.batch.spec.image, plan.environment._asdict())
        options = RunOptions(1, NAME, only=frozenset(new), observer=observer, retry=True)
        store = Store.create(project.paths.store)
        with giving(source):
            summary = described(project, execute.run(executing, store, options))
        summary = drawn(project, summary) if figures else summary
        before = _recorded(store, ended)
    return Collection(
        folder,
        plan.batch.id,
        examined.runs,
        len(ended),
        len(ended) - len(new),
        sum(status not in ("ok", "accepted") for status in before.values()),
        tuple(examined.waiting),
        examined.refused,
        summary,
        tuple(_notes(plan)),
    )


def _request(root: Path) -> tuple[RequestFile, Mapping[str, str]]:
    """Return the request in a folder, and the texts of the machine that wrote it. Raises Missing, UsageError."""
    path = root / REQUEST
    try:
        data = read(root, REQUEST, MOST_REQUEST)
    except OSError as error:
        raise Missing(f"{path}: cannot be read: {error.strerror}; name a folder that sierra run --inputs wrote") from error
    if len(data) > MOST_REQUEST:
        raise UsageError(f"{path}: larger than {MOST_REQUEST} bytes; name a folder that sierra run --inputs wrote")
    asked, content = query_request.parse(data, path)
    if asked.batch is None:
        raise UsageError(f"{path}: has no id of a batch; name a folder that sierra run --inputs wrote")
    places = {name: content.get(name) for name in PLACES}
    return asked, {name: text for name, text in places.items() if isinstance(text, str) and "\0" not in text}


def _plan(project: Project, asked: RequestFile, root: Path, observer: Observer) -> Plan:
    """Return the plan of the batch of a folder, by the current code or else as it is recorded.

    Raises UsageError for the batch of another project, or of other code, and the errors of `Project.plan`.
    """
    batch, store = str(asked.batch), project.stored()
    recorded = store is not None and store.values(str, "SELECT batch FROM batches WHERE batch = $b LIMIT 1", b=batch)
    with contextlib.suppress(*([SierraError] if recorded else [])):
        plan = project.plans.resolve(asked.request, observer=observer)
        if plan.batch.id == batch:
            return plan
        if not recorded:
            raise UsageError(
                f"{root / REQUEST}: the query is batch {short(plan.batch.id)} now, and was batch {short(batch)}; "
                "use the code and sierra.toml with which the folder was written"
            )
    return project.plan(batch)


def _check(plan: Plan) -> None:
    """Raise UsageError if the runs of a plan cannot be collected."""
    if plan.batch.spec.robots is not None:
        raise UsageError("runs on robots cannot be collected; execute them with --on robots")
    if step := session_step(plan.project):
        raise UsageError(f"{step.runs} cannot be collected; execute them with sierra run")


def _beside(plan: Plan, store: Store | None) -> tuple[SharedFileRow, ...]:
    """Return the files beside the inputs of runs."""
    if plan.shared_files or plan.batch.spec.shared_files is None or store is None:
        return plan.shared_files
    return tuple(shared_files.recorded(store, plan.batch.spec.shared_files))


class _Examined:
    """The runs of a folder, compared with their plan."""

    def __init__(self, root: Path, plan: Plan, places: Mapping[str, str], beside: tuple[SharedFileRow, ...]) -> None:
        self._root, self._plan, self._beside = root, plan, beside
        self._builder = command_builder(plan, {**own_places(plan), **places})
        self.runs = 0
        self.waiting: list[str] = []
        self.refused: dict[str, str] = {}
        self.ended: dict[str, tuple[str, Ended]] = {}
        """The folder and the record of each run, by id."""
        self._find_ended()
        self._compare()

    def _find_ended(self) -> None:
        for run in self._plan.batch.runs:
            name = run_folder(self._plan.batch, run)
            if not (self._root / name).is_dir():
                continue
            self.runs += 1
            if not has_ended(self._root, name):
                self.waiting.append(name)
                continue
            try:
                record = read_ended(self._root, name)
                if record.run != run.id:
                    raise Refused(f"{ENDED} is of run {short(record.run)!r}, and this is the folder of run {short(run.id)}")
                self.ended.setdefault(run.id, (name, record))
            except Refused as error:
                self.refused[name] = str(error)

    def _compare(self) -> None:
        """Refuse the runs whose input files or commands differ from the plan's, and those whose outputs cannot be read."""
        for run, files in self._plan.inputs.files(self._plan.batch, lambda run: run.id in self.ended):
            known = self.ended.get(run.id)
            if known is None:
                continue
            try:
                self._compare_run(known[0], run_files(self._builder.job(run, files), self._plan))
                self._measure(known[0])
            except Refused as error:
                self.refused[known[0]] = str(error)
                del self.ended[run.id]

    def _compare_run(self, folder: str, expected: Mapping[str, bytes]) -> None:
        for name, content in expected.items():
            if self._content(folder, name, len(content)) != content:
                raise Refused(f"{name} is not as sierra run --inputs wrote it")
        for row in self._beside:
            if sha256(self._content(folder, row.name, row.size)) != row.sha256:
                raise Refused(f"{row.name} is not as sierra run --inputs wrote it")

    def _content(self, folder: str, name: str, most: int) -> bytes:
        try:
            return read(self._root, f"{folder}/{name}", most)
        except OSError as error:
            raise Refused(f"{name} cannot be read: {error.strerror}") from error

    def _measure(self, folder: str) -> None:
        """Check that the outputs can be read, and are not larger than the limit. Raises Refused."""
        most, left = self._plan.limits.output_bytes, 0
        for _, file in files_left(self._root, folder):
            left += file.seek(0, 2) if file else 0
        if most is not None and left > most:
            raise Refused(f"its outputs have {size(left)}, more than output in [limits] allows")


def _executing(project: Project, plan: Plan, observer: Observer, *, trust: bool) -> Plan:
    """Return the plan by which the runs are recorded: nothing is executed here, and nothing is observed."""
    if trust:
        plan.check_programs()
        plan = project.plans.build(plan, observer=observer)
    settings = {"observe": "none"} if trust else {"observe": "none", "requires": ()}
    loaded = replace(plan.project, config=plan.project.config.model_copy(update=settings))
    plan = replace(plan, project=loaded, engine=engines.find("none"), image=None, checkout=None)
    return plan if trust else replace(plan, programs=ELSEWHERE, build=None, lacking="")


def _recorded(store: Store, ended: Mapping[str, EndedRun]) -> dict[str, str]:
    """Return the status of those executions that are recorded."""
    return dict(store.select(_Recorded, GOOD, e=[run.execution for run in ended.values()]))


def _statuses(plan: Plan) -> frozenset[int]:
    return frozenset((*plan.success.statuses, *plan.success.accepted_statuses))


def _notes(plan: Plan) -> Iterator[str]:
    if plan.image is not None:
        yield f"the commands are for the image {plan.image.name}; it is not known whether the other system used it"

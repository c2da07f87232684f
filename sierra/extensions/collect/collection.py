"""Collecting: the runs of a folder are compared with their plan, and those that have ended are recorded.

A run counts only if its input files and its command are, byte for byte, those that SIERRA would write now. Which programs have
executed it is unknown. Therefore its execution has a set of programs of its own, so that it is never reused for one that was
executed here: statistics use either the one or the other, by the last session of the batch. With `trust`, it has the programs
of this machine.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from collections.abc import Set as AbstractSet
from pathlib import Path
from typing import NamedTuple

from sierra.api import Project
from sierra.api.execution import described, drawn
from sierra.api.noun import observer_for
from sierra.config.extensions import giving
from sierra.containers import engines
from sierra.design.query import query_request
from sierra.design.query.query_request import RequestFile
from sierra.errors import Damaged, Missing, SierraError, UsageError
from sierra.execution import execute, recover, reuse, sessions, shared_files
from sierra.execution.observer import Observer
from sierra.execution.plan import Plan, context, session_step
from sierra.execution.run_options import RunOptions
from sierra.execution.summary import Summary
from sierra.execution.write_inputs import ENDED, PLACES, REQUEST, command_builder, own_places, run_files, run_folder
from sierra.extensions.collect.folder import Ended, Refused, files_left, has_ended, logs_left, read, read_ended
from sierra.extensions.collect.runner import NAME, EndedRun, Source, execution_of
from sierra.ingest.recording_context import Context
from sierra.provenance.change_guard import ChangeGuard
from sierra.provenance.dependency_model import Kind, Program, Programs
from sierra.store.layout import SessionPaths
from sierra.store.row_types import SharedFileRow
from sierra.store.store import Store
from sierra.util.hashing import sha256, short
from sierra.util.lazy_definitions import dataclass, replace
from sierra.util.text import counted, size

MOST_REQUEST = 1 << 20
"""The size of `batch.json`, at most."""
ELSEWHERE = Programs((Program("programs of another system", "", "unknown", Kind.DISTRIBUTIONS),))
"""The programs of executions that are not trusted. This kind is not taken for a file of this machine."""
STATUSES = """
SELECT execution, arg_max(status, (ingest_rules = $rules, place, judgement)) AS status
FROM all_judgements WHERE list_contains($e, execution) GROUP BY execution
"""
ELSEWHERE_NOW = "another session has executed the run meanwhile; collect it again"


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
    beside = frozenset(row.name for row in rows)
    source = Source(root, beside, _statuses(plan), plan.batch.spec.image, plan.environment._asdict())
    summary, known, failed = None, 0, 0
    if examined.ended:
        executing = _executing(project, plan, observer, trust=trust)
        summary, known, failed = _record(project, executing, examined.ended, source, observer)
        summary = drawn(project, summary) if figures else summary
    return Collection(
        folder,
        plan.batch.id,
        examined.runs,
        examined.right - len(source.refused),
        known,
        failed,
        tuple(examined.waiting),
        {**examined.refused, **source.refused},
        summary,
        tuple(_notes(plan)),
    )


def _record(
    project: Project, plan: Plan, folders: Mapping[str, tuple[str, Ended]], source: Source, observer: Observer
) -> tuple[Summary, int, int]:
    """Record the runs in these folders; return the summary, the number of those recorded before, and of unsuccessful ones.

    Those that could not be recorded are refused in `source`. Raises Missing if another session executes them.
    """
    store = Store.create(project.paths.store)
    recover.finish_dead(store, observer)
    ended = _executions(plan, store, folders)
    known = _recorded(store, plan, ended)
    source.runs.update({run: record for run, record in ended.items() if record.execution not in known})
    new = source.runs.keys() | ()
    _check_sessions(store, new, plan)
    options = RunOptions(1, NAME, only=ended.keys(), observer=observer, retry=True)
    with giving(source):
        summary = described(project, execute.run(plan, store, options))
    recorded = _recorded(store, plan, ended)
    now = reuse.states(plan, store)
    for run in sorted(new) if not summary.interrupted else ():
        if ended[run].execution not in recorded and not now[run].succeeded:
            source.refused.setdefault(ended[run].folder, ELSEWHERE_NOW)
    return summary, len(known), sum(status not in ("ok", "accepted") for status in recorded.values())


def _executions(plan: Plan, store: Store, folders: Mapping[str, tuple[str, Ended]]) -> dict[str, EndedRun]:
    """Return the runs to record, by id. An execution that the present rules cannot evaluate again is recorded once more."""
    programs, rules = plan.programs.id, context(plan).ingest_rules
    ended = {run: EndedRun(name, record, execution_of(run, record, programs)) for run, (name, record) in folders.items()}
    known = _recorded(store, plan, ended)
    states = reuse.foreseen(plan, store, reuse.states(plan, store)) if known else {}
    return {
        run: replace(record, execution=execution_of(run, record.record, programs, rules))
        if record.execution in known and states[run].lack
        else record
        for run, record in ended.items()
    }


def _check_sessions(store: Store, runs: AbstractSet[str], plan: Plan) -> None:
    """Raise Missing if a session executes some of these runs, so that collecting would wait for it, or even take it over."""
    for paths in sessions.all_of(store.paths):
        shared = sessions.claims(paths) & runs
        if shared and (paths.submission.exists() or _programs(paths) not in ("", plan.programs.id)):
            holder = f"{sessions.holder(paths)} (session {paths.root.name})"
            raise Missing(f"{holder} executes {counted(len(shared), 'run')} of this folder; collect when it has ended")


def _programs(paths: SessionPaths) -> str:
    """Return the programs that a session executes; nothing if it has not begun to."""
    with contextlib.suppress(FileNotFoundError, Damaged):
        return Context.load(paths.context).programs
    return ""


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
        """The folder and the record of each run, by id. Of a run that the batch has twice, it is the first that is right."""
        self.right = 0
        """Number of folders that are right."""
        self._folders: dict[tuple[int, int], tuple[str, Ended]] = {}
        """The folders with the records, by experiment and number."""
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
                self._folders[run.experiment, run.number] = name, record
            except Refused as error:
                self.refused[name] = str(error)

    def _compare(self) -> None:
        """Refuse the runs whose input files or commands differ from the plan's, and those whose outputs cannot be read."""
        for run, files in self._plan.inputs.files(self._plan.batch, lambda run: (run.experiment, run.number) in self._folders):
            known = self._folders.get((run.experiment, run.number))
            if known is None:
                continue
            try:
                self._compare_run(known[0], run_files(self._builder.job(run, files), self._plan))
                self._measure(known[0], self._plan.limits.of(run.experiment).output_bytes)
            except Refused as error:
                self.refused[known[0]] = str(error)
                continue
            self.right += 1
            self.ended.setdefault(run.id, known)

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

    def _measure(self, folder: str, most: int | None) -> None:
        """Check that the outputs can be read, and have at most so many bytes. Raises Refused."""
        left = 0
        for _, file in files_left(self._root, folder):
            left += file.seek(0, 2) if file else 0
        for _ in logs_left(self._root, folder):
            pass
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
    plan = replace(plan, seen=ChangeGuard({}, b""))  # whatever changes here now, the runs ended before, and elsewhere
    return plan if trust else replace(plan, programs=ELSEWHERE, build=None, lacking="")


def _recorded(store: Store, plan: Plan, ended: Mapping[str, EndedRun]) -> dict[str, str]:
    """Return the status of those executions that are recorded, by the last evaluation, or by that of the present rules."""
    executions = [run.execution for run in ended.values()]
    with store.snapshot() as snapshot:
        snapshot.views.make(("all_judgements",))
        return dict(snapshot.select(_Recorded, STATUSES, e=executions, rules=context(plan).ingest_rules))


def _statuses(plan: Plan) -> frozenset[int]:
    return frozenset((*plan.success.statuses, *plan.success.accepted_statuses))


def _notes(plan: Plan) -> Iterator[str]:
    if plan.image is not None:
        yield f"the commands are for the image {plan.image.name}; it is not known whether the other system used it"

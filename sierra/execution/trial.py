"""Trial of one run: the run executes as in a batch, but no store keeps anything of it.

The folder `try` of the project's store has a store of its own, where the run is recorded and judged as in a batch. What a user
wants to know is read from it, and then it is removed. Only the run's folder is left, until the next trial.
"""

from __future__ import annotations

import contextlib
import json
import os
import stat
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path

from sierra import runners
from sierra.config.output_tables import Keys
from sierra.design.expand import Expansion
from sierra.errors import Busy, Missing, SierraError, UsageError
from sierra.execution import commands, session_records, show_record
from sierra.execution.execute import check_packages
from sierra.execution.observer import Observer, Progress, ProgressCounter
from sierra.execution.plan import Plan, context, versioned
from sierra.execution.plan_notes import out_of_reach
from sierra.execution.run_jobs import JobService, Setup
from sierra.execution.sessions import Session, locked
from sierra.execution.shown_records import ShownExecution
from sierra.execution.unread_files import UnreadFiles, of_run, printed, read_small
from sierra.ingest import text_headers
from sierra.ingest.match_outputs import automatic_format
from sierra.model import IN_PROJECT, Experiment, Run, Status, Value
from sierra.store.layout import RUN_OUTPUT, RUN_STDERR, RUN_STDOUT, StorePaths, TrialPaths
from sierra.store.row_types import ArtifactRow
from sierra.store.segments import disk_errors
from sierra.store.sql_names import identifier
from sierra.store.store import GITIGNORE, Store
from sierra.store.table_layout import Columns, TableLayout
from sierra.store.time_axis import is_called_time, names_time
from sierra.templates.base import Files
from sierra.util.fs import write_whole
from sierra.util.hashing import short
from sierra.util.lazy_definitions import dataclass, field, replace
from sierra.worker.files import is_folder, remove

UNCHANGED = "montecarlo.C1"
"""The query for the template as it is, with a seed."""
MARK = "made by sierra try\n"
SAME_TABLES = "this run has the same tables as the one with seed "
CHUNK = 1 << 16
LOOKED_AT = 100_000
"""The number of rows in which a column is looked at."""
LOGS = (RUN_STDOUT, RUN_STDERR)

Show = Callable[[str, bytes], None]
"""A function that receives what the run's program prints: `stdout` or `stderr`, and the next bytes."""


@dataclass(frozen=True, slots=True)
class TriedFile:
    """A file that the run wrote, and the table that it would be part of."""

    path: str
    bytes: int
    table: str | None
    """The table; None if the file would be recorded as a file."""
    rows: int | None
    columns: Mapping[str, str]
    """The kind of values in each column, as the reader sees them."""
    sha256: str = ""
    """The hash of the file."""
    flags: Mapping[str, int] = field(default_factory=dict)
    """The columns of numbers that are 0 or 1, in a table of one row."""
    time: str = ""
    """The column that is the time axis by its name: the first one by the rule of figures, or one that never goes back."""
    keys: Keys = field(default_factory=dict)
    """The keys of `[outputs.NAME]` that read a file that is no plain CSV; empty for others."""


@dataclass(frozen=True, slots=True)
class Used:
    """The files that the run was observed to use."""

    words: str
    """The programs and data in words, as `sierra show` says them."""
    files: tuple[str, ...]
    """The files of the project that it executed or read, relative to the project."""
    incomplete: str | None
    """The reason why it may have used other files too; None if all were seen."""


@dataclass(frozen=True, slots=True)
class Trial:
    """The result of trying one run."""

    values: Mapping[str, Value]
    """The values of the query's variables."""
    run: str
    seed: int
    status: Status
    reason: str | None
    """The reason why a batch would count the run as failed."""
    exit_code: int | None = None
    signal: int | None = None
    wall_s: float | None = None
    folder: Path | None = None
    """The run's folder; None if there is none, because the run was interrupted before it began."""
    files: tuple[TriedFile, ...] = ()
    unread: tuple[UnreadFiles, ...] = ()
    """The files that would become no table, and why."""
    logs: Mapping[str, int] | None = None
    """The bytes that the program printed, by `stdout` and `stderr`."""
    elsewhere: tuple[str, ...] = ()
    """Files that the run wrote, but not into its working directory."""
    used: Used | None = None
    """None if the run was not observed."""
    notes: tuple[str, ...] = ()


def choose(plan: Plan, experiment: int, seed: int | None) -> tuple[Run, Files]:
    """Return the first run of an experiment, with another seed if one is given, and its input files. Raises UsageError."""
    experiments = plan.batch.experiments
    if not 0 <= experiment < len(experiments):
        known = "only experiment 0" if len(experiments) == 1 else f"the experiments 0 to {len(experiments) - 1}"
        raise UsageError(f"there is no experiment {experiment}; this query has {known}")
    first = experiments[experiment].runs[0]
    if seed is None:
        return next(iter(plan.inputs.files(plan.batch, lambda run: run is first)))
    if not isinstance(plan.inputs, Expansion):
        raise UsageError("a recorded batch has recorded seeds; leave out --seed")
    if seed > (most := plan.project.config.seed.max):
        raise UsageError(f"seed {seed} is above {most}, the largest seed ([seed] max)")
    return plan.inputs.seeded(first, seed)


def attempt(plan: Plan, run: Run, files: Files, project: StorePaths, observer: Observer, show: Show) -> Trial:
    """Execute one run, and return what it did. `project` has the paths of the project's store, which need not exist.

    Raises the errors of a batch's session, and Busy if another process tries a run of this project.
    """
    if plan.batch.spec.robots is not None:
        raise UsageError("sierra try executes a run on this machine, and this one takes robots; use sierra run --runs 1")
    check_packages(plan)
    plan = versioned(_alone(plan, run))
    with _locked_folder(project) as paths:
        store = Store.create(paths.store)
        session = Session(store.paths, logged=False)
        output = _Output(session.paths.runs, observer, show)
        counter = ProgressCounter(output, 1)
        try:
            session.take_number()
            session_records.keep_for_trial(plan, store, session)
            root = plan.project.root
            if plan.checkout is not None:
                plan.checkout.make(root := session.paths.source)
            setup = Setup(plan.project, plan.batch.spec, plan.engine, plan.image, plan.limits, root, plan.environment)
            service = JobService(setup, store, session, stays=False, images=project)
            followed = service.execute_jobs(
                runners.find("local", plan.project.config.runners)(1),
                context(plan, session.id, session.number),
                [(run, files)],
                1,
                plan.programs,
                counter,
                doubt=lambda: service.doubt(plan.seen),
                kept=paths.new,
            )
        finally:
            session.close()
        folder = _keep(paths, run)
        output.rest(folder)
        notes = (*plan.notes, *service.isolation.notes, *followed.notes)
        values = plan.batch.experiments[0].values
        if run.id not in counter.statuses:
            return Trial(values, run.id, run.seed, Status.INTERRUPTED, "was interrupted", folder=folder, notes=notes)
        trial = _read(store, commands.execution_id(session.id, run.id), values, run.seed, folder)
        seeded = trial.status is Status.OK and _is_seeded(plan, run)
        if seeded and (same := _same_as_last(paths, plan, trial)):
            notes = (*notes, same)
    if trial.status is not Status.OK:
        notes += tuple(out_of_reach(plan, None))
    if trial.status not in (Status.OK, Status.MISMATCH):
        return replace(trial, notes=tuple(dict.fromkeys(notes)))
    tables = {file.table for file in trial.files if file.table}
    written = folder and folder / RUN_OUTPUT
    unread = of_run((file.path for file in trial.files if file.table is None), plan.outputs, tables, written)
    if not tables and not any(files.keys for files in unread) and folder is not None:
        unread += printed(folder / RUN_STDOUT, plan.outputs)
    return replace(trial, notes=tuple(dict.fromkeys(notes)), unread=unread)


def _is_seeded(plan: Plan, run: Run) -> bool:
    """Return whether the input or the command of a run depends on its seed."""
    if plan.project.config.seed.environment or any("{seed}" in word for word in plan.batch.spec.words):
        return True
    return isinstance(plan.inputs, Expansion) and plan.inputs.seeded(run, run.seed + 1)[0].digests != run.digests


def _same_as_last(paths: TrialPaths, plan: Plan, trial: Trial) -> str | None:
    """Return a note if the last run that was tried had another seed and the same tables; remember this run for the next one."""
    tables = {file.path: file.sha256 for file in trial.files if file.table and file.rows}
    this = {"spec": plan.batch.spec_id, "values": dict(trial.values), "tables": tables}
    last: dict[str, object] = {}
    with contextlib.suppress(OSError, ValueError, TypeError):
        last = dict(json.loads(paths.last.read_bytes()))
    write_whole(paths.last, json.dumps({**this, "seed": trial.seed}).encode())
    seed = last.pop("seed", trial.seed)
    if not tables or seed == trial.seed or last != json.loads(json.dumps(this)):
        return None
    return (
        f"{SAME_TABLES}{seed}, which was tried before: does the program use its seed? (equal runs are not independent samples)"
    )


def _alone(plan: Plan, run: Run) -> Plan:
    """Return the plan with only this run."""
    whole = plan.batch.experiments[run.experiment]
    own = Experiment(whole.id, whole.ordinal, whole.values, (run,))
    return replace(plan, batch=replace(plan.batch, experiments=(own,)))


@contextlib.contextmanager
def _locked_folder(project: StorePaths) -> Iterator[TrialPaths]:
    """Yield the emptied folder for a trial, locked; what it does not leave is removed at the end. Raises Missing."""
    paths = project.trial
    with disk_errors(paths.root):
        _make(project, paths)
        try:
            lock = locked(paths.lock, wait=False)
        except BlockingIOError as error:
            raise Busy("another sierra try is executing in this project; wait until it ends") from error
    try:
        _clear(paths.run, paths.store, paths.new)
        yield paths
    finally:
        _clear(paths.store, paths.new)
        if lock is not None:
            os.close(lock)


def _make(project: StorePaths, paths: TrialPaths) -> None:
    """Make the folder, with a mark; it is not part of git, even before there is a store."""
    if os.path.lexists(paths.root):
        if not is_folder(str(paths.root)) or not paths.mark.is_file() or paths.mark.read_text("utf-8") != MARK:
            raise Missing(f"{paths.root} was not made by sierra try; move it away")
        return
    if not project.root.exists():
        project.root.mkdir(parents=True)
        write_whole(project.gitignore, GITIGNORE)
    unfinished = paths.root.with_name(f".try.{os.getpid()}")
    unfinished.mkdir()
    (unfinished / paths.mark.name).write_text(MARK, "utf-8")
    try:
        unfinished.rename(paths.root)
    except OSError:  # another process was faster
        _clear(unfinished)


def _clear(*folders: Path) -> None:
    for folder in folders:
        if is_folder(str(folder)):
            remove(str(folder))
        elif os.path.lexists(folder):
            folder.unlink()


def _keep(paths: TrialPaths, run: Run) -> Path | None:
    """Move the run's folder to where users find it."""
    folder = paths.new / short(run.id)
    if not folder.is_dir():
        return None
    folder.rename(paths.run)
    return paths.run


class _Output(Observer):
    """Shows what the program prints while it runs: each report of progress is a moment to look at its logs."""

    def __init__(self, runs: Path, observer: Observer, show: Show) -> None:
        self._runs = runs
        self._observer = observer
        self._show = show
        self._shown: dict[int, int] = {}
        """The number of bytes that were shown, by the inode of the log, because the folder is moved."""

    def notice(self, text: str) -> None:
        self._observer.notice(text)

    def progress(self, progress: Progress) -> None:
        folders = [path for pattern in ("[0-9]*", "slot-*/runs/[0-9]*") for path in self._runs.glob(pattern)]
        numbered = [path for path in folders if path.name.isdigit()]
        if numbered:
            self._show_new(max(numbered, key=lambda path: int(path.name)))

    def rest(self, folder: Path | None) -> None:
        """Show what has not been shown yet."""
        if folder is not None:
            self._show_new(folder)

    def _show_new(self, folder: Path) -> None:
        for name in LOGS:
            with contextlib.suppress(OSError):
                descriptor = os.open(folder / name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
                with os.fdopen(descriptor, "rb") as file:
                    status = os.fstat(descriptor)
                    if stat.S_ISREG(status.st_mode):
                        file.seek(self._shown.get(status.st_ino, 0))
                        while piece := file.read(CHUNK):
                            self._show(name, piece)
                        self._shown[status.st_ino] = file.tell()


FILES_ELSEWHERE = "SELECT DISTINCT path FROM files_written WHERE execution = $e AND use = 'written' ORDER BY path"
PROJECT_FILES_USED = """
SELECT DISTINCT f.path FROM observations o JOIN files_read f USING (files)
WHERE o.execution = $e AND f.use IN ('executed', 'read') AND starts_with(f.path, '{project}/') ORDER BY f.path
"""


def _read(store: Store, execution: str, values: Mapping[str, Value], seed: int, folder: Path | None) -> Trial:
    """Return what the store of the trial says about its execution."""
    shown = show_record.show(store, execution)
    if not isinstance(shown, ShownExecution):
        raise SierraError(f"the trial's store has no execution {short(execution)}")
    row = shown.row
    used = None
    if shown.observation is not None:
        of_project = (path.removeprefix(IN_PROJECT) for path in store.values(str, PROJECT_FILES_USED, e=execution))
        used = Used(shown.observation.used, tuple(of_project), shown.observation.row.reason)
    files = [_file(store, file, folder) for file in shown.artifacts if file.kind != "log"]
    tables_first = sorted(files, key=lambda file: file.table is None)
    log_sizes = {name: file.size for name in LOGS for file in shown.artifacts if (file.kind, file.path) == ("log", name)}
    return Trial(
        values=values,
        run=row.run,
        seed=seed,
        status=Status(row.status),
        reason=row.reason,
        exit_code=row.exit_code,
        signal=row.signal,
        wall_s=row.wall_s,
        folder=folder,
        files=tuple(tables_first),
        logs=log_sizes,
        elsewhere=tuple(store.values(str, FILES_ELSEWHERE, e=execution)),
        used=used,
    )


def _file(store: Store, artifact: ArtifactRow, folder: Path | None) -> TriedFile:
    if artifact.kind != "table":
        return TriedFile(artifact.name, artifact.size, None, None, {}, artifact.sha256)
    columns = TableLayout.load(artifact.table_layout).columns
    flags = _flags(store, artifact, columns) if artifact.rows == 1 and artifact.output else {}
    time = _time(store, artifact, columns) if (artifact.rows or 0) > 1 and artifact.output else ""
    content = read_small(folder and folder / RUN_OUTPUT / artifact.path) if automatic_format(artifact.path) == "csv" else None
    keys = text_headers.better_keys_of(content) if content else {}
    return TriedFile(artifact.name, artifact.size, artifact.output, artifact.rows, columns, artifact.sha256, flags, time, keys)


def _time(store: Store, artifact: ArtifactRow, columns: Columns) -> str:
    """Return the time axis of a table by the rule of figures, or else the first column that is called a time and is one."""
    numbers = [name for name, kind in columns.items() if kind == "number"]
    first = next(iter(columns), "")
    if first in numbers and names_time(first):
        return first
    named = [name for name in numbers if is_called_time(name)]
    if not named:
        return ""
    with store.snapshot() as snapshot:
        rows = snapshot.rows(
            f"FROM {identifier(str(artifact.output))} WHERE execution = $e LIMIT {LOOKED_AT}", e=artifact.execution
        )
    for name in named:
        times = [row.get(name) for row in rows]
        if _goes_ahead([time for time in times if isinstance(time, int | float)], len(times)):
            return name
    return ""


def _goes_ahead(times: Sequence[float], rows: int) -> bool:
    """Return whether these times, of so many rows, never go back."""
    return len(times) == rows and times[0] < times[-1] and all(before <= after for before, after in pairwise(times))


def _flags(store: Store, artifact: ArtifactRow, columns: Columns) -> dict[str, int]:
    """Return the columns of numbers that are 0 or 1 in the only row of a table."""
    with store.snapshot() as snapshot:
        rows = snapshot.rows(f"FROM {identifier(str(artifact.output))} WHERE execution = $e", e=artifact.execution)
    values = rows[0] if len(rows) == 1 else {}
    return {name: int(values[name] == 1) for name, kind in columns.items() if kind == "number" and values.get(name) in (0, 1)}

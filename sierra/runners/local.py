"""Runner on this machine: one worker with a number of slots, by default one per core, fed through a pipe."""

from __future__ import annotations

import base64
import contextlib
import json
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import Annotated, ClassVar, Literal, cast

from pydantic import BeforeValidator, Field, PositiveInt

from sierra.config.field_types import Table
from sierra.errors import Missing
from sierra.model import Job, Limits, Result, Status
from sierra.runners.base import Look, Work
from sierra.runners.journal_reader import Journal, Stalled, Started
from sierra.store.layout import SessionPaths
from sierra.util import open_files, signals
from sierra.util.lazy_logger import Log, shown
from sierra.worker import program
from sierra.worker.containers import CLEAN_S
from sierra.worker.devices import NoDevices, ids_in, listed_in, runs_at_once
from sierra.worker.gpus import with_gpus
from sierra.worker.job import GRACE_S
from sierra.worker.job import Job as JobRecord
from sierra.worker.job import Limits as LimitsRecord
from sierra.worker.processes import Stops, birth, marked, stdin_of

log = Log(__name__)
ORPHANS_S = 10.0
LATE_S = 4.0
"""The seconds after the grace time of runs in which a worker that was told to end must have ended."""
STOPPED = "stopped the worker (SIGSTOP) although it had been continued before, or executed beside a run that did"


def _listed(value: object) -> object:
    """Check the GPUs of `[runners.local]`; a list in TOML becomes a tuple of texts."""
    if value == "auto" or (isinstance(value, int) and not isinstance(value, bool) and value > 0):
        return value
    if isinstance(value, list | tuple) and value:
        words = [str(word) for word in value]
        if [*map(str, value)] == ids_in(",".join(words)):
            return tuple(words)
    raise ValueError('should be "auto", a number of GPUs, or a list of their indices or UUIDs, such as [0, 1]')


class LocalTable(Table):
    """This machine as a runner."""

    gpus: Annotated[
        Literal["auto"] | int | tuple[str, ...],
        BeforeValidator(_listed, json_schema_input_type=Literal["auto"] | PositiveInt | tuple[int | str, ...]),
    ] = Field(
        "auto",
        description="GPUs for runs that request some by `[limits] gpus`: `auto` (all that this process may use), a number of "
        "these, or a list of indices (as in nvidia-smi) or UUIDs, such as `[0, 1]`",
        examples=["auto", 2, [0, 1]],
    )


class Local:
    """The runner `local`. The worker ends all runs as soon as this process is gone, because the pipe closes.

    A run may stop the worker (SIGSTOP). It is continued once; the next time, it is killed, the runs that it executes have
    failed, and another worker executes the rest. If a worker that was told to end does not, it is killed too.
    """

    name = "local"
    stays = False
    remote = False
    Options: ClassVar[type[Table]] = LocalTable

    def __init__(self, slots: int, options: Table | None = None) -> None:
        self._slots = slots
        self._table = options if isinstance(options, LocalTable) else LocalTable()
        self._environment: Mapping[str, str] = os.environ
        """The variables of the worker."""
        self._process: subprocess.Popen[bytes] | None = None
        self._trouble: BaseException | None = None
        self._end_by: float | None = None
        """When a worker that was told to end is killed, by the monotonic clock."""
        self._killed = False
        self._continued = False
        self._stops = Stops()
        self._grace = GRACE_S
        self._sent: dict[str, Job] = {}
        """The jobs without a result that the worker has got, by execution."""
        self._notes: list[str] = []
        """Notes for the next look."""
        self._forget: Callable[[], None] = lambda: None
        self._running: dict[str, float] = {}
        """When this process has learnt of the start of each running execution."""

    def submit(self, work: Work, session: SessionPaths) -> None:
        if work.gpus is not None:
            try:
                self._environment = with_gpus(os.environ, work.gpus, self._table.gpus)
            except NoDevices as error:
                raise Missing(str(error)) from error
            # a slot that waited for GPUs would hold a run that another could execute
            self._slots = min(self._slots, runs_at_once(len(listed_in(self._environment)), work.gpus))
        elif "gpus" in self._table.model_fields_set:
            self._notes.append("[runners.local] gpus has no effect: runs request no GPUs, such as by [limits] gpus = 1")
        self._session = session
        self._journal = Journal(session.journal)
        self._journal.skip()
        self._jobs = iter(work.jobs)
        self._forget = signals.at_quit(self._kill)
        self._start(())

    def _start(self, again: Sequence[Job]) -> None:
        """Start a worker for these jobs and all that no other has got."""
        session = self._session
        argv = program.words(str(session.runs), str(self._slots), str(session.journal))
        log.debug("worker: %s", shown(argv))
        self._process = subprocess.Popen(
            argv,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=True,
            env={**self._environment, "SIERRA_SESSION": session.root.name},
        )
        open_files.restore(self._process.pid)
        jobs = chain(again, self._jobs)
        self._feeder = threading.Thread(target=self._feed, args=(jobs, self._process), daemon=True)
        self._feeder.start()

    def resume(self, session: SessionPaths, recorded: Mapping[str, str | None]) -> None:
        raise NotImplementedError("local runs ended with the process that started them")

    def _feed(self, jobs: Iterable[Job], process: subprocess.Popen[bytes]) -> None:
        """Send all jobs, and hold the pipe open until the worker has ended."""
        pipe = stdin_of(process)
        try:
            for number, job in enumerate(jobs):
                if number == 0:
                    log.debug("first run: %s", shown(job.client.argv if job.client else job.argv))
                self._sent[job.execution] = job
                self._grace = max(self._grace, job.limits.grace_s + (CLEAN_S if job.client else 0.0))
                pipe.write(line(job))
            pipe.write(b'{"end": true}\n')
            pipe.flush()
            process.wait()
        except BrokenPipeError:
            return
        except BaseException as error:
            self._trouble = error
        finally:
            with contextlib.suppress(OSError):
                pipe.close()

    def look(self) -> Look:
        notes, self._notes = [*self._notes, *self._watch()], []
        ended = self._process is None or self._process.poll() is not None
        results = []
        events, more = self._journal.some()
        for event in events:
            match event:
                case Started():
                    self._running[event.execution] = time.time()
                case Stalled():
                    notes.append(event.message())
                case Result():
                    self._running.pop(event.execution, None)
                    self._sent.pop(event.execution, None)
                    results.append(event)
        if ended and not more and self._process is not None:
            if self._killed:
                results += self._lost()
                ended = not self._go_on()
            else:
                self._check(self._process)
        return Look(tuple(results), len(self._running), alive=not ended or more, notes=tuple(notes))

    def _watch(self) -> Iterator[str]:
        """Continue a worker that was stopped, or kill it, and one that does not end; yield what was done."""
        process = self._process
        if process is None or process.poll() is not None:
            return
        late = self._end_by is not None and time.monotonic() > self._end_by
        stopped = self._stops.seen(process.pid, time.monotonic())
        if late or (stopped and self._continued and self._end_by is None):
            self._kill()
            yield "the worker was stopped again, and was killed" if stopped and not late else "the worker was killed"
        elif stopped:
            os.kill(process.pid, signal.SIGCONT)
            if self._end_by is None:
                self._continued = True
                yield "a run (or another process) stopped the worker; it was continued, and will be killed the next time"

    def _kill(self) -> None:
        """Kill the worker and its runs."""
        if self._process is not None and self._process.poll() is None:
            self._killed = True
            self._process.kill()
            self._process.wait()
            end_orphans([self._session])

    def _lost(self) -> Iterator[Result]:
        """Yield the results of the runs that a killed worker was executing: failed, or interrupted if it was told to end."""
        for execution, since in self._running.items():
            if job := self._sent.pop(execution, None):
                yield Result(
                    job.run,
                    execution,
                    str(self._session.runs),
                    since,
                    time.time(),
                    exit_code=None,
                    signal=None,
                    stopped=None if self._end_by is None else Status.INTERRUPTED,
                    user_s=None,
                    system_s=None,
                    max_rss_bytes=None,
                    host=os.uname().nodename,
                    slot=0,
                    outputs=(),
                    error=STOPPED if self._end_by is None else None,
                )
        self._running = {}

    def _go_on(self) -> bool:
        """Start another worker for the rest of the jobs after one was killed; return whether there are any."""
        self._feeder.join()
        self._killed = False
        if self._trouble is not None:
            return True  # the next look raises it
        if self._end_by is not None:
            return False
        following = next(self._jobs, None)
        rest = [*self._sent.values(), *(() if following is None else (following,))]
        self._sent = {}
        if rest:
            self._start(rest)
        return bool(rest)

    def stop(self) -> None:
        self._end_by = self._end_by or time.monotonic() + self._grace + LATE_S
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()

    def leave(self) -> None:
        raise NotImplementedError("local runs end with this process")

    def close(self) -> None:
        self._forget()

    def _check(self, process: subprocess.Popen[bytes]) -> None:
        """Raise the error of a worker that has failed. It has ended, and everything that it recorded has been read."""
        ending = _ending(process)
        log.debug("worker: %s", ending)
        if self._trouble is not None:
            raise self._trouble
        unprepared = (
            self._end_by is not None and process.returncode == -signal.SIGTERM
        )  # it was told to stop before it could listen
        if process.returncode not in (0, 1) and not unprepared:
            end_orphans([self._session])
            raise Missing(f"the worker ended with {ending}; the finished runs are kept")


def end_orphans(sessions: Sequence[SessionPaths]) -> None:
    """Kill all processes that the dead workers of these sessions left running, and wait until they are gone.

    Every process of a session has SIERRA_SESSION in its environment, unless it removed the variable. Then the journal still has
    the first process of its program. (Linux only: on other systems nothing is found.) Afterwards, no process changes files of
    these sessions.

    Raises Missing if a process cannot be killed.
    """
    give_up = time.monotonic() + ORPHANS_S
    while left := _orphans(sessions):
        if time.monotonic() > give_up:
            raise Missing(f"process {min(left)} of a dead session cannot be ended; end it and run the command again")
        for pid in left:
            for kill in (os.killpg, os.kill):
                with contextlib.suppress(ProcessLookupError, PermissionError):
                    kill(pid, signal.SIGKILL)
        time.sleep(0.01)


def _orphans(sessions: Iterable[SessionPaths]) -> set[int]:
    marks = {f"SIERRA_SESSION={paths.root.name}".encode() for paths in sessions}
    started = {pid for paths in sessions for pid in _started(paths.journal)}
    return (marked(marks) | started) - {os.getpid()}


def _started(journal: Path) -> list[int]:
    """Return the living processes that a journal records as started but not as ended."""
    started: dict[str, Started] = {}
    for event in Journal(journal).read():
        match event:
            case Started():
                started[event.execution] = event
            case Result():
                started.pop(event.execution, None)
    return [one.pid for one in started.values() if one.born is not None and birth(one.pid) == one.born]


def line(job: Job) -> bytes:
    """Return a job as a line that the worker reads."""
    return json.dumps(record(job), separators=(",", ":")).encode() + b"\n"


def record(job: Job) -> JobRecord:
    """Return a job as the record that the worker expects."""
    record: JobRecord = {
        "run": job.run,
        "execution": job.execution,
        "argv": job.argv,
        "environment": dict(job.environment),
        "files": {name: base64.b64encode(content).decode() for name, content in job.files},
        "limits": limits(job.limits),
    }
    if job.folders is not None:
        record["folders"] = dict(job.folders)
    if job.checkpoint is not None:
        record["checkpoint"] = job.checkpoint
    if job.beside is not None:
        record["beside"] = job.beside
    if client := job.client:
        record["client"] = {"argv": client.argv, "environment": dict(client.environment), "stop": client.stop}
        if client.start_pipe:
            record["client"]["start_pipe"] = client.start_pipe
        record["shared"] = job.shared
    if job.observe is not None:
        record["observe"] = dict(job.observe)
        if job.budget is not None:
            record["budget"] = job.budget
        if job.affordable is not None:
            record["affordable"] = job.affordable
        if job.helps is not None:
            record["helps"] = {"tracer": job.helps.tracer, "digests": job.helps.digests}
    if job.experiment is not None:
        record["experiment"] = job.experiment
    return record


@lru_cache(maxsize=8)
def limits(given: Limits) -> LimitsRecord:
    """Return the limits that are set."""
    return cast("LimitsRecord", {name: value for name, value in asdict(given).items() if value is not None})


def _ending(process: subprocess.Popen[bytes]) -> str:
    """Return a worker's exit status or signal, and the last line that it printed."""
    lines: list[str] = []
    if process.stderr is not None and not process.stderr.closed:
        with process.stderr as stream:
            lines = stream.read().decode("utf-8", "replace").strip().splitlines()
    code = process.returncode
    return ": ".join([f"signal {-code}" if code < 0 else f"status {code}", *lines[-1:]])

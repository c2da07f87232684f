"""Runner on this machine: one worker with a number of slots, by default one per core, fed through a pipe."""

from __future__ import annotations

import base64
import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import ClassVar, cast

from sierra.config.field_types import Table
from sierra.config.plugin_registry import NoOptions
from sierra.errors import Missing
from sierra.model import Job, Limits, Result
from sierra.runners.base import Look, Work
from sierra.runners.journal_reader import Journal, Stalled, Started
from sierra.store.layout import SessionPaths
from sierra.util import open_files
from sierra.util.lazy_logger import Log, shown
from sierra.worker import worker

log = Log(__name__)
ORPHANS_S = 10.0


class Local:
    """The runner `local`. The worker ends all runs as soon as this process is gone, because the pipe closes."""

    name = "local"
    stays = False
    remote = False
    Options: ClassVar[type[Table]] = NoOptions

    def __init__(self, slots: int, options: Table | None = None) -> None:
        self._slots = slots
        self._process: subprocess.Popen[bytes] | None = None
        self._trouble: BaseException | None = None
        self._stopped = False
        self._running: set[str] = set()

    def submit(self, work: Work, session: SessionPaths) -> None:
        self._session = session
        self._journal = Journal(session.journal)
        self._journal.skip()
        argv = (sys.executable, "-I", "-S", worker.__file__, str(session.runs), str(self._slots), str(session.journal))
        log.debug("worker: %s", shown(argv))
        self._process = subprocess.Popen(
            argv,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=True,
            env={**os.environ, "SIERRA_SESSION": session.root.name},
        )
        open_files.restore(self._process.pid)
        threading.Thread(target=self._feed, args=(work.jobs, self._process), daemon=True).start()

    def resume(self, session: SessionPaths, recorded: Mapping[str, str | None]) -> None:
        raise NotImplementedError("local runs ended with the process that started them")

    def _feed(self, jobs: Iterable[Job], process: subprocess.Popen[bytes]) -> None:
        """Send all jobs, and hold the pipe open until the worker has ended."""
        pipe = worker.stdin_of(process)
        try:
            for number, job in enumerate(jobs):
                if number == 0:
                    log.debug("first run: %s", shown(job.client.argv if job.client else job.argv))
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
        ended = self._process is None or self._process.poll() is not None
        results, notes = [], []
        events, more = self._journal.some()
        for event in events:
            match event:
                case Started():
                    self._running.add(event.execution)
                case Stalled():
                    notes.append(event.message())
                case Result():
                    self._running.discard(event.execution)
                    results.append(event)
        if ended and not more and self._process is not None:
            self._check(self._process)
        return Look(tuple(results), len(self._running), alive=not ended or more, notes=tuple(notes))

    def stop(self) -> None:
        self._stopped = True
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()

    def leave(self) -> None:
        raise NotImplementedError("local runs end with this process")

    def close(self) -> None:
        pass

    def _check(self, process: subprocess.Popen[bytes]) -> None:
        """Raise the error of a worker that has failed. It has ended, and everything that it recorded has been read."""
        ending = _ending(process)
        log.debug("worker: %s", ending)
        if self._trouble is not None:
            raise self._trouble
        unprepared = self._stopped and process.returncode == -signal.SIGTERM  # it was told to stop before it could listen
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
    return (worker.marked(marks) | started) - {os.getpid()}


def _started(journal: Path) -> list[int]:
    """Return the living processes that a journal records as started but not as ended."""
    started: dict[str, Started] = {}
    for event in Journal(journal).read():
        match event:
            case Started():
                started[event.execution] = event
            case Result():
                started.pop(event.execution, None)
    return [one.pid for one in started.values() if one.born is not None and worker.birth(one.pid) == one.born]


def line(job: Job) -> bytes:
    """Return a job as a line that the worker reads."""
    return json.dumps(record(job), separators=(",", ":")).encode() + b"\n"


def record(job: Job) -> worker.Job:
    """Return a job as the record that the worker expects."""
    record: worker.Job = {
        "run": job.run,
        "execution": job.execution,
        "argv": job.argv,
        "environment": dict(job.environment),
        "files": {name: base64.b64encode(content).decode() for name, content in job.files},
        "limits": limits(job.limits),
    }
    if job.folders is not None:
        record["folders"] = dict(job.folders)
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
    return record


@lru_cache(maxsize=8)
def limits(given: Limits) -> worker.Limits:
    """Return the limits that are set."""
    return cast("worker.Limits", {name: value for name, value in asdict(given).items() if value is not None})


def _ending(process: subprocess.Popen[bytes]) -> str:
    """Return a worker's exit status or signal, and the last line that it printed."""
    lines: list[str] = []
    if process.stderr is not None and not process.stderr.closed:
        with process.stderr as stream:
            lines = stream.read().decode("utf-8", "replace").strip().splitlines()
    code = process.returncode
    return ": ".join([f"signal {-code}" if code < 0 else f"status {code}", *lines[-1:]])

"""Runs on this machine: one worker with as many slots as there are cores, fed through a pipe."""

from __future__ import annotations

import base64
import contextlib
import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from sierra import worker
from sierra.errors import Missing
from sierra.model import Job, Result
from sierra.paths import SessionPaths
from sierra.runners import Look
from sierra.runners.journal import Journal, Started


class Local:
    """The runner `local`. The worker ends what runs as soon as this process is gone: the pipe closes."""

    name = "local"

    def __init__(self, slots: int) -> None:
        self._slots = slots
        self._trouble: BaseException | None = None
        self._running: set[str] = set()

    def submit(self, jobs: Iterable[Job], session: SessionPaths) -> None:
        self._session = session
        self._journal = Journal(session.journal)
        with session.worker_log.open("wb") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-I", "-S", str(Path(worker.__file__)), str(session.root), str(self._slots)],
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=log,
                start_new_session=True,
                env={**os.environ, "SIERRA_SESSION": session.root.name},
            )
        threading.Thread(target=self._feed, args=(jobs, self._process.stdin), daemon=True).start()

    def _feed(self, jobs: Iterable[Job], pipe: Any) -> None:
        try:
            for job in jobs:
                pipe.write(line(job))
            pipe.write(b'{"end": true}\n')
            pipe.flush()
        except (BrokenPipeError, ValueError):
            return
        except BaseException as error:
            self._trouble = error
            self.stop()

    def look(self) -> Look:
        code = self._process.poll()
        results = []
        for event in self._journal.read():
            match event:
                case Started():
                    self._running.add(event.execution)
                case Result():
                    self._running.discard(event.execution)
                    results.append(event)
        if code is not None:
            self._close()
            if self._trouble is not None:
                raise self._trouble
            if code not in (0, 1) and not results:
                raise Missing(f"the worker ended with {_ending(code)}{self._last_words()}")
        return Look(tuple(results), len(self._running), code is None)

    def stop(self) -> None:
        if self._process.poll() is None:
            self._process.terminate()

    def _close(self) -> None:
        with contextlib.suppress(OSError):
            if self._process.stdin is not None:
                self._process.stdin.close()

    def _last_words(self) -> str:
        said = self._session.worker_log.read_text("utf-8", "replace").strip().splitlines()
        return f": {said[-1]}" if said else ""


def line(job: Job) -> bytes:
    """A job as the worker reads it."""
    limits: dict[str, Any] = {
        name: value
        for name in ("wall_s", "cpu_s", "memory_bytes", "output_bytes", "grace_s")
        if (value := getattr(job.limits, name)) is not None
    }
    record = {
        "run": job.run,
        "execution": job.execution,
        "argv": job.argv,
        "environment": dict(job.environment),
        "files": {name: base64.b64encode(content).decode() for name, content in job.files},
        "limits": limits,
    }
    return json.dumps(record, separators=(",", ":")).encode() + b"\n"


def _ending(code: int) -> str:
    return f"signal {-code}" if code < 0 else f"status {code}"

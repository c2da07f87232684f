"""A runner of one trial that a person watches, and may stop."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

from sierra.config.field_types import Table
from sierra.config.plugin_registry import NoOptions
from sierra.execution.supervised.supervisor import Watch
from sierra.model import OutputFile, Result, Status
from sierra.runners.base import Look, Runner, Work
from sierra.store.layout import RUN_OUTPUT, SessionPaths
from sierra.worker import worker


class WatchedRunner:
    """Another runner, which shows each look to the person who watches, and stops when this person wants it."""

    name = "watched"
    stays = False
    remote = False
    Options: ClassVar[type[Table]] = NoOptions

    def __init__(self, runner: Runner, watch: Watch, *, ends: bool) -> None:
        """`ends`: a trial that is stopped ends as planned; otherwise it has failed."""
        self.runner = runner
        self.remote = runner.remote
        self._watch = watch
        self._ends = ends
        self._began = time.monotonic()
        self.seconds = 0.0
        """Seconds from the submission to the last look."""
        self.stopped = False
        """True if the person has stopped the trial."""

    def submit(self, work: Work, session: SessionPaths) -> None:
        self._began = time.monotonic()
        self.runner.submit(work, session)

    def resume(self, session: SessionPaths, recorded: Mapping[str, str | None]) -> None:
        raise NotImplementedError("a trial ends with the process that started it")

    def look(self) -> Look:
        look = self.runner.look()
        self.seconds = time.monotonic() - self._began
        if look.alive and not self.stopped and self._watch(self.seconds, look.beats):
            self.stopped = True
            self.runner.stop()
        return replace(look, results=tuple(map(self._own, look.results)))

    def _own(self, result: Result) -> Result:
        """Return a result that the person's stop has ended, with its outputs and the meaning that the project gives to it.

        A worker does not read the outputs of a run that it was told to end, because such a run is not recorded. This one is.
        """
        if not self.stopped or result.stopped != Status.INTERRUPTED:
            return result
        result = replace(result, stopped=None if self._ends else Status.STOPPED)
        return result if result.outputs else _with_outputs(result)

    def leave(self) -> None:
        raise NotImplementedError("a trial ends with this process")

    def stop(self) -> None:
        self.runner.stop()

    def close(self) -> None:
        self.runner.close()


def _with_outputs(result: Result) -> Result:
    """Return a result with the files in its output folder, or with the reason why these cannot be read."""
    try:
        files, others = worker.list_files(f"{result.directory}/{RUN_OUTPUT}")
        outputs = tuple(OutputFile(**one) for one in worker.described(files, lambda: None))
    except OSError as error:
        return replace(result, error=f"its outputs cannot be read: {error.strerror}")
    return replace(result, outputs=outputs, left_out=tuple(others[: worker.MOST_NAMED]))

"""A runner of one trial: a person decides when it begins, watches it, and may stop it.

A runner that can hold a run back (see `Holds`) prepares it while the person decides. Any other runner gets it after that.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

from sierra.config.field_types import Table
from sierra.config.plugin_registry import NoOptions
from sierra.extensions.trials.supervisor import Attendant, Start
from sierra.model import OutputFile, Result, Status
from sierra.runners.base import Holds, Look, Runner, Work
from sierra.store.layout import RUN_OUTPUT, SessionPaths
from sierra.worker.outputs import MOST_NAMED, described, list_files


class WatchedRunner:
    """Another runner, which begins, and stops, when the person who attends to it wants that."""

    name = "watched"
    stays = False
    remote = False
    Options: ClassVar[type[Table]] = NoOptions

    def __init__(self, runner: Runner, attendant: Attendant, *, ends: bool) -> None:
        """`ends`: a trial that is stopped ends as planned; otherwise it has failed."""
        self.wrapped = runner
        self.remote = runner.remote
        self._attendant = attendant
        self._ends = ends
        self._submitted = self._over = self._told = self._collecting = False
        self._began = time.monotonic()
        self.decision: Start | None = None
        """The decision of the person; None until there is one."""
        self.seconds = 0.0
        """Seconds from the decision to the last look, or to the end of the run if its files are collected afterwards."""
        self.stopped = False
        """True if the person has stopped the trial; false if it was over, or being stopped, before the person did so."""

    def submit(self, work: Work, session: SessionPaths) -> None:
        self._work, self._session = work, session
        if isinstance(self.wrapped, Holds):
            self.wrapped.hold()
            self._submit()

    def _submit(self) -> None:
        self._submitted = True
        self.wrapped.submit(self._work, self._session)

    def resume(self, session: SessionPaths, recorded: Mapping[str, str | None]) -> None:
        raise NotImplementedError("a trial ends with the process that started it")

    def look(self) -> Look:
        look = self.wrapped.look() if self._submitted else Look((), 0, alive=not self._over)
        if not self._collecting:
            self.seconds = time.monotonic() - self._began if self.decision is Start.GO else 0.0
        self._collecting = self._collecting or look.collecting
        if look.alive and not self._over:
            self._attend(look)
        watched = look.alive and self.decision is Start.GO and not (self._told or self._collecting)
        return replace(look, results=tuple(map(self._own, look.results)), watched=watched)

    def _attend(self, look: Look) -> None:
        """Let the person decide if the trial begins; once it has, let the person stop it until it ends."""
        if self.decision is None:
            self._decide(ready=look.ready or not self._submitted)
        if self.decision is Start.GO:
            self._watch(look)

    def _watch(self, look: Look) -> None:
        if self._collecting:
            self._attendant.ending(look.beats, time.monotonic() - self._began - self.seconds)
        elif look.stopping and not self._told:
            self._attendant.ending(look.beats, None)
        elif not self._told and self._attendant.watch(self.seconds, look.beats):
            self._told = self.stopped = True
            self.wrapped.stop()

    def _decide(self, *, ready: bool) -> None:
        self.decision = self._attendant.decide(ready=ready)
        if self.decision is Start.GO:
            self._began = time.monotonic()
            self.wrapped.begin() if isinstance(self.wrapped, Holds) else self._submit()
        elif self.decision is not None:
            self.stop()

    def _own(self, result: Result) -> Result:
        """Return a result that the person's stop has ended, with its outputs and the meaning that the project gives to it.

        A worker does not read the outputs of a run that it was told to end, because such a run is not recorded. This one is.
        """
        self.stopped = self._told and result.stopped == Status.INTERRUPTED
        if not self.stopped:
            return result
        result = replace(result, stopped=None if self._ends else Status.STOPPED)
        return result if result.outputs else _with_outputs(result)

    def leave(self) -> None:
        raise NotImplementedError("a trial ends with this process")

    def stop(self) -> None:
        self._over = True
        if self._submitted:
            self.wrapped.stop()

    def close(self) -> None:
        if self._submitted:
            self.wrapped.close()


def _with_outputs(result: Result) -> Result:
    """Return a result with the files in its output folder, or with the reason why these cannot be read."""
    try:
        files, others = list_files(f"{result.directory}/{RUN_OUTPUT}")
        outputs = tuple(OutputFile(**one) for one in described(files, lambda: None))
    except OSError as error:
        return replace(result, error=f"its outputs cannot be read: {error.strerror}")
    return replace(result, outputs=outputs, left_out=tuple(others[:MOST_NAMED]))

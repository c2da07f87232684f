"""Variation: the ways in which a replay executes recorded runs otherwise than they were recorded, and what it records.

`Variation` itself changes nothing. `sierra.extensions.videos.capture_runs` has the one that makes runs render.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import NamedTuple

from sierra.config.project_file import Project
from sierra.execution import run_limits
from sierra.execution.run_limits import RunLimits
from sierra.model import Purpose, RunSpec
from sierra.replay.compare_values import Agreement
from sierra.replay.verdicts import Replay
from sierra.store.store import Store
from sierra.templates.base import Files


class Variation:
    """A replay that executes runs as they were recorded."""

    purpose = Purpose.REPLAY
    finished: Collection[str] = ()
    """Executions that count if programs, machine and isolation are the same, beside those of earlier replays."""

    @property
    def is_replay(self) -> bool:
        """Return whether runs are executed as they were recorded, and take about as long."""
        return self.purpose is Purpose.REPLAY

    def spec(self, recorded: RunSpec) -> RunSpec:
        """Return the specification that is executed."""
        return recorded

    def files(self, recorded: Files) -> Files:
        """Return the input files of a run that is executed."""
        return recorded

    def limits(self, project: Project, store: Store, batch: str) -> RunLimits:
        """Return the limits of the runs of a recorded batch."""
        return run_limits.recorded(project, store, batch)

    def compared(self, outputs: Mapping[str | None, Agreement]) -> Mapping[str | None, Agreement]:
        """Return the outputs, by path, whose agreement with the record counts."""
        return outputs

    def records_before(self, executions: Mapping[str, str], batch: str) -> Iterable[NamedTuple]:
        """Return records that are written before anything executes; `executions` are by run."""
        del executions, batch
        return ()

    def records(
        self, answer: Replay, as_replay: Iterable[Iterable[NamedTuple]], store: Store, lamport: int
    ) -> Iterable[Iterable[NamedTuple]]:
        """Return the records of the result, by table; `as_replay` are those of a replay."""
        del answer, store, lamport
        return as_replay

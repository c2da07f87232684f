"""Summaries: the state of a batch after a session."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from sierra.model import Value
from sierra.util.hashing import short
from sierra.util.lazy_definitions import dataclass, field

if TYPE_CHECKING:
    from sierra.execution.outputs_taken import TakenOutputs


@dataclass(frozen=True, slots=True)
class Failure:
    """Runs without a successful execution that share one reason; with the first of these runs and the end of its log."""

    count: int
    status: str
    reason: str
    run: str
    experiment: Mapping[str, Value]
    number: int
    log: str | None


@dataclass(frozen=True, slots=True)
class Counted:
    """One experiment of the batch: its values, and the numbers of its runs, successful runs and failed runs."""

    values: Mapping[str, Value]
    runs: int
    succeeded: int
    failed: int
    accepted: int = 0
    """Number of runs with an end that [success] accepts."""


@dataclass(frozen=True, slots=True)
class Summary:
    """Result of a query's execution. `failed` and `missing` are numbers of runs without a successful execution."""

    batch: str
    query: str
    experiments: int
    runs: int
    executed: int
    reexecuted: int
    """Number of executed runs that had been executed before."""
    reused: int
    failed: int
    missing: int
    interrupted: bool
    awaited: int = 0
    """Number of the reused runs that another session executed at the same time."""
    reevaluated: int = 0
    """Number of runs that were not executed but evaluated again, because [outputs] or [success] have changed."""
    detached: tuple[str, ...] = ()
    """Ids of sessions on a cluster that continue without this process."""
    counts: tuple[Counted, ...] = ()
    """Numbers of runs by experiment, in the batch's order."""
    outcomes: Mapping[str, int] = field(default_factory=dict)
    """Numbers of runs by an end that [success] accepts, such as `exit 3`."""
    failures: tuple[Failure, ...] = ()
    """Failures by reason, most frequent first; at most `SHOWN_REASONS`."""
    target: str | None = None
    """Target that the batch was requested for."""
    selected: int | None = None
    """Number of experiments that the session was limited to; None if it was not limited."""
    left_out: int = 0
    """Number of the missing runs that do not belong to these experiments."""
    notes: tuple[str, ...] = ()
    sessions: tuple[str, ...] = ()
    """Ids of the sessions that recorded executions for it."""
    outputs: TakenOutputs | None = None
    """The description of how outputs were read, if these sessions are the first with such tables or files."""
    figures: tuple[str, ...] = ()
    figure_error: str | None = None
    """Reason why no figure could be written (a full disk, a file in the way); the results themselves are recorded."""

    def _repr_html_(self) -> str:
        from sierra.util import html

        names = ("runs", "succeeded", "accepted", "failed")
        axes = list(self.counts[0].values) if self.counts else []
        rows = ([*row.values.values(), row.runs, row.succeeded, row.accepted, row.failed] for row in self.counts)
        counts = (
            f"{self.runs} runs: {self.executed} executed, {self.reused} reused, {self.failed} failed, {self.missing} missing"
        )
        title = f"batch {short(self.batch)}: {self.query}"
        return html.page(title, (*axes, *names), rows, (counts, *self.notes), total=len(self.counts))

"""Reasons why runs are executed, reused or effective. The command line gives them words (`sierra.cli.render_reasons`)."""

from __future__ import annotations

from enum import StrEnum

from sierra.util.lazy_definitions import dataclass


class ChangeReason(StrEnum):
    """The kinds of reasons."""

    NEW = "new"
    """No execution of the run was known."""
    FAILED = "failed"
    """The last execution failed."""
    FAILED_TWICE = "failed twice"
    """The last two executions failed in the same way, by the same programs and rules."""
    FINDING = "finding"
    """A problem was found in the last execution after it was recorded."""
    RULES = "rules"
    """[outputs] or [success] have changed."""
    PROGRAMS = "programs"
    """The last successful execution used other programs."""
    UNOBSERVED = "not observed"
    """Files have changed, and no run of the experiment was observed, so that nobody knows whether its executions used them."""
    REUSED = "reused"
    """A recorded execution is effective."""
    UNCHANGED = "unchanged"
    """An execution with another source or other programs is effective, because no file that it used has changed."""
    REEVALUATED = "reevaluated"
    """A recorded execution is evaluated again by changed rules."""
    ON_CLUSTER = "on cluster"
    """A cluster executes the run now."""
    CONCURRENT = "concurrent"
    """Two sessions executed the run at the same time."""
    JUST_EXECUTED = "just executed"
    """Another session had executed the run just before."""
    REPLAY = "replay"
    """The run was executed for a replay."""
    CAPTURE = "capture"
    """The run was executed with rendering, for its frames."""
    NEVER = "never"
    """The run was never executed."""
    STALE = "stale"
    """The last successful execution used other programs or rules than the batch's last session."""


@dataclass(frozen=True, slots=True)
class Reason:
    """A reason, and its details in one line: an error, or what has changed."""

    kind: ChangeReason
    detail: str = ""


class Basis(StrEnum):
    """The batch, if any, with which a plan that has new runs is compared."""

    EMPTY_STORE = "empty store"
    SAME_BATCH = "same batch"
    """The batch is recorded; an earlier session ended before it executed the runs."""
    NOTHING = "nothing"
    """No batch with these variables is recorded."""
    BATCH = "batch"


BY_USEFULNESS = (ChangeReason.FAILED, ChangeReason.RULES, ChangeReason.PROGRAMS, ChangeReason.REUSED)
"""Recorded executions by their usefulness for a session, the least useful first; SQL uses the positions."""
FAILED, RULES, PROGRAMS, REUSED = range(len(BY_USEFULNESS))

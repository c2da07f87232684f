"""Words for the reasons why runs are executed, reused or effective."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sierra.execution.reasons import ChangeReason
from sierra.util.hashing import short
from sierra.util.text import counted

if TYPE_CHECKING:
    from collections.abc import Mapping

    from sierra.execution.reasons import Reason
    from sierra.explain.preview_repeat import NextRun

PREVIEW = {
    ChangeReason.NEW: "new",
    ChangeReason.FAILED: "failed: {}",
    ChangeReason.RULES: "[outputs] or [success] have changed",
    ChangeReason.PROGRAMS: "executed with other programs",
    ChangeReason.REUSED: "reused",
    ChangeReason.REEVALUATED: "[outputs] or [success] have changed: evaluated again from the record, not executed",
    ChangeReason.ON_CLUSTER: "on a cluster now: followed, not executed again",
}
"""Why the next session would execute a run, or not."""
HISTORY = {
    ChangeReason.NEW: "new",
    ChangeReason.FAILED: "the last execution failed: {}",
    ChangeReason.FINDING: "a problem was found in the last execution: {}",
    ChangeReason.RULES: "evaluated by other rules before: {}",
    ChangeReason.PROGRAMS: "executed with other programs before: {}",
    ChangeReason.CONCURRENT: "another session executed it at the same time without this session's knowledge",
    ChangeReason.JUST_EXECUTED: "another session had just executed it ({}) without this session's knowledge",
    ChangeReason.REPLAY: "a replay{}",
}
"""Why a session executed a run."""
EFFECTIVE = {
    ChangeReason.REUSED: "the last successful execution with the programs and rules of the batch's last session",
    ChangeReason.NEVER: "never executed",
    ChangeReason.FAILED: "no execution succeeded; the last one: {}",
    ChangeReason.STALE: "stale: the last successful execution differs from the batch's last session: {}",
}
"""Why an execution is effective, or none is."""


def next_run(answer: NextRun) -> list[str]:
    """Return the effect of repeating a batch's query, one line each."""
    if answer.error:
        return [f"the query cannot be repeated as it is: {answer.error}"]
    if answer.other_batch:
        recorded = f"(sierra run {short(answer.batch)} executes this batch with the recorded code)"
        return [f"different runs (batch {short(answer.other_batch)}), because:", *answer.differences, recorded]
    return [*(f"{counted(count, 'run')}: {text(reason, PREVIEW)}" for count, reason in answer.reasons), *answer.differences]


def text(reason: Reason, words: Mapping[ChangeReason, str]) -> str:
    """Return a reason in words."""
    form = words[reason.kind]
    if "{}" in form:
        return form.format(reason.detail)
    return f"{form}, and {reason.detail}" if reason.detail else form

"""Words for the reasons why runs are executed, reused or effective."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sierra.execution.reasons import Basis, ChangeReason
from sierra.util.hashing import short
from sierra.util.text import counted

if TYPE_CHECKING:
    from collections.abc import Mapping

    from sierra.execution.build.state import BuildState
    from sierra.execution.reasons import Reason
    from sierra.explain.preview_repeat import NextRun
    from sierra.explain.why_new_runs import NewRuns

PREVIEW = {
    ChangeReason.NEW: "new",
    ChangeReason.FAILED: "failed: {}",
    ChangeReason.FAILED_TWICE: "failed twice in the same way, and only --retry executes them: {}",
    ChangeReason.RULES: "[outputs] or [success] have changed",
    ChangeReason.PROGRAMS: "executed with other programs or files",
    ChangeReason.UNOBSERVED: "not observed: nobody knows whether these experiments used what has changed",
    ChangeReason.REUSED: "reused",
    ChangeReason.UNCHANGED: "reused: source or programs have changed, but no file that these runs used",
    ChangeReason.REEVALUATED: "[outputs] or [success] have changed: evaluated again from the record, not executed",
    ChangeReason.ON_CLUSTER: "on a cluster now: followed, not executed again",
}
"""Why the next session would execute a run, or not."""
HISTORY = {
    ChangeReason.NEW: "new",
    ChangeReason.FAILED: "the last execution failed: {}",
    ChangeReason.FINDING: "a problem was found in the last execution: {}",
    ChangeReason.RULES: "evaluated by other rules before: {}",
    ChangeReason.PROGRAMS: "executed with other programs or files before: {}",
    ChangeReason.UNOBSERVED: "not observed before, and nobody knows whether it used what has changed: {}",
    ChangeReason.CONCURRENT: "another session executed it at the same time without this session's knowledge",
    ChangeReason.JUST_EXECUTED: "another session had just executed it ({}) without this session's knowledge",
    ChangeReason.REPLAY: "a replay{}",
    ChangeReason.CAPTURE: "a capture of frames",
}
"""Why a session executed a run."""
EFFECTIVE = {
    ChangeReason.REUSED: "the last successful execution with the programs and rules of the batch's last session",
    ChangeReason.UNCHANGED: "an execution with other source or programs, which did not use what differs: {}",
    ChangeReason.NEVER: "never executed",
    ChangeReason.FAILED: "no execution succeeded; the last one: {}",
    ChangeReason.STALE: "stale: the last successful execution differs from the batch's last session: {}",
}
"""Why an execution is effective, or none is."""


BASES = {
    Basis.EMPTY_STORE: "the store is still empty",
    Basis.SAME_BATCH: "this batch is recorded; an earlier session ended before it executed these runs",
    Basis.NOTHING: "no batch with these variables was recorded before",
    Basis.BATCH: "compared with batch {batch} ({query}):",
}
"""The first line of an explanation: the batch, if any, with which the plan is compared."""


def build(state: BuildState, *, dry_run: bool) -> str:
    """Return whether the products of `[build]` are built, and why, in one line."""
    if state.reason is None:
        return "build: the products are up to date"
    when = "would be built first" if dry_run else "were built"
    unknown = "; whether runs are reused depends on the products" if dry_run else ""
    return f"build: the products {when}, because {state.reason}{unknown}"


def new_runs(found: NewRuns) -> list[str]:
    """Return the reasons why runs of a plan or of a recorded batch are new, one line each."""
    return [BASES[found.basis].format(batch=short(found.batch), query=found.query), *(one.whole for one in found.differences)]


def next_run(answer: NextRun) -> list[str]:
    """Return the effect of repeating a batch's query, one line each."""
    if answer.error:
        return [f"the query cannot be repeated as it is: {answer.error}"]
    first = [build(answer.build, dry_run=True)] if answer.build and answer.build.reason else []
    if answer.other_batch:
        recorded = f"(sierra run {short(answer.batch)} executes this batch with the recorded code)"
        return [
            f"different runs (batch {short(answer.other_batch)}), because:",
            *(difference.whole for difference in answer.differences),
            recorded,
            *first,
        ]
    if first:
        return first
    reasons = (f"{counted(count, 'run')}: {text(reason, PREVIEW)}" for count, reason in answer.reasons)
    return [*reasons, *(difference.whole for difference in answer.differences)]


def text(reason: Reason, words: Mapping[ChangeReason, str]) -> str:
    """Return a reason in words."""
    form = words[reason.kind]
    if "{}" in form:
        return form.format(reason.detail)
    return f"{form}, and {reason.detail}" if reason.detail else form

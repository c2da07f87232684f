"""State of a submitted batch, and the decisions that follow from a scheduler's answers.

The functions are pure: from a state and what is known now, they return the next state and actions, which `Cluster` carries out
in this order. What they decide is described in `sierra.runners.cluster.runner`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from enum import StrEnum
from typing import NamedTuple

from sierra.config.cluster_table import ClusterTable
from sierra.errors import Missing
from sierra.runners.cluster.collect import Evidence, Share
from sierra.runners.cluster.submission_record import waits
from sierra.runners.schedulers.base import State, Task
from sierra.util.lazy_definitions import dataclass, field, regex, replace
from sierra.util.text import counted, few, often

PROBE_UNKNOWN = 3
"""Number of consecutive times that the scheduler may not know a preflight job without records, before the job has failed."""
MOST_CONTINUED = 100
"""Number of times that a run with a checkpoint may begin, as long as its element's time ends it."""
TIMED = regex(r"time ?limit|timeout|walltime", re.IGNORECASE)
"""Matches an end reason that means that the element's time was over."""
ASKED = regex(r"asked to end after (\d+) s$")
"""Matches an element's own message that it was asked to end; the number is the time that it had lasted."""
MISHAP = regex(rf"{TIMED.pattern}|node|preempt|memory|boot|requeue|deadline", re.IGNORECASE)
"""Matches a scheduler's end reason that means that nobody ended the element on purpose."""
RELAUNCHED = "launch failed"
"""Text in the scheduler's reason for a job that could not be started, though it can. Such a job is submitted again."""


class Phase(StrEnum):
    """Phase of a submitted batch."""

    PROBING = "probing"
    """The preflight job checks the nodes, and the elements wait for it."""
    EXECUTING = "executing"
    STOPPING = "stopping"
    """Its jobs are cancelled, and have not all ended."""
    OVER = "over"
    """No job of it is alive."""


@dataclass(frozen=True, slots=True)
class BatchState:
    """State of a submitted batch, as far as it is known."""

    shares: tuple[Share, ...]
    phase: Phase = Phase.EXECUTING
    queued: AbstractSet[int] = frozenset()
    alive: AbstractSet[int] | None = None
    """Elements that are queued or running; None before the first answer."""
    waits: str = ""
    """Reason why elements are queued, in the scheduler's words."""
    reachable: bool = True
    uncancelled: bool = False
    """True if the scheduler could not be reached to cancel jobs."""
    resubmit: Mapping[int, str] = field(default_factory=dict)
    """Elements to submit again, with the reason."""
    probe_unknown: int = 0
    """Number of consecutive times that the scheduler did not know the preflight job."""
    probe_attempts: int = 0


class Answer(NamedTuple):
    """A scheduler's answer about the elements, or about the preflight job while it checks the nodes."""

    tasks: Sequence[tuple[Task, AbstractSet[int]]]
    """Each task with its elements."""
    ended: Sequence[tuple[int, Task]]
    """Elements, each with an ended task of its last submission."""
    evidence: Mapping[int, Evidence]
    """Remains of the elements that were gone at the previous answer, and whose records have been read since.

    They tell which runs had begun. An element with new records is left out: more may come.
    """
    now: float
    forgets: bool = False
    """True if the scheduler omits ended tasks: see `Scheduler`."""
    is_longest: bool = False
    """True if no element gets more time when it is submitted again."""


class Cancel(NamedTuple):
    """Cancel these elements; None: all jobs."""

    elements: Sequence[int] | None


class Restart(NamedTuple):
    """Cancel everything and submit it again."""


class LostProbe(NamedTuple):
    """Submit the preflight job again, or end the session because it has ended without a record."""

    reason: str
    again: bool


class Refused(NamedTuple):
    """End the session because this task will never begin."""

    task: Task


class Cancelled(NamedTuple):
    """End the session because somebody else has cancelled a part of it; if not `sure`, because it looks like that."""

    what: str
    sure: bool
    elements: Sequence[int] = ()
    job: str = ""
    """The job; if empty, it is that of the elements."""


class GiveUp(NamedTuple):
    """Let these executions fail."""

    element: int
    executions: Sequence[str]
    tries: int
    why: str


class End(NamedTuple):
    """End the session with an error."""

    error: Missing


Action = Cancel | Restart | LostProbe | Refused | Cancelled | GiveUp | End
Decision = tuple[BatchState, list[Action]]


def on_poll(batch: BatchState, answer: Answer, table: ClusterTable) -> Decision:
    """Return the state and the actions that follow from a scheduler's answer. `table` has the settings of the cluster."""
    shares = tuple(replace(share) for share in batch.shares)
    batch = replace(batch, shares=shares, reachable=True, waits=waits(task for task, _ in answer.tasks))
    if batch.phase is Phase.PROBING:
        return _on_probe(batch, answer.tasks, table)
    queued = {index for task, elements in answer.tasks if task.state is State.QUEUED for index in elements}
    living = [elements for task, elements in answer.tasks if task.state in (State.QUEUED, State.RUNNING)]
    alive = {index for elements in living for index in elements}
    batch = replace(batch, queued=queued, alive=alive)
    for index, task in answer.ended:
        shares[index].reason, shares[index].cancelled = task.reason or shares[index].reason, task.cancelled
        shares[index].blameless = task.blameless
    if batch.phase is Phase.STOPPING:
        return replace(batch, phase=batch.phase if living else Phase.OVER), [Cancel(None)] if batch.uncancelled else []
    actions = _on_stuck(batch, answer.tasks)
    for index, share in enumerate(shares):
        share.gone = share.gone + 1 if share.missing and index not in alive and index not in batch.resubmit else 0
        share.gone_at = answer.now if share.gone == 1 else share.gone_at
        share.queued = index in queued or (share.queued and index not in alive)
    evidence = {index: seen for index, seen in answer.evidence.items() if shares[index].gone > 1}
    lost = {index: seen._replace(message=shares[index].trouble or seen.message) for index, seen in evidence.items()}
    batch, more = _on_lost(batch, lost, table, answer)
    return batch, [*actions, *more]


def _on_probe(batch: BatchState, answer: Sequence[tuple[Task, AbstractSet[int]]], table: ClusterTable) -> Decision:
    """Decide about the preflight job, as long as it has recorded nothing itself."""
    tasks = [task for task, _ in answer]
    again = replace(batch, probe_unknown=0, probe_attempts=batch.probe_attempts + 1)
    if any(map(is_mishap, tasks)) and again.probe_attempts < table.attempts:
        return again, [Restart()]
    actions = _on_stuck(batch, answer)
    living = {task.state for task in tasks} & {State.QUEUED, State.RUNNING}
    unknown = 0 if living else batch.probe_unknown + 1
    batch = replace(batch, queued={0} if State.QUEUED in living else frozenset(), probe_unknown=unknown)
    cancelled = [task.job for task in tasks if task.cancelled]
    if cancelled and not living and table.cancelled == "stop":
        return batch, [*actions, Cancelled("before any node was checked", sure=True, job=cancelled[0])]
    if unknown <= PROBE_UNKNOWN:
        return batch, actions
    reason = next((task.reason for task in tasks if task.reason), "")
    return again, [*actions, LostProbe(reason, again=not tasks and again.probe_attempts < table.attempts)]


def _on_stuck(batch: BatchState, tasks: Sequence[tuple[Task, AbstractSet[int]]]) -> list[Action]:
    """Cancel tasks that will never begin, to submit them again. If the reason is not a mishap, end the session."""
    mishaps = [(task, elements) for task, elements in tasks if is_mishap(task)]
    held = sorted({index for _, elements in mishaps for index in elements})
    for index in held:  # the cancellation that follows is not the reason
        batch.shares[index].trouble = mishaps[0][0].reason
    refused = [task for task, _ in tasks if task.state is State.STUCK and not is_mishap(task)]
    return [*([Cancel(held)] if mishaps else []), *map(Refused, refused[:1])]


def is_mishap(task: Task) -> bool:
    """Return True if a task that will never begin could begin if it were submitted again."""
    return task.state is State.STUCK and RELAUNCHED in task.reason.lower()


def _on_lost(batch: BatchState, lost: Mapping[int, Evidence], table: ClusterTable, answer: Answer) -> Decision:
    """Decide about elements that are gone while runs of theirs are missing.

    A run that had all of an element's time fails at once if no element gets more; other runs are tried `attempts` times. A run
    that has written to its checkpoint when the time was over has made progress: it continues, at most `MOST_CONTINUED` times.
    """
    shares = batch.shares
    why = {index: _end_reason(shares[index], seen, table) for index, seen in lost.items()}
    foreign = [
        index for index, seen in lost.items() if _is_cancelled_by_others(shares[index], seen, table, forgets=answer.forgets)
    ]
    if foreign and table.cancelled == "stop":
        what = f"{counted(len(foreign), 'array task')}: {few([why[index] for index in foreign], 2)}"
        return batch, [Cancelled(what, any(shares[index].cancelled for index in foreign), foreign)]
    actions: list[Action] = []
    resubmit = dict(batch.resubmit)
    for index, seen in lost.items():
        share, timed = shares[index], bool(TIMED.search(why[index]))
        continued = {run for run in seen.continued if timed and share.begun[run] < MOST_CONTINUED}
        if share.done > share.progress or continued or share.blameless:
            share.tries = 0
        cut = (seen.by_limit if timed else seen.alone) - continued
        attempts = 1 if timed and answer.is_longest and _overdue(seen, table) else table.attempts
        guilty = [execution for execution in _suspects(share, attempts) if execution in cut]
        if guilty:
            actions.append(GiveUp(index, guilty, share.tries, why[index]))
        if share.missing == len(guilty):
            continue
        share.tries = 0 if guilty else share.tries
        share.suspects = [] if timed else [run for run in _suspects(share, table.attempts - 1) if run not in guilty]
        if share.tries >= table.attempts * (2 if share.suspects else 1):
            ended = f"array task {index} was executed {often(share.tries)} and ended before any of its runs ended: {why[index]}"
            actions.append(End(Missing(ended)))
            break
        resubmit[index] = why[index]
    return replace(batch, resubmit=resubmit), actions


def _is_cancelled_by_others(share: Share, seen: Evidence, table: ClusterTable, *, forgets: bool) -> bool:
    """Return True if somebody other than SIERRA has ended an element, as far as this can be known.

    The scheduler may not report what has ended an element. Then an element was cancelled if it was asked to end before its
    time was over, or if it never began and the scheduler forgets ended jobs at once.
    """
    if share.ours or share.cancelled is not None:
        return bool(share.cancelled) and not share.ours
    if seen.message:
        return bool(ASKED.search(seen.message)) and not (_overdue(seen, table) or MISHAP.search(share.reason))
    return share.queued and not share.reason and forgets


def _suspects(share: Share, times: int) -> list[str]:
    """Return the runs of an element that may have ended it: those that were begun at least `times` times.

    If the element was submitted `times` times without progress and gave no reason, these are all runs that have not ended.
    """
    stuck = share.tries >= times and not share.trouble
    return [execution for execution, begun in share.begun.items() if stuck or begun >= times]


def _end_reason(share: Share, seen: Evidence, table: ClusterTable) -> str:
    """Return the reason why an element is gone, in its own words and the scheduler's."""
    word = share.reason or _overdue(seen, table)
    if not seen.message or (word and word in seen.message):
        return share.trouble or word or "unknown reason"
    return f"{seen.message} ({word})" if word else seen.message


def _overdue(seen: Evidence, table: ClusterTable) -> str:
    """Return the words for an exceeded time limit if an element's time was over: a scheduler may not report it."""
    asked, wall = ASKED.search(seen.message), table.wall or seen.allowed_s
    return f"walltime of {wall:g} s exceeded" if asked and wall and int(asked[1]) >= wall - 1 else ""

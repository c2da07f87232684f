"""Faults of clusters, as a scheduler's answers show them: the decisions follow from the state and the answer alone."""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import pytest

from sierra.config.cluster_table import ClusterTable
from sierra.runners.cluster.batch_state import (
    MOST_CONTINUED,
    PROBE_UNKNOWN,
    Action,
    Answer,
    BatchState,
    Cancel,
    Cancelled,
    Decision,
    End,
    GiveUp,
    LostProbe,
    Phase,
    Refused,
    Restart,
    on_poll,
)
from sierra.runners.cluster.collect import Evidence, Share
from sierra.runners.schedulers.base import State, Task

QUEUED = Task("7", 0, State.QUEUED, "Resources")
RUNNING = Task("7", 0, State.RUNNING)
NO_NODE = Task("7", 0, State.STUCK, "no node has 9 GPUs")
MISHAP = Task("7", 0, State.STUCK, "launch failed requeued held")
NODE_FAIL = Task("7", 0, State.ENDED, "NODE_FAIL", cancelled=False)
CANCELLED = Task("7", 0, State.ENDED, "CANCELLED by 0", cancelled=True)
TIMEOUT = Task("7", 0, State.ENDED, "TIMEOUT", cancelled=False)
VANISHED = Task("7", 0, State.ENDED)
"""A task that has ended, without more information."""
NOTHING = Evidence("", None, frozenset(), frozenset())
ASKED = Evidence("the task was asked to end after 42 s", None, frozenset(), frozenset())
WHOLE = {"message": ASKED.message, "allowed_s": 42.5, "by_limit": {"a"}}
"""A run that had all of its element's time."""


def table(**settings: Any) -> ClusterTable:
    return ClusterTable(attempts=3, **settings)


def gone(**changes: Any) -> BatchState:
    """Return a batch of one element with two runs, which was gone at the previous answer."""
    return BatchState((Share(**{"count": 2, "tries": 1, "gone": 1, **changes}),))


def poll(
    batch: BatchState,
    *tasks: Task,
    seen: Evidence | None = NOTHING,
    settings: ClusterTable | None = None,
    forgets: bool = False,
    is_longest: bool = False,
) -> Decision:
    """Return the decision about an answer. `seen` is the evidence for element 0; None: its records may not be complete."""
    ended = [(task.element or 0, task) for task in tasks if task.state is State.ENDED]
    known: Mapping[int, Evidence] = {} if seen is None else {0: seen}
    answer = Answer(
        [(task, {task.element or 0}) for task in tasks], ended, known, now=100.0, forgets=forgets, is_longest=is_longest
    )
    return on_poll(batch, answer, settings or table())


@pytest.mark.parametrize(
    ("share", "tasks", "seen", "why"),
    [
        pytest.param({}, [], NOTHING, "unknown reason", id="the accounting is lost"),
        pytest.param({}, [NODE_FAIL], NOTHING, "NODE_FAIL", id="the node is lost"),
        pytest.param({}, [NODE_FAIL], NOTHING._replace(message="no space"), "no space (NODE_FAIL)", id="two reasons"),
        pytest.param({"trouble": "no space"}, [], NOTHING._replace(message="no space"), "no space", id="its own reason"),
        pytest.param({"ours": True}, [CANCELLED], NOTHING, "CANCELLED by 0", id="cancelled by SIERRA"),
        pytest.param({"reason": "PREEMPTED"}, [], ASKED, f"{ASKED.message} (PREEMPTED)", id="preempted"),
        pytest.param({"queued": True}, [], NOTHING, "unknown reason", id="it vanished from the queue"),
        pytest.param(
            *({}, [], ASKED._replace(allowed_s=42.5), f"{ASKED.message} (walltime of 42.5 s exceeded)"), id="its time was over"
        ),
    ],
)
def test_a_lost_element_is_submitted_again_with_the_reason(
    share: dict[str, Any], tasks: Sequence[Task], seen: Evidence, why: str
) -> None:
    batch, actions = poll(gone(**share), *tasks, seen=seen)
    assert (batch.resubmit, actions, batch.phase) == ({0: why}, [], Phase.EXECUTING)


@pytest.mark.parametrize(
    ("share", "tasks", "seen"),
    [
        pytest.param({"gone": 0}, [], NOTHING, id="the scheduler did not know it once"),
        pytest.param({"gone": 9}, [], None, id="its results may arrive late"),
        pytest.param({"done": 2}, [NODE_FAIL], NOTHING, id="all of its runs are recorded"),
        pytest.param({}, [QUEUED], NOTHING, id="it was requeued"),
        pytest.param({}, [NODE_FAIL, RUNNING], NOTHING, id="a second copy of it runs"),
    ],
)
def test_an_element_that_may_still_give_results_is_left_alone(
    share: dict[str, Any], tasks: Sequence[Task], seen: Evidence | None
) -> None:
    batch, actions = poll(gone(**share), *tasks, seen=seen)
    assert (batch.resubmit, actions) == ({}, [])


def test_a_requeued_element_is_not_gone_any_more() -> None:
    batch, _ = poll(gone(), QUEUED)
    assert (batch.shares[0].gone, batch.shares[0].queued, batch.queued, batch.waits) == (0, True, {0}, "Resources")


def test_an_element_that_waits_to_be_submitted_again_is_not_gone() -> None:
    batch, actions = poll(BatchState((Share(2, gone=1),), resubmit={0: "NODE_FAIL"}))
    assert (batch.shares[0].gone, batch.resubmit, actions) == (0, {0: "NODE_FAIL"}, [])


@pytest.mark.parametrize(
    ("share", "tasks", "seen", "forgets", "sure"),
    [
        pytest.param({}, [CANCELLED], NOTHING, False, True, id="the scheduler says so"),
        pytest.param({}, [VANISHED], ASKED, False, False, id="it was asked to end before its time"),
        pytest.param({"queued": True}, [], NOTHING, True, False, id="it vanished from the queue of a scheduler that forgets"),
    ],
)
def test_an_element_that_somebody_else_cancelled_ends_the_session(
    share: dict[str, Any], tasks: Sequence[Task], seen: Evidence, *, forgets: bool, sure: bool
) -> None:
    batch, [action] = poll(gone(**share), *tasks, seen=seen, forgets=forgets)
    assert isinstance(action, Cancelled)
    assert (action.sure, action.elements, batch.resubmit) == (sure, [0], {})
    batch, actions = poll(gone(**share), *tasks, seen=seen, forgets=forgets, settings=table(cancelled="resubmit"))
    assert (list(batch.resubmit), actions) == ([0], [])


def test_only_the_cancelled_ones_of_the_lost_elements_are_named() -> None:
    shares = (Share(1, gone=1, reason="NODE_FAIL", cancelled=False), Share(1, gone=1, reason="CANCELLED", cancelled=True))
    answer = Answer([], [], {0: NOTHING, 1: NOTHING}, now=100.0)
    _, actions = on_poll(BatchState(shares), answer, table())
    assert actions == [Cancelled("1 array task: CANCELLED", True, [1])]


@pytest.mark.parametrize(
    ("share", "task", "seen", "actions", "suspects"),
    [
        pytest.param({"begun": {"a": 3, "b": 1}}, NODE_FAIL, {"alone": {"a"}}, ["a"], [], id="alone"),
        pytest.param({"begun": {"a": 3, "b": 3}}, NODE_FAIL, {}, [], ["a", "b"], id="among others"),
        pytest.param({"begun": {"a": 2, "b": 1}}, NODE_FAIL, {"alone": {"a"}}, [], ["a"], id="before the last time"),
        pytest.param({"begun": {"a": 3, "b": 3}}, TIMEOUT, {"by_limit": {"a"}}, ["a"], [], id="by the time limit"),
        pytest.param({"begun": {"a": 3, "b": 3}}, TIMEOUT, {"alone": {"a"}}, [], [], id="late, by the time limit"),
    ],
)
def test_a_run_fails_only_if_it_alone_can_have_ended_its_element(
    share: dict[str, Any], task: Task, seen: dict[str, Any], actions: list[str], suspects: list[str]
) -> None:
    begun = Counter(share["begun"])
    batch, decided = poll(gone(begun=begun), task, seen=NOTHING._replace(**seen))
    assert decided == ([GiveUp(0, actions, 1, task.reason)] if actions else [])
    assert (batch.shares[0].suspects, batch.resubmit) == (suspects, {0: task.reason})


@pytest.mark.parametrize(
    ("task", "seen", "is_longest", "failed"),
    [
        pytest.param(TIMEOUT, WHOLE, True, ["a"], id="it had all of the time, and there is no more"),
        pytest.param(TIMEOUT, WHOLE, False, [], id="the next element gets more time"),
        pytest.param(TIMEOUT, {**WHOLE, "allowed_s": 90.0}, True, [], id="somebody has shortened its time"),
        pytest.param(TIMEOUT, {**WHOLE, "by_limit": set()}, True, [], id="it began late"),
        pytest.param(NODE_FAIL, {"by_limit": {"a"}}, True, [], id="another reason has ended the element"),
    ],
)
def test_a_run_that_needs_more_time_than_an_element_can_get_is_not_tried_again(
    task: Task, seen: dict[str, Any], failed: list[str], *, is_longest: bool
) -> None:
    batch, decided = poll(gone(begun=Counter(a=1, b=1)), task, seen=NOTHING._replace(**seen), is_longest=is_longest)
    assert [action.executions for action in decided if isinstance(action, GiveUp)] == ([failed] if failed else [])
    assert batch.resubmit.keys() == {0}


@pytest.mark.parametrize(
    ("task", "begun", "failed"),
    [
        pytest.param(TIMEOUT, 9, [], id="time was over"),
        pytest.param(TIMEOUT, MOST_CONTINUED, ["a"], id="time was over again and again"),
        pytest.param(NODE_FAIL, 9, ["a"], id="it may have ended the element"),
    ],
)
def test_a_run_that_has_written_to_its_checkpoint_continues(task: Task, begun: int, failed: list[str]) -> None:
    seen = NOTHING._replace(**{**WHOLE, "alone": {"a"}, "continued": {"a"}})
    batch, decided = poll(gone(begun=Counter(a=begun), tries=3), task, seen=seen, is_longest=True)
    assert [action.executions for action in decided if isinstance(action, GiveUp)] == ([failed] if failed else [])
    assert batch.shares[0].tries == 0
    assert batch.resubmit.keys() == {0}


def test_the_last_run_of_an_element_that_fails_leaves_nothing_to_submit() -> None:
    batch, actions = poll(gone(count=1, begun=Counter(a=3), tries=3), NODE_FAIL, seen=NOTHING._replace(alone={"a"}))
    assert (actions, batch.resubmit) == ([GiveUp(0, ["a"], 3, "NODE_FAIL")], {})


@pytest.mark.parametrize(
    ("share", "ends"),
    [
        pytest.param({"tries": 2}, False, id="it may be tried again"),
        pytest.param({"tries": 3, "done": 1}, False, id="it has made progress"),
        pytest.param({"tries": 3, "trouble": "no space"}, True, id="it was tried as often as allowed"),
        pytest.param({"tries": 3, "begun": Counter(a=1)}, False, id="its runs are executed one by one then"),
        pytest.param({"tries": 6, "begun": Counter(a=1)}, True, id="that did not help either"),
    ],
)
def test_elements_without_progress_end_the_session(share: dict[str, Any], *, ends: bool) -> None:
    batch, actions = poll(gone(**share), NODE_FAIL)
    assert [type(action) for action in actions] == ([End] if ends else [])
    assert list(batch.resubmit) == ([] if ends else [0])


def test_an_error_for_an_element_names_the_number_of_tries_and_the_reason() -> None:
    _, [end] = poll(gone(tries=3), NODE_FAIL)
    assert isinstance(end, End)
    assert str(end.error) == "array task 0 was executed 3 times and ended before any of its runs ended: NODE_FAIL"


def test_a_task_that_could_not_be_launched_is_cancelled_and_submitted_again() -> None:
    batch, actions = poll(BatchState((Share(2, tries=1),)), MISHAP)
    assert (actions, batch.shares[0].trouble) == ([Cancel([0])], MISHAP.reason)
    batch.shares[0].ours = True  # it is cancelled now
    batch, actions = poll(batch, CANCELLED)
    assert (actions, batch.resubmit) == ([], {0: f"{MISHAP.reason} ({CANCELLED.reason})"})


def test_a_task_that_never_begins_ends_the_session() -> None:
    assert poll(BatchState((Share(2),)), NO_NODE)[1] == [Refused(NO_NODE)]


@pytest.mark.parametrize(
    ("uncancelled", "tasks", "phase", "actions"),
    [
        (False, [RUNNING], Phase.STOPPING, []),
        (True, [RUNNING], Phase.STOPPING, [Cancel(None)]),
        (False, [CANCELLED], Phase.OVER, []),
        (False, [], Phase.OVER, []),
    ],
)
def test_a_stopped_batch_is_over_when_nothing_is_alive(
    tasks: Sequence[Task], phase: Phase, actions: Sequence[Action], *, uncancelled: bool
) -> None:
    batch, decided = poll(BatchState((Share(2, gone=5),), Phase.STOPPING, uncancelled=uncancelled), *tasks)
    assert (batch.phase, decided, batch.resubmit) == (phase, actions, {})


def probed(unknown: int = 0, attempts: int = 0) -> BatchState:
    return BatchState((Share(2, tries=1),), Phase.PROBING, probe_unknown=unknown, probe_attempts=attempts)


@pytest.mark.parametrize(
    ("batch", "tasks", "actions", "unknown", "attempts"),
    [
        pytest.param(probed(2), [QUEUED], [], 0, 0, id="it waits"),
        pytest.param(probed(2), [RUNNING], [], 0, 0, id="it runs"),
        pytest.param(probed(PROBE_UNKNOWN - 1), [], [], PROBE_UNKNOWN, 0, id="its record may arrive late"),
        pytest.param(probed(PROBE_UNKNOWN), [], [LostProbe("", again=True)], 0, 1, id="it is lost"),
        pytest.param(probed(PROBE_UNKNOWN, 2), [], [LostProbe("", again=False)], 0, 3, id="it is lost at each attempt"),
        pytest.param(probed(PROBE_UNKNOWN), [NODE_FAIL], [LostProbe("NODE_FAIL", again=False)], 0, 1, id="it failed"),
        pytest.param(probed(), [MISHAP], [Restart()], 0, 1, id="it could not be launched"),
        pytest.param(probed(0, 2), [MISHAP], [Cancel([0])], 1, 2, id="it could never be launched"),
        pytest.param(probed(), [NO_NODE], [Refused(NO_NODE)], 1, 0, id="it will never begin"),
        pytest.param(
            *(probed(), [CANCELLED], [Cancelled("before any node was checked", sure=True, job="7")], 1, 0), id="cancelled"
        ),
    ],
)
def test_faults_of_the_preflight_job(
    batch: BatchState, tasks: Sequence[Task], actions: Sequence[Action], unknown: int, attempts: int
) -> None:
    after, decided = poll(batch, *tasks)
    assert (decided, after.probe_unknown, after.probe_attempts, after.phase) == (actions, unknown, attempts, Phase.PROBING)


def test_a_cancelled_preflight_job_does_not_end_the_session_if_the_project_says_so() -> None:
    batch, actions = poll(probed(), CANCELLED, settings=table(cancelled="resubmit"))
    assert (actions, batch.probe_unknown) == ([], 1)


def test_an_answer_ends_the_time_without_answers() -> None:
    batch, _ = poll(BatchState((Share(2),), reachable=False), RUNNING)
    assert (batch.reachable, batch.alive) == (True, {0})


def test_decisions_do_not_change_the_state_before() -> None:
    for batch in (gone(begun=Counter(a=3), tries=2, reason="OUT_OF_MEMORY"), probed(0, 2)):
        before = copy.deepcopy(batch)
        poll(batch, MISHAP)
        poll(batch, CANCELLED, seen=NOTHING._replace(alone={"a"}))
        assert batch == before

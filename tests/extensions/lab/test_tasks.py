"""Which host gets which share."""

from __future__ import annotations

from pathlib import Path

import pytest

from sierra.errors import Damaged
from sierra.extensions.lab.tasks import AHEAD, Stage, Tasks, deal, to_withdraw
from sierra.store.layout import SessionPaths


@pytest.fixture
def tasks(tmp_path: Path) -> Tasks:
    tasks = Tasks(SessionPaths(tmp_path))
    tasks.submit(range(10))
    return tasks


def test_hosts_get_a_share_for_each_slot_and_one_more(tasks: Tasks) -> None:
    dealt = deal(tasks, {"pc1": 1, "pc2": 3})
    assert [task.element for task in dealt] == list(range(AHEAD * (1 + 3)))
    assert len(list(tasks.on("pc1"))) == AHEAD
    assert not deal(tasks, {"pc1": 1, "pc2": 3})


def test_a_host_that_joins_gets_the_next_shares(tasks: Tasks) -> None:
    deal(tasks, {"pc1": 1})
    assert [task.host for task in deal(tasks, {"pc1": 1, "pc2": 1})] == ["pc2", "pc2"]


def test_before_this_machine_leaves_hosts_get_everything(tasks: Tasks) -> None:
    tasks.without_end = True
    deal(tasks, {"pc1": 1, "pc2": 3})
    assert not tasks.waiting()
    assert len(list(tasks.on("pc2"))) > len(list(tasks.on("pc1")))


def test_without_hosts_everything_waits(tasks: Tasks) -> None:
    assert not deal(tasks, {})
    assert len(tasks.waiting()) == 10


def test_a_share_that_waits_at_a_busy_host_goes_to_an_idle_one(tasks: Tasks) -> None:
    for task in deal(tasks, {"pc1": 9})[:9]:
        task.stage = Stage.RUNNING
    [behind] = [task for task in tasks.alive() if task.stage is Stage.SENT]
    assert to_withdraw(tasks, {"pc1": 9}) is None
    assert to_withdraw(tasks, {"pc1": 9, "pc2": 1}) is behind


def test_tasks_are_read_as_they_were_written(tasks: Tasks) -> None:
    deal(tasks, {"pc1": 2})
    tasks.contents = {"/code": "code"}
    tasks.save()
    assert Tasks.load(tasks.session) == tasks


def test_each_job_has_an_id_of_its_own(tasks: Tasks) -> None:
    jobs = {tasks.submit([3]), tasks.submit([3]), Tasks(tasks.session).submit([3])}
    assert len(jobs) == 3, "also if a session submits several times"


def test_a_damaged_record_of_tasks_is_named(tasks: Tasks) -> None:
    tasks.session.carried.write_text('{"tasks": [{}]}')
    with pytest.raises(Damaged, match=r"carried\.json: cannot be read"):
        Tasks.load(tasks.session)

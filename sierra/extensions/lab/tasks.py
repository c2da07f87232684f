"""The tasks of a session in a lab: which element is to be started, where it is, and how it ended. It knows no connection."""

from __future__ import annotations

import json
import secrets
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from enum import StrEnum
from functools import partial

from sierra.errors import Damaged
from sierra.store.layout import SessionPaths
from sierra.store.segments import disk_errors
from sierra.util.fs import write_whole
from sierra.util.json_types import JsonView
from sierra.util.lazy_definitions import dataclass, field

Links = Mapping[str, Mapping[str, JsonView]]
OWN = ("number", "without_end", "token", "jobs", "contents", "gpus", "cores", "links")
"""The fields of `Tasks` beside its tasks."""
AHEAD = 2
"""The number of tasks of a host for each of its slots: one that it executes, and one for which the slot need not wait."""


class Stage(StrEnum):
    """The stage of a task."""

    WAITING = "waiting"
    """It is on no host."""
    SENT = "sent"
    """It is on a host, and waits for a slot there."""
    RUNNING = "running"
    ENDED = "ended"


@dataclass(slots=True)
class LabTask:
    """One start of an element."""

    job: str
    element: int
    stage: Stage = Stage.WAITING
    host: str = ""
    entry: str = ""
    """Its name on the host: see `agent.host_folder`."""
    reason: str = ""
    """Why it ended, if it did not end by itself."""
    ours: bool = False
    """True if this project has told it to end."""
    blameless: bool = False
    """True if it ended because of its host, or of the connection to it."""
    failures: int = 0
    """The number of hosts that could not execute it."""

    @property
    def name(self) -> str:
        """Its job's id on the host, which begins the names of its attempts."""
        return f"{self.job}-{self.entry.partition('.')[0]}"

    def end(self, reason: str, *, blameless: bool = False) -> None:
        self.stage, self.reason, self.blameless = Stage.ENDED, reason, blameless


@dataclass(slots=True)
class Tasks:
    """All tasks of a session, in the order of their submission. It is saved before a host gets to know of a change."""

    session: SessionPaths
    all: list[LabTask] = field(default_factory=list)
    number: int = 0
    """The number of the last entry."""
    without_end: bool = False
    """True if hosts go on without this machine."""
    token: str = field(default_factory=partial(secrets.token_hex, 4))
    """It distinguishes this submission from others of the session, which may submit several times."""
    jobs: int = 0
    """The number of jobs."""
    contents: Mapping[str, str] = field(default_factory=dict)
    """The files and folders of this machine that jobs name, each with the kind of its content."""
    gpus: float | None = None
    """The most GPUs that a run requests, or its share of one; None: it requests none."""
    cores: int = 1
    """The most cores that a run requests."""
    links: Links = field(default_factory=dict)
    """The options of links in `sierra.toml`."""

    @classmethod
    def load(cls, session: SessionPaths) -> Tasks:
        """Read the tasks of a session; none if nothing was submitted. Raises Damaged."""
        try:
            record = json.loads(session.carried.read_bytes())
            tasks = [LabTask(**{**task, "stage": Stage(task["stage"])}) for task in record["tasks"]]
            return cls(session, tasks, **{name: record[name] for name in OWN})
        except FileNotFoundError:
            return cls(session)
        except (OSError, ValueError, TypeError, LookupError) as error:
            raise Damaged(f"{session.carried}: cannot be read: {error}") from error

    def save(self) -> None:
        """Write the tasks. Raises Missing if the disk is full."""
        own = {name: getattr(self, name) for name in OWN}
        tasks = [{name: getattr(task, name) for name in LabTask.__slots__} for task in self.all]  # much faster than `asdict`
        record = {"tasks": tasks, **own}
        with disk_errors(self.session.root):
            write_whole(self.session.carried, json.dumps(record).encode())

    def submit(self, elements: Collection[int]) -> str:
        """Add tasks for these elements; return the id of their job."""
        self.jobs += 1
        job = f"{self.token}-{self.jobs}"
        self.all += [LabTask(job, element) for element in elements]
        return job

    def on(self, host: str) -> Iterator[LabTask]:
        """Yield the tasks on a host that have not ended."""
        return (task for task in self.all if task.host == host and task.stage in (Stage.SENT, Stage.RUNNING))

    def waiting(self) -> list[LabTask]:
        return [task for task in self.all if task.stage is Stage.WAITING]

    def alive(self) -> list[LabTask]:
        return [task for task in self.all if task.stage is not Stage.ENDED]

    def send(self, task: LabTask, host: str) -> None:
        """Put a task on a host."""
        self.number += 1
        task.stage, task.host, task.entry = Stage.SENT, host, f"{self.number}.{task.element}"

    def take_back(self, task: LabTask) -> None:
        """Let a task wait for another host."""
        task.stage, task.host, task.entry = Stage.WAITING, "", ""

    def entry(self, name: str) -> LabTask | None:
        """Return the task with this name on its host, unless it was taken back."""
        return next((task for task in self.all if task.entry == name), None)


def deal(tasks: Tasks, slots: Mapping[str, int]) -> list[LabTask]:
    """Put waiting tasks on the hosts that have the fewest for each of their slots; return these tasks.

    `slots` are those of all hosts that can take tasks. The longest tasks come first.
    """
    loads = Counter({host: sum(1 for _ in tasks.on(host)) for host in slots})
    dealt: list[LabTask] = []
    for task in tasks.waiting():
        host = min(slots, key=lambda name: (loads[name] / slots[name], name), default=None)
        if host is None or (not tasks.without_end and loads[host] >= AHEAD * slots[host]):
            break
        tasks.send(task, host)
        loads[host] += 1
        dealt.append(task)
    return dealt


def to_withdraw(tasks: Tasks, slots: Mapping[str, int]) -> LabTask | None:
    """Return a task that waits for a slot while another host has a free one, if nothing else can be dealt; else None."""
    if tasks.waiting() or tasks.without_end:
        return None
    running = Counter(task.host for task in tasks.all if task.stage is Stage.RUNNING)
    sent = Counter(task.host for task in tasks.all if task.stage is Stage.SENT)
    idle = [host for host, count in slots.items() if running[host] + sent[host] < count]
    behind = [task for task in tasks.all if task.stage is Stage.SENT and running[task.host] >= slots.get(task.host, 0)]
    return behind[-1] if idle and behind else None

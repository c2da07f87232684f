"""The scheduler `lab`: hosts over SSH, without a scheduler and without a shared file system.

The runner of clusters divides a batch into elements and reads their result logs. This scheduler deals the elements to hosts,
carries their files there, and carries the result logs back while they grow. Each host takes a new element when one has ended,
so a fast one takes more. The processes on a host need no connection (see `agent.keeper`): if it is lost, they go on for the
time of the lease. Then they end, and this side lets their elements be submitted again. Which element is where is written down
before a host hears of it, so that a process that takes the session over finds all of them.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from textwrap import shorten
from typing import Any, ClassVar, cast

from sierra.config.cluster_table import ClusterTable
from sierra.errors import ConfigError, Damaged, Missing, SierraError
from sierra.extensions.lab import carried_files
from sierra.extensions.lab.agent import host_folder
from sierra.extensions.lab.agent.host_folder import Record
from sierra.extensions.lab.agent.keeper import LEASE_OVER, REBOOTED
from sierra.extensions.lab.carried_files import Paths, ResultLogs
from sierra.extensions.lab.host_connection import HostConnection
from sierra.extensions.lab.lab_table import Host, LabTable, sizes
from sierra.extensions.lab.tasks import LabTask, Links, Stage, Tasks, deal, to_withdraw
from sierra.runners.base import Work
from sierra.runners.schedulers.base import Bounds, NodeVariables, Request, State, Task
from sierra.store.layout import SessionPaths
from sierra.store.segments import disk_errors
from sierra.util.lazy_definitions import dataclass, field
from sierra.util.lazy_logger import Log
from sierra.util.text import counted, few

log = Log(__name__)
TICK_S = 1.0
REASON = 200
"""The most characters of the reason of each host in one message."""
MARGIN_S = 30.0
"""The seconds after the end of a lease in which a host ends its runs."""
BEGIN_S = 60.0
"""The seconds in which hosts must be ready, if others are."""
FIRST_S = 8.0
"""The seconds after which hosts that are not ready are waited for no longer, if one is."""
REMOVE_S = 3.0
BLAMELESS = (LEASE_OVER, REBOOTED)
TROUBLE = 3
"""The exit status of a task that could not execute runs on its host."""
STATES = {Stage.WAITING: State.QUEUED, Stage.SENT: State.QUEUED, Stage.RUNNING: State.RUNNING, Stage.ENDED: State.ENDED}


@dataclass(slots=True)
class LabHost:
    """A host, as it is known in this process."""

    connection: HostConnection
    unusable: str = ""
    """Why no runs are executed there any more; empty if they are."""
    lost: str = ""
    """Why there is no connection; empty if there is one, or was none yet."""
    leaves: bool = False
    """True if it is not listed any more: it executes what it has begun."""
    resends: bool = True
    """True until the first state that it sends over a connection."""
    seen: set[str] = field(default_factory=set)
    """The entries that it has sent in a state."""
    has_settings: bool = False
    removed: bool = False

    @property
    def slots(self) -> int:
        return self.connection.slots

    @property
    def is_ready(self) -> bool:
        return self.connection.connected and not (self.unusable or self.leaves)


class Lab:
    """The scheduler `lab`."""

    name = "lab"
    Options: ClassVar[type[ClusterTable]] = LabTable
    node: ClassVar[NodeVariables] = NodeVariables(
        task=("{SIERRA_LAB_TASK}",), job=("{SIERRA_LAB_JOB}",), host=("{SIERRA_LAB_HOST}",), clock=("{SIERRA_LAB_CLOCK}",)
    )
    requeue = ()
    forgets = False
    _tasks: Tasks
    """The tasks of the session, once it is open."""

    def __init__(self, table: ClusterTable) -> None:
        assert isinstance(table, LabTable)  # noqa: S101 - it is of `Options`
        self._table = table
        self._hosts: dict[str, LabHost] = {}
        self._notes: list[str] = []
        self._changed = threading.Condition(threading.RLock())
        self._withdrawing: set[str] = set()
        self._listed: object = None
        self._follows = self._closed = self._has_changed = False

    @staticmethod
    def refuses(line: str) -> str | None:
        return "a lab has no scheduler"

    def version(self) -> str:
        return "lab"

    def bounds(self) -> Bounds:
        return Bounds()

    def script(self, request: Request) -> str:
        hosts = (f"{host.name}:{host.slots}" if host.slots else host.name for host in self._table.listed().values())
        program = f"{self._table.folder}/programs/…/worker.pyz array_task"
        return f"on each of {', '.join(hosts)}:\n{self._table.python} -I -S {program} {request.folder.name} INDEX\n"

    def explain(self, words: str) -> str:
        return words

    def open(self, session: SessionPaths, work: Work | None, *, follows: bool) -> None:
        self._session = session
        if work is not None:
            session.carried.unlink(missing_ok=True)
        self._tasks = tasks = Tasks.load(session)
        if not follows:
            return
        self._follows = True
        self._logs = ResultLogs(session)
        if work is not None:
            tasks.contents, tasks.links = self._contents(work), cast(Links, work.links)
            tasks.gpus, tasks.cores = work.gpus, work.cores
            tasks.save()
        listed = self._table.listed()
        with self._changed:
            for host in (*listed.values(), *(Host(task.host, None) for task in tasks.alive() if task.host)):
                self._connect(host, leaves=host.name not in listed)
        threading.Thread(target=self._tick, daemon=True).start()
        self._wait_for_hosts()
        if work is not None and not any(host.is_ready for host in self._hosts.values()):
            self.close(over=False)
            why = {name: host.unusable or host.lost or "does not answer" for name, host in self._hosts.items()}
            raise Missing(f"no host of the lab can be used: {few([f'{name}: {reason}' for name, reason in why.items()], 3)}")

    def _contents(self, work: Work) -> dict[str, str]:
        """Return what is copied to hosts, each with the kind of its content."""
        contents = {str(work.code): "code"} if work.code else {}
        if self._session.shared.is_dir():
            contents[str(self._session.shared)] = "files"
        return contents | {str(path): "images" for path in work.files}

    def _connect(self, host: Host, *, leaves: bool = False) -> None:
        """Begin to connect to a host, unless this was done."""
        if host.name in self._hosts:
            self._hosts[host.name].leaves = leaves
            return
        tasks, name = self._tasks, f"{self._session.root.name}-{self._tasks.token}"
        connection = HostConnection(host, self._table, tasks, name, self._lease, self._have, self._handle)
        self._hosts[host.name] = LabHost(connection, leaves=leaves)
        connection.start()

    def _lease(self) -> float | None:
        """Return the seconds for which hosts go on without this machine; None: without end."""
        return None if self._tasks.without_end else self._table.lease

    def _wait_for_hosts(self) -> None:
        """Wait until hosts are ready, or cannot be reached."""
        began = time.monotonic()
        with self._changed:
            while not self._closed:
                undecided = [
                    host for host in self._hosts.values() if not (host.connection.connected or host.unusable or host.lost)
                ]
                is_ready = any(host.is_ready for host in self._hosts.values())
                if not undecided or time.monotonic() - began > (FIRST_S if is_ready else BEGIN_S):
                    break
                self._changed.wait(0.2)

    def sizes(self, durations: Sequence[float]) -> Sequence[int]:
        with self._changed:
            ready = sum(host.slots for host in self._hosts.values() if host.is_ready)
        return sizes(durations, ready or sum(host.slots or 1 for host in self._table.listed().values()))

    def submit(self, request: Request) -> str:
        with self._changed:
            self._check_containers(request.elements)
            job = self._tasks.submit(request.elements)
            self._tasks.save()
            self._dispatch()
        return job

    def _check_containers(self, elements: Sequence[int]) -> None:
        """Raise ConfigError if runs are in containers whose image is in the storage of an engine."""
        common = carried_files.common_job(self._session, elements[0])
        if "client" in common and "images" not in self._tasks.contents.values():
            raise ConfigError("a lab executes containers whose image is a file; use --engine apptainer")

    def look(self, name: str) -> tuple[Task, ...]:
        with self._changed:
            tasks = self._tasks if self._follows else Tasks.load(self._session)
            never = self._never() if self._follows else ""
            return tuple(self._reported(task, never) for task in tasks.all)

    def _reported(self, task: LabTask, never: str) -> Task:
        state = State.STUCK if never and task.stage is Stage.WAITING else STATES[task.stage]
        cancelled = task.ours if task.stage is Stage.ENDED else None
        waits = {Stage.WAITING: "no host is free", Stage.SENT: "its host is busy"}.get(task.stage, "")
        reason = never if state is State.STUCK else task.reason or waits
        return Task(task.job, task.element, state, reason, task.host, cancelled, task.blameless)

    def blameless(self) -> Collection[str]:
        with self._changed:
            return {task.name for task in self._tasks.all if task.blameless}

    def _never(self) -> str:
        """Return why no host will ever execute what waits; empty if one may."""
        hosts = {name: host for name, host in self._hosts.items() if not host.leaves}
        if any(not host.unusable for host in hosts.values()):
            return ""
        reasons = [f"{name}: {shorten(host.unusable, REASON)}" for name, host in hosts.items()]
        return f"no host is left: {few(reasons or ['none is listed'], 3)}"

    def cancel(self, name: str, elements: Sequence[int] | None = None) -> None:
        if not self._follows:
            self._session.cancelled.touch()
            return
        with self._changed:
            for task in self._tasks.alive():
                if elements is None or task.element in elements:
                    self._end(task)
            if elements is None:
                self._tell_all("cancel")
            self._tasks.save()

    def _end(self, task: LabTask) -> None:
        """Let a task end because this project does not need it any more."""
        task.ours = True
        host = self._hosts.get(task.host)
        if task.stage is Stage.WAITING or host is None:
            task.end("cancelled")
        elif not host.connection.connected:
            when = "to the end" if self._tasks.without_end else "until its lease is over"
            self._note(f"{task.host} cannot be reached: it executes what it has {when}, and nobody fetches the results")
            task.end("cancelled")
        else:
            host.connection.send("withdraw", entry=task.entry)
            host.connection.send("end", entry=task.entry)

    def _tell_all(self, do: str, **fields: Any) -> None:
        for host in self._hosts.values():
            if host.connection.connected:
                host.connection.send(do, **fields)

    def notes(self) -> Sequence[str]:
        with self._changed:
            notes, self._notes = self._notes, []
            return notes

    def leave(self) -> None:
        if not self._follows or self._closed:
            return
        with self._changed:
            self._tasks.without_end = True
            self._tell_all("lease", seconds=None)
            self._dispatch()
            self._tasks.save()
            give_up = time.monotonic() + FIRST_S
            left = self._not_there()
            while left and time.monotonic() < give_up:
                self._changed.wait(0.2)
                before, left = left, self._not_there()
                give_up = time.monotonic() + FIRST_S if left < before else give_up
            if left:
                self._note(f"{counted(left, 'array task')} could not be sent to a host; sierra attach sends them")

    def _not_there(self) -> int:
        """Return the number of tasks that no host is known to have."""
        there = {(name, entry) for name, host in self._hosts.items() for entry in host.seen}
        return sum((task.host, task.entry) not in there for task in self._tasks.alive())

    def close(self, *, over: bool) -> None:
        """End the connections; if everything has ended, the hosts forget the session first."""
        with self._changed:
            if self._closed or not self._follows:
                return
            give_up = time.monotonic() + REMOVE_S
            while over and self._alive_there() and time.monotonic() < give_up:
                self._changed.wait(0.1)
            if self._tasks.all and not self._tasks.alive():
                self._tell_all("remove")
                give_up = time.monotonic() + REMOVE_S
                while time.monotonic() < give_up and any(
                    host.connection.connected and not host.removed for host in self._hosts.values()
                ):
                    self._changed.wait(0.1)
            self._closed = True
            hosts = list(self._hosts.values())
        for host in hosts:
            host.connection.close()

    def _alive_there(self) -> bool:
        """Return whether a connected host has tasks whose end it has not told."""
        return any(task.host in self._hosts and self._hosts[task.host].connection.connected for task in self._tasks.alive())

    # ---------------------------------------------------------------- in the threads of connections

    def _have(self) -> Mapping[str, int]:
        with self._changed:
            return self._logs.have()

    def _handle(self, connection: HostConnection, event: Record, content: bytes) -> None:
        """Take in an event of a host, or of the connection to it. Raises Missing if the disk is full, and Damaged."""
        with self._changed:
            if self._closed and event["event"] != "removed":
                return
            host = self._hosts[connection.name]
            match event["event"]:
                case "connected":
                    self._on_connection(host)
                case "state":
                    self._on_state(host, event)
                case "log":
                    self._check_log(event)
                    self._logs.add(event["name"], int(event["at"]), content)
                    return
                case "cut":
                    self._check_log(event)
                    self._logs.cut(event["name"], int(event["at"]))
                case "withdrawn":
                    self._on_withdrawal(host, str(event["entry"]))
                case "trouble":
                    self._put_aside(host, str(event["reason"]))
                case "unusable":
                    self._put_aside(host, str(event["reason"]))
                case "lost":
                    self._on_loss(host, str(event["reason"]))
                case "removed":
                    host.removed = True
                case _:
                    return
            self._dispatch()
            self._changed.notify_all()

    def _check_log(self, event: Record) -> None:
        index = carried_files.index_of(event)
        if all(task.element != index for task in self._tasks.all):
            raise Damaged(f"a host sends results of array task {index}, which the session does not have")

    def _on_connection(self, host: LabHost) -> None:
        if host.lost:
            self._note(f"{host.connection.name}: is connected again")
        host.lost, host.resends, host.has_settings = "", True, False

    def _on_state(self, host: LabHost, event: Record) -> None:
        """Take in the state of the tasks on a host; what it does not know of a lost connection is sent again."""
        queued, running, ended = event["queued"], event["running"], event["ended"]
        name, has_changed = host.connection.name, False
        for task in list(self._tasks.on(name)):
            if task.entry in ended:
                self._on_end(host, task, *ended[task.entry])
            elif task.entry in running:
                if task.ours:
                    host.connection.send("end", entry=task.entry)
                has_changed = has_changed or task.stage is not Stage.RUNNING
                task.stage = Stage.RUNNING
            elif task.entry in queued:
                continue
            elif task.entry in host.seen and task.stage is Stage.RUNNING:
                task.end(f"{name} has no record of its end (is its disk full?)")
                has_changed = True
            elif task.entry in host.seen or (host.resends and not host.is_ready):  # it was withdrawn, or never came
                self._tasks.take_back(task)
                has_changed = True
            elif host.resends:
                self._send(host, task)
        host.resends = False
        host.seen |= {*queued, *running, *ended}
        own = {task.entry for task in self._tasks.on(name)}
        for entry in (*queued, *running):
            if entry not in own and entry not in ended:  # it was given up, or the driver has taken it back
                host.connection.send("withdraw", entry=entry)
                host.connection.send("end", entry=entry)
        self._withdrawing -= {*running, *ended}
        self._has_changed = self._has_changed or has_changed

    def _on_end(self, host: LabHost, task: LabTask, status: int | None, reason: str, line: str) -> None:
        """Take in that a task has ended. If its host could not execute it, another one does."""
        job, name = task.job, host.connection.name
        if line:
            with disk_errors(self._session.logs):
                (self._session.logs / f"{job}_{task.element}.out").write_text(f"{line}\n", "utf-8")
        task.failures += status == TROUBLE
        if status == TROUBLE and task.failures == 1 and not task.ours:  # if another host fails too, runs may be the cause
            said = line.removeprefix("array task: ").removeprefix(f"{name}: ")
            self._put_aside(host, said or reason or "its programs cannot start")
            self._tasks.take_back(task)
        else:
            task.end(f"{name}: {reason}" if reason else "", blameless=reason in BLAMELESS)
        self._has_changed = True

    def _on_withdrawal(self, host: LabHost, entry: str) -> None:
        self._withdrawing.discard(entry)
        host.seen.discard(entry)
        task = self._tasks.entry(entry)
        if task is None or task.stage is not Stage.SENT:
            return
        if task.ours:
            task.end("cancelled")
        else:
            self._tasks.take_back(task)
        self._has_changed = True

    def _on_loss(self, host: LabHost, reason: str) -> None:
        """Take in that there is no connection to a host, after one more attempt to connect."""
        name = host.connection.name
        if not host.lost:
            self._note(f"{name}: {reason}; SIERRA tries again, and other hosts go on")
        host.lost = reason
        self._give_up(host)

    def _give_up(self, host: LabHost) -> None:
        """Let the tasks of a host be submitted again when its lease is over."""
        silent = host_folder.now() - host.connection.heard
        tasks = list(self._tasks.on(host.connection.name))
        if host.connection.connected or not tasks or silent < self._table.lease + MARGIN_S:
            return
        for task in tasks:
            task.end(f"node {host.connection.name} was lost: no connection for {silent:.0f} s", blameless=True)
        self._has_changed = True

    def _put_aside(self, host: LabHost, reason: str) -> None:
        """Send no more tasks to a host, and take back what it has not begun. Its results are still fetched."""
        if host.unusable:
            return
        host.unusable = reason
        self._note(f"{host.connection.name} is not used any more: {reason}")
        self._withdraw_all(host)

    def _withdraw_all(self, host: LabHost) -> None:
        for task in self._tasks.on(host.connection.name):
            if task.stage is Stage.SENT:
                host.connection.send("withdraw", entry=task.entry)

    # ---------------------------------------------------------------- dealing

    def _dispatch(self) -> None:
        """Send waiting tasks to hosts that have room. Raises Missing if the disk is full."""
        if self._session.cancelled.exists() or self._closed:
            slots: dict[str, int] = {}
        else:
            slots = {name: host.slots for name, host in self._hosts.items() if host.is_ready and not host.resends}
        dealt = deal(self._tasks, slots)
        if dealt or self._has_changed:
            self._tasks.save()
            self._has_changed = False
        for task in dealt:
            self._send(self._hosts[task.host], task)
        waits = to_withdraw(self._tasks, slots)
        if waits is not None and waits.entry not in self._withdrawing:
            self._withdrawing.add(waits.entry)
            self._hosts[waits.host].connection.send("withdraw", entry=waits.entry)

    def _send(self, host: LabHost, task: LabTask) -> None:
        """Send a task to its host, with its files."""
        connection, session, index = host.connection, self._session, task.element
        paths = self._paths(connection)
        if not host.has_settings:
            connection.send("file", carried_files.settings(session, paths), name="element.json")
            of_containers = sorted(session.engine.glob("*"))
            for path in (session.worker, *of_containers) if of_containers else ():
                connection.send("file", path.read_bytes(), name=str(path.relative_to(session.root)))
            host.has_settings = True
        connection.send("file", carried_files.jobs(session, index, paths), name=f"elements/{index}.jobs")
        connection.send("file", carried_files.not_to_start(session, index), name=f"elements/{index}.failed")
        alone = session.alone(index).read_bytes() if session.alone(index).exists() else b""
        connection.send("file", alone, name=f"elements/{index}.alone")
        clock = connection.clock.offset_ns / 1e9 if connection.clock else 0.0
        job = f"{task.job}-{task.entry.partition('.')[0]}"
        name, offset = connection.name, f"{clock:.6f}"
        connection.send("queue", entry=task.entry, task=f"{task.job}_{index}", job=job, host=name, clock=offset)

    def _paths(self, connection: HostConnection) -> Paths:
        """Return the paths on a host of what jobs name."""
        folder, session = connection.folder, self._session
        paths = {str(session.root.parent.parent): str(Path(folder).parents[2]), str(session.root): folder}
        return Paths(paths | connection.places)

    def _tick(self) -> None:
        """Notice hosts that are listed or not any more, and leases that are over."""
        while not self._closed:
            time.sleep(TICK_S)
            with self._changed:
                try:
                    self._look_after_hosts()
                except (SierraError, OSError) as error:
                    self._note(str(error))

    def _look_after_hosts(self) -> None:
        if not self._closed:
            self._read_list()
            for host in self._hosts.values():
                if host.unusable:
                    self._give_up(host)
            self._dispatch()

    def _read_list(self) -> None:
        """Use the hosts that were added to the file of hosts, and no more those that were removed."""
        if self._table.file is None:
            return
        try:
            listed = self._table.listed()
        except ConfigError as error:
            self._note(f"{error}; the hosts stay as they were")
            return
        if self._listed in (None, listed):
            self._listed = listed
            return
        self._listed = listed
        for host in listed.values():
            if host.name not in self._hosts:
                self._note(f"{host.name}: is listed now, and used")
            self._connect(host)
        for name, known in self._hosts.items():
            if name not in listed and not known.leaves:
                self._note(f"{name}: is not listed any more; it ends what it has begun")
                known.leaves = True
                self._withdraw_all(known)

    def _note(self, text: str) -> None:
        log.info("%s", text)
        if text not in self._notes:
            self._notes.append(text)

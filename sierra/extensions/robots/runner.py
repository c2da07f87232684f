"""The runner `robots`: executes each run on several robots at once, over SSH. Nothing of SIERRA is installed there.

One run executes at a time. A thread connects to the robots, executes one run after the other (see `trial`), and appends each
result to the session's journal, after its rows of `robots`. Therefore, the results of a killed process are recorded by the next
one. A robot that is missing before a run starts ends the session: the runs that are left were not executed.
"""

from __future__ import annotations

import contextlib
import itertools
import queue
import secrets
import shutil
import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import ClassVar, cast

from sierra.config.field_types import Table
from sierra.config.plugin_registry import LINKS
from sierra.containers.engines.hosts import OtherHost
from sierra.containers.on_hosts import HostContainer
from sierra.errors import ConfigError, Missing, SierraError
from sierra.extensions.hosts.push import content_name, push_content
from sierra.extensions.robots import agent_start, fitting, results
from sierra.extensions.robots.agent.software import Software
from sierra.extensions.robots.agent_link import AgentLink
from sierra.extensions.robots.agent_messages import Record, as_report
from sierra.extensions.robots.fleet_table import FleetTable, RobotTable, allocate, check_groups
from sierra.extensions.robots.trial import STOPPED, Late, Part, Trial, each
from sierra.model import Job, LateFiles, Limits, Member, Result
from sierra.provenance import environment
from sierra.runners.base import Beat, Look, Work
from sierra.runners.journal_reader import Journal, Row, result_of
from sierra.runners.links.base import Link, NoSession, Unreachable
from sierra.runners.local import record
from sierra.store.layout import RUN_STDERR, SessionPaths
from sierra.store.ownership_marks import SESSION
from sierra.store.segments import disk_errors
from sierra.util.json_types import RecordValue
from sierra.util.lazy_logger import Log
from sierra.util.processors import name_of
from sierra.worker import journal
from sierra.worker.files import end_of
from sierra.worker.job import Job as JobRecord
from sierra.worker.journal import Event

log = Log(__name__)
SESSION_S = 10.0
"""The seconds in which a host must execute one more command while its agent serves."""
REJOIN_S = 0.3
SHOWN = 2000
"""The bytes of an engine's errors that explain the end of a program."""
DONE_S = 60.0
"""The seconds in which a robot must remove what a run has left."""
LATE = 1 << 62
"""The least number of the folder of files that were collected late."""
LEADS_S = (0.25, 1.0, 4.0)
"""The seconds that robots have to confirm the common start. If a run has not started, it is tried again with the next ones."""
WAKE: tuple[str, Record] = ("", {})
"""An event of no robot: the thread that executes the run looks at once why it must end."""
NO_FLEET = 'the runner "robots" needs robots; add [runners.robots.fleet.NAME] with host = … to sierra.toml'
MakeLink = Callable[[str, RobotTable], Link]


class StillMoving(SierraError):
    """Robots that may be moving, because their stop command has failed."""


class Robots:
    """The runner `robots`. Runs end with this process, because the robots' leases expire."""

    name = "robots"
    stays = False
    remote = True
    contains_members = True
    Options: ClassVar[type[Table]] = FleetTable

    def __init__(self, slots: int, options: Table, make_link: MakeLink | None = None) -> None:
        """Make a runner; `slots` has no effect. `make_link` makes the link to a robot, by default the one in the options."""
        self._table = cast(FleetTable, options)
        self._make_link = make_link or self._link
        self._events: queue.SimpleQueue[tuple[str, Record]] = queue.SimpleQueue()
        self._notes: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._robots: dict[str, Robot] = {}
        self._moving: dict[str, str] = {}
        """The robots that may be moving, and why. No further run starts."""
        self._stopped: str | None = None
        self._may_begin = threading.Event()
        self._may_begin.set()
        self._trouble: BaseException | None = None
        self._trial: Trial | None = None
        """The run that executes now."""
        self._thread: threading.Thread | None = None

    def submit(self, work: Work, session: SessionPaths) -> None:
        self._work, self._session = work, session
        if not self._table.fleet:
            raise ConfigError(NO_FLEET)
        jobs = list(work.jobs)
        for job in jobs:
            allocate(self._table, [(member.place, member.group) for member in job.members])
        self._journal = Journal(session.journal)
        self._journal.skip()
        session.runs.mkdir(parents=True, exist_ok=True)
        used = [int(path.name) for path in session.runs.iterdir() if path.name.isdigit() and int(path.name) < LATE]
        self._numbers = itertools.count(max(used, default=0) + 1)
        self._writer = journal.Journal(str(session.journal))
        self._code = content_name(work.code) if work.code else None
        beside = next((job.beside for job in jobs if job.beside), None)
        self._beside = content_name(Path(beside)) if beside else None
        self._thread = threading.Thread(target=self._execute, args=(jobs,), daemon=True)
        self._thread.start()

    def check_robots(self, runs: Collection[Sequence[tuple[int, str]]], groups: Collection[str]) -> None:
        if not self._table.fleet:
            raise ConfigError(NO_FLEET)
        check_groups(self._table, groups)
        for places in sorted(runs, key=len, reverse=True):
            allocate(self._table, places)

    def robot_names(self, places: Sequence[tuple[int, str]]) -> Mapping[int, str]:
        return allocate(self._table, places)

    def hold(self) -> None:
        self._may_begin.clear()

    def begin(self) -> None:
        self._may_begin.set()

    def resume(self, session: SessionPaths, recorded: Mapping[str, str | None]) -> None:
        raise NotImplementedError("runs on robots end with the process that started them")

    def leave(self) -> None:
        raise NotImplementedError("runs on robots end with this process")

    def look(self) -> Look:
        alive = self._thread is not None and self._thread.is_alive()
        trial = self._trial
        parts = trial.parts if trial else []
        events, more = self._journal.some()
        notes = tuple(self._notes.get() for _ in range(self._notes.qsize()))
        wrong = None
        if not alive and not more and self._trouble is not None:
            if not isinstance(self._trouble, SierraError):
                raise self._trouble
            wrong = self._trouble
        return Look(
            tuple(event for event in events if isinstance(event, Result)),
            1 if trial else 0,
            alive=alive or more,
            late=tuple(event for event in events if isinstance(event, LateFiles)),
            rows=tuple((event.table, event.row) for event in events if isinstance(event, Row)),
            notes=notes,
            wrong=wrong,
            beats=tuple(Beat(part.name, part.agent.silence, part.before.get("battery")) for part in parts),
            ready=trial is not None and trial.waits,
            stopping=trial is not None and trial.stopped is not None,
            collecting=trial is not None and trial.over,
        )

    def stop(self) -> None:
        self._stopped = self._stopped or STOPPED
        self._events.put(WAKE)

    def close(self) -> None:
        self.stop()
        if self._thread is not None:
            self._thread.join()

    def _execute(self, jobs: Sequence[Job]) -> None:
        """Execute the jobs, one after the other, until one has left a robot that may be moving."""
        try:
            for job in jobs:
                if self._stopped is not None or self._moving:
                    break
                self._run(job)
        except BaseException as error:
            self._trouble = error
        if self._moving and (self._trouble is None or isinstance(self._trouble, SierraError)):
            self._trouble = self._still_moving()
        for robot in self._robots.values():
            with contextlib.suppress(SierraError, OSError, EOFError):
                robot.close()

    def _still_moving(self) -> StillMoving:
        reasons = "; ".join(f"{name} may be moving: {reason}" for name, reason in self._moving.items())
        return StillMoving(f"{reasons}; stop it by hand, and correct stop in [runners.robots]")

    def _run(self, job: Job) -> None:
        """Execute one run, and append its result to the journal. Raises SierraError if it was not started.

        It is tried again if a robot did not confirm the start in time, as on a busy machine, or if a connection was lost since
        the last run.
        """
        for lead in LEADS_S:
            try:
                self._try(job, lead)
            except (Late, Unreachable) as error:
                lost = [robot for robot in self._robots.values() if robot.forget_if_lost()]
                if lead == LEADS_S[-1] or self._stopped or not (lost or isinstance(error, Late)):
                    raise
                log.warning("trying again: %s", error)
            else:
                return

    def _try(self, job: Job, lead: float) -> None:
        """Execute one run as `_run` does, once. `lead` is as in `Trial.execute`. Raises SierraError."""
        self._check_room()
        taken = allocate(self._table, [(member.place, member.group) for member in job.members])
        robots = {number: self._robot(name) for number, name in taken.items()}
        each(Robot.connect, robots.values())
        each(Robot.examine, robots.values())
        each(Robot.supply, robots.values())
        if self._stopped is not None:
            return
        fitting.check_addresses({robot.name: robot.address for robot in robots.values()})
        fitting.check_time_zones({robot.name: robot.hello for robot in robots.values()})
        addresses = {f"SIERRA_ADDRESS_{number}": robot.address for number, robot in robots.items() if robot.address}
        parts = [self._part(job, member, robots[member.place], addresses) for member in job.members]
        attempt = f"{job.execution[:16]}-{secrets.token_hex(4)}"
        trial = Trial(
            attempt,
            parts,
            self._table,
            self._events,
            stopping=lambda: self._stopped,
            notice=self._notes.put,
            may_begin=self._may_begin.is_set,
        )
        self._trial = trial
        try:
            try:
                executed = trial.execute(lead)
            finally:
                for part in parts:
                    self._robots[part.name].take_changes(part.before.get("software"))
                self._note_moving(parts)
            if executed:
                with disk_errors(self._session.root):
                    self._keep(trial, job)
                self._note_moving(parts)
                for part in parts:
                    if part.failure and not part.started:
                        raise Missing(f"{part.name}: not ready: {part.failure}")
        finally:
            self._trial = None

    def _note_moving(self, parts: Iterable[Part]) -> None:
        self._moving.update((part.name, part.moving) for part in parts if part.moving)

    def _check_room(self) -> None:
        """Check that what a run measures can be kept on this machine. Raises Missing."""
        least = self._table.disk_min
        for folder in dict.fromkeys((self._session.root, self._session.runs)):
            free = shutil.disk_usage(folder).free
            if free < least:
                raise Missing(f"this machine: the disk of {folder} has {free} bytes free, less than disk_min = {least}")

    def _keep(self, trial: Trial, job: Job) -> None:
        """Pull what the run has left, and append its result to the journal."""
        folder = self._next_folder()
        folder.mkdir()
        trial.finish(folder, lambda part: self._rejoin(part, trial.attempt))
        for part in trial.parts:
            if container := self._robots[part.name].container:
                classify(part, container)
        own = record(replace(job, members=()))
        end = results.result(trial, own, folder)
        for part in trial.parts:
            self._robots[part.name].forget_if_lost(part)
        for text in results.notes(trial):
            self._notes.put(text)
        for table, row in self._rows(trial, own):
            self._writer.write(cast(Event, {"event": "row", "table": table, "row": as_json(row)}))
        first = trial.parts[0]
        isolated = {"isolation": first.hello["isolation"]} if "isolation" in first.hello else {}
        more = {"environment": first.hello.get("environment"), "robots": {str(p.place): p.name for p in trial.parts}}
        self._writer.write(cast(Event, {**end, **more, **isolated}))

    def _rejoin(self, part: Part, attempt: str) -> Record:
        """Connect to a lost robot again, if it comes back within the time of a lease. Raises Unreachable."""
        robot = self._robots[part.name]
        robot.forget_if_lost(part)
        give_up = time.monotonic() + self._table.lease
        while True:
            try:
                return robot.connect(attempt)
            except Unreachable:
                if time.monotonic() > give_up or self._stopped:
                    raise
                time.sleep(REJOIN_S)

    def _rows(self, trial: Trial, job: JobRecord) -> list[tuple[str, Mapping[str, RecordValue]]]:
        robots = [self._robots[part.name] for part in trial.parts]
        isolations = [row for robot in robots if robot.container and (row := robot.container.isolation.row)]
        return [
            *(("environments", robot.environment) for robot in robots if robot.environment),
            *(("isolations", row._asdict()) for row in isolations),
            *results.rows(trial, job),
        ]

    def _collect(self, robot: Robot, left: Record) -> None:
        """Copy what an earlier run has left on a robot, to be recorded with it. Raises Missing, Unreachable."""
        folder = self._session.runs / str(LATE + secrets.randbits(62))  # not one that the journal names already
        robot.agent.pull(f"{robot.hello['folder']}/runs/{left['attempt']}/1", folder)
        late = {"execution": left["execution"], "place": left["place"], "robot": robot.name, "directory": str(folder)}
        self._writer.write(cast(Event, {"event": "late", **late}))

    def _next_folder(self) -> Path:
        return self._session.runs / str(next(self._numbers))

    def _part(self, job: Job, member: Member, robot: Robot, addresses: Mapping[str, str]) -> Part:
        """Return the part of a run that a robot executes. `addresses`: variables with those of all robots of the run."""
        if self._work.code:
            fitting.check_programs(robot.name, robot.arch, member, self._work.code, robot.agent.link)
        placed = member.at("\0", robot.code, robot.arch)
        given = robot.options.variables if robot.container else robot.hello["variables"]  # a setup line is about the host
        variables = {**given, **placed.environment, **addresses, "SIERRA_EXECUTION": job.execution}
        if robot.address:
            variables["SIERRA_ADDRESS"] = robot.address
        own = replace(
            job,
            argv=placed.argv,
            environment=variables,
            files=placed.files,
            folders=placed.folders,
            limits=replace(member_limits(job.limits, member.place), grace_s=self._table.grace),
            beside=robot.beside(Path(job.beside), self._beside) if job.beside else None,
            client=robot.container.client(placed.argv, variables, waits=True) if robot.container else None,
            observe=robot.folders() if job.observe is not None else None,
            budget=None,
            affordable=None,
            experiment=None,
            helps=None,
            members=(),
        )
        unchanged = robot.container.files if robot.container else {}
        return Part(member.place, member.group, robot.agent, robot.hello, record(own), unchanged)

    def _robot(self, name: str) -> Robot:
        if name not in self._robots:
            options = self._table.robot(name)
            link = self._make_link(name, options)
            link.python = self._table.python
            agent = AgentLink(name, link, self._table.lease, self._events)
            self._robots[name] = Robot(
                name, options, self._table, agent, self._work, self._code, self._session, self._notes, self._collect
            )
        return self._robots[name]

    def _link(self, name: str, options: RobotTable) -> Link:
        kind = self._table.link
        link: Link = LINKS.make(kind, {kind: {**self._work.links.get(kind, {}), **options.link_options}}, options.host)
        return link


@dataclass(eq=False)
class Robot:
    """One robot of the fleet, and its agent once it is connected."""

    name: str
    options: RobotTable
    _table: FleetTable
    agent: AgentLink
    _work: Work
    _code: str | None
    """The name of the folder of the code on robots; None if the runs do not need it."""
    _session: SessionPaths
    _notes: queue.SimpleQueue[str]
    _collect: Callable[[Robot, Record], None]
    """Copies what an earlier run has left there."""
    container: HostContainer | None = None
    """The containers there; None without containers, or before `examine`."""
    hello: Record = field(default_factory=dict)
    environment: Mapping[str, RecordValue] = field(default_factory=dict)
    code: str = ""
    """The folder of the code there."""
    _connected: bool = False
    _examined: bool = False
    _supplied: bool = False

    @property
    def _root(self) -> str:
        return self._table.folder.removeprefix("~/")

    def examine(self) -> None:
        """Check that containers can be executed there, before anything is copied for runs. Raises Missing, Unreachable."""
        if self._examined or not self._work.containers:
            return
        with self._named():
            host = OtherHost(self.name, self.agent.link, self._root, self._table.python)
            self.container = self._work.containers.on(host)
            for note in self.container.notes:
                self._notes.put(note)
        self._examined = True

    @property
    def address(self) -> str | None:
        """Return its address for other robots; None if it is unknown."""
        return self.options.address or self.hello.get("address")

    def connect(self, keep: str | None = None) -> Record:
        """Start the agent unless it is there, and return what it says about its robot, which it has brought to a standstill.

        `keep`: an attempt whose files are still to be collected. Raises Missing, Unreachable, UntrustedHost.
        """
        if self._connected and self.agent.lost is None:
            return self.hello
        try:
            with self._named():
                session = self._session.root.name
                self.hello = agent_start.start(self.agent, self.options, self._table, session, self._work.store)
                self._check_sessions()
        except SierraError:
            self.agent.abandon("the connection was given up")
            raise
        self._connected, self._supplied = True, False
        self._describe(self.hello["software"])
        self._note_isolation()
        for left in self.hello["leftovers"]:
            if left["attempt"] != keep:
                with self._named():
                    self._settle(left)
        return self.hello

    def _settle(self, left: Record) -> None:
        """Collect what an earlier run of this store has left, and remove it. Raises Missing, Unreachable."""
        ended = f", and ended {left['ended']} of its processes" if left["ended"] else ""
        for problem in (as_report(left["report"]) or {}).get("problems", ()):
            self._notes.put(f"{self.name}: after an earlier run, {problem}")
        who = left["who"] or {}
        if who.get("store") not in (None, self._work.store) or self._is_recorded_by_others(str(who.get("session"))):
            self._notes.put(f"{self.name}: keeps what a run of {who.get('text', 'another user')} has left{ended}")
            return
        try:
            if left["files"] and left["execution"] and left["place"] is not None:
                self._collect(self, left)
        except Unreachable:
            raise
        except Missing as error:
            self._notes.put(f"{self.name}: keeps what an earlier run has left{ended}: {error}")
            return
        self.agent.ask("done", DONE_S, attempt=left["attempt"])
        self._notes.put(f"{self.name}: removed what an earlier run had left{ended}")

    def _is_recorded_by_others(self, session: str) -> bool:
        """Return whether another session of this store has not ended, which may not have recorded its runs yet."""
        own = self._session.root
        return bool(SESSION.fullmatch(session)) and session != own.name and (own.parent / session).is_dir()

    def supply(self) -> None:
        """Copy what runs need there, unless this was done. Raises Missing, Unreachable."""
        if self._supplied:
            return
        with self._named():
            link, work = self.agent.link, self._work
            code = push_content(link, work.code, self._root, "sources", self._code) if work.code else ""
            if self.container:
                self._give_image(self.container, code)
                self._note_isolation()
        self.code = f"{self.hello['folder']}/{code.removeprefix(self._root + '/')}"
        self._supplied = True

    def _note_isolation(self) -> None:
        """Add the isolation of its containers to its description, once it is known."""
        if self.container and (row := self.container.isolation.row):
            self.hello["isolation"] = row.isolation

    @contextlib.contextmanager
    def _named(self) -> Iterator[None]:
        """Let errors of the block begin with the robot's name."""
        try:
            yield
        except SierraError as error:
            if str(error).startswith(f"{self.name}:"):
                raise
            raise type(error)(f"{self.name}: {error}") from error

    def _check_sessions(self) -> None:
        """Check that files can be copied while the agent occupies a session of the link. Raises Missing, Unreachable."""
        try:
            self.agent.link.run(("true",), timeout=SESSION_S)
        except NoSession as error:
            raise NoSession(f"{error}; a run needs two sessions at once, one for the agent and one for files") from error

    @property
    def arch(self) -> str:
        """Return the name of its processor."""
        return name_of(str(self.hello["facts"]["machine"]))

    def _give_image(self, container: HostContainer, code: str) -> None:
        """Give the robot the image, and copies of what is mounted."""
        copies = {one: self._copied(container, Path(one)) for one in container.sources}
        container.supply(container.placed(code) if code else "", copies, self._notes.put)

    def _copied(self, container: HostContainer, source: Path) -> str:
        """Return the path on the robot of a copy of a file or folder."""
        folder = container.placed(push_content(self.agent.link, source, self._root, "mounts"))
        return f"{folder}/{source.name}" if source.is_file() else folder

    def folders(self) -> dict[str, str]:
        """Return the folders there that names of observed files refer to."""
        home, own = self.hello["home"], self.hello["folder"]
        return {"project": self.code or own, "home": home, "cache": f"{home}/.cache", "store": own}

    def take_changes(self, software: Software | None) -> None:
        """Take what the agent has reported before a run: its software, if this has changed since the last report."""
        if software is not None:
            self._describe(software)

    def _describe(self, software: Software) -> None:
        """Take the row of `environments` from what the agent reported."""
        variables = {
            name: value for name, value in self.hello["variables"].items() if environment.is_recorded(name, self._work.record)
        }
        around = {**self._work.around, "variables": ""}
        row = environment.elsewhere(around, self.hello["facts"], variables, software)
        self.environment = dict(row)
        self.hello["environment"] = row["environment"]

    def beside(self, folder: Path, name: str | None) -> str:
        """Copy the files beside the inputs of all runs to the robot; return their folder there. `name`: that of its content."""
        target = push_content(self.agent.link, folder, self._root, "beside", name)
        return f"{self.hello['folder']}/{target.removeprefix(self._root + '/')}"

    def forget_if_lost(self, part: Part | None = None) -> bool:
        """Connect again before the next run if the robot was lost; return whether it was."""
        lost = self._connected and ((part is not None and part.lost is not None) or self.agent.lost is not None)
        if lost:
            self.agent.abandon("the robot was lost")
            self._connected = False
        return lost

    def close(self) -> None:
        """Give the robot back, and end the connection."""
        if self._connected and self.agent.lost is None:
            if self.container:
                with contextlib.suppress(SierraError):
                    self.container.engine.sweep([self._session.root.name])
            self.agent.close()
        self.agent.link.close()


def classify(part: Part, container: HostContainer) -> None:
    """Replace the end of the engine's client by that of the program, in the report of a part whose files were pulled."""
    end = part.end
    if end is None or end["exit_code"] == 0 or part.files is None:
        return
    errors = end_of(str(part.files / RUN_STDERR), SHOWN).decode("utf-8", "replace")
    result = container.classify(result_of(end), errors)
    end["exit_code"], end["signal"] = result.exit_code, result.signal
    end["stopped"], end["error"] = result.stopped, result.error


def as_json(row: Mapping[str, RecordValue]) -> dict[str, object]:
    """Return a row whose times are texts."""
    return {name: value.isoformat() if isinstance(value, datetime) else value for name, value in row.items()}


def member_limits(given: Limits, place: int) -> Limits:
    """Return the limits of a run for the robot at a place: the marker of another place does not end its program."""
    folder, separator, own = (given.marker or "").partition("/")
    if given.after_marker_s is None or not separator or not folder.isdecimal():
        return given
    return (
        replace(given, marker=own) if int(folder) == place else replace(given, after_marker_s=None, marker=None, contains=None)
    )

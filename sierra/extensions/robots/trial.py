"""One run on several robots: check, arm, common start, supervision, stop of all together, and pull.

Nothing starts unless all robots are ready. They may have to wait then until a person says go; if one drops out meanwhile, all
others are disarmed. If one is lost while the run executes, or if its program fails, all others are told to stop. What was
measured is pulled from every robot that can be reached.

The start is common: each robot gets the time by its own clock, from the offset that was measured just before. A robot that gets
this time too late refuses, and all others are told to stop before their time has come.
"""

from __future__ import annotations

import contextlib
import queue
import time
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from sierra.errors import Missing, SierraError
from sierra.extensions.hosts.clock import Clock
from sierra.extensions.robots.agent.clock_watch import ClockWatch, Course
from sierra.extensions.robots.agent_link import AgentLink, Refused
from sierra.extensions.robots.agent_messages import Record, as_report
from sierra.extensions.robots.fleet_table import FleetTable
from sierra.runners.links.base import Unreachable
from sierra.worker.job import Job
from sierra.worker.journal import End
from sierra.worker.running import START_S

ARM_S = START_S + 30.0
"""The seconds in which a robot must have its input files, and must have started its container."""
CHECK_S = 30.0
CANCEL_S = 0.1
"""The seconds before the start in which the others can still be told that a robot did not confirm it."""
ROUND_TRIPS = 6
POLL_S = 0.02
MARGIN_S = 1.0
"""The seconds that a robot may be silent after its lease, before it counts as lost."""
SETTLE_S = 6.0
"""The seconds that an agent may take to report an end, after the grace time and the time of the stop command."""
OVER = "the run is over"
"""The reason for the stop when the base station's program has ended successfully."""
STOPPED = "the runs were ended by the user"
Item = TypeVar("Item")
Made = TypeVar("Made")


class Late(Missing):
    """A common start that a robot did not confirm in time, so that none has started."""


@dataclass
class Part:
    """The part of one robot in a run, and what became of it."""

    place: int
    group: str
    agent: AgentLink
    hello: Record
    """The agent's description of its robot."""
    job: Job
    unchanged: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    """Files on the robot that must not have changed since they were verified, with the kernel's data about them then."""
    before: Record = field(default_factory=dict)
    """The agent's measurements before the run, and after it."""
    after: Record = field(default_factory=dict)
    clock: Clock | None = None
    clock_after: Clock | None = None
    course: Course | None = None
    """The course of its clock between both measurements; None if it was measured once."""
    armed: bool = False
    """True if its agent may have the run."""
    started: bool = False
    ended: Record | None = None
    """The agent's report on the end."""
    lost: str | None = None
    """The reason why the robot counts as lost; None if it does not."""
    files: Path | None = None
    """The folder of the run that was pulled from it."""
    problem: str | None = None
    """The reason why nothing was pulled."""
    refused_stop: str | None = None
    """The reason why a lost robot, which has come back, may still be moving."""

    @property
    def name(self) -> str:
        return self.agent.name

    @property
    def is_open(self) -> bool:
        """Return whether its end is still to come."""
        return self.ended is None and self.lost is None

    @property
    def end(self) -> End | None:
        """Return the worker's report; None if there is none."""
        return (self.ended or {}).get("end")

    @property
    def moving(self) -> str | None:
        """Return why the robot may still be moving; None if it stands still, as far as its agent knows."""
        return self.refused_stop or (self.ended or {}).get("moving")

    @property
    def failure(self) -> str | None:
        """Return how its program failed by itself; None if it did not, or if it was told to stop."""
        if self.ended is None or self.ended["why"] is not None:
            return None
        end = self.end
        if end is None:
            return str(self.ended["problems"][-1])
        if end["error"] or end["stopped"]:
            return end["error"] or f"{end['stopped']} limit exceeded"
        if end["signal"] is not None:
            return f"a signal ({end['signal']}) ended its program"
        return f"its program ended with status {end['exit_code']}" if end["exit_code"] else None


@dataclass(eq=False)
class Trial:
    """One run while it executes."""

    attempt: str
    parts: list[Part]
    table: FleetTable
    _events: queue.SimpleQueue[tuple[str, Record]]
    stopping: Callable[[], str | None]
    """Returns why it must end; None while it may go on."""
    notice: Callable[[str], None]
    may_begin: Callable[[], bool]
    stopped: str | None = None
    """The reason why the robots were told to stop; the first one counts."""
    at_ns: int = 0
    """The common start by this host's clock."""
    waits: bool = False
    """True while all robots are armed, and the run may not begin."""
    over: bool = False
    """True from the end of the run on all robots on."""
    course: Course | None = None
    """The course of this host's clock between the measurements of the robots' clocks; None before the last ones."""
    _stopped_at: float = 0.0
    _silent: set[str] = field(default_factory=set)
    _watch: ClockWatch = field(default_factory=ClockWatch)

    def execute(self, lead: float) -> bool:
        """Execute the run until it has ended on all robots; return False if it was stopped before it began.

        Between the last measurement of the clocks and the start are `lead` seconds, and `ROUND_TRIPS` round trips. Raises
        Missing if it could not start.
        """
        try:
            self._check()
            self._arm()
            self._hold()
            if reason := self.stopping():
                return self._cancel(reason)
            self._measure()
            self._start(lead)
        except SierraError as error:
            if not self._cancel(f"not all robots were ready: {error}"):
                raise
        self._supervise()
        if dead := [part for part in self.parts if part.failure and not part.started]:
            self._give_up(dead[0])
        self.over = True
        return True

    def _give_up(self, dead: Part) -> None:
        """Raise Missing for a robot that cannot execute runs, unless the program has begun on another robot."""
        if not any(part.started for part in self.parts):
            each(self._disarm, [part for part in self.parts if part.ended])
            raise Missing(f"{dead.name}: not ready: {dead.failure}")

    def _check(self) -> None:
        """Check battery, disk and the declared conditions. Raises Missing."""

        def check(part: Part) -> None:
            part.before = part.agent.ask("check", CHECK_S, unchanged=part.unchanged)

        each(check, self.parts)
        for part in self.parts:
            if reason := self._unfit(part.before):
                raise Missing(f"{part.name}: {reason}")

    def _unfit(self, found: Record) -> str | None:
        table = self.table
        for value, reason in found["unread"].items():
            return f"its {value} cannot be read: {reason}"
        if found["battery"] is not None and found["battery"] < table.battery_min:
            return f"its battery has {found['battery']:g} %, less than battery_min = {table.battery_min:g}"
        if found["disk"] < table.disk_min:
            return f"its disk has {found['disk']} bytes free, less than disk_min = {table.disk_min}"
        return f"not ready: {found['failed'][0]}" if found["failed"] else None

    def _arm(self) -> None:
        def arm(part: Part) -> None:
            part.armed = True
            try:
                part.agent.ask("arm", ARM_S, attempt=self.attempt, place=part.place, job=part.job)
            except Refused:
                part.armed = False
                raise

        each(arm, self.parts)

    def _hold(self) -> None:
        """Wait until the run may begin, or is stopped. Raises Missing if a robot drops out."""
        self.waits = True
        try:
            while True:
                while not self._events.empty():
                    self._take(POLL_S)
                for part in self.parts:
                    self._listen(part)
                    if not part.is_open:
                        reason = part.lost or part.failure or (part.ended or {}).get("why")
                        raise Missing(f"{part.name}: was ready, but cannot start any more: {reason}")
                if self.may_begin() or self.stopping():
                    return
                self._take(POLL_S)
        finally:
            self.waits = False

    def _measure(self) -> None:
        """Measure all clocks, and begin to watch them. Raises Missing if one cannot be measured well enough."""

        def measure(part: Part) -> Clock:
            part.agent.ask("watch")
            return part.agent.clock(self._watch.now_ns)  # the start is by this clock, also if the wall clock is set

        self._watch = ClockWatch()
        for part, clock in zip(self.parts, each(measure, self.parts), strict=True):
            part.clock = clock
            if clock.rtt_ns / 2e9 > self.table.clock_error:
                raise Missing(
                    f"{part.name}: its clock is only known to {clock.rtt_ns / 2e6:.0f} ms, because its answers take long; "
                    f"raise clock_error = {self.table.clock_error:g} in [runners.robots], or improve the link"
                )

    def _start(self, lead: float) -> None:
        """Tell all robots when to start. Raises Late if one does not confirm this in time."""
        slowest = max(part.clock.rtt_ns for part in self.parts if part.clock)
        self.at_ns = self._watch.now_ns() + int(lead * 1e9) + ROUND_TRIPS * slowest

        def tell(part: Part) -> None:
            offset = part.clock.offset_ns if part.clock else 0
            wait = (self.at_ns - self._watch.now_ns()) / 1e9 - CANCEL_S
            try:
                answer = part.agent.ask("at", max(wait, 0.01), attempt=self.attempt, at=self.at_ns + offset)
            except Unreachable:
                if part.agent.lost is not None:
                    raise
                raise Late(f"{part.name}: did not confirm the common start in time") from None
            if answer["event"] != "gated":
                raise Late(f"{part.name}: the start reached it {answer['by']:.3f} s too late")

        each(tell, self.parts)

    def _cancel(self, reason: str) -> bool:
        """Tell all robots to stop before the start; return whether one has started nevertheless."""
        self.stop(reason)
        give_up = time.monotonic() + self._patience()
        while any(part.armed and part.is_open for part in self.parts) and time.monotonic() < give_up:
            self._take(POLL_S)
        begun = any(part.started for part in self.parts)
        if not begun:
            each(self._disarm, [part for part in self.parts if part.ended])
        return begun

    def _disarm(self, part: Part) -> None:
        """Remove what was prepared on a robot; what cannot be removed now is removed before the next run."""
        with contextlib.suppress(SierraError):
            part.agent.ask("done", attempt=self.attempt)

    def stop(self, reason: str) -> None:
        """Tell all robots whose part has not ended to stop. The reason of the first call counts."""
        if self.stopped is None:
            self.stopped, self._stopped_at = reason, time.monotonic()
            for part in self.parts:
                if part.ended is None:
                    part.agent.tell("stop", attempt=self.attempt, why=reason)

    def _supervise(self) -> None:
        """Follow the run until it has ended on all robots, or until these are lost."""
        looked = time.monotonic()
        while any(part.is_open for part in self.parts):
            self._take(POLL_S)
            self._watch.look()
            if time.monotonic() - looked > self.table.lease / 2:  # this process was stopped, and may have much to read
                for part in self.parts:
                    part.agent.heard = time.monotonic()
            looked = time.monotonic()
            if reason := self.stopping():
                self.stop(reason)
            for part in self.parts:
                if part.is_open:
                    self._listen(part)
            if self.stopped is not None and time.monotonic() - self._stopped_at > self._patience():
                for part in self.parts:
                    if part.is_open:
                        part.agent.abandon(f"it did not report its end within {self._patience():g} s")

    def _patience(self) -> float:
        return self.table.grace + 2 * self.table.stop_limit + SETTLE_S

    def _listen(self, part: Part) -> None:
        """Count a robot as lost if its lease has expired, and note a shorter silence once."""
        silence, lease = part.agent.silence, self.table.lease
        if silence > lease + MARGIN_S:
            part.agent.abandon(f"no answer for {silence:.1f} s")
        elif silence > lease / 2 and part.name not in self._silent:
            self._silent.add(part.name)
            does = "its run goes on" if part.started else "it stays ready"
            self.notice(f"{part.name} does not answer; {does} for {lease:g} s at most, its lease")

    def _take(self, seconds: float) -> None:
        """Take the next event, if there is one in this time."""
        try:
            name, event = self._events.get(timeout=seconds)
        except queue.Empty:
            return
        part = next((part for part in self.parts if part.name == name), None)
        if part is None or event.get("attempt", self.attempt) != self.attempt:
            return
        match event["event"]:
            case "started":
                part.started = True
            case "ended":
                part.ended = event
                part.started = part.started or event["started"]
                self._react(part)
            case "lost" if part.is_open and part.agent.lost is not None:
                part.lost = str(event["reason"])
                self.stop(f"{part.name} was lost")

    def _react(self, part: Part) -> None:
        """Stop the others if a program has failed, or if that of the base station has ended."""
        if part.moving:
            self.notice(f"{part.name} may be moving: {part.moving}")
            self.stop(f"{part.name} may be moving")
        elif part.failure:
            self.stop(f"{part.name}: {part.failure}")
        elif part.ended and part.ended["why"] and self.stopped is None:
            self.stop(f"{part.name}: {part.ended['why']}")
        elif part.place == 0:
            self.stop(OVER)

    def finish(self, folder: Path, rejoin: Callable[[Part], Record]) -> None:
        """Measure the clocks again, and pull what the run has left on each robot into `folder`/PLACE.

        `rejoin` connects to a lost robot again. Raises nothing: `Part.problem` says why nothing was pulled.
        """

        def finished(part: Part) -> None:
            if part.problem is not None:
                return
            try:
                if part.lost is not None:
                    self._find(part, rejoin(part))
                if part.started:
                    target = folder / str(part.place)
                    part.agent.pull(f"{part.hello['folder']}/runs/{self.attempt}/1", target)
                    part.files = target
                with contextlib.suppress(Refused):
                    part.after = part.agent.ask("check", CHECK_S, checks=False)
                part.agent.ask("done", attempt=self.attempt)
            except SierraError as error:
                part.problem = str(error).removeprefix(f"{part.name}: ")
                if isinstance(error, Refused) and error.about == "stop":
                    part.refused_stop = part.problem.removeprefix("may be moving: ")

        each(self._measure_again, self.parts)
        self.course = self._watch.course()
        each(finished, self.parts)

    def _measure_again(self, part: Part) -> None:
        """Measure a clock after the run. Nobody has watched that of a robot that was lost."""
        if part.lost is not None:
            return
        try:
            clock, watched = part.agent.clock(time.time_ns), part.agent.ask("watched")
            part.clock_after, part.course = clock, Course(watched["uneven"], watched["moved"])
        except SierraError as error:
            part.problem = str(error).removeprefix(f"{part.name}: ")

    def _find(self, part: Part, hello: Record) -> None:
        """Take the report of a lost robot that has come back."""
        part.hello = hello
        for left in hello["leftovers"]:
            if left["attempt"] == self.attempt:
                report = as_report(left["report"])
                part.ended = report and {**report, "moving": None}  # it stands still since it was joined again
                part.started = True


def each(work: Callable[[Item], Made], items: Iterable[Item]) -> list[Made]:
    """Do something with several items at once; return the results. Raises the first error, after all have ended."""
    several = list(items)
    with ThreadPoolExecutor(max(1, len(several))) as pool:
        futures = [pool.submit(work, one) for one in several]
    return [future.result() for future in futures]

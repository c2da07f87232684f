"""The program of an array task on its node: it executes the runs of one element by the worker, and packs their results.

    python3 -I -S FOLDER/worker.pyz array_task FOLDER [--wall=SECONDS] INDEX

FOLDER is the session's folder on the file system that nodes and login nodes share. It has `worker.pyz` (see `__main__`), and:

    element.json            settings that all elements of the session share: see `Settings`
    elements/INDEX.jobs     the element's jobs: gzip (possibly several members), lines of JSON; see `element_jobs`
    elements/INDEX.failed   optional: executions, one a line, that were started too often; they are not started again
    elements/INDEX.alone    optional: executions, one a line, that may have ended earlier attempts; each is executed alone on
                            the element, one after the other, before all others
    results/INDEX.<attempt>.pack    the records of one attempt at the element; see `result_log`
    cancelled               if it exists, no further run is started, and running ones are ended

An *attempt* is one execution of an element. There may be several: a task may be requeued, its node may be lost, and the first
copy may still live beside the second. So each attempt writes into a file of its own, made with O_EXCL. It first reads the
records of other attempts at its element, and executes only runs whose results are missing or damaged. Runs execute in a local
folder of the node (`scratch`), which is removed at the end, or by the next attempt of the session on this node. Only packs are
written to the shared file system, and no locks are needed there.

An interrupted run (the task was told to end, by a time limit or by a user) has a start and no end. A scheduler sends its
SIGTERM to all processes of a task, and a run that reacts to it may look as if it had ended by itself. Therefore no run is
packed that ended less than HOLD_S before this process got the signal. The start of a run is packed at once. The start of a run
that executes alone is written to the disk before it begins, because the run may end the whole task at once.

Before anything executes, every file in `needs` is hashed once. If one differs from the file on the submitting host, the attempt
ends with `trouble`, and nothing executes. If one changes later, no run that has ended since is packed. SIGTERM ends the running
runs with the grace time of their jobs, a second SIGTERM without it. If FOLDER or the attempt's own pack has been removed,
nobody waits for the results any more, and running runs are ended. The exit status is 0 if finished, 1 if told to end, and 3 for
trouble. The reason is also written to stderr, and so is the time that the task had run when it was told to end.

A task whose time (`--wall=SECONDS`) will be over before its runs are finished requests its scheduler to start it again, once
and shortly before the end: by the command `requeue` of the settings, with its own id. It does so only if a run has ended or has
written to its checkpoint, so that each attempt makes progress, and if nothing is cancelled. It submits no new jobs. If the
request is refused, it continues as long as it may.

    python3 -I -S FOLDER/worker.pyz array_task FOLDER --probe INDEX

does all of this without executing runs, and records it in results/probe.<attempt>.pack.
"""

from __future__ import annotations

import contextlib
import errno
import fnmatch
import itertools
import json
import os
import platform
import re
import signal
import subprocess
import sys
import time
from collections import deque
from functools import partial
from types import FrameType
from typing import Callable, Iterable, NamedTuple

from sierra.worker import checkpoints, machine, program, result_log
from sierra.worker.allocation import Allocation, Need, Needs, scratch
from sierra.worker.element_jobs import Feeder
from sierra.worker.errors import CannotContinue, explain
from sierra.worker.files import CHUNK, remove, unlink
from sierra.worker.journal import End, Event, GrowingJournal
from sierra.worker.layout import LOGS, OBSERVED, SLOT_LOCKS
from sierra.worker.processes import Stops, adopt_orphans, birth, end_orphans, stdin_of
from sierra.worker.result_log import Attempt, Changed, File, Finished, Pack, Requeued, Started, Trouble, line_of, short

HOLD_S = 0.2
BEFORE_S = 60.0
"""The seconds before its end at which a task requests to be started again; at most a sixth of its time."""
AGAIN_S = 1.0
"""The seconds until a task that has made no progress looks again."""
REQUEUE_S = 20.0
GIVE_UP_S = 5.0
"""The seconds in which ended runs are still packed after the task was told to end."""
BUSY_S, IDLE_S = 0.02, 0.1
AHEAD, AHEAD_EACH = 64, 8
"""The number of runs that are sent to the worker in advance, plus so many for each slot.

A run that has left little frees its place when it has ended, any other run when it is packed.
"""
SECRET = ("TOKEN", "SECRET", "PASSWORD", "CREDENTIAL")


class Unwanted(Exception):
    """The task must end before everything was read or packed."""


class Settings(NamedTuple):
    """The contents of `element.json`."""

    session: str
    slots: int
    """The greatest number of runs at a time; fewer if the node has fewer cores."""
    scratch: str | None
    """A folder of the node, in which `$NAME` and `${NAME}` are its variables. None: that of the scheduler, $TMPDIR or /tmp."""
    needs: list[Need]
    record: list[str]
    """The names, or patterns of names, of variables to record."""
    requeue: tuple[str, ...] = ()
    """The command that starts a task again, to which the task's id is added; empty: there is none."""
    node: dict[str, list[str]] = {}  # noqa: RUF012 - nobody changes it
    """The variables by which the scheduler tells what it gives: see `sierra.runners.schedulers.base.NodeVariables`."""


class StopSignals:
    """A counter of the signals that told this process to end."""

    def __init__(self) -> None:
        self.times = 0
        self.when = 0.0
        for signalled in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(signalled, self._note)

    def check(self) -> None:
        """Raise Unwanted if there was a signal."""
        if self.times:
            raise Unwanted

    def _note(self, signalled: int, frame: FrameType | None) -> None:
        self.when = self.when or time.clock_gettime(time.CLOCK_BOOTTIME)
        self.times += 1


def start_of_task() -> float:
    """Return the start of the task in seconds since boot: the job script has become this process, by `exec`."""
    return (birth(os.getpid()) or 0) / os.sysconf("SC_CLK_TCK")


def first_record(settings: Settings, given: Allocation, index: int) -> Attempt:
    """Return the first record, without the attempt's own name and clock."""
    variables, cores = os.environ, machine.usable_cores()
    return Attempt(
        attempt="",
        session=settings.session,
        element=index,
        job=given.text("task"),
        node=given.text("host") or os.uname().nodename,
        started=time.time(),
        slots=min(settings.slots, cores),
        cpus=given.number("cores") or cores,
        memory=given.memory,
        gpus=given.text("gpus") or variables.get("CUDA_VISIBLE_DEVICES"),
        allocation=given.variables,
        facts=machine.facts(),
        variables={name: value for name, value in sorted(variables.items()) if is_recorded(name, settings.record)},
        python=platform.python_version(),
        clock=0.0,
        end=given.number("end"),
    )


def is_recorded(name: str, patterns: list[str]) -> bool:
    return any(fnmatch.fnmatchcase(name, pattern) for pattern in patterns) and not any(word in name.upper() for word in SECRET)


def name_of_attempt(given: Allocation, suffix: int) -> str:
    """Return the name `job.restart.host.process`, with a suffix if another attempt has taken it."""
    process = "%d-%d" % (os.getpid(), suffix) if suffix else str(os.getpid())
    parts = (given.text("job") or given.text("task") or "none", given.text("restarts") or "0", os.uname().nodename, process)
    return ".".join(re.sub(r"[^A-Za-z0-9_-]", "_", part) for part in parts)


def new_pack(folder: str, index: str, first: Attempt, given: Allocation) -> Pack:
    """Create the pack of this attempt, with its first record."""
    for name in map(partial(name_of_attempt, given), itertools.count()):
        with contextlib.suppress(FileExistsError):
            pack = Pack(folder, index, name)
            break
    pack.note(first._replace(attempt=name, clock=float(given.text("clock") or pack.clock)), sync=True)
    return pack


class Requeue:
    """The request to the scheduler to start this task again before its time is over: once, and only after progress."""

    def __init__(self, cancelled: str, pack: Pack, command: Iterable[str], wall: float | None, task: str) -> None:
        """`cancelled` is the file that exists if the session is cancelled."""
        self._cancelled = cancelled
        self._pack = pack
        self._command = [*command, task]
        self._at = start_of_task() + wall - min(BEFORE_S, wall / 6) if wall and len(self._command) > 1 else float("inf")
        self.progressed = False

    def send_if_due(self, has_continued: Callable[[], bool]) -> None:
        """Send the request if it is time to. If the scheduler agrees, it soon tells this task to end.

        `has_continued` returns whether a run in flight can continue from its checkpoint, which is progress, too.
        """
        now = time.clock_gettime(time.CLOCK_BOOTTIME)
        if now < self._at or os.path.exists(self._cancelled):
            return
        if not (self.progressed or has_continued()):
            self._at = now + AGAIN_S
            return
        self._at = float("inf")
        self._record(None)
        try:
            subprocess.run(self._command, stdin=subprocess.DEVNULL, capture_output=True, check=True, timeout=REQUEUE_S)
        except subprocess.CalledProcessError as error:
            words = (error.stderr or error.stdout).decode("utf-8", "replace").split()
            self._record(" ".join(words) or "status %d" % error.returncode)
        except (OSError, subprocess.TimeoutExpired) as error:
            self._record(" ".join(str(error).split()))

    def _record(self, refused: str | None) -> None:
        self._pack.note(Requeued(time.time(), refused), sync=True)


class Shared(NamedTuple):
    """The objects of an attempt that its executions share."""

    session: str
    cancelled: str
    """The file that exists if the session is cancelled."""
    lock: int
    """The lock of the folder on the node. The worker holds it as long as it lives."""
    pack: Pack
    stop: StopSignals
    requeue: Requeue
    needs: Needs


class Execution:
    """A worker process, and the transfer of its events into the pack."""

    def __init__(self, shared: Shared, scratch: str) -> None:
        """Make `scratch`, a folder of the node."""
        os.mkdir(scratch)
        self._session, self._cancelled, self._lock, self._pack, self._stop, self._requeue, self._needs = shared
        self._scratch = scratch
        self._journal = GrowingJournal(os.path.join(scratch, "journal.jsonl"))
        self._held: deque[tuple[float, End]] = deque()
        self._begun: set[str] = set()
        self._ended = 0
        self._stopping = False
        self._continued = self._killed = False
        self._stops = Stops()
        self._check_at = 0.0

    def run(self, slots: int, path: str, wanted: Callable[[str], bool], *, last: bool) -> bool:
        """Execute the wanted jobs of a file, and return whether all were executed. Raises CannotContinue, OSError.

        `last`: no other execution follows in this attempt.
        """
        self._last = last
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-S", "-X", "utf8", program.PROGRAM, self._scratch, str(slots)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            bufsize=0,
            env={**os.environ, "SIERRA_SESSION": self._session, "TMPDIR": os.path.dirname(os.path.dirname(self._scratch))},
            pass_fds=(self._lock,),
            start_new_session=True,
        )
        pipe = stdin_of(self._process)
        work, ahead = os.path.dirname(self._scratch), max(0.0, self._pack.clock)
        self._feeder = Feeder(path, wanted, AHEAD + slots * AHEAD_EACH, pipe, work, ahead)
        self._feeder.start()
        try:
            self._follow()
        finally:
            self._end()
        return self._is_finished()

    def _follow(self) -> None:
        pause = BUSY_S
        while True:
            over = self._process.poll() is not None
            if not over:
                self._continue_stopped()
            events = self._journal.read()
            now = time.monotonic()
            self._check_stop(now)
            for event in events:
                self._handle(now, event)
            self._pack_due(now)
            self._pack.sync(now)
            if not (over or self._stopping) and (self._feeder.is_alive() or self._ended < self._feeder.sent):
                self._requeue.send_if_due(self._has_continued)
            elif self._last and not self._feeder.is_alive() and self._ended + len(self._held) == self._feeder.sent:
                release_slots()
            if over and not events and not self._held:
                return
            pause = BUSY_S if events or self._held else min(IDLE_S, 1.2 * pause)
            time.sleep(pause)

    def _has_continued(self) -> bool:
        """Return whether a run in flight has written to its checkpoint since the attempt began."""
        paths = (path for execution, path in list(self._feeder.checkpoints.items()) if execution in self._begun)
        return any(checkpoints.changed_since(path, self._pack.started) for path in paths)

    def _continue_stopped(self) -> None:
        """Continue the worker if a run has stopped it; kill it the second time, unless it is to end anyway."""
        if not self._stops.seen(self._process.pid, time.monotonic()):
            return
        if self._continued and not self._stopping:
            self._killed = True
            self._process.kill()
        else:
            self._continued = True
            self._process.send_signal(signal.SIGCONT)

    def _handle(self, now: float, event: Event) -> None:
        """Record at once that a run has begun; hold a run's end back."""
        if event["event"] == "end":
            self._held.append((now, event))
            if is_small(event):
                self._feeder.permits.release()
        elif event["event"] == "stalled":
            self._pack.add(line_of(event))
        elif not (self._stopping or self._stop.times):
            self.begin(event["execution"])

    def begin(self, execution: str, *, alone: bool = False) -> None:
        """Record once that a run begins. With `alone`, write that to the disk first."""
        if execution not in self._begun:  # else it begins again, because its observation has changed it
            self._pack.note(Started(execution, time.time(), alone), sync=alone)
        self._begun.add(execution)

    def _check_stop(self, now: float) -> None:
        """End the worker if that was requested, or if nobody waits for the results any more."""
        if not self._stopping and (self._stop.times or self._is_unwanted(now)):
            self._stopping = True
            # not SIGTERM: the scheduler may have sent one, and a second skips the grace time
            self._process.send_signal(signal.SIGHUP)
        if self._stop.times > 1:
            self._process.send_signal(signal.SIGTERM)

    def _is_unwanted(self, now: float) -> bool:
        if now < self._check_at:
            return False
        self._check_at = now + result_log.SYNC_S
        return os.path.exists(self._cancelled) or self._pack.is_gone()

    def _pack_due(self, now: float) -> None:
        """Pack the ends that were held back long enough; none after this process was told to end."""
        if self._stopping or self._process.returncode == 1:
            self._held.clear()
        if self._held and now - self._held[0][0] >= HOLD_S:
            self._needs.check()
        while self._held and now - self._held[0][0] >= HOLD_S and not self._stop.times:
            self._take_end(self._held.popleft()[1])

    def _take_end(self, event: End) -> None:
        directory = event["directory"]
        if event["stopped"] != "interrupted":
            with contextlib.suppress(Unwanted):
                self._pack_run(event, directory)
                self._ended += 1
                self._requeue.progressed = True
        if event.get("spare"):
            self._feeder.spare.append(int(os.path.basename(directory)))
        elif self._is_own(directory):
            remove(directory)
            unlink(directory)  # a link in place of the folder
        if not is_small(event):
            self._feeder.permits.release()

    def _is_own(self, directory: str) -> bool:
        """Return whether it is the folder of one run. A run that could not be prepared has none."""
        return os.path.dirname(directory) == self._scratch and os.path.basename(directory).isdigit()

    def _pack_run(self, event: End, directory: str) -> None:
        root = None
        if self._is_own(directory):
            with contextlib.suppress(OSError):
                root = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
        if root is None:
            error = event["error"] or ("its folder is gone" if event["outputs"] else None)
            self._add({**event, "outputs": [], "error": error}, -1, [])
            return
        try:
            logs = list(result_log.described(root, LOGS))
            seen = list(result_log.described(root, [OBSERVED])) if event.get("observed") else []
            outputs = [("output/" + file["path"], file["bytes"], file["sha256"]) for file in event["outputs"]]
            try:
                self._add({**event, "observed": bool(seen)}, root, logs + seen + outputs)
            except Changed as changed:
                error = event["error"] or "its outputs cannot be read: %s" % changed
                self._add({**event, "outputs": [], "error": error, "observed": False}, root, logs)
        finally:
            os.close(root)

    def _add(self, event: End, root: int, files: list[File]) -> None:
        size = sum(size for _, size, _ in files)
        fields = {name: value for name, value in event.items() if name not in ("directory", "spare")}
        payload = itertools.chain(result_log.contents(root, files, self._check_time), (b"\n",))
        self._pack.add(line_of({**fields, "files": files, "size": size}), size, payload)

    def _check_time(self) -> None:
        """Raise Unwanted if nobody waits for the results any more, or if there is no time left for packing."""
        self._check_stop(time.monotonic())
        stop = self._stop
        if self._stopping and (stop.times != 1 or time.clock_gettime(time.CLOCK_BOOTTIME) - stop.when > GIVE_UP_S):
            raise Unwanted

    def _end(self) -> None:
        """Wait for the worker's end in any case, and end the processes that it has left."""
        while self._process.poll() is None:
            self._stopping = True
            self._process.send_signal(signal.SIGTERM if self._stop.times > 1 else signal.SIGHUP)
            self._continue_stopped()
            time.sleep(IDLE_S)
        end_orphans(None)
        self._stderr = self._process.stderr.read() if self._process.stderr else b""

    def _is_finished(self) -> bool:
        code, error = self._process.returncode, self._feeder.error
        if self._stopping or self._stop.times:
            return False
        if error is not None:
            raise error
        if code == 0 and self._ended != self._feeder.sent:
            raise CannotContinue("the worker reported %d of %d runs" % (self._ended, self._feeder.sent))
        if code == 4:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), self._scratch)
        if code not in (0, 1):
            lines = self._stderr.decode("utf-8", "replace").strip().splitlines()
            reason = "the worker ended with %s" % (code if code > 0 else "signal %d" % -code)
            reason = "a run stopped the worker (SIGSTOP) although it had been continued before" if self._killed else reason
            raise CannotContinue(": ".join([reason, *lines[-1:]]))
        return code == 0


def is_small(event: End) -> bool:
    """Return whether a run has left small outputs."""
    return sum(file["bytes"] for file in event["outputs"]) <= CHUNK


def attempt(folder: str, index: int, stop: StopSignals, *, wall: float | None = None, probing: bool) -> bool:
    """Execute the missing runs of an element, and return whether it is finished. Raises CannotContinue and OSError."""
    with open(os.path.join(folder, "element.json"), "rb") as file:
        settings = Settings(**json.load(file))
    adopt_orphans()
    cancelled, results = (os.path.join(folder, name) for name in ("cancelled", "results"))
    if os.path.exists(cancelled):
        return False
    given = Allocation(settings.node, os.environ)
    first = first_record(settings, given, index)
    pack = new_pack(results, "probe" if probing else str(index), first, given)
    try:
        needs = Needs(settings.needs)
        needs.check()
        with scratch(settings.session, settings.scratch, given) as (own, lock):
            named = os.path.join(folder, "elements", str(index))
            done = result_log.executed(results, str(index), pack.path, stop.check)
            done.update(map(short, read_lines(named + ".failed")))
            requeue = Requeue(cancelled, pack, settings.requeue, wall, given.text("task"))
            shared = Shared(settings.session, cancelled, lock, pack, stop, requeue, needs)
            if not probing and not execute(named, done, first.slots, own, shared):
                pack.sync(float("inf"))
                return False
        pack.note(Finished(time.time()), sync=True)
        return True
    except Unwanted:
        return False
    except Exception as error:
        with contextlib.suppress(OSError):  # if there is space for it
            pack.note(Trouble(reason_of(error), getattr(error, "errno", None) in (errno.ENOSPC, errno.EDQUOT)), sync=True)
        raise


def read_lines(path: str) -> list[str]:
    """Return the executions in a list, in order; none if there is no such file."""
    try:
        with open(path) as file:
            return [line.strip() for line in file]
    except FileNotFoundError:
        return []


def execute(named: str, done: set[bytes], slots: int, scratch: str, shared: Shared) -> bool:
    """Execute an element's runs that are not done, first those that must be alone. Return whether all were executed."""
    jobs = named + ".jobs"
    for number, execution in enumerate(read_lines(named + ".alone")):
        if short(execution) not in done:
            done.add(short(execution))
            alone = Execution(shared, os.path.join(scratch, "alone%d" % number))
            alone.begin(execution, alone=True)
            if not alone.run(1, jobs, execution.__eq__, last=False):
                return False
    others = Execution(shared, os.path.join(scratch, "runs"))
    return others.run(slots, jobs, lambda execution: short(execution) not in done, last=True)


def release_slots() -> None:
    """Let another task begin on this computer, since this one only packs its last runs; see SLOT_LOCKS."""
    for lock in os.environ.pop(SLOT_LOCKS, "").split():
        os.close(int(lock))


def reason_of(error: BaseException) -> str:
    """Return the reason of an error in one line, with the node's name."""
    return "%s: %s" % (os.uname().nodename, " ".join(explain(error).split()))


def print_error(text: str) -> None:
    with contextlib.suppress(OSError):
        os.write(2, ("array task: %s\n" % text).encode("utf-8", "backslashreplace"))


def main(arguments: list[str]) -> int:
    stop = StopSignals()
    try:
        folder, index = os.path.abspath(arguments[0]), int(arguments[-1])
        probing = "--probe" in arguments
        wall = next((float(argument.partition("=")[2]) for argument in arguments if argument.startswith("--wall=")), None)
        if attempt(folder, index, stop, wall=wall, probing=probing):
            return 0
        if stop.times and not probing:
            print_error("asked to end after %.0f s" % (stop.when - start_of_task()))
        return 1
    except Exception as error:
        print_error(reason_of(error))
        return 3

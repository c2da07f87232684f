"""The worker: executes runs on this machine, in an array task, in a container or on a robot.

    FOLDER SLOTS [JOURNAL | - PLACES] < jobs

Jobs are lines of JSON, one for each run, and end with the line `{"end": true}`. A sender that uses a pipe keeps it open until
the worker has ended. A pipe that is closed earlier, or an input that ends without that line, means that nobody waits for the
results any more: the worker then ends the running runs and starts no others. SIGTERM requests the same, and a second SIGTERM
requests it without grace time.

For each job the worker makes a folder (`run_folder`). It starts the program in a session (and so a process group) of its own
with `output` as its working directory, enforces the limits (`running`), hashes the files that were left in `output`
(`outputs`), and writes events to its `journal`. In argv and environment, the character NUL stands for the run's folder. If
TMPDIR would be `tmp`, the run gets a folder with a short path instead, unless it is in a container: see `temporary_folders`.

The exit status is 0 if all jobs have been executed, 1 if the worker was told to stop, and 3 if it could not continue (4: a disk
has no space); its last line on stderr then gives the reason. If the disk has no space when a run has ended, no `end` is written
for it, whatever its exit status (the run may have failed for that reason, or may not have noticed), and the worker cannot
continue.

A worker that stops, for whatever reason, continues for GIVE_UP_S to read the outputs of runs that had ended by then. Runs whose
outputs are not read by then count as interrupted.

The argv of a job with services, or with commands before or after its own, is CONDUCTED and a plan for the `conductor`, which is
started instead, and executes all of them.

If a run waits for its moment, and its client has a `start_pipe`, its container starts before: see `containers.HeldContainer`.
Otherwise its `end` has the key `delay_s`: how many seconds after its moment its program had begun, because the engine took so
long.
"""

from __future__ import annotations

import contextlib
import errno
import heapq
import itertools
import json
import os
import queue
import select
import signal
import stat
import sys
import threading
import time
from typing import TYPE_CHECKING, Mapping, Sequence, TextIO

from sierra.worker import checkpoints
from sierra.worker.conductor_report import report_of
from sierra.worker.containers import PROGRAM, HeldContainer, await_orphans, end_container
from sierra.worker.cores import Cores
from sierra.worker.devices import Lease, NoDevices, Pool, requests_devices, with_leased, with_own_devices
from sierra.worker.errors import explain, why_not_started
from sierra.worker.files import CHUNK, check_room, entries_of, is_folder, is_full, remove, unlink
from sierra.worker.free_ports import NoFreePort, Ports
from sierra.worker.job import Job, is_conducted
from sierra.worker.journal import BEGUN, GONE, READY, UNUSED, Announce, End, Event, Journal, Remains, Stalled, Usage, no_outputs
from sierra.worker.layout import TRACE
from sierra.worker.observations import Observations
from sierra.worker.outputs import GivenUp, collect_outputs
from sierra.worker.ports import marks_in, with_ports
from sierra.worker.processes import (
    POLL_S,
    SAMPLE_S,
    become_subreaper,
    birth,
    continue_ending,
    descendants,
    end_orphans,
    orphans,
    read_proc,
    reap,
    signal_process,
    state_of,
)
from sierra.worker.run_folder import RunFolder, inputs_of, prepare
from sierra.worker.running import MARKED, STALLED_S, Running, await_end, exceeded, start, used
from sierra.worker.shared_container import Container
from sierra.worker.shared_files import shared_files
from sierra.worker.shared_services import UNOBSERVED, SharedServices, trouble_of_services
from sierra.worker.temporary_folders import OWN_TMP, Temporary, check_temporary
from sierra.worker.wakeup_pipe import WakeupPipe

if TYPE_CHECKING:
    from sierra.worker.file_trace import Way
    from sierra.worker.nvml import GpuSampler, GpuUsage

STOPPED, FAILED, FULL = 1, 3, 4  # exit statuses
GIVE_UP_S = 5.0  # to read the outputs of ended runs after the worker was told to stop
LOOKS = 4  # the next look at an observed run comes after a quarter of its time, because most programs load their files early
SPREAD_S = 0.5  # for a signal to reach all processes that it was sent to


class Worker:
    """Slots, each a thread, which take jobs from a queue; and the main thread, which watches over them."""

    def __init__(
        self,
        folder: str,
        slots: int,
        *,
        journal: str | None = "",
        adopts: bool = False,
        places: tuple[str, ...] = (),
        announce: Announce = lambda state: None,
    ) -> None:
        """Prepare a worker in `folder` with `slots` slots.

        `adopts`: this process becomes the parent of all orphans of its runs. `places`: folders that runs share. `journal` is a
        file, by default in the folder; None is standard output. `announce` is called with each state of a run, before anything
        else that could fail or take long.
        """
        self.announce = announce
        self.folder = folder
        self.adopts = adopts
        self.slots = slots
        self.journal = Journal(os.path.join(folder, "journal.jsonl") if journal == "" else journal)
        self.host = os.uname().nodename
        self.jobs: queue.Queue[Job | None] = queue.Queue(maxsize=2 * slots)
        self.running: dict[int, Running] = {}
        self.containers: dict[int, Container] = {}
        self.devices = Pool(os.environ)
        self.cores = Cores(slots)
        self.leases: dict[int, Lease] = {}
        """The devices of the slots' containers."""
        self.sampler: GpuSampler | None = None
        self.starting_sampler = threading.Lock()
        self.contains = False
        self.stopping = self.terminated = self.without_grace = False
        self.stop_reading_at = 0.0
        self.wakeup = WakeupPipe()
        self.failure: str | None = None
        self.full = False
        self.numbers = itertools.count(1 + max([int(name) for name in os.listdir(folder) if name.isdigit()], default=0))
        self.lock = threading.Lock()
        self.spare: dict[int, RunFolder] = {}
        self.shared = {path: entries_of(path) for path in places}
        self.temporary = Temporary(os.path.abspath(folder))
        self.observations = Observations(folder, self.temporary, self.check_stop)
        self.services: SharedServices | None = None
        self.starting_services = threading.Lock()
        self.begin: float | None = None
        self.wall = 0.0
        self.parent = os.getppid()
        self.continue_at = 0.0

    @property
    def status(self) -> int:
        """Return the exit status of its process: see above."""
        return (FULL if self.full else FAILED) if self.failure else STOPPED if self.stopping else 0

    def report_failure(self) -> None:
        """Write why it could not continue, if it could not."""
        if self.failure:
            with contextlib.suppress(OSError):
                os.write(2, ("worker: %s\n" % self.failure).encode("utf-8", "backslashreplace"))

    def work(self, stream: TextIO) -> None:
        """Execute all jobs in `stream`, or stop before its end: see `status`."""
        kind = os.fstat(stream.fileno()).st_mode
        if stat.S_ISFIFO(kind) or stat.S_ISSOCK(kind):
            self.wakeup.watch_pipe(stream.fileno())
        threading.Thread(target=self.read, args=(stream,), daemon=True).start()
        threads = [threading.Thread(target=self.slot, args=(number,)) for number in range(self.slots)]
        for thread in threads:
            thread.start()
        while any(thread.is_alive() for thread in threads):
            if not self.wakeup.wait(self.watch()):
                self.stop()
        if self.services is not None:
            self.services.end(skip_grace=lambda: self.without_grace)
        if self.contains:
            await_orphans()
        end_orphans(None)
        self.temporary.close()

    def read(self, stream: TextIO) -> None:
        """Put the jobs into the queue, until the line that ends them.

        The line `{"begin": SECONDS, "wall": SECONDS}` gives the moment for a job that waits for it, by the monotonic clock
        and by the wall clock.
        """
        try:
            for line in stream:
                job = json.loads(line)
                if "begin" in job:
                    self.wall, self.begin = job["wall"], job["begin"]
                    continue
                if job.get("end"):
                    for _ in range(self.slots):
                        self.jobs.put(None)
                    return
                self.jobs.put(job)
        except Exception as error:
            self.fail(error)
        self.stop()

    def stop(self) -> None:
        """Start no further runs, and end the running ones. Can be called by a signal handler."""
        self.stop_reading_at = self.stop_reading_at or time.monotonic() + GIVE_UP_S
        self.stopping = True
        self.wakeup.wake()

    def close(self) -> None:
        """Close the files of the worker."""
        self.journal.close()
        self.wakeup.close()

    def check_stop(self) -> None:
        """Raise GivenUp if the worker was told to stop so long ago that outputs are no longer read."""
        if self.stopping and (self.without_grace or time.monotonic() >= self.stop_reading_at):
            raise GivenUp

    def terminate(self) -> None:
        """Stop the worker; at the second call, without grace time. For a signal handler."""
        self.without_grace, self.terminated = self.terminated, True
        self.stop()

    def fail(self, error: BaseException) -> None:
        """Note why the worker cannot continue, and stop."""
        if self.failure is None:
            self.failure = explain(error)
            self.full = getattr(error, "errno", None) in (errno.ENOSPC, errno.EDQUOT)
        self.stop()

    def slot(self, number: int) -> None:
        while not self.stopping:
            try:
                job = self.jobs.get(timeout=2 * POLL_S)
            except queue.Empty:
                continue
            if job is None:
                break
            self.contains = self.contains or "client" in job
            try:
                with self.cores.held(job["limits"].get("cores", 0), lambda: self.stopping) as has_cores:
                    if has_cores:
                        self.execute_with_devices(job, number)
            except Exception as error:
                self.fail(error)
        container = self.containers.pop(number, None)
        if container is not None:
            container.close()
        if number in self.leases:
            self.devices.give_back(self.leases.pop(number))
        self.wakeup.wake()

    def execute_with_devices(self, job: Job, slot: int) -> None:
        """Execute one run, which has GPUs of its own until it has ended, or those of its slot's container, if it needs any."""
        gpus = job["limits"].get("gpus")
        if gpus is None or not requests_devices(job):
            self.execute_with_ports(with_own_devices(job, slot, self.slots), slot)
            return
        lease = self.leases.get(slot)
        if lease is None:
            try:
                lease = self.devices.take(gpus, lambda: self.stopping)
            except NoDevices as error:
                began, started = self.now()
                self.report(job, slot, self.next_folder(), began, time.monotonic() - started, no_outputs(str(error)))
                return
        if lease is None:
            return
        if job.get("shared"):
            self.leases[slot] = lease
        try:
            self.execute_with_ports(with_leased(job, lease), slot)
        finally:
            if slot not in self.leases:
                self.devices.give_back(lease)

    def execute_inside(self, job: Job, slot: int) -> None:
        """Execute one run in the slot's container. Starts the container if there is none."""
        container = self.containers.get(slot)
        began, started = time.time(), time.monotonic()
        if container is None:
            try:
                container = self.containers[slot] = Container(job["client"], self.next_folder("slot-"))
            except OSError as error:
                reason = "its container could not be started: " + explain(error)
                self.report(job, slot, self.folder, began, 0.0, no_outputs(reason))
                return
        for event in container.execute(job):
            if event["event"] == "end":
                if event["stopped"] != "interrupted":
                    check_room(self.folder)
                self.journal.write(self.take_out(job, container, event, slot))
                return
            if event["event"] != "ready":
                event["pid"] = container.pid
            if event["event"] == "start":
                event["born"] = birth(container.pid)
            self.journal.write(event)
        del self.containers[slot]
        output = container.close()
        wall = time.monotonic() - started
        folder = os.path.join(container.runs, "lost")
        stopped = "interrupted" if self.stopping else "timeout" if container.late else None
        trouble = None if stopped else "its container ended: " + output
        self.report(job, slot, folder, began, wall, no_outputs(trouble, stopped))

    def take_out(self, job: Job, container: Container, event: End, slot: int) -> End:
        """Move a run's folder out of the container's reach, and return its event with its outputs."""
        folder = self.next_folder()
        inside = os.path.join(container.runs, os.path.basename(event["directory"]))
        remains = no_outputs("its folder is gone", event["stopped"])
        if is_folder(inside):
            os.rename(inside, folder)
            remains = collect_outputs(folder, inputs_of(job), job["limits"], event["stopped"], self.check_stop)
        remains["error"] = event["error"] or remains["error"]
        return {**event, "directory": folder, "slot": slot, "host": self.host, **remains}

    def next_folder(self, prefix: str = "") -> str:
        with self.lock:
            return os.path.join(self.folder, prefix + str(next(self.numbers)))

    def execute_with_ports(self, job: Job, slot: int) -> None:
        """Execute one run, which has ports of its own until it has ended, if it needs any."""
        execute = self.execute_inside if job.get("shared") else self.execute
        marks = marks_in(job)
        if not marks:
            execute(job, slot)
            return
        held = Ports()
        try:
            ports = {mark: held.take() for mark in marks}
        except NoFreePort as failed:
            held.give_back()
            began, started = self.now()
            self.report(job, slot, self.next_folder(), began, time.monotonic() - started, no_outputs("{port}: %s" % failed))
            return
        try:
            execute(with_ports(job, ports), slot)
        finally:
            held.give_back()

    def execute(self, job: Job, slot: int) -> None:
        """Execute one run, from making its folder to writing its line in the journal."""
        with checkpoints.claimed(job, lambda: self.stopping) as placed:
            self.execute_placed(placed, slot)

    def execute_placed(self, job: Job, slot: int) -> None:
        """Execute one run that has its checkpoint, if it needs one."""
        job = self.observations.with_observation(job)
        folder = self.next_folder()
        run_folder = prepare(job, folder, self.spare.pop(job.get("used") or 0, None))
        job = checkpoints.prepared(job, folder)
        services = self.shared_services(job)
        try:
            self.execute_prepared(self.with_temporary(job, folder), folder, slot, run_folder, services)
        finally:
            self.temporary.remove(folder)

    def with_temporary(self, job: Job, folder: str) -> Job:
        """Return the job with a short path in TMPDIR, unless a container has its own, or the job names another folder."""
        if "client" in job or "seal" in job or job["environment"].get("TMPDIR") != OWN_TMP:
            return job
        short = self.temporary.make(folder)
        return {**job, "environment": {**job["environment"], "TMPDIR": short}} if short else job

    def execute_prepared(
        self, job: Job, folder: str, slot: int, run_folder: RunFolder | None, services: SharedServices | None
    ) -> None:
        """Execute a run in its folder, which has been made."""
        observation = self.observations.begin(job, folder)
        held = HeldContainer(job, folder) if job.get("waits") and job.get("client", {}).get("start_pipe") else None
        if job.get("waits") and not self.await_moment(job, held):
            remove(folder)
            return
        began, started = self.now()
        try:
            process = held.begin() if held else start(job, folder, observation, services)
        except (OSError, ValueError) as error:
            if observation:  # perhaps the tracer is gone
                self.observations.trusts = False
                unlink(folder + TRACE)
                self.execute_unobserved(job, folder, slot, "it could not be started by the tracer")
                return
            wall = time.monotonic() - started
            self.report(job, slot, folder, began, wall, no_outputs("could not be started: " + why_not_started(error, job)))
            return
        running = Running(job, folder, process, observation, self.announce)
        running.temporary = self.temporary.places.get(folder)
        self.announce(BEGUN)
        if held and running.meter:
            running.meter.since = running.started
        with self.lock:
            self.running[running.pid] = running
        self.note(running, {"event": "start", "execution": running.execution, "pid": running.pid, "born": birth(running.pid)})
        if unkept := job.get("unkept"):
            self.note(running, {**stalled(running, time.time()), "unkept": unkept})
        if running.limited or observation or self.stopping:
            self.wakeup.wake()
        running.gpu_usage = self.gpu_usage(job)
        status, usage = await_end(running)
        wall = time.monotonic() - started
        process.returncode = status
        if running.stopped is None and os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGTERM:
            self.await_signal()
        with self.lock:
            del self.running[running.pid]
        if running.client and (running.stopped is not None or os.WIFSIGNALED(status)):
            end_container(running.client)
        report = report_of(job, folder)
        left, after_marker = running.left or report.left_running, report.after_marker
        if running.stopped == MARKED and running.marker:
            running.stopped, after_marker, status = None, running.marker.seconds, 0
        # a run with a seal is alone in its container
        alone = end_orphans(None if running.seal else running.execution, running.pid, running.is_tracer)
        if alone:
            self.announce(GONE)
        observed, disturbed = self.observations.keep(job, running, services)
        if disturbed:
            self.await_signal()  # a scheduler may kill the tracer before it tells this process to end
            self.observations.trusts = False
            self.observations.account.charge(wall)
        if disturbed and not self.stopping:
            self.execute_unobserved(job, folder, slot, disturbed)
            return
        self.observations.account.add(wall)
        if disturbed or (running.stopped is None and self.stopping and os.WIFSIGNALED(status)):
            running.stopped = "interrupted"
        if running.stopped != "interrupted" and not running.seal:
            check_room(self.folder)
            check_temporary(running.temporary)
            if running.checkpoint and is_folder(running.checkpoint):
                check_room(running.checkpoint)
        failure = report.error or trouble_of_services(services)
        spare = alone and self.adopts and run_folder is not None and run_folder.is_reusable()
        if running.seal:  # the worker that takes the folder out of the container reads it
            remains = no_outputs(self.clear_shared(folder), running.stopped)
        else:
            remains = collect_outputs(folder, inputs_of(job), running.limits, running.stopped, self.check_stop, spare)
        if running.stopped is None and remains["stopped"] is None:
            remains["error"] = failure or remains["error"]
        if "beside" in job and (trouble := shared_files(job["beside"]).changed()):
            remains["error"] = remains["error"] or trouble
        if (
            spare
            and run_folder is not None
            and not remains["error"]
            and sum(file["bytes"] for file in remains["outputs"]) <= CHUNK
        ):
            self.spare[int(os.path.basename(folder))] = run_folder
            remains["spare"] = True
        if running.observation and (status or not observed or remains["stopped"] or remains["error"]):
            self.observations.request_another(job)
        if observed:
            remains["observed"] = True
        if left and after_marker is None:
            remains["left_running"] = list(left)
        if after_marker is not None:
            remains["after_marker"] = after_marker
        if job.get("resumed"):
            remains["resumed"] = True
        if job.get("own_ports"):
            remains["ports"] = list(job["own_ports"])
        if running.gpu_usage:
            remains["gpu_s"], remains["gpu_memory_bytes"] = running.gpu_usage.seconds, running.gpu_usage.memory
        if job.get("waits") and not held and running.meter:
            remains["delay_s"] = wall if running.meter.since is None else running.meter.since - running.started
        self.report(job, slot, folder, began, wall, remains, status, running.meter.report() if running.meter else used(usage))

    def await_moment(self, job: Job, held: HeldContainer | None) -> bool:
        """Report that a run is prepared, and wait until its moment. Return False if the worker was told to stop before.

        Raises NotHeld if its container has ended.
        """
        come = False
        try:
            if held:
                held.await_ready(lambda: self.stopping)
            self.journal.write({"event": "ready", "execution": job["execution"]})
            self.announce(READY)
            come = self.has_time_come(held)
        finally:
            if held and not come:
                held.end()
        return come

    def now(self) -> tuple[float, float]:
        """Return the time by the wall clock and by the monotonic clock.

        The wall clock may be set after a run has got its moment. So its time is that of the moment plus the elapsed time.
        """
        now = time.monotonic()
        return time.time() if self.begin is None else self.wall + now - self.begin, now

    def has_time_come(self, held: HeldContainer | None) -> bool:
        while not self.stopping:
            if held:
                held.check()
            left = SAMPLE_S if self.begin is None else self.begin - time.monotonic()
            if left <= 0:
                return True
            select.select((), (), (), min(left, SAMPLE_S))  # a clock that tests replace makes time.sleep fail
        return False

    def shared_services(self, job: Job) -> SharedServices | None:
        """Return the services that the run shares with others, if there are any. The first of these runs starts them."""
        plan = json.loads(job["argv"][1]) if is_conducted(job) and "client" not in job else {}
        if not plan.get("shared"):
            return None
        with self.starting_services:
            if self.services is None:
                self.services = self.start_services(job, plan)
            self.services.await_ready(lambda: self.stopping)
        return self.services

    def start_services(self, job: Job, plan: Mapping[str, object]) -> SharedServices:
        """Start services that runs share. They are observed, unless this changes how they start."""
        if plan.get("observed"):
            with self.observations.looking:
                way, unusable = self.observations.way(job.get("helps"))
            try:
                services = self.new_services(job, plan, way, unusable)
            except (OSError, ValueError) as error:  # perhaps the tracer is gone
                disturbed: str | None = "they could not be started by the tracer: " + explain(error)
            else:
                services.await_ready(lambda: self.stopping)
                disturbed = services.disturbed()
                if not disturbed or self.stopping:
                    return services
                services.end(skip_grace=lambda: self.without_grace)
            return self.new_services(job, plan, None, ("%s: %s" % (UNOBSERVED, disturbed),))
        return self.new_services(job, plan)

    def new_services(
        self, job: Job, plan: Mapping[str, object], way: Way | None = None, reasons: Sequence[str] = (UNOBSERVED,)
    ) -> SharedServices:
        """Start services in a new folder. Raises OSError and ValueError if they cannot be started."""
        folder = self.next_folder("services-")
        return SharedServices(self.with_temporary(job, folder), plan, folder, way, reasons)

    def execute_unobserved(self, job: Job, folder: str, slot: int, reason: str) -> None:
        """Execute a run that could not be observed once more, in a new folder."""
        remove(folder)
        self.temporary.remove(folder)
        self.observations.request_another(job)
        unobserved = job.copy()
        unobserved.pop("compares", None)
        del unobserved["observe"]
        unobserved["unobserved"] = reason
        self.execute_placed(unobserved, slot)

    def gpu_usage(self, job: Job) -> GpuUsage | None:
        """Return what measures the use of GPUs by a run; None if it has none, or if NVML or ctypes is not installed here.

        In a container, process ids are not those that NVML tells.
        """
        if not job.get("gpus") or "seal" in job:
            return None
        with contextlib.suppress(ImportError), self.starting_sampler:
            from sierra.worker import nvml

            if self.sampler is None and (library := nvml.opened()) is not None:
                self.sampler = nvml.GpuSampler(library)
            return nvml.GpuUsage(self.sampler) if self.sampler else None
        return None

    def await_signal(self) -> None:
        """Give a SIGTERM that has ended a run time to reach this process too: a scheduler sends it to one after the other."""
        deadline = time.monotonic() + SPREAD_S
        while not self.stopping and time.monotonic() < deadline:
            time.sleep(SAMPLE_S)

    def note(self, running: Running, event: Event) -> None:
        """Write an event of a run. If this fails, the worker cannot continue."""
        try:
            self.journal.write(event, running.seal)
        except OSError as error:
            self.fail(error)

    def clear_shared(self, folder: str) -> str | None:
        """Remove what a run has left in shared folders. Return why that failed, or that the run may have lacked space there."""
        full = [place for place in self.shared if is_full(place)]
        for place, before in self.shared.items():
            for path in (os.path.join(place, name) for name in sorted(entries_of(place) - before)):
                if path != folder:
                    remove(path) if is_folder(path) else unlink(path)
                    if os.path.lexists(path):
                        return "files that it left in shared folders cannot be removed: " + path
        return "no space was left in its container: " + full[0] if full else None

    def report(
        self,
        job: Job,
        slot: int,
        folder: str,
        began: float,
        wall: float,
        remains: Remains,
        status: int | None = None,
        usage: Usage = UNUSED,
    ) -> None:
        """Write that a run has ended; `began` is in seconds since the epoch, `wall` in seconds. `status`: None if not begun."""
        event: End = {
            "event": "end",
            "run": job["run"],
            "execution": job["execution"],
            "directory": folder,
            "started": began,
            "ended": began + wall,
            "exit_code": os.WEXITSTATUS(status) if status is not None and os.WIFEXITED(status) else None,
            "signal": os.WTERMSIG(status) if status is not None and os.WIFSIGNALED(status) else None,
            **usage,
            "host": self.host,
            "slot": slot,
            **remains,
        }
        if job.get("gpus"):
            event["gpus"], event["gpu_limit"] = list(job["gpus"]), job["limits"].get("gpus")
        self.journal.write(event, job.get("seal"))

    def continue_inside(self, now: float) -> None:
        """Continue, at intervals, a worker or a conductor in a container that is stopped: a run may stop its parent."""
        if now < self.continue_at:
            return
        self.continue_at = now + 1.0
        with self.lock:
            roots = [*self.running, *(container.pid for container in list(self.containers.values())), *orphans()]
        for pid in {pid for root in roots for pid in descendants(root)}:
            if state_of(pid) == b"T" and PROGRAM.search(read_proc("%d/cmdline" % pid)):
                signal_process(pid, signal.SIGCONT)

    def watch(self) -> float:
        """Enforce the limits that are due, and return the seconds until the next check."""
        with self.lock:
            running = list(self.running.values())
        now = time.monotonic()
        due = []
        if self.contains:
            reap()
            self.continue_inside(now)
        if self.services is not None:
            self.services.look()
        continue_ending(self.parent)
        for container in list(self.containers.values()):
            if self.stopping:
                container.stop()
            if self.without_grace:
                container.skip_grace()
            if container.kill_at is not None and now >= container.kill_at:
                container.kill()
            container.expire(now)
        for run in running:
            if run.conducted:
                run.continue_conductor(now)
            if run.meter:
                run.meter.read(now)
                due.append(run.meter.due)
            if run.gpu_usage:
                run.gpu_usage.read(run.pids)
            if self.stopping:
                run.stop("interrupted")
            if self.without_grace:
                run.skip_grace()
            deadline = run.deadline()
            if deadline is not None and now >= deadline:
                run.stop("timeout")
            if run.marker and run.stopped is None:
                due.append(run.marker.due(now))
                if due[-1] <= now:
                    run.stop(MARKED)
            if run.stalled(now):
                self.note(run, stalled(run, time.time() - STALLED_S))
            if run.observation:
                run.observation.limit()
                run.observation.look(pid for pid in run.pids() if pid != run.pid or not run.conducted)
                due.append(now + max(SAMPLE_S, (now - run.started) / LOOKS))
            if run.stopped is None and now - run.started > POLL_S / 2:
                reason = exceeded(run)
                if reason:
                    run.stop(reason)
            if run.kill_at is not None and now >= run.kill_at:
                run.kill()
            times = [run.kill_at, deadline if run.stopped is None else None]
            if run.measured:
                times.append(now + POLL_S)
            due += [moment for moment in times if moment is not None]
        if running or self.stopping:
            due.append(now + 1.0)
        else:
            due.append(now + POLL_S)
        return max(0.005, heapq.nsmallest(1, due)[0] - time.monotonic())


def stalled(running: Running, since: float) -> Stalled:
    """Return the event that a run makes no progress, or what it makes is lost, since a time in seconds since the epoch."""
    return {"event": "stalled", "run": running.run, "execution": running.execution, "pid": running.pid, "since": since}


def execute(arguments: Sequence[str], announce: Announce = lambda state: None) -> Worker:
    """Execute the jobs on standard input; return the worker, which has ended. See `Worker` for `announce`."""
    folder, slots = arguments[:2]
    piped = list(arguments[2:3]) == ["-"]
    journal = None if piped else "".join(arguments[2:3])
    adopts = become_subreaper(secretive=piped)
    worker = Worker(
        os.path.abspath(folder), int(slots), journal=journal, adopts=adopts, places=tuple(arguments[3:]), announce=announce
    )

    for number in (signal.SIGQUIT, signal.SIGUSR1, signal.SIGUSR2, signal.SIGALRM):
        signal.signal(number, signal.SIG_DFL)  # perhaps ignored by the process that started this one in the background
    signal.signal(signal.SIGTERM, lambda number, frame: worker.terminate())
    signal.signal(signal.SIGHUP, lambda number, frame: worker.stop())
    signal.signal(signal.SIGINT, lambda number, frame: None)  # a signal that is ignored here would be ignored by all runs
    worker.work(sys.stdin)
    return worker


def main(arguments: list[str]) -> int:
    worker = execute(arguments)
    worker.report_failure()
    return worker.status

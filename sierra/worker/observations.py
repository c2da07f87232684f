"""Observation of runs: which are observed, at which cost, and the record of what they did with files.

The modules of the tracer are loaded only when a run is observed, because that takes longer than all else that a worker loads.
"""

from __future__ import annotations

import hashlib
import json
import os
import threading
import time
from typing import TYPE_CHECKING, Callable, Mapping

from sierra.worker.files import size_of_file, unlink
from sierra.worker.job import Helps, Job
from sierra.worker.layout import LOGS, OBSERVED, TRACE
from sierra.worker.outputs import GivenUp
from sierra.worker.processes import orphans
from sierra.worker.running import Running
from sierra.worker.shared_services import SharedServices, own_ports, with_reasons
from sierra.worker.temporary_folders import Temporary

if TYPE_CHECKING:
    from sierra.worker.file_names import Names
    from sierra.worker.file_trace import Observation, Trace, Way
    from sierra.worker.observed_record import Contents, Hashed

TRACED_S = 0.004  # by which a run takes longer under a tracer,
BYTE_S = 1e-6  # and for each byte of the log: 0.1 ms a call
SMALL, RACY_NS = 1 << 16, 2 * 10**9  # as in sierra.provenance.hash_cache
MOST_LOST = 3  # observed runs that another one replaces, because they have failed: in each experiment, and to compare runs
ANY = -1  # stands for all experiments
UNKNOWN_S = 0.1  # for an observation, while none has ended


def own_folders(running: Running) -> Mapping[str, str]:
    """Return the folders for temporary files of a run and its worker, by the names of the folders in whose place they are."""
    kept = {} if running.checkpoint is None else {"run:checkpoint": running.checkpoint}
    if running.temporary is None:
        return kept
    return {**kept, "work:temporary": os.path.dirname(running.temporary), "run:temporary": running.temporary}


class Observations:
    """The observations of a worker's runs."""

    def __init__(self, folder: str, temporary: Temporary, check_stop: Callable[[], None]) -> None:
        """`folder` is that of the worker. `check_stop` raises GivenUp if outputs are no longer read."""
        self.folder = folder
        self.temporary = temporary
        self.check_stop = check_stop
        self.account = Account()
        self.hashes = Hashes()
        self.trusts = True  # that a tracer works which has worked before
        self.unusable: tuple[str, ...] = ()
        """Why better ways to observe runs cannot be used here."""
        self.looking = threading.Lock()
        self.lock = threading.Lock()
        self.requests: dict[int, Job] = {}
        """By experiments: a run, observed in vain, in whose place the next one is observed.

        `ANY`: a run whose use of files must be compared with that of another one.
        """
        self.lost: dict[int, int] = {}
        """By the same numbers: how many observations were requested in place of others."""

    def with_observation(self, job: Job) -> Job:
        """Return the job, which is observed if a run before it was doubtful, or was observed for its experiment and failed."""
        if "client" in job or "waits" in job or "unobserved" in job:
            return job
        with self.lock:
            compares = ANY in self.requests
            first = self.requests.pop(ANY if compares else job.get("experiment", ANY), None)
        if first is None:
            return job
        job = job.copy()
        job["observe"] = first["observe"]
        if "helps" in first:
            job["helps"] = first["helps"]
        job.pop("budget", None)
        job.pop("affordable", None)
        if compares:
            job["compares"] = True
            if first.get("again"):
                again = first.copy()
                del again["again"]
                with self.lock:
                    self.requests.setdefault(ANY, again)
        elif "affordable" in first:
            job["affordable"] = first["affordable"]
        return job

    def request_comparison(self, job: Job, trace: Trace) -> None:
        """Let the next run be observed if this one wrote and read the same files outside its folder, or used ports.

        For ports, two are observed, so that they overlap if runs do: a program that looks for a free port is recognised then.
        The next run most likely is one of the same experiment, of which the first run is observed. Nothing is requested for a
        run that is itself such a comparison, or one of the sample.
        """
        is_comparison, is_sampled = "compares" in job, "budget" in job
        if is_comparison or is_sampled:
            return
        from sierra.worker.channels import is_doubtful

        uses_ports = is_doubtful(trace.channels)
        if uses_ports or trace.reread or trace.reread_new:
            with self.lock:
                self.requests[ANY] = {**job, "again": uses_ports}

    def request_another(self, job: Job) -> None:
        """Let another run be observed in place of one that has failed, or could not be observed; at most a few times.

        Any run may be compared with a doubtful one; else it is the next of the experiment. None replaces one of the sample.
        """
        key = ANY if "compares" in job else job.get("experiment")
        if key is None or "budget" in job:
            return
        with self.lock:
            if self.lost.setdefault(key, 0) < MOST_LOST:
                self.requests.setdefault(key, job)
            self.lost[key] += 1

    def begin(self, job: Job, folder: str) -> Observation | None:
        """Begin to observe a run, if that is requested and takes no more time than it may."""
        if "observe" not in job or "client" in job or not self.account.allows(job.get("budget"), job.get("affordable")):
            return None
        began = time.monotonic()
        from sierra.worker.observers import gentle

        with self.looking:
            way, self.unusable = gentle() if job.get("waits") else self.way(job.get("helps"))
        own = [self.temporary.places[folder]] if folder in self.temporary.places else []
        observation = way.begin(folder + TRACE, os.path.join(folder, "output"), own) if way else None
        self.account.charge(time.monotonic() - began, sampled="budget" in job)
        return observation

    def way(self, helps: Helps | None) -> tuple[Way | None, tuple[str, ...]]:
        """Return the best way to observe runs here, and why others cannot be used. No tracer is tried that is known to work."""
        from sierra.worker.observers import Strace, usable

        if helps is not None:
            self.hashes.learn(helps["digests"])
            if helps["tracer"] is not None and self.trusts:
                return Strace(helps["tracer"]), ()
        return usable()

    def keep(self, job: Job, running: Running, services: SharedServices | None = None) -> tuple[bool, str | None]:
        """Write what a run did with files to its folder.

        Return whether it was observed, and what the observation may have changed: such a run is executed again without it.
        """
        if running.observation is None:
            return "unobserved" in job and keep_reason(running.folder, job["unobserved"]), None
        from sierra.worker.channels import with_channels
        from sierra.worker.file_names import Names
        from sierra.worker.observed_record import as_record, uses_gpu, with_services

        began = time.monotonic()
        running.observation.end(orphans)
        path = os.path.join(running.folder, OBSERVED)
        disturbed = None
        traced = size_of_file(running.folder + TRACE)
        try:
            trace = running.observation.trace(os.path.join(running.folder, LOGS[1]), self.check_stop)
            disturbed = trace.disturbed
            shared = services.seen() if services else None
            theirs = {name for name, _ in shared.channels} if shared else ()
            trace = with_channels(trace, own_ports(job, running.folder, services), theirs, job["environment"])
            names = Names({"work": self.folder, **job["observe"], "run": running.folder, **own_folders(running)})
            seen = names.inputs(trace._replace(reasons=(*trace.reasons, *self.unusable)))
            self.request_comparison(job, seen)
            with self.looking:
                contents = self.contents(job, seen, names, running.observation.began)
                if services:
                    seen = with_reasons(seen, services, shared)
                if services and services.observation and shared:
                    used = names.inputs(shared)
                    own = self.contents(job, used, names, services.observation.began)
                    seen, contents = with_services(seen, contents, used, own)
                digests = self.hashes.news()
            gpu = any(uses_gpu(whole) for whole in (trace, shared) if whole)
            record = as_record(seen, contents, names, gpu=gpu)
            record["digests"] = digests
            unlink(path)  # a link or a pipe that the run has put there
            with open(path, "x", encoding="ascii") as file:
                json.dump(record, file)
        except (OSError, GivenUp):  # the run is not observed; its result is kept, unless the observation has disturbed it
            unlink(path)
            return False, disturbed
        finally:
            unlink(running.folder + TRACE)
            took = time.monotonic() - began + TRACED_S + traced * BYTE_S
            self.account.charge(took, observations=1, sampled="budget" in job)
        return True, disturbed

    def contents(self, job: Job, trace: Trace, names: Names, began: int) -> Contents:
        """Return the contents of the files in a trace, which began at this time."""
        from sierra.worker.observed_record import contents

        since = began - int(job.get("ahead", 0.0) * 1e9)
        return contents(trace, since, self.hashes.get, self.check_stop, names.is_listed)


class Account:
    """The time that runs have taken, and that their observation has taken, in seconds, in all slots together."""

    def __init__(self) -> None:
        self._ran = self._spent = self._sampled = 0.0
        self._runs = self._observations = 0
        self._lock = threading.Lock()

    def add(self, wall: float) -> None:
        """Add a run."""
        with self._lock:
            self._ran += wall
            self._runs += 1

    def charge(self, seconds: float, observations: int = 0, *, sampled: bool = False) -> None:
        """Add time that was spent on observations (`sampled`: of the sample), and so many of them that have ended."""
        with self._lock:
            self._spent += seconds
            self._sampled += seconds if sampled else 0.0
            self._observations += observations

    def allows(self, part: float | None = None, times: float | None = None) -> bool:
        """Return whether one more observation, as long as the others, is allowed.

        With `part`: if it and those of the sample take at most this part of the runs' time. With `times`: if it takes at most
        so many times the mean time of a run; while no run has ended, each slot may observe one.
        """
        with self._lock:
            mean = self._spent / self._observations if self._observations else UNKNOWN_S
            if part is not None:
                return self._sampled + mean <= part * self._ran
            return times is None or mean * self._runs <= times * self._ran


class Hashes:
    """The SHA-256 of files that were hashed before, as long as their inode, size and times are the same."""

    def __init__(self) -> None:
        self._known: dict[tuple[object, ...], str] = {}
        self._learnt: Mapping[str, object] | None = None
        self._new: dict[str, list[int | str]] = {}

    def learn(self, path: str) -> None:
        """Read once what others have hashed: `sierra.provenance.hash_cache` describes the file. A damaged one is ignored."""
        if self._learnt is None:
            self._learnt = sealed_record(path)

    def get(self, path: str, status: os.stat_result, hashed: Hashed) -> str:
        state = [status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns]
        key = (path, *state)
        if key not in self._known:
            shared = not path.endswith("/RECORD")  # of which not all bytes count: see `python_files.counted`
            learnt = (self._learnt or {}).get(path) if shared else None
            if isinstance(learnt, list) and learnt[:-1] == state and isinstance(learnt[-1], str):
                self._known[key] = learnt[-1]
            else:
                self._known[key] = hashed()
                if shared and status.st_size > SMALL and max(state[3:]) < time.time_ns() - RACY_NS:
                    self._new[path] = [*state, self._known[key]]
        return self._known[key]

    def news(self) -> Mapping[str, list[int | str]]:
        """Return the hashes of large files that are new since the last call, as the file of `learn` has them."""
        new, self._new = self._new, {}
        return new


def sealed_record(path: str) -> Mapping[str, object]:
    """Return the JSON object in a file whose first line is the SHA-256 of the rest; empty if it is damaged or missing."""
    try:
        with open(path, "rb") as file:
            seal, _, content = file.read().partition(b"\n")
        record = json.loads(content) if hashlib.sha256(content).hexdigest().encode() == seal else {}
    except (OSError, ValueError, RecursionError):
        return {}
    return record if isinstance(record, dict) else {}


def keep_reason(folder: str, reason: str) -> bool:
    """Write why a run was not observed to its folder, as a record without files; return whether that was possible."""
    record = {"method": "none", "reason": reason, "notes": [], "distributions": [], "files": [], "listings": {}, "written": []}
    try:
        unlink(os.path.join(folder, OBSERVED))
        with open(os.path.join(folder, OBSERVED), "x", encoding="ascii") as file:
            json.dump(record, file)
    except OSError:
        return False
    return True

"""The jobs of an element of an array job, in a file and on their way to the worker.

The file is gzip (possibly several members), lines of JSON. The first line is `{"common": JOB}`, the last line is
`{"end": COUNT}`. Each line between is a `Difference`.
"""

from __future__ import annotations

import binascii
import gzip
import json
import threading
from collections import deque
from typing import TYPE_CHECKING, Callable, Iterator, Mapping, Sequence, Tuple, TypedDict

from sierra.worker.errors import CannotContinue
from sierra.worker.files import write_all

if TYPE_CHECKING:
    from typing import IO

    from sierra.worker.job import Job, Limits, Program

Between = Tuple[int, str, int]
"""A file that begins and ends like the common job's: bytes of the common beginning, the rest in base64, bytes of the end."""


class Difference(TypedDict, total=False):
    """A job without the keys that equal those of the common job, also within `environment`."""

    run: str
    execution: str
    argv: Sequence[str]
    environment: dict[str, str]
    files: dict[str, str | Between]
    folders: dict[str, str]
    limits: Limits
    client: Program
    shared: bool
    observe: Mapping[str, str]
    """Not in the common job; nor is the budget."""
    budget: float
    affordable: float
    experiment: int
    checkpoint: str
    end: int
    """The number of jobs; only in the last line."""


def jobs(path: str) -> Iterator[Job]:
    """Yield the jobs of an element, in the form that the worker reads. Raises CannotContinue if their number is wrong."""
    count = 0
    with gzip.open(path, "rb") as lines:
        common: Job = json.loads(next(lines))["common"]
        for line in lines:
            job: Difference = json.loads(line)
            if "end" in job:
                if job["end"] != count:
                    break
                return
            count += 1
            yield complete(job, common)
    raise CannotContinue("%s contains %d jobs, which is not the expected number" % (path, count))


def complete(job: Difference, common: Job) -> Job:
    """Return the job that differs in this from the common job."""
    files = common["files"]
    if job.get("files"):
        files = {name: content_of(file, common["files"].get(name, "")) for name, file in job["files"].items()}
    environment = {**common["environment"], **job.get("environment", {})}
    return {**common, **job, "environment": environment, "files": files}  # type: ignore[typeddict-unknown-key]  # `end` is not there


def content_of(file: str | Between, common: str) -> str:
    """Return a file's content in base64."""
    if isinstance(file, str):
        return file
    head, between, tail = file
    outer = binascii.a2b_base64(common)
    content = outer[:head] + binascii.a2b_base64(between) + outer[len(outer) - tail :]
    return binascii.b2a_base64(content, newline=False).decode()


class Feeder(threading.Thread):
    """A thread that sends missing jobs to the worker; few in advance, so that large outputs do not fill up the node."""

    def __init__(
        self, path: str, wanted: Callable[[str], bool], permits: int, pipe: IO[bytes], work: str, ahead: float
    ) -> None:
        """`work` is the attempt's folder, and `ahead` how far its clock is ahead: the worker needs both to observe a run."""
        super().__init__(daemon=True)
        self._path = path
        self._wanted = wanted
        self._pipe = pipe
        self._work = work
        self._ahead = ahead
        self.permits = threading.Semaphore(permits)
        self.spare: deque[int] = deque()
        """The numbers of folders of packed runs, which other runs can reuse; see the worker."""
        self.checkpoints: dict[str, str] = {}
        """The checkpoints of runs that were sent, by execution."""
        self.sent = 0
        self.error: CannotContinue | None = None

    def run(self) -> None:
        try:
            for job in jobs(self._path):
                if self._wanted(job["execution"]):
                    self.permits.acquire()
                    if "client" not in job:
                        job["used"] = self.spare.popleft() if self.spare else None
                    if "observe" in job:
                        job["observe"] = {**job["observe"], "work": self._work}
                        job["ahead"] = self._ahead
                    if "checkpoint" in job:
                        self.checkpoints[job["execution"]] = job["checkpoint"]
                    self._send(job)
                    self.sent += 1
            self._send({"end": True})
        except BrokenPipeError:
            pass  # the worker has ended, and reports the reason itself
        except Exception as error:
            own = error if isinstance(error, CannotContinue) else None
            self.error = own or CannotContinue("%s cannot be read: %s" % (self._path, error))
            self._pipe.close()  # closing the pipe ends the worker

    def _send(self, record: Mapping[str, object]) -> None:
        write_all(self._pipe.fileno(), json.dumps(record, separators=(",", ":")).encode() + b"\n")

"""Sharding of jobs over the elements of an array job, into the files that `sierra.worker.element_jobs` reads.

Each file has once what all jobs of the element have in common, including the common parts of their input files, which come from
one template. If memory suffices, each file is written in one go, because opening files is expensive on a network file system.

If a few runs go first, the others wait in one file until these have shown how many elements are needed.
"""

from __future__ import annotations

import gzip
import json
import zlib
from binascii import b2a_base64
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic_core import to_json

from sierra.errors import Damaged
from sierra.model import Job
from sierra.runners import local
from sierra.store.layout import SessionPaths
from sierra.store.segments import disk_errors

if TYPE_CHECKING:
    from sierra.worker import element_jobs
    from sierra.worker.element_jobs import Difference

LEVEL = 1
ENCODER = json.JSONEncoder(separators=(",", ":"))
BUFFERED = 2 << 20
"""Bytes of lines that may wait to be compressed."""
PACKED = 4 << 20
"""Bytes of compressed data that may wait to be written."""


def deal(jobs: Iterable[Job], elements: int, session: SessionPaths) -> tuple[int, ...]:
    """Write job k to element k mod `elements`; return the number of jobs of each. An element without jobs has no file."""
    shares = [_Share(session.jobs(number)) for number in range(elements)]
    _write(((shares[number % elements], job) for number, job in enumerate(jobs)), shares, session)
    return tuple(share.count for share in shares)


def deal_first(jobs: Iterable[Job], first: AbstractSet[int], session: SessionPaths) -> tuple[int, int]:
    """Write the jobs at the places `first` to element 0, and the others to `rest`; return the number of jobs of each."""
    shares = [_Share(session.jobs(0)), _Share(session.rest)]
    _write(((shares[number not in first], job) for number, job in enumerate(jobs)), shares, session)
    return shares[0].count, shares[1].count


def deal_sized(jobs: Iterable[Job], places: Sequence[int], counts: Sequence[int], session: SessionPaths) -> None:
    """Write the jobs at the first `counts[0]` of these places to element 0, those at the next ones to element 1, and so on."""
    shares = [_Share(session.jobs(number)) for number in range(len(counts))]
    elements = [0] * len(places)
    for place, element in zip(places, (element for element, count in enumerate(counts) for _ in range(count)), strict=True):
        elements[place] = element
    _write(((shares[elements[number]], job) for number, job in enumerate(jobs)), shares, session)


def deal_rest(elements: int, begin: int, session: SessionPaths) -> tuple[int, ...]:
    """Write the jobs in `rest` to `elements` elements from `begin` on. May be repeated. Raises Damaged if jobs are missing."""
    shares = [_Share(session.jobs(begin + number)) for number in range(elements)]
    lines = _lines(session.rest)
    common = next(lines)
    for share in shares:
        share.begin(common)
    _write(((shares[number % elements], line) for number, line in enumerate(lines)), shares, session)
    return tuple(share.count for share in shares)


def _lines(path: Path) -> Iterator[bytes]:
    """Yield the lines of a job file as they are: first the common part of all jobs, then each job."""
    count = -1
    try:
        with gzip.open(path, "rb") as lines:
            for line in lines:
                if line.startswith(b'{"end"') and line == _line({"end": count}):
                    return
                yield line
                count += 1
    except (OSError, EOFError, zlib.error) as error:
        raise Damaged(f"{path}: cannot be read: {error}") from error
    raise Damaged(f"{path}: contains {max(count, 0)} jobs, which is not the expected number")


def _write(dealt: Iterable[tuple[_Share, Job | bytes]], shares: Sequence[_Share], session: SessionPaths) -> None:
    """Give each share its jobs. Keep only as much in memory as is needed to open files seldom."""
    buffered = packed = 0
    with disk_errors(session.root):
        session.jobs(0).parent.mkdir(mode=0o700, exist_ok=True)  # variables of runs are private
        for share, job in dealt:
            buffered += share.put(job) if isinstance(job, bytes) else share.add(job)
            if buffered > BUFFERED:
                packed, buffered = packed + sum(share.compress() for share in shares), 0
            if packed > PACKED:
                packed = sum(share.write() for share in shares)
        for share in shares:
            share.close()


class _Share:
    """The jobs of one element: first lines, then members of a gzip file, then bytes on the disk."""

    def __init__(self, path: Path) -> None:
        self.count = 0
        self._path = path
        self._lines: list[bytes] = []
        self._members: list[bytes] = []
        self._common: Job | None = None
        self._templates: dict[str, _Template] = {}

    def add(self, job: Job) -> int:
        """Add a job; return the bytes of memory that it uses until it is compressed."""
        if self._common is None:
            self._common = job
            self._templates = defaultdict(_Template, ((name, _Template(content)) for name, content in job.files))
            self.begin(_line({"common": local.record(replace(job, observe=None, checkpoint=None))}))
        return self.put(_line(_difference(job, self._common, self._templates)))

    def begin(self, common: bytes) -> None:
        """Write the first line. An existing file is replaced."""
        with disk_errors(self._path.parent):
            self._path.unlink(missing_ok=True)
        self._lines.append(common)

    def put(self, line: bytes) -> int:
        """Add the line of a job, without its common part; return the bytes of memory that it uses until it is compressed."""
        self._lines.append(line)
        self.count += 1
        return len(line)

    def compress(self) -> int:
        """Compress the waiting lines; return the bytes of the result."""
        if not self._lines:
            return 0
        compressor = zlib.compressobj(LEVEL, zlib.DEFLATED, zlib.MAX_WBITS | 16)
        member = compressor.compress(b"".join(self._lines)) + compressor.flush()
        self._lines.clear()
        self._members.append(member)
        return len(member)

    def write(self) -> int:
        """Write the compressed data; return the bytes that still wait, which are 0."""
        if self._members:
            with self._path.open("ab") as file:
                file.writelines(self._members)
            self._members.clear()
        return 0

    def close(self) -> None:
        if self.count:
            self._lines.append(_line({"end": self.count}))
            self.compress()
            self.write()


class _Template:
    """An input file of the first job, and the number of bytes at its start and end that all files so far share with it."""

    def __init__(self, content: bytes = b"") -> None:
        self._content = content
        self._head = self._tail = len(content)

    def difference(self, content: bytes) -> element_jobs.Between:
        """Return the number of bytes shared at the start, the base64 of the bytes between, and the number shared at the end."""
        if not self._fits(content):
            most = min(len(content), len(self._content))
            self._head = _alike(content, self._content, min(most, self._head))
            self._tail = _alike(content[::-1], self._content[::-1], min(most - self._head, self._tail))
        between = content[self._head : len(content) - self._tail]
        return self._head, b2a_base64(between, newline=False).decode(), self._tail

    def _fits(self, content: bytes) -> bool:
        return (
            self._head + self._tail <= min(len(content), len(self._content))
            and content[: self._head] == self._content[: self._head]
            and content[len(content) - self._tail :] == self._content[len(self._content) - self._tail :]
        )


def _line(record: Mapping[str, object]) -> bytes:
    try:
        return to_json(record) + b"\n"
    except ValueError:  # a path whose bytes are not valid text
        return ENCODER.encode(record).encode() + b"\n"


def _difference(job: Job, common: Job, templates: Mapping[str, _Template]) -> Difference:
    """Return the parts of a job that differ from the common job, whose files are `templates`.

    Raises ValueError if they differ in the names of their variables or in the use of an engine.
    """
    if job.environment.keys() != common.environment.keys() or (job.client is None) != (common.client is None):
        raise ValueError(f"runs {job.run} and {common.run} have different variables or engines")
    shared = common.environment
    own = {name: value for name, value in job.environment.items() if shared[name] != value}
    record: Difference = {"run": job.run, "execution": job.execution, "environment": own}
    if job.argv != common.argv:
        record["argv"] = job.argv
    if job.files != common.files:
        record["files"] = {name: templates[name].difference(content) for name, content in job.files}
    if job.folders != common.folders:
        record["folders"] = dict(job.folders or {})
    if job.limits is not common.limits or job.client is not common.client or job.shared != common.shared:
        complete = local.record(replace(job, files=()))
        record["limits"] = complete["limits"]
        if "client" in complete:
            record["client"], record["shared"] = complete["client"], complete["shared"]
    if job.observe is not None:
        record["observe"] = dict(job.observe)
        if job.budget is not None:
            record["budget"] = job.budget
        if job.affordable is not None:
            record["affordable"] = job.affordable
    if job.checkpoint is not None:
        record["checkpoint"] = job.checkpoint
    if job.experiment is not None:
        record["experiment"] = job.experiment
    return record


def _alike(one: bytes, other: bytes, most: int) -> int:
    """Return the length of the longest common beginning of two contents, at most `most`. It is found by bisection."""
    low, high = 0, most
    while low < high:
        middle = (low + high + 1) // 2
        if one[low:middle] == other[low:middle]:
            low = middle
        else:
            high = middle - 1
    return low

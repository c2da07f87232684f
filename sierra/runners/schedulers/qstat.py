"""What `qstat` answers, as records and as tasks.

Two forms are read. The text of `qstat -f` is the same in OpenPBS, Torque and SLURM's wrapper:

    Job Id: 5[3].pbs1
        Job_Name = sierra-12ab
        Variable_List = PBS_O_HOME=/home/user,PBS_O_PATH=/usr/local/bin:/usr/b
    <tab>in:/bin

What is too long goes on in lines that begin with a tab. OpenPBS's JSON (`-F json`) is quicker to read; but some of its
versions write it so that no reader takes it (strings that hold quotes), and then its text is asked for instead.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from sierra.runners.schedulers.base import State, Task

Record = Mapping[str, str]
"""The attributes of a job, a queue or a server by their names, as in the text: `resources_max.walltime`; and its `id`."""

ELEMENTS = "SIERRA_ELEMENTS"
"""The variable of a job that says which elements its tasks are, by their places, where the scheduler doesn't."""
HEAD = re.compile(r"(?:Job Id|Queue|Server):\s*(\S+)\s*")
ATTRIBUTE = re.compile(r"(?: {4}|\t)([A-Za-z_][\w.]*) = (.*)")
ID = re.compile(r"(\d+)(?:\[(\d*)\]|-(\d+))?(\..+)?")
"""`12.pbs1`, the array `12[].pbs1`, its element `12[3].pbs1` or, in old Torques, `12-3.pbs1`."""
SPELLED = re.compile(r"\d{1,9}(-\d{1,9})?(\+\d{1,9}(-\d{1,9})?)*")
ENDED = frozenset("FXC")
WAITING = frozenset("QWT")
NEVER = re.compile(r"can never run|too many failed attempts", re.IGNORECASE)
FORGOTTEN = "Subjob finished"
"""The comment of what OpenPBS knows no more of an element than that."""
HOLDS = frozenset("sop")
"""Holds of the system (a launch that failed), of an operator, for a bad password. The user's own (u) is theirs to release,
and Torque's a and l hold elements until the array is there or has a place."""
ENDS = {
    ("Exit_status", "-20"): "its node was lost",
    ("Exit_status", "-27"): "memory exceeded",
    ("Exit_status", "-29"): "walltime exceeded",
    ("Exit_status", "271"): "asked to end",
    ("exit_status", "-10"): "memory exceeded",
    ("exit_status", "-11"): "walltime exceeded",
    ("exit_status", "271"): "asked to end",
}
"""What statuses that are no program's mean: OpenPBS's and, in small letters, Torque's (job.h, pbs_job.h)."""
DELETED = "91"
"""The `substate` of what was deleted while it ran, or waited (OpenPBS)."""


@dataclass(frozen=True, slots=True)
class Name:
    """What a job's id says."""

    job: str
    """The id of the whole job."""
    place: int | None
    """The index in the array; None where it is no element of one."""
    array: bool


def name(text: str) -> Name:
    """Read a job's id."""
    match = ID.fullmatch(text)
    if not match:
        return Name(text, None, array=False)
    number, inside, after, server = match.groups("")
    place = inside or after
    array = inside != "" or "[" in text
    return Name(f"{number}{'[]' if array else ''}{server}", int(place) if place else None, array or bool(after))


def text_records(text: str) -> Iterator[Record]:
    """What stands in the text of `qstat -f`, `-Q -f` or `-B -f`."""
    record: dict[str, str] = {}
    key = ""
    for line in text.splitlines():
        if head := HEAD.fullmatch(line):
            if record:
                yield record
            record, key = {"id": head[1]}, ""
        elif attribute := ATTRIBUTE.fullmatch(line):
            key = attribute[1]
            record[key] = attribute[2]
        elif line.startswith("\t") and key:
            record[key] += line[1:]
    if record:
        yield record


def json_records(text: str) -> Iterator[Record]:
    """What stands in the answer to `qstat -f -F json`. Raises ValueError where that is no JSON, or not such JSON."""
    answer = json.loads(text, strict=False) if text.strip() else {}
    jobs = answer.get("Jobs", {}) if isinstance(answer, dict) else None
    if not isinstance(jobs, dict) or not all(isinstance(job, dict) for job in jobs.values()):
        raise ValueError("no jobs in what qstat says")
    for job, attributes in jobs.items():
        yield {"id": job, **{key: _plain(value) for key, value in attributes.items()}}


def _plain(value: Any) -> str:
    """As the text has it; numbers in JSON may have been texts of digits."""
    if isinstance(value, dict):
        return ",".join(f"{key}={_plain(inner)}" for key, inner in value.items())
    return str(value)


def own(records: Iterable[Record], called: str, owner: str) -> list[Record]:
    """Those jobs that have this name and this owner. Torque adds to the name of an element its index."""
    return [one for one in records if one.get("Job_Owner", "").partition("@")[0] == owner and _is_called(one, called)]


def _is_called(record: Record, called: str) -> bool:
    said, place = record.get("Job_Name", ""), name(record["id"]).place
    return said == called or (place is not None and said == f"{called}-{place}")


def tasks(records: Sequence[Record]) -> Iterator[Task]:
    """What is to be said of jobs: of each element, and of an array as a whole only where none of it is listed."""
    wholes = {name(one["id"]).job: one for one in records if name(one["id"]).place is None}
    listed = {name(one["id"]).job for one in records if name(one["id"]).place is not None}
    for record in records:
        known = name(record["id"])
        if known.place is not None or known.job not in listed:
            whole = wholes.get(known.job, {}) if known.place is not None else {}
            state, reason = _state(record, whole)
            node = record.get("exec_host", "").partition("/")[0]
            cancelled = state is State.ENDED and _is_deleted(record)
            yield Task(known.job, element(record), state, reason, node, cancelled)


def element(record: Record) -> int | None:
    """Which element a job or a part of one is: what the job's variable says, else its index."""
    known = name(record["id"])
    if known.array and known.place is None:
        return None
    said = re.search(rf"(?:^|,){ELEMENTS}=([^,]*)", record.get("Variable_List", ""))
    if not said:
        return known.place
    elements = _spelled(said[1].strip())
    place = known.place or 0
    return elements[place] if place < len(elements) else None


@lru_cache(maxsize=4)
def _spelled(text: str) -> tuple[int, ...]:
    """What was spelled, nothing where it is damaged; every part of an array says the same."""
    if not SPELLED.fullmatch(text):
        return ()
    ends = [part.partition("-") for part in text.split("+") if part]
    return tuple(index for first, _, last in ends for index in range(int(first), int(last or first) + 1))


def _state(record: Record, whole: Record) -> tuple[State, str]:
    """What becomes of a task, and the scheduler's words on it. A letter that nobody knows is a task that may live."""
    letter, comment = record.get("job_state", ""), record.get("comment", "")
    if letter in ENDED:
        return State.ENDED, _end(record)
    if letter == "H" or (letter in WAITING and whole.get("job_state") == "H"):
        held = record if letter == "H" else whole
        return _held(held), comment or held.get("comment") or f"held: {held.get('Hold_Types', '?')}"
    if letter in WAITING:
        words = comment or (whole.get("comment", "") if whole.get("job_state") in WAITING else "")
        return State.STUCK if NEVER.search(words) else State.QUEUED, words
    return State.RUNNING, comment


def _end(record: Record) -> str:
    """How a task ended, where that is worth a word.

    Without a history, OpenPBS has forgotten an element that ended in an array that lives, and says what the array is instead.
    """
    if record.get("comment") == FORGOTTEN:
        return ""
    for key in ("Exit_status", "exit_status"):
        if (status := record.get(key, "0")) != "0":
            return ": ".join(filter(None, (f"{key} {status}", ENDS.get((key, status)))))
    return ""


def _is_deleted(record: Record) -> bool:
    """Whether `qdel` has ended a task: what it says of itself may be any exit status."""
    return record.get("substate") == DELETED or "271" in (record.get("Exit_status"), record.get("exit_status"))


def _held(record: Record) -> State:
    """A job that waits for another is held by the system as well, and will be released."""
    if "depend" in record or not HOLDS & set(record.get("Hold_Types", "")):
        return State.QUEUED
    return State.STUCK

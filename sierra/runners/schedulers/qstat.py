"""Parser of the answers of `qstat`, into records and tasks.

Two forms are read. The text of `qstat -f` is the same in OpenPBS and SLURM's wrapper:

    Job Id: 5[3].pbs1
        Job_Name = sierra-12ab
        Variable_List = PBS_O_HOME=/home/user,PBS_O_PATH=/usr/local/bin:/usr/b
    <tab>in:/bin

A long value continues in lines that begin with a tab. OpenPBS's JSON (`-F json`) is faster to read, but some of its versions
write invalid JSON (strings that contain quotes). Then the text is requested instead.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache

from sierra.runners.schedulers.base import State, Task
from sierra.util.json_types import Json
from sierra.util.lazy_definitions import dataclass, regex

Record = Mapping[str, str]
"""Attributes of a job, a queue or a server by their names in the text, for example `resources_max.walltime`; and its `id`."""

ELEMENTS = "SIERRA_ELEMENTS"
"""The variable of a job that lists the elements of its tasks, by their places, if the scheduler does not know them."""
HEAD = regex(r"(?:Job Id|Queue|Server):\s*(\S+)\s*")
ATTRIBUTE = regex(r"(?: {4}|\t)([A-Za-z_][\w.]*) = (.*)")
ID = regex(r"(\d+)(?:\[(\d*)\])?(\..+)?")
"""`12.pbs1`, the array `12[].pbs1`, or its element `12[3].pbs1`."""
ELEMENT_LIST = regex(r"\d{1,9}(-\d{1,9})?(\+\d{1,9}(-\d{1,9})?)*")
ENDED = frozenset("FXC")
WAITING = frozenset("QWT")
NEVER = regex(r"can never run|too many failed attempts", re.IGNORECASE)
FORGOTTEN = "Subjob finished"
"""The comment of an element about which OpenPBS knows nothing else."""
HOLDS = frozenset("sop")
"""Holds by the system (a launch that failed), by an operator, or because of a bad password. A user's own hold (u) is theirs to
release."""
ENDS = {"-20": "its node was lost", "-27": "memory exceeded", "-29": "walltime exceeded", "271": "asked to end"}
"""Meanings of special exit statuses, which no program returns (OpenPBS's job.h)."""
DELETED = "91"
"""The `substate` of a job that was deleted while it ran or waited (OpenPBS)."""


@dataclass(frozen=True, slots=True)
class Name:
    """The parts of a job's id."""

    job: str
    """The id of the whole job."""
    place: int | None
    """The index in the array; None if the id is not that of an element."""
    array: bool


def name(text: str) -> Name:
    """Parse a job's id."""
    match = ID.fullmatch(text)
    if not match:
        return Name(text, None, array=False)
    number, inside, server = match.groups()
    array = inside is not None
    return Name(f"{number}{'[]' if array else ''}{server or ''}", int(inside) if inside else None, array)


def text_records(text: str) -> Iterator[Record]:
    """Yield the records in the text of `qstat -f`, `-Q -f` or `-B -f`."""
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
    """Yield the records in the answer to `qstat -f -F json`. Raises ValueError for invalid or unexpected JSON."""
    answer: Json = json.loads(text, strict=False) if text.strip() else {}
    jobs = answer.get("Jobs", {}) if isinstance(answer, dict) else None
    if not isinstance(jobs, dict):
        raise ValueError("the output of qstat contains no jobs")
    for job, attributes in jobs.items():
        if not isinstance(attributes, dict):
            raise ValueError(f"the output of qstat describes no job {job}")
        yield {"id": job, **{key: _text(value) for key, value in attributes.items()}}


def _text(value: Json) -> str:
    """Return a JSON value as the text form has it. Numbers in the JSON may have been texts of digits."""
    if isinstance(value, dict):
        return ",".join(f"{key}={_text(inner)}" for key, inner in value.items())
    return str(value)


def own(records: Iterable[Record], called: str, owner: str) -> list[Record]:
    """Return the jobs of this name and owner."""
    return [one for one in records if one.get("Job_Owner", "").partition("@")[0] == owner and one.get("Job_Name") == called]


def tasks(records: Sequence[Record]) -> Iterator[Task]:
    """Yield the task of each element. A whole array is one task if none of its elements is listed."""
    wholes = {name(job_record["id"]).job: job_record for job_record in records if name(job_record["id"]).place is None}
    listed = {name(job_record["id"]).job for job_record in records if name(job_record["id"]).place is not None}
    for record in records:
        known = name(record["id"])
        if known.place is not None or known.job not in listed:
            whole = wholes.get(known.job, {}) if known.place is not None else {}
            state, reason = _state(record, whole)
            node = record.get("exec_host", "").partition("/")[0]
            cancelled = (state is State.ENDED and _is_deleted(record)) or None  # an exit status does not rule it out
            yield Task(known.job, element(record), state, reason, node, cancelled)


def element(record: Record) -> int | None:
    """Return the element of a job or of a part of one: from the job's variable, if there is one, else its index."""
    known = name(record["id"])
    if known.array and known.place is None:
        return None
    said = re.search(rf"(?:^|,){ELEMENTS}=([^,]*)", record.get("Variable_List", ""))
    if not said:
        return known.place
    elements = _parse_elements(said[1].strip())
    position = known.place or 0
    return elements[position] if position < len(elements) else None


@lru_cache(maxsize=4)
def _parse_elements(text: str) -> tuple[int, ...]:
    """Return the elements in such a text; empty if it is damaged. All parts of an array have the same text."""
    if not ELEMENT_LIST.fullmatch(text):
        return ()
    ends = [part.partition("-") for part in text.split("+") if part]
    return tuple(index for first, _, last in ends for index in range(int(first), int(last or first) + 1))


def _state(record: Record, whole: Record) -> tuple[State, str]:
    """Return the state of a task and the scheduler's words about it. A task with an unknown letter may be alive."""
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
    """Return how a task ended; empty if it ended normally or nothing is known.

    Without a history, OpenPBS has forgotten an ended element of a living array. It reports the array's attributes instead.
    """
    status = record.get("Exit_status", "0")
    if status == "0" or record.get("comment") == FORGOTTEN:
        return ""
    return ": ".join(filter(None, (f"Exit_status {status}", ENDS.get(status))))


def _is_deleted(record: Record) -> bool:
    """Return True if `qdel` has ended a task, whose own exit status may be any."""
    return record.get("substate") == DELETED or record.get("Exit_status") == "271"


def _held(record: Record) -> State:
    """Return the state of a held job. The system also holds a job that waits for another, and will release it."""
    if "depend" in record or not HOLDS & set(record.get("Hold_Types", "")):
        return State.QUEUED
    return State.STUCK

"""One record of the files that the programs of a run used on all of its robots, from the records of their workers.

The name of a file begins with the robot's: `{robot tb1}/usr/bin/python3`. Files of the project keep their names, because all
robots have the same.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, Field

from sierra.extensions.robots.agent_messages import Text
from sierra.extensions.robots.trial import Part
from sierra.model import IN_PROJECT
from sierra.util.regular_files import read_regular
from sierra.worker import remote_folder
from sierra.worker.layout import OBSERVED

MOST_BYTES = 64 << 20
Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
Name = Annotated[str, AfterValidator(lambda name: remote_folder.text(remote_folder.raw(name)))]
"""The name of a file, which may have bytes that are no text."""
Use = Literal["executed", "read", "found", "missed", "listed", "linked", "link"]


class _Observed(BaseModel):
    """The parts of a worker's record that count: see `sierra.worker.observed_record.as_record`."""

    method: Text
    reason: Text | None
    notes: list[Text]
    distributions: list[Text]
    files: list[tuple[Name, Use, Sha256 | None, Annotated[int, Field(ge=0, lt=1 << 63)] | None]]


def merge(parts: Iterable[Part], folder: Path) -> bool:
    """Write the record of a run to its folder; return whether there is one. Call it before the files of parts are moved."""
    records = {part.name: _read(part) for part in parts if part.started}
    known = {name: own for name, own in records.items() if own is not None}
    if not known:
        return False
    missing = [f"{name} was not observed" for name in records.keys() - known.keys()]
    reasons = [*dict.fromkeys(own.reason for own in known.values() if own.reason), *sorted(missing)]
    record = {
        "method": next(iter(known.values())).method,
        "reason": "; ".join(reasons) or None,
        "notes": [f"{name}: {note}" for name, own in known.items() for note in own.notes],
        "distributions": list(dict.fromkeys(line for own in known.values() for line in own.distributions)),
        "files": sorted({file for name, own in known.items() for file in _files(name, own)}, key=lambda file: file[:2]),
        "written": [],
    }
    (folder / OBSERVED).write_text(json.dumps(record), encoding="ascii")
    return True


def _read(part: Part) -> _Observed | None:
    """Return the record of one robot; None if there is none, or if it is not what a worker writes."""
    if part.files is None or part.end is None or not part.end.get("observed"):
        return None
    path = part.files / OBSERVED
    with contextlib.suppress(OSError, ValueError, RecursionError):
        if not path.is_symlink() and path.stat().st_size <= MOST_BYTES:
            return _Observed.model_validate(json.loads(read_regular(path)))  # pydantic's own JSON has no bytes that are no text
    return None


def _files(robot: str, one: _Observed) -> Iterator[tuple[str, str, str | None, int | None]]:
    for path, use, sha256, size in one.files:
        yield path if path.startswith(IN_PROJECT) else f"{{robot {robot}}}{path}", use, sha256, size

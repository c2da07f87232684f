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

from pydantic import BaseModel, Field, ValidationError

from sierra.model import IN_PROJECT
from sierra.runners.robots.trial import Part
from sierra.worker.worker import OBSERVED

MOST_BYTES = 64 << 20
Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
Use = Literal["executed", "read", "found", "missed", "listed", "linked", "link"]


class _Observed(BaseModel):
    """The parts of a worker's record that count: see `sierra.worker.file_trace.as_record`."""

    method: str
    reason: str | None
    notes: list[str]
    distributions: list[str]
    files: list[tuple[str, Use, Sha256 | None, int | None]]


def merge(parts: Iterable[Part], folder: Path) -> bool:
    """Write the record of a run to its folder; return whether there is one. Call it before the files of parts are moved."""
    found = {part.name: _read(part) for part in parts if part.started}
    known = {name: one for name, one in found.items() if one is not None}
    if not known:
        return False
    missing = [f"{name} was not observed" for name in found.keys() - known.keys()]
    reasons = [*dict.fromkeys(one.reason for one in known.values() if one.reason), *sorted(missing)]
    record = {
        "method": next(iter(known.values())).method,
        "reason": "; ".join(reasons) or None,
        "notes": [f"{name}: {note}" for name, one in known.items() for note in one.notes],
        "distributions": list(dict.fromkeys(line for one in known.values() for line in one.distributions)),
        "files": sorted({file for name, one in known.items() for file in _files(name, one)}, key=lambda file: file[:2]),
        "written": [],
    }
    (folder / OBSERVED).write_text(json.dumps(record), encoding="ascii")
    return True


def _read(part: Part) -> _Observed | None:
    """Return the record of one robot; None if there is none, or if it is not what a worker writes."""
    if part.files is None or part.end is None or not part.end.get("observed"):
        return None
    path = part.files / OBSERVED
    with contextlib.suppress(OSError, ValidationError):
        if not path.is_symlink() and path.stat().st_size <= MOST_BYTES:
            return _Observed.model_validate_json(path.read_bytes())
    return None


def _files(robot: str, one: _Observed) -> Iterator[tuple[str, str, str | None, int | None]]:
    for path, use, sha256, size in one.files:
        yield path if path.startswith(IN_PROJECT) else f"{{robot {robot}}}{path}", use, sha256, size

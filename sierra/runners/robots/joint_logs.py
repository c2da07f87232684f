"""The logs of all robots of a run in one file each: every robot gets its share of what is kept, however much others print.

The part of a robot whose program has failed comes last, because the end of a log is shown with the reason of a failure.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from sierra.runners.robots.trial import Part
from sierra.util.kept_log import KEPT, kept_of, shares
from sierra.worker import worker

SPARE = 64
"""Bytes for the line that says how much of a log is left out."""


def join(parts: Iterable[Part], folder: Path) -> None:
    """Write `stdout` and `stderr` of all parts whose files were pulled into a folder, each part below the robot's name."""
    pulled = sorted((part for part in parts if part.files is not None), key=lambda part: part.failure is not None)
    for name in worker.LOGS:
        logs = [(f"==> {part.name} <==\n".encode(), str(part.files / name)) for part in pulled if part.files]
        (folder / name).write_bytes(b"".join(_joined(logs)))


def _joined(logs: Iterable[tuple[bytes, str]]) -> Iterator[bytes]:
    """Yield the parts of a joint log, from titles and paths."""
    filled = [(title, path, size) for title, path in logs if (size := kept_of(path, 0)[1])]
    room = KEPT - sum(len(title) + SPARE for title, _, _ in filled)
    for (title, path, _), share in zip(filled, shares([size for _, _, size in filled], room), strict=True):
        kept = kept_of(path, share)[0]
        yield title + kept + (b"" if kept.endswith(b"\n") else b"\n")

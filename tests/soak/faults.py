"""Commands with a fault at a named point; hook/sitecustomize.py defines points."""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tests.projects import SIERRA

HOOK = Path(__file__).with_name("hook")
LONGEST_S = 300

Action = Literal["kill", "interrupt", "ENOSPC", "EIO", "EACCES"]


@dataclass(frozen=True, slots=True)
class Ended:
    """A `sierra` command that has ended."""

    words: tuple[str, ...]
    code: int
    out: str
    err: str
    struck: bool = False
    """True if the fault happened."""


def sierra(
    root: Path,
    *words: str,
    point: str = "",
    action: Action = "kill",
    prefix: tuple[str, ...] = (),
    environment: Mapping[str, str] | None = None,
    indexes: bool = False,
) -> Ended:
    """Run `sierra WORDS` in a project, with an optional fault at `point`; `prefix` is a command such as faketime.

    `indexes`: build an index even for a few segments.
    """
    with tempfile.TemporaryDirectory(prefix="sierra-soak-") as folder:
        struck = Path(folder, "struck")
        setting = {**_watched(root, indexes=indexes), "point": point, "action": action, "struck": str(struck)}
        faulty = {"PYTHONPATH": str(HOOK), "SIERRA_SOAK": json.dumps(setting)} if point or indexes else {}
        done = _call(root, words, {**faulty, **(environment or {})}, prefix)
        return Ended(words, done.returncode, done.stdout, done.stderr, struck.exists())


def _watched(root: Path, *, indexes: bool) -> dict[str, object]:
    return {"root": str(root), "temporary": tempfile.gettempdir(), "indexes": indexes}


def points(root: Path, *words: str, indexes: bool = False) -> list[str]:
    """Return the points that `sierra WORDS` passes, in order."""
    with tempfile.TemporaryDirectory(prefix="sierra-soak-") as folder:
        log = Path(folder, "points")
        setting = {**_watched(root, indexes=indexes), "log": str(log)}
        done = _call(root, words, {"PYTHONPATH": str(HOOK), "SIERRA_SOAK": json.dumps(setting)})
        assert done.returncode in (0, 1), done.stderr
        return log.read_text().splitlines() if log.exists() else []


def _call(
    root: Path, words: tuple[str, ...], more: dict[str, str], prefix: tuple[str, ...] = ()
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*prefix, str(SIERRA), *words],
        cwd=root,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        errors="replace",
        timeout=LONGEST_S,
        check=False,
        env={**os.environ, **more},
    )

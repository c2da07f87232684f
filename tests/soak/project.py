"""The project for faults, and the content of its store after undisturbed runs."""

from __future__ import annotations

import os
from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from pathlib import Path
from typing import Any

from sierra.store.store import Store
from tests import projects
from tests.soak.faults import sierra

Wanted = Mapping[str, list[dict[str, Any]]]
"""The content of an undisturbed store, by its kind."""
QUERY = ("run", "population_size.Log4", "--runs", "4", "-j", "2", "--no-figures")
RUNS = 12

SIMULATOR = (
    projects.SIMULATOR.replace("noise * (seed % 100)", 'noise * (seed % 100) + float(os.environ.get("OFFSET", 0))')
    + """
with open("notes.jsonl", "w") as file:
    for place in range(3):
        print('{"place": %d, "what": "note %d"}' % (place, place), file=file)
with open("picture.bin", "wb") as file:
    file.write(bytes((seed + place) % 256 for place in range(5_000)))
print("seed", seed)
"""
).replace("import sys", "import os, sys", 1)

NAMES = (
    "plain",
    "v=7",
    "run=zzz",
    "a'; echo b",
    "[0]*",
    "{a,b}?",
    "über ß",
    " two  blanks ",
    "-n",
    "$HOME",
    "line\nfeed",
    'quo"te',
    "back\\slash",
    "%d{uuid}",
)
"""Folders that may contain a project."""


def make(parent: Path, name: str = "plain") -> Path:
    """Make the project in `parent/name/p`, and return its folder."""
    return projects.make(parent / name / "p", simulator=SIMULATOR)


def content(root: Path, store: Store | None = None) -> dict[str, list[dict[str, Any]]]:
    """Return the content of the store that does not depend on time, place and number of executions of the query."""
    store = store or Store(root / ".sierra")
    return {name: store.rows(text) for name, text in CONTENT.items()}


ROWS = "SELECT * EXCLUDE (execution, row), row_number() OVER (PARTITION BY run ORDER BY row) AS place FROM {} ORDER BY ALL"
KEPT = (
    "SELECT DISTINCT sha256, size FROM objects WHERE sha256 IN (SELECT sha256 FROM artifacts "
    "WHERE kind {} 'table' AND execution IN (SELECT execution FROM effective)) ORDER BY ALL"
)
RAW = "bytes of tables"
CONTENT = {
    "batch_runs": "SELECT batch, ordinal, number, run, seed, input FROM batch_runs ORDER BY ALL",
    "experiments": "SELECT * FROM experiments ORDER BY ALL",
    "effective": "SELECT c.batch, c.ordinal, c.run, e.status, e.result, e.exit_code FROM effective c JOIN executions e "
    "USING (execution) ORDER BY ALL",
    "artifacts": "SELECT a.run, a.path, a.kind, a.output, a.size, a.sha256, a.rows FROM artifacts a "
    "WHERE a.execution IN (SELECT execution FROM effective) ORDER BY ALL",
    "swarm": ROWS.format("swarm"),
    "notes": ROWS.format("notes"),
    "kept files": KEPT.format("<>"),
    RAW: KEPT.format("="),
}


def recorded(root: Path) -> set[str]:
    """Return the successful executions in the store."""
    if not (root / ".sierra" / "format").exists():
        return set()
    return {row["execution"] for row in Store(root / ".sierra").rows("SELECT execution FROM executions WHERE status = 'ok'")}


def left_over(root: Path) -> list[str]:
    """Return the remaining sessions and their processes."""
    sessions = [str(path) for path in root.glob(".sierra/work/*") if path.is_dir()]
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            text = (process / "environ").read_bytes() + (process / "cmdline").read_bytes()
        except OSError:
            continue
        if b"SIERRA_SESSION=" in text and os.fsencode(root) in text:
            found.append(f"process {process.name}")
    return sessions + found


class Differs(AssertionError):
    """A difference from the state after an undisturbed run."""


def check(root: Path, wanted: Wanted, before: AbstractSet[str] = frozenset(), *, but: str = "") -> None:
    """Complete the query, and compare the store with an undisturbed one; executions in `before` must not be lost.

    The content named `but` may differ.
    """
    done = sierra(root, *QUERY)
    if done.code != 0:
        raise Differs(f"completing the query ended with exit code {done.code}: {done.out}{done.err}")
    found = content(root)
    for name, rows in wanted.items():
        if found[name] != rows and name != but:
            raise Differs(f"{name} differ: {_difference(found[name], rows)}")
    if lost := before - recorded(root):
        raise Differs(f"{len(lost)} recorded executions are lost: {sorted(lost)[:3]}")
    if left := left_over(root):
        raise Differs(f"sessions or processes are left: {left[:3]}")
    fsck = sierra(root, "fsck")
    if fsck.code != 0:
        raise Differs(f"fsck ended with {fsck.code}: {fsck.out}{fsck.err}")


def _difference(found: list[dict[str, Any]], wanted: list[dict[str, Any]]) -> str:
    for place, (one, other) in enumerate(zip(found, wanted, strict=False)):
        if one != other:
            return f"row {place} is {one} instead of {other}"
    return f"{len(found)} rows instead of {len(wanted)}"

"""Small real stores for tests: several batches, tables of all formats, logs, binary files, a replay."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import sierra
from sierra.store import segments
from tests import projects

SIMULATOR = (
    projects.SIMULATOR
    + """
import json
with open("notes.jsonl", "w") as file:
    for place in range(3):
        print(json.dumps({"place": place, "what": f"note {place}"}), file=file)
with open("picture.bin", "wb") as file:
    file.write(bytes((seed + place) % 256 for place in range(10_000)))
print("said by", seed)
print("complained", file=sys.stderr)
"""
)


IRRELEVANT = (".git/index", ".git/hooks/", ".git/logs/")
"""Files of a repository that differ although commits and checked-out files are equal."""


def make(folder: Path) -> Path:
    """Make a project with three batches, two of which share runs, and a replay; return its folder."""
    root = projects.make(folder, simulator=SIMULATOR)
    project = sierra.open(root)
    first = project.run("population_size=1,2", figures=False).batch
    project.run("population_size=2,3", runs=3, figures=False)
    project.run("noise=0.5", figures=False)
    project.replay(first, runs=1)
    return root


def ask(root: Path, *query: str, **more: Any) -> str:
    """Run a query; return its batch. The store is copied if an equal project has run the same query before."""
    files = {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}
    if any(name.startswith(".sierra/") for name in files):
        return _asked(root, query, more)
    for name in [name for name in files if name.startswith(IRRELEVANT)]:
        del files[name]
    key = hashlib.sha256(repr((files, query, more)).encode()).hexdigest()
    kept = Path(os.environ["XDG_CACHE_HOME"], "asked", key)  # a cache of the tests: see conftest
    if kept.exists():
        shutil.copytree(kept / ".sierra", root / ".sierra", symlinks=True)
    else:
        _asked(root, query, more)
        copy(root, kept)
    return str(sierra.open(root).batches[-1].batch)


def _asked(root: Path, query: Sequence[str], more: Mapping[str, Any]) -> str:
    batch: str = sierra.open(root).run(*query, figures=False, **more).batch
    return batch


def copy(root: Path, target: Path) -> Path:
    """Copy a project to another folder."""
    shutil.copytree(root, target, symlinks=True)
    return target


def files(root: Path, name: str) -> list[Path]:
    """Return the Parquet files of a table in the segments of a project; those of an output, `output.NAME`, have numbers."""
    found = segments.on_disk(root / ".sierra" / "segments")
    return [Path(segment.files[name]) for segment in found if name in segment.files]


def file(folder: Path, name: str) -> Path:
    """Return the Parquet file of a table in the folder of one segment."""
    [found] = [path for path in files(folder.parents[2], name) if path.parent == folder]
    return found


def state(root: Path) -> dict[str, bytes]:
    """Return every file of a store by its path in the store."""
    store = root / ".sierra"
    return {str(path.relative_to(store)): path.read_bytes() for path in sorted(store.rglob("*")) if path.is_file()}

"""The project that a command works on."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from types import ModuleType

from sierra.api import Project
from sierra.cli.output import note
from sierra.errors import NotFound, UsageError
from sierra.store import index_files
from sierra.util.first_import import Load, load_with
from sierra.util.hashing import short

ALLOCATOR = "ARROW_DEFAULT_MEMORY_POOL"


_folder = ContextVar("_folder", default=Path())
"""The folder in which the project is looked for."""


@contextmanager
def using(folder: Path) -> Iterator[None]:
    """Make the project in `folder` the one that commands work on, until the end of the context."""
    before = _folder.set(folder)
    try:
        yield
    finally:
        _folder.reset(before)


def refuse_in_package(option: str, reason: str) -> None:
    """Raise UsageError for an option of a command that reads a received package, if that is what commands work on."""
    if _folder.get() != Path():
        raise UsageError(f"{option} {reason}; nothing of a package is executed")


def project() -> Project:
    """Return the project of the working directory, as `sierra.open` does, or that of `using`.

    pyarrow loads pandas when it makes its first array, which takes half a second. No command converts to pandas, so pandas is
    hidden from pyarrow if a command loads pyarrow. It also gets the system's allocator instead of its own, which keeps freed
    memory: this saves 80 MB for 100,000 runs. Neither affects users of SIERRA from Python.
    """
    if "pandas" not in sys.modules:
        load_with("pyarrow", _load)
    index_files.announce = note
    return Project(_folder.get(), received=_folder.get() != Path())


def _load(module: ModuleType, load: Load) -> None:
    """Load pyarrow without pandas and with the system's allocator.

    An environment variable selects the allocator, because the C++ code of pyarrow obeys nothing else; it reads it once.
    """
    before = os.environ.get(ALLOCATOR)
    os.environ[ALLOCATOR] = "system"
    sys.meta_path.insert(0, hidden := _NoPandas())
    try:
        load(module)
        module.array([0])
    finally:
        sys.meta_path.remove(hidden)
        del os.environ[ALLOCATOR]
        os.environ.update({} if before is None else {ALLOCATOR: before})


def given_or_last(word: str | None, opened: Project) -> str:
    """Return the id or name that was given; without one, the id of the last batch, after a note that names it.

    Raises Missing if no batch is recorded.
    """
    return _noted(opened.records.batch()) if word is None else word


def last_on_cluster(opened: Project, *, only: bool = False) -> str:
    """Return the id of the last batch that has cluster jobs, after a note that names it.

    Raises NotFound if there is none and, with `only`, UsageError if there are several.
    """
    on_clusters = [batch for batch in opened.batches if batch.clusters]
    if not on_clusters:
        raise NotFound("no batch has jobs on a cluster; sierra ls lists recorded batches")
    if only and len(on_clusters) > 1:
        listed = ", ".join(f"{short(batch.batch)} ({batch.query})" for batch in on_clusters)
        raise UsageError(f"{len(on_clusters)} batches have jobs on a cluster; name one of them: {listed}")
    return _noted(on_clusters[-1].batch, "the only one with cluster jobs" if only else "the last one with cluster jobs")


def _noted(batch: str, which: str = "the last one") -> str:
    note(f"batch {short(batch)}, {which}")
    return batch


class _NoPandas:
    """An importer that makes Python find no pandas."""

    def find_spec(self, name: str, path: object = None, target: object = None) -> None:
        if name == "pandas":
            raise ModuleNotFoundError(name)

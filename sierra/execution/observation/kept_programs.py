"""Programs of the project that git ignores and that executions used: the store keeps small ones, so that replays have them.

A program is a file that was executed, or that is an ELF file or a script: for example `build/libcontroller.so`. Data is not
kept, except files of the source that git would restore with other bytes. The records of programs and of observed files have
their SHA-256. Products of `[build]` are not kept, because a replay builds them again, and neither are files of a virtual
environment, which a replay uses where it is.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from sierra.execution.plan import Plan
from sierra.model import IN_PROJECT
from sierra.provenance import source
from sierra.provenance.hash_cache import VENV
from sierra.store.store import Store
from sierra.util.fs import unescaped
from sierra.util.hashing import sha256

MAGIC = (b"\x7fELF", b"#!")
CONVERTED = "converted"
"""The use of a file of the source that git would restore with other bytes."""
KEPT = ("executed", CONVERTED)


class _Used(NamedTuple):
    path: str
    use: str
    sha256: str


OBSERVED = """
SELECT DISTINCT f.path, f.use, f.sha256
FROM observations o JOIN executions e USING (execution) JOIN files_read f USING (files)
WHERE e.session = $s AND starts_with(f.path, $inside) AND f.use IN ('executed', 'read') AND f.sha256 IS NOT NULL ORDER BY ALL
"""


def contents(plan: Plan, store: Store, session: str) -> Iterator[bytes]:
    """Yield the programs to keep that the store does not have, the smallest first, up to the limit of `[source]`."""
    if plan.source is None:  # a recorded batch
        return
    used = _used(plan, store, session)
    if not used:
        return
    with store.snapshot() as snapshot:
        stored = snapshot.kept_sizes(file.sha256 for file in used.values())
    left = plan.project.config.source.max_ignored
    for size, path, file in sorted((path.stat().st_size, path, file) for path, file in used.items() if path.is_file()):
        if size > left:
            return
        content = b"" if file.sha256 in stored else path.read_bytes()
        if (file.use in KEPT or content.startswith(MAGIC)) and sha256(content) == file.sha256:
            left -= size
            yield content


def _used(plan: Plan, store: Store, session: str) -> Mapping[Path, _Used]:
    """Return the project's files outside the source that are known to be used."""
    converted = plan.source.converted if plan.source else {}
    derived = [_Used(file.name, str(file.kind), file.sha256) for file in plan.programs.all if file.name.startswith(IN_PROJECT)]
    observed = [] if plan.project.config.observe == "none" else store.select(_Used, OBSERVED, s=session, inside=IN_PROJECT)
    root, known = plan.project.root, source.paths(plan.source.manifest) if plan.source else set()
    products = {file.name for file in plan.build.products} if plan.build else set()
    files = {file.path.removeprefix(IN_PROJECT): file for file in (*derived, *observed)}
    lossy = {root / unescaped(name): _Used(name, CONVERTED, sha256) for name, sha256 in converted.items()}
    return lossy | {
        root / name: file
        for name, file in files.items()
        if os.fsencode(name) not in known and name not in products and not _is_in_environment(root, name)
    }


def _is_in_environment(root: Path, name: str) -> bool:
    return any((root / folder / VENV).is_file() for folder in Path(name).parents)

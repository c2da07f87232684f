"""Hints at compiled programs that stayed the same although their code changed, in projects without `[build]`."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import NamedTuple

from sierra.errors import NotFound
from sierra.execution import row_queries
from sierra.execution.plan import Plan
from sierra.model import IN_PROJECT
from sierra.provenance import referenced_files, source
from sierra.provenance.compiled_languages import is_code, is_compiled
from sierra.store.store import Store
from sierra.util.hashing import short
from sierra.util.text import few

SHOWN = 3


class Before(NamedTuple):
    """The last session with another source: its batch and programs, and the list of the source's files."""

    batch: str
    programs: str
    files: str


BEFORE = """
SELECT s.batch, s.programs, o.files FROM sessions s JOIN sources o USING (source)
WHERE o.tree <> $tree ORDER BY s.lamport DESC LIMIT 1
"""


def unbuilt(plan: Plan, store: Store | None) -> Iterator[str]:
    """Yield a hint if runs use compiled programs of the project that are older than the code, as far as content shows.

    That is so if files in compiled languages differ from those of the last other source, but the programs do not. Times are
    no evidence: a checkout changes them, and a copy may keep them. With `dirty = "refuse"`, a hint says that nothing is known
    about them at all.
    """
    if plan.project.config.build is not None or plan.source is None or plan.checkout is not None:
        return
    held = source.paths(plan.source.manifest)
    used = {
        program.name: program.sha256
        for program in plan.programs.all
        if program.name.startswith(IN_PROJECT)
        and os.fsencode(program.name.removeprefix(IN_PROJECT)) not in held
        and is_compiled(program.path)
    }
    if not used:
        return
    if plan.project.config.source.dirty == "refuse":
        names = [name.removeprefix(IN_PROJECT) for name in sorted(used)]
        yield (
            f'[source] dirty = "refuse": everything is committed, but {few(names, SHOWN)} may have been built from other code; '
            "declare [build], and SIERRA builds it from this code"
        )
    if store is None:
        return
    with store.snapshot() as snapshot:
        past = snapshot.select(Before, BEFORE, tree=plan.source.tree)
        recorded = {row.name: row.sha256 for row in row_queries.programs(snapshot, [before.programs for before in past])}
    variables = plan.batch.spec.environment
    built = {name for name, digest in used.items() if recorded.get(name, digest) != digest}
    found_by_path = {name for name in used if referenced_files.is_in_library_folder(name, variables)}
    left = used.keys() - found_by_path if built & found_by_path else used.keys()  # a build makes only what depends on an edit
    same = [name.removeprefix(IN_PROJECT) for name, digest in used.items() if name in left and recorded.get(name) == digest]
    changed = list(_changed(past, plan.source.manifest, store)) if same else []
    if changed:
        yield (
            f"{few(changed, SHOWN)} changed since batch {short(past[0].batch)}, but {few(same, SHOWN)} did not: "
            "build it, or declare [build], and SIERRA builds it whenever the source changes"
        )


def _changed(found: list[Before], manifest: bytes, store: Store) -> Iterator[str]:
    """Yield the files in compiled languages that differ from those of another source."""
    for before in found:
        try:
            yield from filter(is_code, source.changed(store.object(before.files), manifest))
        except NotFound:  # sierra fsck reports it
            return

"""Sets of files that observed executions used, as the store has them, with what a comparison with the current files needs."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from sierra.execution import commands
from sierra.execution.resolve_plan import Plan, not_in_checkouts
from sierra.execution.unchanged_files import FileSets, UsedFile
from sierra.provenance import pythons
from sierra.store.store import Snapshot

USED = "SELECT files, path, use, sha256 FROM files_read SEMI JOIN needed USING (files)"
LISTINGS = "SELECT sha256, names FROM listings WHERE sha256 IN (SELECT sha256 FROM files_read SEMI JOIN needed USING (files))"
WRITTEN = """
SELECT DISTINCT path FROM files_written
WHERE execution IN (SELECT execution FROM observations SEMI JOIN needed USING (files))
"""
SEARCHED = """
SELECT DISTINCT o.files, json_extract_string(v.variables, '$.PATH') AS search
FROM observations o SEMI JOIN needed USING (files) JOIN executions e USING (execution) JOIN environments v USING (environment)
"""
TABLES = ("executions", "observations", "files_read", "listings", "files_written", "environments")


class _Listing(NamedTuple):
    sha256: str
    names: list[str]


def of_user() -> dict[str, Path]:
    """Return the user's folders that names of observed files refer to, by name."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return {"home": Path.home().resolve(), "cache": cache.resolve()}


def folders(plan: Plan) -> dict[str, Path]:
    """Return the folders that names of observed files refer to, by name."""
    named = {"project": plan.project.root.resolve(), **of_user()}
    search = commands.declared(plan.batch.spec.environment, plan.project.root, plan.project.root)["PATH"]
    environment = pythons.environment(plan.programs, search)
    return {**named, "prefix": environment} if environment else named


def load(plan: Plan, snapshot: Snapshot, sets: Iterable[str]) -> FileSets:
    """Return these sets, with all that is needed to compare them with the files that are here now."""
    snapshot.views.make(TABLES)
    snapshot.add_table("needed", files=sorted(sets))
    program = plan.programs.all[0].path if plan.programs.all else ""
    now = commands.search_path(commands.declared(plan.batch.spec.environment, plan.project.root, plan.project.root))
    found = file_sets(snapshot, folders(plan), now, program, declared="PATH" in plan.batch.spec.environment)
    return replace(found, words=_words(plan), lacking=frozenset(not_in_checkouts(plan.project)))


def _words(plan: Plan) -> str:
    """Return all texts of a plan that may name modules of Python."""
    spec, template = plan.batch.spec, plan.project.root / plan.project.config.template
    try:
        text = template.read_text(errors="replace")
    except OSError:
        text = ""
    return " ".join((*spec.command, *spec.environment.values(), plan.text, text))


def file_sets(snapshot: Snapshot, named: Mapping[str, Path], search: str, program: str, *, declared: bool) -> FileSets:
    """Return the sets in the table `needed`, with all that is needed to compare them.

    `named` are the folders that names refer to. `search` is the search path (PATH) of runs now, and `declared` whether it is
    part of their specification. `program` is the one that the command starts now.
    """
    searched: dict[str, set[str | None]] = {}
    for files, before in snapshot.run(SEARCHED):
        searched.setdefault(files, set()).add(search if declared else before)
    return FileSets(
        used=tuple(snapshot.select(UsedFile, USED)),
        listings={one.sha256: frozenset(one.names) for one in snapshot.select(_Listing, LISTINGS)},
        written=frozenset(snapshot.values(str, WRITTEN)),
        folders=named,
        searched={files: frozenset(paths) for files, paths in searched.items()},
        search=search,
        program=program,
    )

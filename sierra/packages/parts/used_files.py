"""The part of a package with the files that runs used and that are not in the source, as executions were observed to use them.

Files of the project, for example programs that git ignores, are packed if they are still the recorded ones; otherwise a note
names them. Files of the machine are not packed: `environment/used-files.txt` lists them with their hashes.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import PurePosixPath
from typing import NamedTuple

from sierra.model import IN_PROJECT
from sierra.packages.layout import PROJECT, USED
from sierra.packages.members import unsafe
from sierra.packages.subject import Member, PartResult, Subject
from sierra.store.store import Snapshot
from sierra.util.fs import inside
from sierra.util.hashing import sha256_file
from sierra.util.text import counted

USED_FILES = """
CREATE TEMP TABLE used AS SELECT DISTINCT path, sha256 FROM (
    SELECT path, sha256 FROM files_read WHERE use IN ('executed', 'read') AND sha256 IS NOT NULL
    UNION SELECT if(starts_with(name, '{project}/'), name, path), sha256 FROM programs
    WHERE kind IN ('program', 'library', 'file') AND sha256 IS NOT NULL AND path IS NOT NULL
) WHERE sha256 NOT IN (SELECT sha256 FROM blobs)
"""
"""SQL: the files that executions used, without those of the packed sources."""
OF_PROJECT = "SELECT path, sha256 FROM used WHERE starts_with(path, '{project}/') ORDER BY ALL"
MACHINE = "SELECT path, sha256 FROM used WHERE NOT starts_with(path, '{project}/') ORDER BY ALL"
UNOBSERVED = """
SELECT count(*) FROM effective f
ANTI JOIN (SELECT execution FROM observations SEMI JOIN files_read USING (files)) o USING (execution)
"""


class _Used(NamedTuple):
    path: str
    sha256: str


def members(subject: Subject, packed: Mapping[str, Member]) -> PartResult:
    """Return the project's files that runs used and no source has, and the list of the machine's files."""
    with subject.store.snapshot() as snapshot:
        snapshot.views.make(("files_read", "programs", "blobs", "effective", "observations"))
        snapshot.run(USED_FILES)
        collected, notes = _of_project(subject, snapshot, packed)
        machine = snapshot.select(_Used, MACHINE)
        [(unobserved,)] = snapshot.run(UNOBSERVED)
    lines = "".join(f"{used.sha256}  {used.path!a}\n" for used in machine)
    facts = [f"{counted(len(machine), 'file')} of this machine that runs used: not packed, but listed in {USED}"]
    if unobserved:
        facts.append(f"{counted(unobserved, 'execution')} not observed: files that only they used may be missing")
    listing = Member(USED, lines.encode(), "files of the machine that runs used, with their SHA-256")
    return PartResult([*collected, listing], notes=tuple(notes), facts=tuple(facts))


def _of_project(subject: Subject, snapshot: Snapshot, packed: Mapping[str, Member]) -> tuple[list[Member], list[str]]:
    collected: list[Member] = []
    notes: list[str] = []
    for used in snapshot.select(_Used, OF_PROJECT):
        name = used.path.removeprefix(IN_PROJECT)
        member = packed.get(PROJECT + name)
        if member is not None and member.sha256() == used.sha256:
            continue
        if reason := _missing(subject, name, used.sha256, packed=member is not None):
            notes.append(f"runs used {name!r}, which is not packed: {reason}")
        else:
            path = subject.project.root / name
            executable = bool(path.stat().st_mode & 0o100)
            collected.append(Member(PROJECT + name, path, "file that runs used, outside the source", executable=executable))
    return collected, notes


def _missing(subject: Subject, name: str, sha256: str, *, packed: bool) -> str:
    """Return the reason why a file that runs used cannot be packed; "" if it can."""
    if packed:
        return "another version of it is"
    if ".." in PurePosixPath(name).parts:
        return "it is outside the project"
    if reason := unsafe(PROJECT + name):
        return reason
    path = inside(subject.project.root, name)
    if not path.is_file():
        return "it no longer exists"
    return "" if sha256_file(path) == sha256 else "it has changed since"

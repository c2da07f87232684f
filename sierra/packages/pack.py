"""Packing: batches of a project become one file.

The batches are extracted to a temporary store first, from which all parts of the package are made. Each part is a function of
`PARTS`, in this order; see `sierra.packages.subject.Part`. Everything that is left out is listed before the file is written.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path

from sierra.config.project_file import LoadedProject
from sierra.deliverables.claims import registration
from sierra.errors import UsageError
from sierra.maintenance.extract import extract
from sierra.packages import archive, instructions, manifest
from sierra.packages.anonymity import anonymous
from sierra.packages.anonymity.anonymous import Anonymity, anonymous_file
from sierra.packages.crates import crate
from sierra.packages.layout import INSTRUCTIONS, PACKAGE
from sierra.packages.parts import (
    checks,
    completeness,
    declared_files,
    execution,
    figures,
    history,
    images,
    licence,
    metadata,
    own_wheel,
    report,
    sources,
    stored,
    used_files,
    verifier,
    wheels,
)
from sierra.packages.subject import Member, Options, Part, PartResult, Subject
from sierra.store.store import Store
from sierra.util.lazy_definitions import dataclass
from sierra.util.scratch import scratch

SCRATCH = ".sierra-package-"
"""The prefix of the names of temporary folders, which are beside the package."""
PARTS: tuple[Part, ...] = (
    sources.members,
    anonymous.members,  # rewrites the records, which all parts below show
    history.members,
    stored.members,
    completeness.members,
    declared_files.members,
    used_files.members,
    execution.members,
    images.members,
    own_wheel.members,
    wheels.members,
    figures.members,
    report.members,
    metadata.members,
    licence.members,
    verifier.members,
    checks.members,
)


@dataclass(frozen=True, slots=True)
class Preview:
    """A package that has not been written yet."""

    members: int
    bytes: int
    """The size of all members in bytes."""
    notes: tuple[str, ...]
    """One line for each thing that is left out."""
    facts: tuple[str, ...]
    """Further lines for the reader of the package."""
    searched: tuple[str, ...] = ()
    """The words that an anonymous package was searched for; they are not in the package."""
    general: tuple[str, ...] = ()
    """Names that are too general to show who made a package, and were not searched."""


@dataclass(frozen=True, slots=True)
class Packed:
    """A package that has been written."""

    path: Path
    id: str
    """The identity of the package: the hash of its members."""
    preview: Preview


def pack(
    project: LoadedProject,
    store: Store,
    prefixes: Sequence[str],
    path: Path,
    agree: Callable[[Preview], bool] = lambda preview: True,
    options: Options | None = None,
    anonymity: Anonymity | None = None,
) -> Packed | None:
    """Write a package of these batches, if `agree` returns true for the preview; return None if it returns false.

    `anonymity`: given for an anonymous package. Raises UsageError if `path` exists or an id is not that of a batch, Missing and
    ConfigError for what cannot be packed, Identifying if an anonymous package would name people or machines.
    """
    path, chosen = path.parent.resolve() / path.name, options or Options()
    check_needs(project, path, chosen, anonymous=anonymity is not None)
    batches = _batches(store, prefixes)
    images.check(project.root, store, batches, chosen.image)
    with scratch(path.parent, SCRATCH) as folder:
        part = extract(store, batches, folder / "store", registration.recorded(project, store))
        subject = Subject(project, part, batches, folder, _date(project, part), chosen)
        if anonymity is not None:
            subject = anonymity.subject(subject)
        members, notes, facts = _collect(subject)
        described = manifest.describe(subject, (*notes, *facts))
        members[PACKAGE] = Member(PACKAGE, manifest.written(described), "description of the package for programs")
        members[INSTRUCTIONS] = instructions.member(described, members)
        members |= {member.name: member for member in crate.members(subject, members).members}
        size = sum(member.size for member in members.values())
        if anonymity is None:
            preview = Preview(len(members), size, notes, facts)
        else:
            unread = anonymity.check(subject, members)
            preview = Preview(len(members), size, (*notes, *unread), facts, anonymity.searched, anonymity.general)
        if not agree(preview):
            return None
        programs = [name for name, member in members.items() if member.executable]
        return Packed(path, archive.write(path, members, programs, folder), preview)


def check_needs(project: LoadedProject, path: Path, options: Options, *, anonymous: bool) -> None:
    """Check all that a package needs and that can be known before any work is done. Raises as `pack` does."""
    archive.check_new(path)
    metadata.files(project.config.package)
    if options.wheels:
        wheels.check(options)
    if anonymous:
        anonymous_file(project)


def _batches(store: Store, prefixes: Sequence[str]) -> tuple[str, ...]:
    """Return the ids of the named batches in the order in which they were requested."""
    named = [store.resolve(prefix) for prefix in prefixes]
    for prefix, resolved in zip(prefixes, named, strict=True):
        if resolved.kind != "batch":
            raise UsageError(f"{prefix} is the id of a {resolved.kind}; sierra package takes batches: see sierra ls")
    known = store.values(str, "SELECT batch FROM batches ORDER BY lamport, batch")
    return tuple(batch for batch in known if batch in {resolved.id for resolved in named})


def _date(project: LoadedProject, store: Store) -> str:
    """Return the date of `[package]`, else the end of the newest execution in UTC."""
    newest = store.values(float, "SELECT epoch(max(ended)) FROM executions HAVING count(ended) > 0")
    ended = f"{datetime.fromtimestamp(newest[0], UTC):%Y-%m-%dT%H:%M:%SZ}" if newest else ""
    return project.config.package.date or ended


def _collect(subject: Subject) -> tuple[dict[str, Member], tuple[str, ...], tuple[str, ...]]:
    """Return the members of all parts, their notes, and their facts. A later part never replaces a member of an earlier one."""
    members: dict[str, Member] = {}
    notes: list[str] = []
    facts: list[str] = []
    problems: list[str] = []
    for part in PARTS:
        result: PartResult = part(subject, members)
        for member in result.members:
            members.setdefault(member.name, member)
        notes += result.notes
        facts += result.facts
        problems += result.problems
    if problems:
        raise UsageError("; ".join(problems))
    return members, tuple(notes), tuple(facts)

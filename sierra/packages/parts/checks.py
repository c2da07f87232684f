"""Checks of a package before it is written: secrets, large files, editable installs.

A secret is a problem: what has been published cannot be taken back. `[package] no_secrets` names what only looks like one. A
large file must be confirmed. An editable install is a fact that readers learn of: its code is hashed, but not packed.
"""

from __future__ import annotations

import itertools
import json
import operator
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from fnmatch import fnmatchcase
from pathlib import Path

from sierra.packages.archive import STORED
from sierra.packages.layout import PROJECT
from sierra.packages.parts.secret_shapes import kinds, variables
from sierra.packages.subject import Member, PartResult, Subject
from sierra.util.hashing import CHUNK, short
from sierra.util.text import few, size

SHOWN = 5
"""Secrets that are named."""
TEXTS = {
    "batches": "SELECT DISTINCT CAST(t AS VARCHAR) FROM batches t",
    "builds": "SELECT DISTINCT CAST(t AS VARCHAR) FROM builds t",
    "environments": "SELECT DISTINCT CAST(t AS VARCHAR) FROM environments t",
    "images": "SELECT DISTINCT CAST(t AS VARCHAR) FROM images t",
    "isolations": "SELECT DISTINCT CAST(t AS VARCHAR) FROM isolations t",
    "sessions": "SELECT DISTINCT CAST(t AS VARCHAR) FROM sessions t",
    "sources": "SELECT DISTINCT CAST(t AS VARCHAR) FROM sources t",
    "specs": "SELECT DISTINCT CAST(t AS VARCHAR) FROM specs t",
}
"""SQL: recorded texts that users or their machines wrote, by table."""
VARIABLES = """
SELECT variables FROM (
    SELECT variables FROM builds UNION SELECT variables FROM environments UNION SELECT variables FROM images
    UNION SELECT variables FROM specs
) WHERE variables IS NOT NULL
"""
"""SQL: recorded variables, as JSON."""
USES = "SELECT any_value(path) FROM artifacts WHERE sha256 = $sha256 HAVING count(*) > 0"
EDITABLE = """
SELECT DISTINCT version FROM programs
WHERE kind = 'distributions' AND starts_with(path, '/') AND NOT starts_with(path, $root)
AND version IS NOT NULL AND NOT ends_with(name, ': installed distributions')
ORDER BY 1
"""
"""SQL: distributions that were installed as links to a folder. Others have an address, and other folders have no version."""


def members(subject: Subject, found: Mapping[str, Member]) -> PartResult:
    """Return no members, but the reasons why these must not be published as they are, and files to confirm."""
    editable = subject.store.values(str, EDITABLE, root=str(subject.project.root))
    facts = [f"editable installs, whose code is hashed and not packed: {few(editable, SHOWN)}"] if editable else []
    problems = secret_problems(subject, _secrets(subject, found))
    return PartResult((), notes=tuple(_large(subject, found.values())), facts=tuple(facts), problems=tuple(problems))


def _large(subject: Subject, found: Iterable[Member]) -> Iterator[str]:
    limit = subject.project.config.package.max_file
    for member in found:
        if member.size > limit:
            yield f"{member.name} has {size(member.size)}, which is more than {size(limit)} ([package] max_file)"


def _secrets(subject: Subject, found: Mapping[str, Member]) -> Iterator[tuple[str, str]]:
    """Yield the places of secrets, and their kinds."""
    yield from _of_members(found)
    yield from _of_settings(subject)
    yield from _of_records(subject)
    yield from _of_objects(subject, found)


def secret_problems(subject: Subject, places: Iterable[tuple[str, str]]) -> Iterator[str]:
    """Yield one line that names secrets by their places and kinds, without those of `[package] no_secrets`."""
    allowed = subject.project.config.package.no_secrets
    lines = dict.fromkeys(f"{name} ({kind})" for name, kind in places if not any(fnmatchcase(name, glob) for glob in allowed))
    if lines:
        remedy = "remove them, and record the batch again; or list what is no secret in [package] no_secrets"
        yield f"packages must not contain secrets, and these look like some: {few(list(lines), SHOWN)}; {remedy}"


def _of_members(found: Mapping[str, Member]) -> Iterator[tuple[str, str]]:
    for member in found.values():
        if not member.name.endswith(STORED):
            for kind in sorted(member_kinds(member)):
                yield member.name.removeprefix(PROJECT), kind


def member_kinds(member: Member) -> set[str]:
    """Return the kinds of secrets in a member."""
    with member.open() as file:
        return kinds(iter(lambda: file.read(CHUNK), b""))


def _of_settings(subject: Subject) -> Iterator[tuple[str, str]]:
    """Yield the variables in sierra.toml whose names are those of secrets."""
    for name in variables(tomllib.loads(subject.project.file.read_text("utf-8"))):
        yield name, f"a variable in {subject.project.file.name}"


def _of_records(subject: Subject) -> Iterator[tuple[str, str]]:
    """Yield secrets in recorded texts, and recorded variables whose names are those of secrets."""
    for table, statement in TEXTS.items():
        for text in subject.store.values(str, statement):
            yield from ((f"table {table}", kind) for kind in sorted(kinds([text.encode()])))
    for text in subject.store.values(str, VARIABLES):
        yield from ((name, "a recorded variable") for name in variables(json.loads(text)))


def _of_objects(subject: Subject, packed: Mapping[str, Member]) -> Iterator[tuple[str, str]]:
    """Yield secrets in recorded files: inputs, outputs, logs. Those of sources are named by their members."""
    known: set[str] | None = None
    for path in sorted(subject.store.paths.segments.glob("*/objects.parquet")):
        for sha256, blocks in _objects(path):
            for kind in sorted(kinds(blocks)):
                known = {member.sha256() for member in packed.values() if member_kinds(member)} if known is None else known
                if sha256 not in known:
                    named = subject.store.values(str, USES, sha256=sha256)
                    yield named[0] if named else f"recorded file {short(sha256)}", kind


def _objects(path: Path) -> Iterator[tuple[str, Iterator[bytes]]]:
    """Yield the recorded files of a segment: SHA-256 and parts of the content."""
    import pyarrow.parquet as pq

    with pq.ParquetFile(path) as file:
        rows = (
            (sha256.as_py(), content.as_buffer().to_pybytes())
            for batch in file.iter_batches(batch_size=64, columns=["sha256", "content"])
            for sha256, content in zip(*batch.columns, strict=True)
        )
        for sha256, parts in itertools.groupby(rows, operator.itemgetter(0)):
            yield sha256, (content for _, content in parts)

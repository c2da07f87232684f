"""`package.json`: a package's description for programs. Its JSON Schema is published in `schemas/package.schema.json`.

It is written last but for the crate and the list of hashes, and contains no hash of a member. Nothing in it is trusted:
programs that open a package use it to show what there is to do, and the records in the store decide.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Annotated, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from sierra.deliverables.claims.evaluate import Verdict, evaluate
from sierra.errors import Damaged
from sierra.packages.layout import PACKAGE
from sierra.packages.needs import Machine, Measured, machines, of_batches
from sierra.packages.parts.sources import folders
from sierra.packages.subject import Subject
from sierra.util.version import __version__

FORMAT: Literal["sierra package 1"] = "sierra package 1"


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class PackedBatch(_Part):
    """A batch in the package."""

    batch: str = Field(description="id, 64 hexadecimal digits")
    query: str = Field(description="research query")
    experiments: int = Field(ge=0, description="number of experiments")
    runs: int = Field(ge=0, description="number of runs")
    successful: int = Field(ge=0, description="number of runs with a successful execution")
    needs: Measured | None = Field(None, description="time and memory; null if no run was measured")


class PackedSource(_Part):
    """A source in the package."""

    tree: str = Field(description="identifier of its content, an SWHID")
    commit: str | None = Field(None, description="commit that was checked out; null outside git and in anonymous packages")
    folder: str = Field(description="folder in the package")


class PackedClaim(_Part):
    """A claim of the paper, as the packed records decide it."""

    name: str = Field(description="name in sierra.toml")
    says: str = Field(description="the sentence")
    shown: str = Field("", description="figure, table or place in the paper")
    verdict: Verdict = Field(description="verdict on the recorded data")
    text: str = Field(description="numbers behind the verdict")
    registered: str = Field(
        "", description="planned if its text was recorded before all executions that count for it, else exploratory"
    )
    registration: str = Field("", description="the word with its reason, and how often the claim was changed")
    batches: tuple[str, ...] = Field(description="ids of the batches that decide it; none if they are not packed")
    seconds: float = Field(ge=0, description="sum of the durations of all runs of these batches, in seconds")


class PackageManifest(_Part):
    """The content of `package.json`."""

    format: Literal["sierra package 1"] = Field(FORMAT, description="format of the package")
    sierra: str = Field(description="version of SIERRA that wrote it")
    title: str = Field("", description="title")
    date: str = Field("", description="date of publication, in ISO 8601")
    batches: tuple[PackedBatch, ...] = Field(description="packed batches, in the order in which they were requested")
    sources: tuple[PackedSource, ...] = Field((), description="sources of the runs")
    claims: tuple[PackedClaim, ...] = Field((), description="claims of the paper")
    machines: tuple[Machine, ...] = Field((), description="machines that the runs were executed on")
    notes: tuple[str, ...] = Field((), description="things that the package does not contain, and other facts, one line each")
    redacted: Annotated[bool, Field(description="true in packages for double-blind review")] = False


BATCHES = """
SELECT b.batch, b.query, m.experiments, m.runs, coalesce(f.successful, 0) AS successful
FROM batches b LEFT JOIN (
    SELECT batch, count(DISTINCT run) AS successful FROM effective WHERE outcome = 'success' GROUP BY batch
) f USING (batch)
JOIN (SELECT batch, count(DISTINCT ordinal) AS experiments, count(DISTINCT run) AS runs FROM batch_runs GROUP BY batch) m
    USING (batch)
"""
"""SQL: the batches. A join of all runs would need much more memory."""


class _Batch(NamedTuple):
    batch: str
    query: str
    experiments: int
    runs: int
    successful: int


def describe(subject: Subject, notes: tuple[str, ...]) -> PackageManifest:
    """Return the description of a package with these notes."""
    rows = {row.batch: row for row in subject.store.select(_Batch, BATCHES)}
    needs = of_batches(subject.store)
    return PackageManifest(
        sierra=__version__,
        title=subject.project.config.package.title,
        date=subject.date,
        batches=tuple(PackedBatch(**rows[batch]._asdict(), needs=needs.get(batch)) for batch in subject.batches),
        sources=tuple(
            PackedSource(tree=tree.tree, commit=tree.commit, folder=folder) for folder, tree in folders(subject).items()
        ),
        claims=tuple(_claims(subject, needs)),
        machines=machines(subject.store),
        notes=notes,
        redacted=subject.redacted,
    )


def _claims(subject: Subject, needs: Mapping[str, Measured]) -> Iterator[PackedClaim]:
    """Yield the claims, decided by the packed batches, whose source may not be that of today."""
    for one in evaluate(subject.project, subject.store, among=subject.batches) if subject.project.config.claims else ():
        seconds = sum(needs[batch].seconds for batch in one.batches if batch in needs)
        same = {name: getattr(one, name) for name in ("name", "says", "shown", "verdict", "text", "batches")}
        yield PackedClaim(**same, registered=one.registered, registration="; ".join(one.registration.lines), seconds=seconds)


def written(manifest: PackageManifest) -> bytes:
    """Return the content of the file."""
    return (manifest.model_dump_json(indent=2) + "\n").encode()


def read(content: bytes) -> PackageManifest:
    """Return the description from the content of the file. Raises Damaged if it is not valid, or of another format."""
    try:
        found = json.loads(content)
        if isinstance(found, dict) and found.get("format") != FORMAT:
            raise Damaged(f"{PACKAGE}: the format is {str(found.get('format'))[:60]!r}, but this SIERRA reads {FORMAT!r}")
        return PackageManifest.model_validate(found)
    except (ValueError, RecursionError, ValidationError) as error:
        raise Damaged(f"{PACKAGE} is not valid: {str(error).splitlines()[0][:120]}") from error

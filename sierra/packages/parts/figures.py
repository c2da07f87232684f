"""The part `figures/` of a package: figures and tables as they were drawn, if they still follow from the packed records.

A figure that shows other data, whose file was changed, or that rests on batches that are not packed, is named and left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from sierra.deliverables.check import check
from sierra.deliverables.record import Checked
from sierra.errors import Missing
from sierra.packages.layout import DRAWN
from sierra.packages.members import unsafe
from sierra.packages.subject import Made, Member, Subject
from sierra.store.layout import FIGURES
from sierra.util.hashing import short


def members(subject: Subject, found: Mapping[str, Member]) -> Made:
    """Return the files of the recorded deliverables of all packed batches that follow from the packed records."""
    made: list[Member] = []
    notes: list[str] = []
    for batch in subject.batches:
        try:
            for one in check(subject.project, subject.store, batch):
                reason = one.problem or next(filter(None, map(unsafe, one.files)), "")
                made += () if reason else _files(subject, one)
                notes += [f"{one.kind} {one.name!r} of batch {short(batch)} is not packed: {reason}"] if reason else []
        except Missing as error:
            notes.append(f"no figure of batch {short(batch)} is packed: {error}")
    return Made(made, notes=tuple(notes))


def _files(subject: Subject, deliverable: Checked) -> Iterator[Member]:
    for file in deliverable.files:
        name = DRAWN + file.removeprefix(f"{FIGURES}/")
        yield Member(name, subject.project.root / file, f"{deliverable.kind} {deliverable.name!r}, as it was drawn")

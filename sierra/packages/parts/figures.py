"""The part `figures/` of a package: deliverables as they were made, if they still follow from the packed records.

A figure that shows other data, whose file was changed, or that rests on batches that are not packed, is named and left out.
Reports are not among them, because a package has a report of its own.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import product

from sierra.deliverables.check import Checked, check
from sierra.deliverables.report.results import REPORT
from sierra.errors import Missing
from sierra.packages.layout import drawn
from sierra.packages.members import unsafe
from sierra.packages.subject import Made, Member, Subject
from sierra.store import deliverable_records
from sierra.util.hashing import short


def members(subject: Subject, found: Mapping[str, Member]) -> Made:
    """Return the files of the recorded deliverables of all packed batches that follow from the packed records.

    `Options.without` leaves kinds out.
    """
    made: list[Member] = []
    done: set[Checked] = set()
    notes: list[str] = []
    without = (REPORT, *subject.options.without)
    for batch in subject.batches:
        try:
            for one in check(subject.project, subject.store, batch, without=without):
                if one in done:  # it shows several batches
                    continue
                done.add(one)
                reason = one.problem or next(filter(None, map(unsafe, one.files)), "")
                made += () if reason else _files(subject, one)
                notes += [f"{one.kind} {one.name!r} of batch {short(batch)} is not packed: {reason}"] if reason else []
        except Missing as error:
            notes.append(f"no figure of batch {short(batch)} is packed: {error}")
    return Made(made, notes=tuple(notes), facts=tuple(_left_out(subject)))


def _left_out(subject: Subject) -> Iterator[str]:
    """Yield a line for each batch and each kind that is left out."""
    for batch, kind in product(subject.batches, subject.options.without):
        names = [row.name for row in deliverable_records.latest(subject.store, batch) if row.kind == kind]
        if names:
            yield f"the {kind}s of batch {short(batch)} are left out: {', '.join(dict.fromkeys(names))}"


def _files(subject: Subject, deliverable: Checked) -> Iterator[Member]:
    for file in deliverable.files:
        yield Member(drawn(file), subject.project.root / file, f"{deliverable.kind} {deliverable.name!r}, as it was drawn")

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
from sierra.packages.subject import Member, PartResult, Subject
from sierra.store import deliverable_records
from sierra.util.hashing import short


def members(subject: Subject, packed: Mapping[str, Member]) -> PartResult:
    """Return the files of the recorded deliverables of all packed batches that follow from the packed records.

    `Options.without` leaves kinds out.
    """
    collected: list[Member] = []
    done: set[Checked] = set()
    notes: list[str] = []
    without = (REPORT, *subject.options.without)
    for batch in subject.batches:
        try:
            for checked in check(subject.project, subject.store, batch, without=without):
                if checked in done:  # it shows several batches
                    continue
                done.add(checked)
                reason = checked.problem or next(filter(None, map(unsafe, checked.files)), "")
                collected += () if reason else _files(subject, checked)
                notes += [f"{checked.kind} {checked.name!r} of batch {short(batch)} is not packed: {reason}"] if reason else []
        except Missing as error:
            notes.append(f"no figure of batch {short(batch)} is packed: {error}")
    return PartResult(collected, notes=tuple(notes), facts=tuple(_left_out(subject)))


def _left_out(subject: Subject) -> Iterator[str]:
    """Yield a line for each batch and each kind that is left out."""
    for batch, kind in product(subject.batches, subject.options.without):
        names = [row.name for row in deliverable_records.latest(subject.store, batch) if row.kind == kind]
        if names:
            yield f"the {kind}s of batch {short(batch)} are left out: {', '.join(dict.fromkeys(names))}"


def _files(subject: Subject, deliverable: Checked) -> Iterator[Member]:
    for file in deliverable.files:
        yield Member(drawn(file), subject.project.root / file, f"{deliverable.kind} {deliverable.name!r}, as it was drawn")

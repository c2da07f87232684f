"""The part `report.html` of a package: one page about the packed records, made when the package is written.

It is made as `sierra report` makes that of a received package: from the packed records alone, without executing anything.
"""

from __future__ import annotations

from collections.abc import Mapping

from sierra.deliverables.report import make, recorded
from sierra.deliverables.report.moving_pictures import Read
from sierra.deliverables.report.reproduce import Received
from sierra.errors import DamagedFile, SierraError
from sierra.packages.layout import REPORT, drawn
from sierra.packages.subject import Member, PartResult, Subject


def members(subject: Subject, packed: Mapping[str, Member]) -> PartResult:
    """Return the report of all packed batches. `Options.report` leaves it out."""
    if not subject.options.report:
        return PartResult(())
    package = subject.project.config.package
    received = Received(package.model_copy(update={"date": package.date or subject.date}))
    source = make.ReportSource(subject.project, subject.store, received=received, read=_from_members(packed))
    try:
        report = make.of_batches(source, subject.batches, every=package.title or f"{len(subject.batches)} batches")
    except DamagedFile:
        raise
    except SierraError as error:
        return PartResult((), notes=(f"no report is packed: {error}",))
    page = Member(REPORT, recorded.named(report), "report of all batches, for a browser")
    return PartResult([page], notes=() if report.complete else tuple(report.notes))


def _from_members(packed: Mapping[str, Member]) -> Read:
    """Return a function that reads deliverables that are packed."""

    def read(name: str, most: int) -> bytes | None:
        member = packed.get(drawn(name))
        if member is None or member.size > most:
            return None
        with member.open() as file:
            return file.read()

    return read

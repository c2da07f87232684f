"""The report of a received package, made from its records. Nothing of it is executed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from sierra.deliverables.report import files, make, recorded
from sierra.deliverables.report.files import Written
from sierra.deliverables.report.moving_pictures import Read, TooLarge
from sierra.deliverables.report.reproduce import Received as About
from sierra.packages.archive import Archive
from sierra.packages.layout import drawn
from sierra.packages.reading.received import Received, batches


def write(package: Received, to: Path | None, tell: Callable[[str], None]) -> Written:
    """Write the report of all batches of a package; by default beside it: `results-report.html` for `results.zip`.

    `tell` receives the progress. Raises UsageError for a file that exists and is no report, Missing, Damaged.
    """
    file = package.path.with_name(f"{package.path.stem}-report.html") if to is None else to
    files.check(file)
    about = _about(package)
    with package.project.plugins():
        report = make.of_batches(source(package), batches(package.store), tell, about.package.title or package.path.name)
    files.write(file, recorded.named(report))
    return Written(file, tuple(report.batches), tuple(report.notes))


def source(package: Received) -> make.ReportSource:
    """Return what a report of a package is made from."""
    return make.ReportSource(package.project, package.store, received=_about(package), read=_from_archive(package))


def _about(package: Received) -> About:
    described, config = package.manifest, package.project.config.package
    stated = config.model_copy(update={"date": config.date or described.date, "title": config.title or described.title})
    return About(stated, package.path.name, package.id, (*described.notes, *package.notes))


def _from_archive(package: Received) -> Read:
    """Return a function that reads deliverables in the package, each of which is checked when it is read."""

    def read(name: str, most: int) -> bytes | None:
        member = drawn(name)
        with Archive(package.path) as archive:
            if member not in archive.hashes:
                return None
            if archive.size(member) > most:
                raise TooLarge(name)
            return archive.read(member)

    return read

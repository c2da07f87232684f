"""Reports as recorded deliverables, so that the store knows which page shows which of its data.

The data of a report are the page without its pictures: the numbers of all figures are in the page, too, as data for charts and
as tables, and other versions of matplotlib draw other pictures of the same numbers.
"""

from __future__ import annotations

import json
from pathlib import Path

from sierra.deliverables.record import Deliverable, Recorder, origin_of, parsing
from sierra.deliverables.report import make
from sierra.deliverables.report.make import Report, ReportSource
from sierra.deliverables.report.page import ORIGIN
from sierra.deliverables.report.results import REPORT
from sierra.errors import Missing, SierraError
from sierra.store.row_types import DeliverableRow
from sierra.store.store import Store
from sierra.util.hashing import digest, sha256
from sierra.util.lazy_definitions import regex
from sierra.util.version import __version__

PICTURE = regex(rb'src="data:image/svg\+xml;base64,[A-Za-z0-9+/=]*"')
UNNAMED = f'<meta name="{ORIGIN}" content="">'.encode()
SIERRA = f"sierra-experiments=={__version__}"
AGAIN = "write it again with: sierra report"


def data(report: Report) -> str:
    """Return the hash of all that a report shows."""
    return digest("report data", {"page": sha256(PICTURE.sub(b"", report.page))})


def named(report: Report) -> bytes:
    """Return the page of a report with the line that names its batches and the hash of its data."""
    if not report.complete:
        return report.page
    first, *others = report.batches
    line = origin_of(first, data(report), *others)
    return report.page.replace(UNNAMED, f'<meta name="{ORIGIN}" content="{line}">'.encode(), 1)


def content(name: str, report: Report) -> Deliverable:
    """Return everything that the file of a report depends on. `name` is that of its file, without ending."""
    made_by = (SIERRA, *report.libraries)
    return Deliverable(
        REPORT, name, tuple(report.batches), {"title": report.title}, "\n\n".join(report.sql), data(report), made_by
    )


def record(store: Store, root: Path, file: Path, report: Report) -> list[str]:
    """Record a report that was written to a file of the project; return a note if that is not possible.

    A file outside of the project is not recorded, because records name files within it; nor is a list of too many batches,
    which no batch owns.
    """
    path, within = file.resolve(), root.resolve()
    if not report.complete or not path.is_relative_to(within):
        return []
    recorder = Recorder(store, root, report.batches[0])
    recorder.add(content(path.stem, report), (root / path.relative_to(within),))
    try:
        recorder.close()
    except Missing as error:
        return [f"the report is written, but not recorded: {error}"]
    return []


def again(source: ReportSource, row: DeliverableRow) -> Deliverable:
    """Return the content of a recorded report, made from the store as it is now. Raises SierraError for another version's."""
    if SIERRA not in row.made_by:
        raise SierraError(f"{' '.join(row.made_by[:1])} wrote it, and pages of SIERRA {__version__} differ; {AGAIN}")
    with parsing(row.name):
        title = str(json.loads(row.definition)["title"])
    return content(row.name, make.of_batches(source, row.batches, every=title))

"""The sections about results: figures as they are printed and as charts to explore, tables for papers, other files."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from sierra.deliverables import comparison, declared_tables, default_figures, paper_tables
from sierra.deliverables.declared_tables import ComputedTable
from sierra.deliverables.figures.base import made_by
from sierra.deliverables.figures.drawing import Drawing, explorable
from sierra.deliverables.gallery import Gallery
from sierra.deliverables.html.charts import Chart, chart_element
from sierra.deliverables.html.sections import SectionContent, data_element
from sierra.deliverables.html.tables import table_element
from sierra.deliverables.record import origin_of
from sierra.deliverables.report.batch_state import BatchState
from sierra.deliverables.report.moving_pictures import Films
from sierra.deliverables.report.parts import Place, Section, auto, details, note, picture, sql, table
from sierra.errors import DamagedFile, Missing, NotInstalled, SierraError
from sierra.store import deliverable_records
from sierra.store.batch_data import AllFailed, BatchData
from sierra.store.row_types import DeliverableRow
from sierra.util.hashing import short
from sierra.util.html_elements import Markup, element, joined
from sierra.util.lazy_definitions import dataclass, regex
from sierra.util.text import digits_apart, few, short_number

WIDTH = regex(rb'<svg\b[^>]*? width="([0-9.]+)pt"')
WIDE = 400.0
"""The width in points above which a figure takes a whole row: those for two columns of a paper."""
SERIES = 8
"""The largest number of series that the text of a picture describes."""
REPORT = "report"
"""The kind of the records of reports, among deliverables."""
LAST_RESULT = """
SELECT coalesce(max(lamport), 0) FROM (
    SELECT lamport FROM effective WHERE batch = $b
    UNION ALL SELECT t.lamport FROM trials t JOIN executions e USING (execution)
    WHERE t.valid IS NOT NULL AND e.run IN (SELECT run FROM batch_runs WHERE batch = $b)
)
"""
"""The logical time of the last change of the results of a batch: an execution that counts, or a trial that was judged."""
DRAWN = ("figure", comparison.KIND, declared_tables.KIND, REPORT)
"""Kinds of deliverables that the report does not list: it shows them, or is one."""


@dataclass(frozen=True, slots=True)
class Figures:
    """The figures of a batch, as contents of sections, and notes on those that could not be drawn."""

    contents: Sequence[SectionContent]
    notes: Sequence[str]
    libraries: Sequence[str]
    """The libraries that draw them, as name==version."""


def figures(state: BatchState, tell: Callable[[str], None]) -> Figures:
    """Return the figures that `sierra figures` draws. `tell` receives the number and the name of each before it is drawn.

    Raises Missing if something necessary is missing; other errors become notes.
    """
    contents, failed = [], []
    libraries: set[str] = set()
    with BatchData(state.store, state.id) as frame:
        gallery = Gallery(state.project, state.store, frame)
        wanted, notes = default_figures.wanted(gallery, None)
        for number, (name, figure) in enumerate(wanted.items(), 1):
            tell(f"figure {number} of {len(wanted)}: {name}")
            try:
                contents.append(_content(*explorable(gallery.drawing(name, figure))))
                libraries.update(made_by(figure.kind))
            except SierraError as error:
                if isinstance(error, DamagedFile | Missing) and not isinstance(error, NotInstalled):
                    raise
                failed.append(f"figure {name} could not be drawn: {error}")
        more = (*gallery.declared_notes, *gallery.time_notes.values(), *gallery.models.notes([*wanted]))
    return Figures(contents, (*failed, *notes, *more), sorted(libraries))


def _content(drawing: Drawing, svg: bytes) -> SectionContent:
    from sierra.deliverables.figures import interactive

    return interactive.content(drawing, svg, origin_of(drawing.batch, drawing.data))


def figure_section(drawn: Figures, headings: Place) -> Section:
    """Return the section with all figures."""
    shown = [_figure(content, headings, number) for number, content in enumerate(drawn.contents, 1)]
    lines = [element("div", *shown, class_="figures") if shown else note("There is no figure.")]
    return Section("figures", "Figures", joined((*lines, *map(note, drawn.notes))))


def _figure(content: SectionContent, headings: Place, number: int) -> Markup:
    name = f"{headings.prefix}figure-{number}"
    tables = [table_element(data, k) for k, data in enumerate(content.tables)]
    charts = [chart_element(chart, k, headings.innermost) for k, chart in enumerate(content.charts)]
    return element(
        "section",
        auto(content.title, headings.inner, id=name),
        picture(content.picture, described(content), ". ".join(content.notes)),
        _explorer(charts) if charts else None,
        *tables,
        sql(content.sql) if content.sql else None,
        data_element(content),
        class_="figure wide" if _width(content.picture) > WIDE else "figure",
        aria_labelledby=headings.labels(name),
    )


def _width(svg: bytes) -> float:
    """Return the width of an SVG file of matplotlib, in points; 0 if it does not name it."""
    match = WIDTH.search(svg[:5000])
    return float(match[1]) if match else 0.0


def _explorer(charts: Sequence[Markup]) -> Markup:
    lost = element("noscript", element("p", "The charts need JavaScript. The figure and the data show the same numbers."))
    return details("Explore: values, intervals and n at each point", lost, element("div", joined(charts), class_="charts"))


def described(content: SectionContent) -> str:
    """Return a text for those who do not see a figure: what it shows, and the numbers at its end or its ends."""
    if not content.charts:
        return f"{content.title}. {' '.join(content.notes)} The numbers are in the data below the figure."
    shown = " ".join(sentence for chart in content.charts for sentence in _sentences(chart))
    return f"{content.title}. {shown}"


def _sentences(chart: Chart) -> Iterator[str]:
    yield f"{f'{chart.title}: ' if chart.title else ''}{chart.y.label} over {chart.x.label}."
    for series in chart.series[:SERIES]:
        rows = [series.stop - 1] if chart.form == "lines" else [series.start, series.stop - 1]
        values = [text for row in dict.fromkeys(rows) if (text := _value(chart, row))]
        yield f"{f'{series.name}: ' if series.name else ''}{', '.join(values)}." if values else f"{series.name}: no value."
    if len(chart.series) > SERIES:
        yield f"And {len(chart.series) - SERIES} more series."


def _value(chart: Chart, row: int) -> str:
    columns = chart.table.columns
    value = columns[chart.y.column][row]
    if not isinstance(value, int | float):
        return ""
    at = f" at {_short(columns[chart.x.column][row], [])}" if chart.x.column >= 0 else ""
    ends = [columns[k][row] for k in (chart.low, chart.high) if k >= 0]
    known = [end for end in ends if isinstance(end, int | float)]
    every = [value, *known]
    interval = f" (interval {_short(known[0], every)} to {_short(known[1], every)})" if len(known) == 2 else ""
    return f"{_short(value, every)}{interval}{at}"


def _short(value: object, beside: Sequence[object]) -> str:
    """Return a value in short, with as many digits as tell it from those beside it."""
    return short_number(value, digits_apart(beside, 4)) if isinstance(value, float) else str(value)


def table_section(state: BatchState, headings: Place) -> tuple[Section | None, list[str]]:
    """Return the section with the declared tables for papers, None if there are none, and notes on those that failed."""
    lines: list[Markup] = []
    failed = []
    for name, declared in state.project.config.paper_tables.items():
        try:
            computed = declared_tables.make(state.project, state.store, name, declared, {state.short: state.id})
        except (DamagedFile, Missing):
            raise
        except SierraError as error:
            failed += [] if isinstance(error, AllFailed) else [f"table {name} could not be made: {error}"]
            continue
        lines += _table(computed, headings)
    lines += map(note, failed)
    return (Section("tables", "Tables", joined(lines)) if lines else None), failed


def _table(computed: ComputedTable, headings: Place) -> Iterator[Markup]:
    yield auto(computed.table.caption or computed.name, headings.inner)
    yield paper_table(computed.table)
    yield sql(computed.sql)


def paper_table(shown: paper_tables.PaperTable) -> Markup:
    """Return a table for papers, with the line below it."""
    rows = [[paper_tables.as_text(cell) for cell in row] for row in shown.rows]
    numbers = tuple(column for column in range(len(shown.headers)) if column not in shown.texts)
    return joined((table(shown.headers, rows, numbers=numbers), note(shown.note) if shown.note else None))


def other_section(state: BatchState, films: Films) -> Section | None:
    """Return the section with deliverables in files of their own, such as videos; None if there are none."""
    records = [row for row in deliverable_records.latest(state.store, state.id) if row.kind not in DRAWN]
    if not records:
        return None
    rows = [(row.name, row.kind, joined(auto(file, "div") for file in row.files), _hashes(row.sha256s)) for row in records]
    shown = [player for row in records for player in films.players(row)]
    text = "Their SHA-256 tells whether a file is the recorded one."
    if not shown:
        text = f"These files are not in this page. {text}"
    listed = table(("name", "kind", "files", "SHA-256"), rows, "Videos and other files")
    inner = (element("div", *shown, class_="figures") if shown else None, *_older(state, records), element("p", text), listed)
    return Section("videos", "Videos and other files", joined(inner))


def _older(state: BatchState, records: Sequence[DeliverableRow]) -> Iterator[Markup]:
    """Yield a note on deliverables whose records are older than a result of the batch. They are not made again for a page."""
    last = next(iter(state.store.values(int, LAST_RESULT, b=state.id)), 0)
    if older := list(dict.fromkeys(row.name for row in records if row.lamport < last)):
        text = f"The records of these files are older than the last results of this batch: {few(older, SERIES)}."
        yield note(f"{text} sierra figures --check tells whether they still show the results.")


def _hashes(digests: Sequence[str]) -> Markup:
    return joined(element("div", element("code", short(digest))) for digest in digests)

"""Sections of a page: a title, charts or a picture, notes, tables, and where the numbers come from."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping

from sierra.deliverables.html import charts, tables
from sierra.deliverables.html.charts import Chart, chart_element
from sierra.deliverables.html.escaping import Data, data
from sierra.deliverables.html.tables import Table, table_element
from sierra.util.html_elements import Markup, element, joined
from sierra.util.lazy_definitions import dataclass, field


@dataclass(frozen=True, slots=True)
class SectionContent:
    """The content of a section. Every table of a chart must be among the tables."""

    title: str
    charts: tuple[Chart, ...] = ()
    picture: bytes = b""
    """An SVG file, which is embedded as it is."""
    notes: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    sql: str = ""
    origin: Mapping[str, str] = field(default_factory=dict)
    """Facts about where the numbers come from, by name."""


def section(content: SectionContent) -> Markup:
    """Return a section as an element of HTML."""
    return element("section", joined(_lines(content), "\n"))


def _lines(content: SectionContent) -> Iterator[Markup]:
    yield element("h2", content.title, dir="auto")
    if content.picture:
        image = element("img", alt=". ".join((content.title, *content.notes)), src=svg_address(content.picture))
        yield element("p", image, class_="picture")
    if content.charts:
        yield element("noscript", element("p", "The charts need JavaScript. Their numbers are below."))
        shown = (chart_element(chart, index) for index, chart in enumerate(content.charts))
        yield element("div", joined(("", *shown, ""), "\n"), class_="charts")
    yield from (element("p", note, class_="note", dir="auto") for note in content.notes)
    yield from (table_element(table, index) for index, table in enumerate(content.tables))
    if content.sql or content.origin:
        yield _origin(content)
    yield data_element(content)


def svg_address(svg: bytes) -> str:
    """Return an SVG file as the address of an image, because the policy of the page forbids the styles in an SVG element."""
    return f"data:image/svg+xml;base64,{base64.b64encode(svg).decode()}"


def _origin(content: SectionContent) -> Markup:
    facts = (joined((element("dt", name), element("dd", fact))) for name, fact in content.origin.items())
    summary = element("summary", "Where these numbers come from")
    known = joined((summary, element("dl", joined(("", *facts, ""), "\n"))))
    sql = element("pre", content.sql, class_="scroll", tabindex=0, role="group", aria_label="SQL") if content.sql else None
    return element("details", joined((known, sql, ""), "\n"))


def data_element(content: SectionContent) -> Markup:
    """Return the tables and charts as an element with data for scripts."""
    payload: Data = {
        "tables": [tables.as_data(table) for table in content.tables],
        "charts": [charts.as_data(chart, content.tables) for chart in content.charts],
    }
    return element("script", Markup(data(payload)), type="application/json")

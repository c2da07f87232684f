"""Sections of a page: a title, charts or a picture, notes, tables, and where the numbers come from."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from sierra.deliverables.html import charts as chart_elements
from sierra.deliverables.html import tables as table_elements
from sierra.deliverables.html.charts import Chart
from sierra.deliverables.html.escaping import Data, data, text
from sierra.deliverables.html.tables import Table


@dataclass(frozen=True, slots=True)
class Content:
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


def section(content: Content) -> str:
    """Return a section as an element of HTML."""
    return "\n".join(_lines(content))


def _lines(content: Content) -> Iterator[str]:
    yield f'<section><h2 dir="auto">{text(content.title)}</h2>'
    if content.picture:
        yield _picture(content.picture, ". ".join((content.title, *content.notes)))
    if content.charts:
        yield "<noscript><p>The charts need JavaScript. Their numbers are below.</p></noscript>"
        yield '<div class="charts">'
        yield from (chart_elements.element(chart, place) for place, chart in enumerate(content.charts))
        yield "</div>"
    yield from (f'<p class="note" dir="auto">{text(note)}</p>' for note in content.notes)
    yield from (table_elements.element(table, place) for place, table in enumerate(content.tables))
    if content.sql or content.origin:
        yield from _origin(content)
    yield f'<script type="application/json">{data(as_data(content))}</script></section>'


def _picture(svg: bytes, description: str) -> str:
    return f'<p class="picture"><img alt="{text(description)}" src="{svg_address(svg)}"></p>'


def svg_address(svg: bytes) -> str:
    """Return an SVG file as the address of an image, because the policy of the page forbids the styles in an SVG element."""
    return f"data:image/svg+xml;base64,{base64.b64encode(svg).decode()}"


def _origin(content: Content) -> Iterator[str]:
    yield "<details><summary>Where these numbers come from</summary><dl>"
    for name, fact in content.origin.items():
        yield f"<dt>{text(name)}</dt><dd>{text(fact)}</dd>"
    yield "</dl>"
    if content.sql:
        yield f'<pre class="scroll" tabindex="0" role="group" aria-label="SQL">{text(content.sql)}</pre>'
    yield "</details>"


def as_data(content: Content) -> Data:
    """Return the tables and charts as data for scripts."""
    return {
        "tables": [table_elements.as_data(table) for table in content.tables],
        "charts": [chart_elements.as_data(chart, content.tables) for chart in content.charts],
    }

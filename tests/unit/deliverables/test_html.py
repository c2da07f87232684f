"""Figures as pages of HTML and as drawing commands for LaTeX: what a file holds, and what it cannot hold."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from hashlib import sha256
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from sierra.deliverables import html
from sierra.deliverables.figures import tex
from sierra.deliverables.figures.drawing import Drawing, rendered
from sierra.deliverables.figures.formats import FORMATS
from sierra.deliverables.figures.interactive import CONTRAST, POINTS, on_dark
from sierra.deliverables.html import SectionContent, Table, escaping
from sierra.deliverables.html.page import ASSETS
from sierra.deliverables.record import origin_of
from sierra.errors import UsageError
from sierra.model import Axis
from tests.unit.deliverables.test_figures import BATCH, NAMES, SIZES, SQL, drawing, svg, table

TITLE = "</title></script><script>alert(1)</script><b>\"'&amp; `x`"
HOSTILE = Axis("scenario", ("<script>alert(1)</script>", "a\"b'c &lt; ]]>", "שלום"), label='<b onclick="x">')
ROOT = Path(__file__).parents[3]


class _Parsed(HTMLParser):
    """The elements of a page with their attributes and texts."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[tuple[str, str]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        if self.elements:
            self.texts.append((self.elements[-1][0], data))

    def all(self, tag: str) -> Iterator[dict[str, str | None]]:
        return (attributes for name, attributes in self.elements if name == tag)

    def metadata(self) -> dict[str | None, str | None]:
        return {one.get("name") or one.get("http-equiv"): one.get("content") for one in self.all("meta")}

    def data(self) -> Any:
        return json.loads(next(text for tag, text in self.texts if tag == "script"))


def page(shown: Drawing) -> _Parsed:
    return _Parsed(source(shown))


def source(shown: Drawing) -> str:
    ((_, data),) = rendered(replace(shown, formats=("html",)))
    return data.decode()


def pgf(shown: Drawing) -> str:
    ((_, data),) = rendered(replace(shown, formats=("pgf",)))
    return data.decode()


def test_a_page_refers_to_nothing_and_allows_only_its_own_script_and_style() -> None:
    text = source(drawing())
    found = _Parsed(text)
    assert [tag for tag, attributes in found.elements if {"src", "href", "style"} & attributes.keys()] == []
    assert not any(name.startswith("on") for _, attributes in found.elements for name in attributes)
    policy = str(found.metadata()["Content-Security-Policy"])
    for tag in ("script", "style"):
        (content,) = re.findall(rf"<{tag}>(.*?)</{tag}>", text, re.DOTALL)
        assert f"{tag}-src 'sha256-{base64.b64encode(sha256(content.encode()).digest()).decode()}'" in policy
    rest = re.sub(r"'sha256-[^']+'", "#", policy)
    assert rest == "default-src 'none'; script-src #; style-src #; img-src data:; base-uri 'none'; form-action 'none'"


def test_a_page_has_the_same_bytes_for_the_same_data_and_names_its_origin() -> None:
    text = source(drawing())
    assert source(drawing()) == text
    found = _Parsed(text).metadata()
    assert found["sierra"] == origin_of(BATCH, drawing().data)
    assert found["sierra:sql"] == SQL
    together = page(replace(drawing(), together={"sim": "a" * 64, "robots": "b" * 64}))
    assert ("dd", f"{'a' * 64} (sim), {'b' * 64} (robots)") in together.texts


def test_a_chart_has_the_rows_of_the_figure() -> None:
    found = page(drawing("timeseries", (SIZES, NAMES))).data()
    (data,), charts = found["tables"], found["charts"]
    assert data["headers"][:4] == ["population_size [robots]", "scenario", "time [s]", "missing"]
    assert [len(chart["series"]) for chart in charts] == [4, 4]
    columns = dict(zip(data["headers"], data["columns"], strict=True))
    for chart, scenario in zip(charts, NAMES.values, strict=True):
        for series, size in zip(chart["series"], SIZES.values, strict=True):
            rows = slice(*series["rows"])
            assert set(columns["scenario"][rows]) == {scenario}
            assert set(columns["population_size [robots]"][rows]) == {size}
            assert columns["time [s]"][rows] == list(range(20))
            assert series["name"] == str(size)
    assert (charts[0]["y"]["label"], charts[0]["x"]["label"]) == ("energy [J]", "time [s]")
    low, high = charts[0]["y"]["limits"]
    assert charts[1]["y"]["limits"] == [low, high]
    assert low < min(columns["mean_low"]) < max(columns["mean_high"]) < high


def test_a_chart_over_a_variable_has_its_groups_and_panels() -> None:
    found = page(drawing("summary", (SIZES, NAMES))).data()["charts"]
    assert [(one["name"], one["rows"]) for one in found[0]["series"]] == [("low", [0, 4]), ("high", [4, 8])]
    assert (found[0]["x"]["log"], found[0]["x"]["ticks"]) == (2, [1, 2, 4, 8])
    panels = page(drawing("summary", (SIZES, NAMES), facet="scenario")).data()["charts"]
    assert [[one["rows"] for one in panel["series"]] for panel in panels] == [[[0, 4]], [[4, 8]]]
    mixed = page(drawing("summary", (Axis("speed", (1, "fast")),))).data()
    assert mixed["charts"][0]["x"]["names"] == mixed["tables"][0]["columns"][0] == [1, "fast"]
    names = page(drawing("summary", (NAMES,))).data()["charts"][0]
    assert (names["x"]["names"], names["joined"]) == (["low", "high"], False)


def test_a_long_series_is_thinned_without_losing_a_peak_and_the_page_says_so() -> None:
    rows = 2 * POINTS + 7
    peak = [0.0] * 7777 + [1e6] + [0.0] * (2 * rows - 7778)
    found = page(drawing("timeseries", (NAMES,), {"energy": table(2, rows, mean_high=peak)}))
    (data,), (chart,) = found.data()["tables"], found.data()["charts"]
    times = data["columns"][data["headers"].index("time [s]")]
    for series in chart["series"]:
        start, stop = series["rows"]
        assert POINTS // 5 < stop - start <= POINTS
        assert (times[start], times[stop - 1]) == (0, rows - 1)
    assert max(data["columns"][chart["columns"]["high"]]) == 1e6
    left_out = 2 * rows - len(times)
    assert any(f"{left_out:,} of {2 * rows:,} rows are left out" in text for _, text in found.texts)
    exact = page(drawing("timeseries", (NAMES,), {"energy": table(2, POINTS)})).data()
    assert len(exact["tables"][0]["columns"][0]) == 2 * POINTS


@pytest.mark.integration
def test_other_kinds_show_the_figure_as_it_is_printed_with_its_data() -> None:
    found = page(drawing("box"))
    (picture,) = found.all("img")
    assert base64.b64decode(str(picture["src"]).partition(",")[2]) == svg(drawing("box"))
    assert picture["alt"] == f"box. {drawing('box').note}"
    values, runs = found.data()["tables"]
    assert (values["headers"][0], runs["headers"]) == ("population_size [robots]", ["population_size [robots]", "run", "value"])
    assert found.data()["charts"] == []


def test_hostile_text_stays_text() -> None:
    found = page(drawing("timeseries", (HOSTILE,), title=TITLE, xlabel=TITLE, ylabel=TITLE, footnote=TITLE))
    assert [attributes.get("type") for attributes in found.all("script")] == ["application/json", None]
    assert not list(found.all("b"))
    assert ("title", TITLE) in found.texts
    (chart,) = found.data()["charts"]
    assert [one["name"] for one in chart["series"]] == list(HOSTILE.values)
    assert chart["y"]["label"] == TITLE


@pytest.mark.parametrize("text", ["</script>", "<!--", "a&b", "\u2028", "\ud800", "\u202e", '"\n\\'])
def test_data_within_a_script_can_hold_any_text(text: str) -> None:
    written = escaping.data({"a": text})
    assert json.loads(written) == {"a": text}
    assert not set("<>&") & set(written)
    written.encode()


def test_a_table_keeps_every_digit_and_says_what_it_lacks() -> None:
    large = Table("values", ("a", "b"), ([2**60, 0.1 + 0.2] * 200, [float("inf"), None] * 200), "the first 400 of 900 rows")
    text = html.section(SectionContent("title", tables=(large,)))
    found = _Parsed(text)
    assert found.data()["tables"][0]["columns"] == [[str(2**60), 0.1 + 0.2] * 200, ["inf", None] * 200]
    assert len(list(found.all("tr"))) == 1 + 200
    assert "the first 400 of 900 rows; the first 200 of 400 rows are shown, the CSV has all" in text


@pytest.mark.parametrize("colour", ["#000000", "#0072b2", "#440154", "#333333", "#ffffff"])
def test_colours_can_be_seen_on_the_dark_background(colour: str) -> None:
    def luminance(text: str) -> float:
        parts = [int(text[place : place + 2], 16) / 255 for place in (1, 3, 5)]
        linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    style = (ASSETS / "page.css").read_text()
    (paper,) = re.findall(r"prefers-color-scheme: dark.*?--paper: (#\w+)", style, re.DOTALL)
    assert (luminance(on_dark(colour)) + 0.05) / (luminance(paper) + 0.05) >= CONTRAST


def test_the_copy_of_uplot_is_the_one_that_the_notice_names() -> None:
    notice = (ROOT / "THIRD-PARTY.md").read_text()
    hashes = dict(re.findall(r"^([0-9a-f]{64})  (\S+)$", notice, re.MULTILINE))
    folder = ASSETS / "uplot"
    assert {sha256(file.read_bytes()).hexdigest(): file.name for file in folder.iterdir()} == hashes
    script = source(drawing("summary"))
    assert "The MIT License (MIT)" in script
    assert "https://github.com/leeoniya/uPlot (v1.6.32)" in script
    assert "| 1.6.32 |" in notice


def test_pgf_needs_no_tex_and_escapes_text_for_latex() -> None:
    text = pgf(drawing("summary", title="100 % of $x_1$ & \\more", ylabel="E [µJ]"))
    assert r"100 \% of \$x\_1\$ \& \textbackslash{}more" in text
    assert r"E {[}$\mu$J]" in text
    assert f"% {origin_of(BATCH, drawing('summary').data)}\n" in text
    assert f"% {SQL.splitlines()[1]}\n" in text
    assert pgf(drawing("summary")) == pgf(drawing("summary"))


def test_a_figure_that_tex_cannot_hold_is_refused_as_pgf(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tex, "MOST", 1000)
    with pytest.raises(UsageError, match=r"needs more than 0.001 MB of commands, too many for TeX; use pdf"):
        pgf(drawing("summary"))


def test_each_format_has_a_function() -> None:
    from typing import get_args

    from sierra.config.deliverable_tables import Format

    assert set(FORMATS) == set(get_args(Format))

"""`index.html`: deliverables of the reproduced runs beside those of the package, in one file."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from sierra.config.project_file import Project
from sierra.deliverables.claims.model import Evaluated
from sierra.deliverables.html.page import page as html_page
from sierra.deliverables.report.claims import KINDS
from sierra.deliverables.report.parts import auto, badge, note, table
from sierra.deliverables.report.results import paper_table
from sierra.packages.reproduction.drawn_again import DrawnAgain, Rendering
from sierra.packages.reproduction.outcome import Reproduction
from sierra.util.hashing import short
from sierra.util.html_elements import Markup, element, joined

TITLES = {
    "claims": "Claims",
    "numbers": "Numbers in the text",
    "figures": "Figures",
    "tables": "Tables",
    "comparisons": "Comparisons",
    "batches": "Batches",
}
STYLE = "report"
"""The style of reports, in the assets of pages."""


class Numbers(NamedTuple):
    """The numbers of a paper's text, by name: from the recorded and from the reproduced runs; and why there are none."""

    texts: Mapping[str, tuple[str, str]]
    problem: str


def page(
    done: Reproduction, drawn: Sequence[DrawnAgain], shown: Numbers, recorded: Sequence[Evaluated], config: Project
) -> bytes:
    """Return the page. `recorded` are the claims as the recorded runs decide them."""
    title = f"Reproduction of {done.title or 'a package'}"
    contents: dict[str, Sequence[Markup]] = {
        "claims": list(_claims(done, recorded)),
        "numbers": list(_numbers(shown)),
        **{
            f"{kind}s": [_beside(deliverable, config) for deliverable in drawn if deliverable.kind == kind]
            for kind in ("figure", "table", "comparison")
        },
        "batches": list(_batches(done)),
    }
    parts = [(name, _section(name, TITLES[name], content)) for name, content in contents.items() if content]
    links = [element("li", element("a", TITLES[name], href=f"#{name}")) for name, _ in parts]
    good = done.exit_code == 0
    body = (
        element(
            "header",
            element("p", "Reproduction", class_="kicker"),
            auto(title, "h1"),
            element("p", f"Package {short(done.package)}", class_="note"),
            element("p", element("strong", done.verdict), class_=f"banner {'complete' if good else 'partial'}", role="status"),
            element("p", _summary(drawn), class_="note"),
        ),
        element("nav", element("p", "Contents", class_="kicker"), element("ul", joined(links)), aria_label="Contents"),
        element("main", *(part for _, part in parts), id="content", tabindex=-1),
    )
    return html_page(title, body, {"description": title}, extra=STYLE)


def _summary(drawn: Sequence[DrawnAgain]) -> str:
    if not drawn:
        return "The package has no figure, table or comparison of batches of which all runs were executed again."
    same = sum(deliverable.same for deliverable in drawn)
    lacking = sum(bool(deliverable.problem) for deliverable in drawn)
    more = f", {lacking} could not be made" if lacking else ""
    return f"{same} of {len(drawn)} figures, tables and comparisons show the same values{more}."


def _section(name: str, title: str, content: Sequence[Markup]) -> Markup:
    heading = element("h2", title, id=f"{name}-title")
    return element("section", heading, *content, id=name, aria_labelledby=f"{name}-title", class_="part")


def _claims(done: Reproduction, recorded: Sequence[Evaluated]) -> Iterator[Markup]:
    before = {claim.name: claim for claim in recorded}
    rows = []
    for now in done.claims:
        was = before.get(now.name, now)
        rows.append((auto(now.says or now.name), *(_verdict(side) for side in (was, now)), auto(was.text), auto(now.text)))
    if rows:
        yield table(("claim", "recorded runs", "reproduced runs", "recorded numbers", "reproduced numbers"), rows, "Claims")


def _verdict(one: Evaluated) -> Markup:
    return joined((badge(one.verdict.value, KINDS[one.verdict]), element("div", one.ground.value, class_="note")))


def _numbers(shown: Numbers) -> Iterator[Markup]:
    rows = [(auto(name), auto(before), auto(now), _apart(before, now)) for name, (before, now) in shown.texts.items()]
    if rows:
        yield table(("number", "recorded runs", "reproduced runs", "difference"), rows, "Numbers in the text")
    if shown.problem:
        yield note(f"The numbers in the text could not be computed: {shown.problem}")


def _apart(before: str, now: str) -> str:
    if before == now:
        return "none"
    try:
        return f"{float(now) - float(before):.3g}"
    except ValueError:
        return "other text"


def _beside(drawn: DrawnAgain, config: Project) -> Markup:
    """Return a deliverable from both sides, and how they differ."""
    if drawn.problem:
        said = badge("not made", "unclear")
    else:
        said = badge("same values", "good") if drawn.same else badge("other values", "unclear")
    sides = (("from the recorded runs", drawn.recorded), ("from the reproduced runs", drawn.reproduced))
    return element(
        "article",
        element("h3", auto(drawn.name), " ", said),
        note(", ".join(f"batch {short(batch)}" for batch in drawn.batches)),
        element("p", f"It could not be made: {drawn.problem}") if drawn.problem else None,
        element("p", f"Greatest difference: {drawn.difference}. {_tolerance(drawn, config)}") if drawn.difference else None,
        element("div", *(_side(f"{drawn.kind} {drawn.name}", words, side) for words, side in sides), class_="figures"),
        class_="beside",
    )


def _tolerance(one: DrawnAgain, config: Project) -> str:
    output = config.outputs.get(one.table)
    if output is None or not output.tolerance:
        return "No tolerance is declared."
    said = (f"{column}: {tolerance.model_dump(exclude_defaults=True)}" for column, tolerance in output.tolerance.items())
    return f"Declared tolerance: {'; '.join(said)}."


def _side(title: str, words: str, rendering: Rendering | None) -> Markup:
    if rendering is None:
        return element("div", element("p", f"{words}: nothing"))
    shown: list[Markup | None] = []
    if rendering.picture:
        content = base64.b64encode(rendering.picture.content).decode()
        image = element("img", src=f"data:{rendering.picture.media_type};base64,{content}", alt=f"{title}, {words}")
        words = f"{rendering.picture.packed} in the package" if rendering.picture.packed else words
        shown.append(element("figure", image, element("figcaption", words)))
    else:
        shown.append(element("p", words, class_="note"))
    if rendering.text:
        shown.append(element("p", rendering.text, dir="auto"))
    if rendering.table:
        shown.append(paper_table(rendering.table))
    return element("div", *shown, class_="figure")


def _batches(done: Reproduction) -> Iterator[Markup]:
    rows = [(short(one.planned.batch), auto(one.planned.query), auto(one.verdict)) for one in done.batches]
    if rows:
        yield table(("batch", "query", "verdict"), rows, "Batches")
    yield from map(note, (*done.left_out, *done.notes))

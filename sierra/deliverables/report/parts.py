"""Parts of which the sections of a report consist: tables, lists of facts, commands, SQL, notes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from sierra.deliverables.html.sections import svg_address
from sierra.util.html_elements import Markup, Node, element, joined
from sierra.util.lazy_definitions import dataclass, regex

CODE = regex(r"\$b\b")


@dataclass(frozen=True, slots=True)
class Section:
    """A section of a report."""

    name: str
    """The end of its id: lower-case letters and hyphens."""
    title: str
    body: Markup


@dataclass(frozen=True, slots=True)
class Place:
    """A place in the page: the beginning of ids there, and the level of headings."""

    prefix: str = ""
    level: int = 2

    @property
    def heading(self) -> str:
        """The element of the headings of sections."""
        return f"h{self.level}"

    def labels(self, heading: str) -> str:
        """Return the ids of the texts that name a section: its heading, after the batch's name if there are several."""
        return f"{self.prefix}batch {heading}" if self.prefix else heading

    @property
    def inner(self) -> str:
        """The element of the headings within sections."""
        return f"h{self.level + 1}"

    @property
    def innermost(self) -> str:
        return f"h{self.level + 2}"


def section(part: Section, headings: Place) -> Markup:
    """Return a section as an element, which readers and links find by its heading."""
    name = f"{headings.prefix}{part.name}"
    heading = element(headings.heading, part.title, id=f"{name}-title")
    return element("section", heading, part.body, id=name, aria_labelledby=headings.labels(f"{name}-title"), class_="part")


def auto(text: str, tag: str = "span", **attributes: str) -> Markup:
    """Return a text of others, whose direction is its own."""
    return element(tag, text, dir="auto", **attributes)


def table(
    headers: Sequence[str], rows: Iterable[Sequence[Node | int]], caption: str = "", numbers: Sequence[int] = ()
) -> Markup:
    """Return a table that scrolls if it is too wide. `numbers` are the places of the columns that are right-aligned."""
    kinds = ["number" if column in numbers else None for column in range(len(headers))]
    head = joined(
        element("th", header, scope="col", dir="auto", class_=kind) for header, kind in zip(headers, kinds, strict=True)
    )
    body = joined(element("tr", joined(_cell(k, cell, k in numbers) for k, cell in enumerate(row))) for row in rows)
    above = element("caption", caption) if caption else None
    inner = element("table", above, element("thead", element("tr", head)), element("tbody", body))
    return element("div", inner, class_="scroll", tabindex=0, role="group", aria_label=caption or ", ".join(headers))


def filled_table(
    headers: Sequence[str], rows: Sequence[Sequence[Node | int]], caption: str = "", numbers: Sequence[int] = ()
) -> Markup:
    """Return a table like `table`, without the columns that are empty in all rows."""
    kept = [column for column in range(len(headers)) if any(row[column] not in (None, "") for row in rows)]
    inner = [["" if row[column] is None else row[column] for column in kept] for row in rows]
    return table(
        [headers[column] for column in kept], inner, caption, [kept.index(column) for column in numbers if column in kept]
    )


def _cell(column: int, cell: Node | int, number: bool) -> Markup:
    shown = str(cell) if isinstance(cell, int) else cell
    kind = "number" if number else None
    if column == 0:
        return element("th", shown, scope="row", dir="auto", class_=kind)
    return element("td", shown, dir="auto", class_=kind)


def facts(values_by_name: Mapping[str, Node]) -> Markup:
    """Return names and values as a list; values that are None or empty are left out."""
    pairs = ((name, value) for name, value in values_by_name.items() if value not in (None, ""))
    inner = (element("div", element("dt", name), element("dd", value, dir="auto")) for name, value in pairs)
    return element("dl", joined(inner), class_="facts")


def code(text: str, label: str) -> Markup:
    """Return commands or SQL with a button that copies them; `label` says to screen readers what is copied."""
    button = element("button", "Copy", type="button", class_="copy", aria_label=f"Copy {label}")
    status = element("span", role="status")
    shown = element("pre", element("code", text), tabindex=0, role="group", aria_label=label)
    return element("div", shown, element("p", button, status), class_="code")


def sql(statement: str, batch: str = "", summary: str = "SQL behind this") -> Markup:
    """Return a statement that readers can unfold and copy. `$b` in it becomes the batch's id."""
    shown = CODE.sub(lambda _: f"'{batch}'", statement).strip() if batch else statement.strip()
    return details(summary, code(shown, "the SQL"))


def details(summary: str, *content: Node) -> Markup:
    """Return content that readers unfold."""
    return element("details", element("summary", summary), *content)


def note(text: str) -> Markup:
    return element("p", text, class_="note", dir="auto")


def badge(text: str, kind: str) -> Markup:
    """Return a word that stands out. `kind`: good, bad or unclear."""
    return element("strong", text, class_=f"badge {kind}")


def picture(svg: bytes, description: str, caption: str = "") -> Markup:
    """Return an SVG file with its caption; `description` is for those who do not see it."""
    shown = element("img", src=svg_address(svg), alt=description)
    return element("figure", shown, element("figcaption", caption, dir="auto") if caption else None)

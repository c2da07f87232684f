"""Tables of statistics for papers, as LaTeX, Markdown and HTML.

A row is an experiment, or one of its times. Numbers are rounded by their interval: see `sierra.stats.rounding`. The line
below a table has n, the kinds of intervals, and what is not in the numbers. The same statistics give the same bytes.
"""

from __future__ import annotations

import csv as csv_module
import io
import re
import textwrap
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from itertools import groupby
from typing import TYPE_CHECKING, TypeAlias

from sierra.config.project_file import LoadedProject, Project
from sierra.errors import UsageError
from sierra.execution import targets
from sierra.stats import survival
from sierra.stats.rounding import Rounded, rounded
from sierra.util.html_elements import element, joined
from sierra.util.lazy_definitions import dataclass, regex
from sierra.util.text import digits_apart, short_number

if TYPE_CHECKING:
    import pyarrow as pa

    from sierra.deliverables.run_statistics import Statistics
    from sierra.store.store import Store

LABEL = regex(r"[A-Za-z0-9:._-]+")
PLAIN = ("mean",)
"""Statistics that need no name in a header if they are the only one."""
SPECIAL = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    "[": "{[}",
    "*": "{*}",
    **{character: f"\\{character}" for character in "&%$#_{}"},
}
"""Characters with a meaning in LaTeX, and how they are written; `[` and `*` have one after the end of a row."""
COMMANDS = """
± pm × times ≥ geq ≤ leq ∞ infty µ mu ○ circ △ triangle
Γ Gamma Δ Delta Θ Theta Λ Lambda Ξ Xi Π Pi Σ Sigma Φ Phi Ψ Psi Ω Omega
"""
"""Characters, each followed by its command in mathematics."""
GREEK = """
alpha beta gamma delta epsilon zeta eta theta iota kappa lambda mu nu xi mathrm{o} pi rho varsigma sigma tau upsilon phi chi psi
omega
"""
"""The commands of the small Greek letters, in the order of Unicode."""
SUPERSCRIPTS = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
OUTSIDE_TEXT = {
    "−": "$-$",
    "□": r"$\sqcap\!\!\!\!\sqcup$",
    **{character: rf"$\{name}$" for character, name in re.findall(r"(\S) (\w+)", COMMANDS)},
    **{chr(0x3B1 + place): rf"$\{name}$" for place, name in enumerate(GREEK.split())},
    **{chr(raised): f"$^{{{chr(plain)}}}$" for plain, raised in SUPERSCRIPTS.items()},
}
"""Characters that LaTeX knows only as commands of mathematics."""
MINUS = regex(r"(?<![\w.)\]-])-(?=[.]?\d)|(?<=\de)-(?=\d)")
"""A hyphen that is the minus of a number."""
Cell: TypeAlias = Rounded | str | None
Heads: TypeAlias = tuple[str, ...]
"""The heads of a column from the outermost, which may span several columns, to its own."""
COLUMN = 240.0
"""The width of a column of text, in points, that a table is made for: ACM has 241, IEEE 252."""
CHARACTER, GAP = 3.75, 8.0
"""The width of a character of a small font, and of the space between two columns, in points."""
NARROWEST = 8
"""The number of characters below which a head is not wrapped."""


class Latex(str):
    """A text that is LaTeX already, and is not escaped."""

    __slots__ = ()


@dataclass(frozen=True, slots=True)
class PaperTable:
    """The content of a table: headers, rows, and the line below it."""

    headers: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    note: str
    caption: str = ""
    label: str = ""
    texts: frozenset[int] = frozenset()
    """The places of the columns that hold text, and not numbers."""
    heads: tuple[Heads, ...] = ()
    """The heads of each column for LaTeX, where equal ones are one; by default its header."""


def text(
    project: LoadedProject, store: Store, statistics: Statistics | None, format: str, caption: str = "", label: str = ""
) -> str:
    """Return the text of a table of statistics in one of `FORMATS`. Raises UsageError."""
    check_format(format, label)
    if statistics is None or not statistics.chosen or "remaining" in statistics.table.column_names:
        raise UsageError(
            "a table for papers needs chosen statistics, one row for each experiment or time; name them, as in mean"
        )
    config = targets.of_batch(project, store, statistics.batch).config
    axes = [f"axis {index}" for index in range(len(statistics.axes))]
    headers: dict[str, Heads] = {axis: (header,) for axis, header in zip(axes, axis_headers(config, statistics), strict=True)}
    headers |= {"t": (_header(statistics.time, _unit(config, statistics, statistics.time)),)} | statistic_headers(
        config, statistics
    )
    table = statistics.with_axes(axes, labels=True)
    shown = {name: header for name, header in headers.items() if name in table.column_names}
    return FORMATS[format](
        paper_table(table, statistics.chosen, shown, "; ".join(statistics.notes), caption=caption, label=label)
    )


def flat(heads: Heads) -> str:
    """Return the heads of a column in one line: `mean speed [m/s]`."""
    return " ".join(reversed(heads)) if len(heads) > 1 else heads[0]


def check_format(format: str, label: str) -> None:
    """Raise UsageError for an unknown format, or for a label that LaTeX would not take."""
    if label and not LABEL.fullmatch(label):
        raise UsageError(f"label {label!r}: use letters, digits and the characters : . _ - only")
    if format not in FORMATS:
        raise UsageError(f"unknown format of a table {format!r}; known are {', '.join(FORMATS)}")


def axis_headers(config: Project, statistics: Statistics) -> list[str]:
    """Return the headers of the variables."""
    headers = []
    for name in statistics.axes:
        variable = config.variables.get(name)
        headers.append(_header((variable and variable.label) or name, variable.unit if variable else ""))
    return headers


def statistic_headers(config: Project, statistics: Statistics) -> dict[str, Heads]:
    """Return the heads of the chosen statistics, by name; one alone is named by its column only."""
    what, unit = statistics.column, _unit(config, statistics, statistics.column)
    if statistics.threshold is not None:
        reached = f"{statistics.column} ≥ {statistics.threshold:.12g}"
        what, unit = f"time until {reached}{f' {unit}' if unit else ''}", _unit(config, statistics, statistics.time)
    alone, head = len(statistics.chosen) == 1, _header(what, unit)
    return {name: (head,) if alone and name in PLAIN else (head, name.replace("_", " ")) for name in statistics.chosen}


Estimates: TypeAlias = dict[int, tuple[float | None, float | None, float | None, int]]


def estimates_of(statistics: Statistics, name: str, ordinals: Container[int]) -> tuple[Estimates, list[str]]:
    """Return value, low, high and n of a statistic by the position of the experiment, and the methods of its intervals."""
    columns = [
        statistics.table.column(column).to_pylist() for column in ("experiment", name, f"{name}_low", f"{name}_high", "n")
    ]
    if name in survival.STATISTICS:  # these count the runs that never reached the threshold too
        columns[-1] = [n + never for n, never in zip(columns[-1], statistics.table.column("never").to_pylist(), strict=True)]
    methods = statistics.table.column(f"{name}_interval").to_pylist()
    rows = [row for row in zip(*columns, methods, strict=True) if row[0] in ordinals]
    return {row[0]: row[1:5] for row in rows}, list(dict.fromkeys(row[5] for row in rows if row[5]))


def _unit(config: Project, statistics: Statistics, column: str) -> str:
    declared = config.declared(statistics.output)
    return "ns" if column in statistics.durations else declared.units.get(column, "") if declared else ""


def _header(name: str, unit: str) -> str:
    return f"{name.replace('_', ' ')} [{unit}]" if unit not in ("", "1") else name.replace("_", " ")


def paper_table(
    statistics: pa.Table, names: Sequence[str], headers: Mapping[str, Heads], notes: str, *, caption: str = "", label: str = ""
) -> PaperTable:
    """Return the table of these statistics. `headers` has the heads of each column; columns without one are not shown."""
    columns = {name: statistics.column(name).to_pylist() for name in statistics.column_names}
    counts = columns.get("n", [])
    shown: dict[Heads, list[Cell]] = {}
    for name, header in headers.items():
        if name in names:
            ends = zip(columns[name], columns[f"{name}_low"], columns[f"{name}_high"], strict=True)
            shown[header] = [None if value is None else rounded(value, low, high) for value, low, high in ends]
        else:
            shown[header] = plain(columns[name])
    n = f"n = {counts[0]}" if len(set(counts)) == 1 else ""
    if counts and not n:
        shown[("n",)] = [str(count) for count in counts]
    methods = {name: list(dict.fromkeys(filter(None, columns[f"{name}_interval"]))) for name in names}
    texts = [
        index for index, name in enumerate(headers) if name not in names and any(isinstance(v, str) for v in columns[name])
    ]
    note = "; ".join(filter(None, (n, intervals(methods), notes)))
    rows = tuple(zip(*shown.values(), strict=True))
    return PaperTable(tuple(map(flat, shown)), rows, note, caption, label, frozenset(texts), tuple(shown))


def plain(values: Sequence[object]) -> list[Cell]:
    """Return the values of a variable as text, with as many digits as it takes to tell them apart."""
    digits = digits_apart(values, 12)
    texts = [short_number(value, digits) if isinstance(value, float) else str(value) for value in values]
    numbers = (isinstance(value, int | float) and not isinstance(value, bool) for value in values)
    return [text.replace("-", "−") if number else text for text, number in zip(texts, numbers, strict=True)]


def intervals(methods: Mapping[str, Iterable[str]]) -> str:
    """Return what the intervals are, in words."""
    having = {name: " or ".join(applied) for name, applied in methods.items() if applied}
    if not having:
        return "no intervals"
    if len(methods) == 1:
        return f"95 % interval ({next(iter(having.values()))})"
    return f"95 % intervals: {', '.join(f'{name} {method}' for name, method in having.items())}"


def latex(table: PaperTable) -> str:
    """Return the table as a `tabular` with the rules of the package booktabs, in a `table` if it has a caption or a label.

    It fits a column of text if it can: heads are wrapped if they would make it wider, and the note always is. A table that
    is wider nevertheless is a `table*`, for both columns.
    """
    heads = table.heads or tuple((header,) for header in table.headers)
    widths = [max(len(as_text(row[column])) for row in table.rows) for column in range(len(heads))]
    own = [[head[-1]] for head in heads]
    if _width(heads, own, widths) > COLUMN:
        own = [_wrapped(lines[0], max(width, NARROWEST)) for lines, width in zip(own, widths, strict=True)]
    star = "*" if _width(heads, own, widths) > COLUMN else ""
    alignment = "".join("l" if column in table.texts else "r" for column in range(len(heads)))
    lines = [
        r"\footnotesize\setlength{\tabcolsep}{4pt}%",
        rf"\begin{{tabular}}{{@{{}}{alignment}@{{}}}}",
        r"\toprule",
        *_spanning(heads),
        *(" & ".join(map(escaped, row)) + r" \\" for row in _below(own)),
        r"\midrule",
        *(" & ".join(map(_latex_cell, row)) + r" \\" for row in table.rows),
        r"\bottomrule",
        r"\end{tabular}\par\smallskip",
        rf"\noindent\parbox{{\linewidth}}{{\raggedright {escaped(table.note)}}}\par",
    ]
    if not (table.caption or table.label):
        wide = ["% This table is wider than a column of text: put it into table*."] if star else []
        return "\n".join([*wide, r"\begingroup\noindent", *lines, r"\endgroup"]) + "\n"
    caption = [rf"\caption{{{escaped(table.caption)}}}"] if table.caption else []
    label = [rf"\label{{{table.label}}}"] if table.label else []
    return "\n".join([rf"\begin{{table{star}}}", r"\centering", *caption, *label, *lines, rf"\end{{table{star}}}"]) + "\n"


def _spans(heads: Sequence[Heads]) -> Iterator[list[tuple[str, int, int]]]:
    """Yield for each line of spanning heads: each head, its first column, and that after its last."""
    depth = max(map(len, heads))
    padded = [("",) * (depth - len(head)) + head for head in heads]
    for level in range(depth - 1):
        spans, first = [], 0
        for path, columns in groupby(head[: level + 1] for head in padded):
            spans.append((path[-1], first, first := first + len(list(columns))))
        yield spans


def _spanning(heads: Sequence[Heads]) -> Iterator[str]:
    """Yield the rows of the heads that span columns, each with the rules below it."""
    for spans in _spans(heads):
        cells = (
            rf"\multicolumn{{{end - first}}}{{c}}{{{escaped(head)}}}" if head else " & " * (end - first - 1)
            for head, first, end in spans
        )
        yield " & ".join(cells) + r" \\"
        yield "".join(rf"\cmidrule(lr){{{first + 1}-{end}}}" for head, first, end in spans if head)


def _wrapped(head: str, width: int) -> list[str]:
    """Return the lines of a head; LaTeX has one, because it may end anywhere."""
    return [head] if isinstance(head, Latex) else textwrap.wrap(head, width, break_long_words=False, break_on_hyphens=False)


def _below(own: Sequence[Sequence[str]]) -> list[tuple[str, ...]]:
    """Return the rows of the columns' own heads, whose last lines are beside each other."""
    high = max(map(len, own))
    return list(zip(*([""] * (high - len(lines)) + list(lines) for lines in own), strict=True))


def _width(heads: Sequence[Heads], own: Sequence[Sequence[str]], widths: Sequence[int]) -> float:
    """Return about the width of a table in points; `widths` are the numbers of characters of the widest cells."""
    points = [max(width, *map(len, lines)) * CHARACTER for width, lines in zip(widths, own, strict=True)]
    for spans in reversed(list(_spans(heads))):
        for head, first, end in spans:
            points[end - 1] += max(0.0, len(head) * CHARACTER - sum(points[first:end]) - GAP * (end - first - 1))
    return sum(points) + GAP * (len(points) - 1)


def escaped(text: str) -> str:
    """Return a text for LaTeX, in one line, with minus signs."""
    if isinstance(text, Latex):
        return str(text)
    known = {**SPECIAL, **OUTSIDE_TEXT}
    return "".join(known.get(character, character) for character in MINUS.sub("−", " ".join(text.split())))


def _latex_cell(cell: Cell) -> str:
    match cell:
        case None:
            return "--"
        case str():
            return escaped(cell)
        case Rounded(value, half, ends, exponent):
            inner = value if not half else rf"{value} \pm {half}"
            if exponent:
                inner = rf"{f'({inner})' if half else inner} \times 10^{{{exponent}}}"
            if ends:
                inner += rf"\ [{ends[0]}, {ends[1]}]" + (rf" \times 10^{{{exponent}}}" if exponent else "")
            inner = inner.replace("−", "-").replace("∞", r"\infty")
            return f"${inner}$"


def markdown(table: PaperTable) -> str:
    """Return the table as a table of GitHub's Markdown."""
    rules = [":--" if column in table.texts else "--:" for column in range(len(table.headers))]
    rows = [table.headers, rules, *([as_text(cell) for cell in row] for row in table.rows)]
    lines = ["| " + " | ".join(as_markdown(cell) for cell in row) + " |" for row in rows]
    above = [as_markdown(table.caption), ""] if table.caption else []
    return "\n".join([*above, *lines, "", as_markdown(table.note)]) + "\n"


def as_markdown(text: str) -> str:
    """Return a text without characters that Markdown gives a meaning to, in one line."""
    return "".join(f"\\{c}" if c in "\\|*_`<>" else c for c in " ".join(text.split()))


def as_text(cell: Cell) -> str:
    """Return the text of a cell: `0.714 ± 0.021`, `–` for none."""
    match cell:
        case None:
            return "–"
        case str():
            return cell
        case Rounded(value, half, ends, exponent):
            power = f" × 10{str(exponent).translate(SUPERSCRIPTS)}" if exponent else ""
            if half:
                return f"({value} ± {half}){power}" if power else f"{value} ± {half}"
            return f"{value}{power}" + (f" [{ends[0]}, {ends[1]}]{power}" if ends else "")


def csv(table: PaperTable) -> str:
    """Return the table as CSV, with the rounded numbers as text."""
    file = io.StringIO()
    writer = csv_module.writer(file, lineterminator="\n")
    writer.writerows([table.headers, *(["" if cell is None else as_text(cell) for cell in row] for row in table.rows)])
    return file.getvalue()


def page(table: PaperTable) -> str:
    """Return the table as an element of HTML."""
    rows = (element("tr", *(element("td", as_text(cell)) for cell in row)) for row in table.rows)
    parts = (
        element("caption", table.caption) if table.caption else None,
        element("thead", element("tr", *(element("th", header) for header in table.headers))),
        element("tbody", joined(("", *rows, ""), "\n")),
        element("tfoot", element("tr", element("td", table.note, colspan=len(table.headers)))),
    )
    return element("table", joined(("", *parts, ""), "\n"), id=table.label or None) + "\n"


FORMATS: Mapping[str, Callable[[PaperTable], str]] = {"latex": latex, "markdown": markdown, "html": page}
"""The formats of tables for papers, by name."""

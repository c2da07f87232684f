"""Tables of statistics for papers, as LaTeX, Markdown and HTML.

A row is an experiment, or one of its times. Numbers are rounded by their interval: see `sierra.stats.rounding`. The line
below a table has n, the kinds of intervals, and what is not in the numbers. The same statistics give the same bytes.
"""

from __future__ import annotations

import csv as csv_module
import io
import re
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
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
Cell: TypeAlias = Rounded | str | None


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


def text(
    project: LoadedProject, store: Store, found: Statistics | None, format: str, caption: str = "", label: str = ""
) -> str:
    """Return the text of a table of statistics in one of `FORMATS`. Raises UsageError."""
    check_format(format, label)
    if found is None or not found.chosen or "remaining" in found.table.column_names:
        raise UsageError(
            "a table for papers needs chosen statistics, one row for each experiment or time; name them, as in mean"
        )
    config = targets.of_batch(project, store, found.batch).config
    axes = [f"axis {place}" for place in range(len(found.axes))]
    headers = dict(zip(axes, axis_headers(config, found), strict=True))
    headers |= {"t": _header(found.time, _unit(config, found, found.time))} | statistic_headers(config, found)
    table = found.with_axes(axes, labels=True)
    shown = {name: header for name, header in headers.items() if name in table.column_names}
    return FORMATS[format](paper_table(table, found.chosen, shown, "; ".join(found.notes), caption=caption, label=label))


def check_format(format: str, label: str) -> None:
    """Raise UsageError for an unknown format, or for a label that LaTeX would not take."""
    if label and not LABEL.fullmatch(label):
        raise UsageError(f"label {label!r}: use letters, digits and the characters : . _ - only")
    if format not in FORMATS:
        raise UsageError(f"unknown format of a table {format!r}; known are {', '.join(FORMATS)}")


def axis_headers(config: Project, found: Statistics) -> list[str]:
    """Return the headers of the variables."""
    headers = []
    for name in found.axes:
        variable = config.variables.get(name)
        headers.append(_header((variable and variable.label) or name, variable.unit if variable else ""))
    return headers


def statistic_headers(config: Project, found: Statistics) -> dict[str, str]:
    """Return the headers of the chosen statistics, by name; one alone is named by its column only."""
    what, unit = found.column, _unit(config, found, found.column)
    if found.threshold is not None:
        reached = f"{found.column} ≥ {found.threshold:.12g}"
        what, unit = f"time until {reached}{f' {unit}' if unit else ''}", _unit(config, found, found.time)
    alone = len(found.chosen) == 1
    return {name: _header(what if alone and name in PLAIN else f"{name} {what}", unit) for name in found.chosen}


Estimates: TypeAlias = dict[int, tuple[float | None, float | None, float | None, int]]


def estimates_of(found: Statistics, name: str, ordinals: Container[int]) -> tuple[Estimates, list[str]]:
    """Return value, low, high and n of a statistic by the position of the experiment, and the methods of its intervals."""
    columns = [found.table.column(column).to_pylist() for column in ("experiment", name, f"{name}_low", f"{name}_high", "n")]
    if name in survival.STATISTICS:  # these count the runs that never reached the threshold too
        columns[-1] = [n + never for n, never in zip(columns[-1], found.table.column("never").to_pylist(), strict=True)]
    methods = found.table.column(f"{name}_interval").to_pylist()
    rows = [row for row in zip(*columns, methods, strict=True) if row[0] in ordinals]
    return {row[0]: row[1:5] for row in rows}, list(dict.fromkeys(row[5] for row in rows if row[5]))


def _unit(config: Project, found: Statistics, column: str) -> str:
    declared = config.declared(found.output)
    return "ns" if column in found.durations else declared.units.get(column, "") if declared else ""


def _header(name: str, unit: str) -> str:
    return f"{name.replace('_', ' ')} [{unit}]" if unit not in ("", "1") else name.replace("_", " ")


def paper_table(
    statistics: pa.Table, names: Sequence[str], headers: Mapping[str, str], notes: str, *, caption: str = "", label: str = ""
) -> PaperTable:
    """Return the table of these statistics. `headers` has the header of each column; columns without one are not shown."""
    columns = {name: statistics.column(name).to_pylist() for name in statistics.column_names}
    counts = columns.get("n", [])
    shown: dict[str, list[Cell]] = {}
    for name, header in headers.items():
        if name in names:
            ends = zip(columns[name], columns[f"{name}_low"], columns[f"{name}_high"], strict=True)
            shown[header] = [None if value is None else rounded(value, low, high) for value, low, high in ends]
        else:
            shown[header] = plain(columns[name])
    n = f"n = {counts[0]}" if len(set(counts)) == 1 else ""
    if counts and not n:
        shown["n"] = [str(count) for count in counts]
    methods = {name: list(dict.fromkeys(filter(None, columns[f"{name}_interval"]))) for name in names}
    texts = [
        place for place, name in enumerate(headers) if name not in names and any(isinstance(v, str) for v in columns[name])
    ]
    note = "; ".join(filter(None, (n, intervals(methods), notes)))
    rows = tuple(zip(*shown.values(), strict=True))
    return PaperTable(tuple(shown), rows, note, caption, label, frozenset(texts))


def plain(values: Sequence[object]) -> list[Cell]:
    """Return the values of a variable as text, with as many digits as it takes to tell them apart."""
    digits = digits_apart(values, 12)
    texts = [short_number(value, digits) if isinstance(value, float) else str(value) for value in values]
    numbers = (isinstance(value, int | float) and not isinstance(value, bool) for value in values)
    return [text.replace("-", "−") if number else text for text, number in zip(texts, numbers, strict=True)]


def intervals(methods: Mapping[str, Iterable[str]]) -> str:
    """Return what the intervals are, in words."""
    having = {name: " or ".join(found) for name, found in methods.items() if found}
    if not having:
        return "no intervals"
    if len(methods) == 1:
        return f"95 % interval ({next(iter(having.values()))})"
    return f"95 % intervals: {', '.join(f'{name} {method}' for name, method in having.items())}"


def latex(table: PaperTable) -> str:
    """Return the table as a `tabular` with the rules of the package booktabs, in a `table` if it has a caption or a label."""
    alignment = "".join("l" if place in table.texts else "r" for place in range(len(table.headers)))
    rows = [" & ".join(map(_latex_cell, row)) + r" \\" for row in table.rows]
    lines = [
        rf"\begin{{tabular}}{{{alignment}}}",
        r"\toprule",
        " & ".join(map(escaped, table.headers)) + r" \\",
        r"\midrule",
        *rows,
        r"\bottomrule",
        rf"\multicolumn{{{len(table.headers)}}}{{l}}{{\footnotesize {escaped(table.note)}}} \\",
        r"\end{tabular}",
    ]
    if not (table.caption or table.label):
        return "\n".join(lines) + "\n"
    caption = [rf"\caption{{{escaped(table.caption)}}}"] if table.caption else []
    label = [rf"\label{{{table.label}}}"] if table.label else []
    return "\n".join([r"\begin{table}", r"\centering", *caption, *label, *lines, r"\end{table}"]) + "\n"


def escaped(text: str) -> str:
    """Return a text for LaTeX, in one line."""
    known = {**SPECIAL, **OUTSIDE_TEXT}
    return "".join(known.get(character, character) for character in " ".join(text.split()))


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
    rules = [":--" if place in table.texts else "--:" for place in range(len(table.headers))]
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

"""A comparison for a paper, as LaTeX, Markdown or HTML: its table, its paragraph, and its figure.

Differences are rounded by their intervals (see `sierra.stats.rounding`), A12 has two digits, and p values are those that are
corrected for all tests of the report. The caption says that each interval is of one pair alone.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from sierra.deliverables.comparison import Compared
from sierra.deliverables.comparison_figure import caption_of, estimates_of
from sierra.deliverables.paper_tables import FORMATS, Cell, PaperTable, as_markdown, check_format, escaped, plain
from sierra.stats.comparison.model import Effect, Omnibus, Pair
from sierra.stats.comparison.wording import number, p_value
from sierra.stats.rounding import Rounded, rounded
from sierra.stats.words import of_run
from sierra.util.html_elements import element

SUFFIXES = {"latex": ".pdf", "markdown": ".png", "html": ".svg"}
"""The files of figures that each format can show."""


def text(
    compared: Compared, format: str, files: Sequence[Path] = (), folder: Path | None = None, caption: str = "", label: str = ""
) -> str:
    """Return a comparison as text. `files` are those of its figure, which are named relative to `folder`.

    Raises UsageError for an unknown format, or for a label that LaTeX would not take.
    """
    check_format(format, label)
    table = FORMATS[format](paper_table(compared, caption, label))
    parts = [table, PARAGRAPHS[format](compared.text)]
    if shown := next((file for file in files if file.suffix == SUFFIXES[format]), None):
        path = Path(os.path.relpath(shown, folder or Path.cwd())).as_posix()
        parts.append(PICTURES[format](path, f"{_subject(compared)}: {caption_of(compared)}", f"fig:{compared.name}"))
    return "\n".join(parts)


def paper_table(compared: Compared, caption: str = "", label: str = "") -> PaperTable:
    """Return the table of a comparison: a row for each test, the values of variables first.

    To be narrow, it has no column for a number of runs or a test that is the same in all rows, and no row for a test of all
    groups, if there is one such test: these are in the note.
    """
    alone = compared.omnibus if len(compared.omnibus) == 1 and compared.pairs else ()
    tests: list[Omnibus | Pair | Effect] = [*(() if alone else compared.omnibus), *compared.pairs, *compared.effects]
    points = [test.point if not isinstance(test, Effect) else {} for test in tests]
    variables = list(dict.fromkeys(name for point in points for name in point))
    places = {name: plain([point.get(name, "") for point in points]) for name in variables}
    rows: list[dict[str, Cell]] = [
        {name: cells[k] for name, cells in places.items()} | _cells(test, compared) for k, test in enumerate(tests)
    ]
    first = {name: str(rows[0][name] or "") for name in ("n", "test")}
    same = {name: text for name, text in first.items() if "," not in text and all(row[name] == text for row in rows)}
    headers = [name for name in rows[0] if name not in same and any(row[name] is not None for row in rows)]
    texts = frozenset(column for column, name in enumerate(headers) if name in ("groups", "effect", "test", "verdict"))
    texts |= {column for column, name in enumerate(headers) if any(isinstance(point.get(name), str) for point in points)}
    cells = tuple(tuple(row[name] for name in headers) for row in rows)
    called = {name: name.replace("_", " ") for name in variables} | {
        "groups": _variable(compared).replace("_", " ") or "groups"
    }
    note = [f"{_subject(compared)}: {estimates_of(compared)}", same.get("test", ""), *map(_in_words, alone)]
    note += ["p values corrected (Holm)"] if compared.analysis.tests > 1 else []
    shown = tuple(called.get(name, name) for name in headers)
    return PaperTable(shown, cells, "; ".join(filter(None, note)), caption, label, texts)


def _variable(compared: Compared) -> str:
    """Return the variable whose values the groups are, as in `size=1`; empty if their names are no such values."""
    names = {group.partition("=")[0] if "=" in group else "" for pair in compared.pairs for group in (pair.first, pair.second)}
    return names.pop() if len(names) == 1 else ""


def _in_words(omnibus: Omnibus) -> str:
    """Return a test of all groups for the note below a table."""
    statistic = "" if omnibus.statistic is None else f"χ²({omnibus.df}) = {number(omnibus.statistic)}, "
    return f"{omnibus.test} of all groups: {statistic}n = {omnibus.n}, {p_value(omnibus.p_adjusted)}"


def _cells(test: Omnibus | Pair | Effect, compared: Compared) -> dict[str, Cell]:
    """Return the cells of a row, by header; all rows have the same headers."""
    cells: dict[str, Cell] = dict.fromkeys(
        ("groups", "effect", "n", "test", "statistic", _difference(compared), "A12", "partial η²", "p", "p (TOST)", "verdict")
    )
    cells["p"] = _short(p_value(test.p_adjusted))
    match test:
        case Pair():
            n = str(test.n_first) if test.n_first == test.n_second else f"{test.n_first}, {test.n_second}"
            difference = None if test.difference is None else rounded(test.difference, test.low, test.high)
            a12 = None if test.a12 is None else Rounded(f"{test.a12:.2f}")
            named = _variable(compared)
            groups = " − ".join(group.removeprefix(f"{named}=" if named else "") for group in (test.second, test.first))
            cells |= {"groups": groups, "n": n, "test": test.test, _difference(compared): difference}
            cells |= {"A12": a12, "verdict": test.verdict.value}
            if test.p_equivalent_adjusted is not None:
                cells["p (TOST)"] = _short(p_value(test.p_equivalent_adjusted))
        case Omnibus():
            statistic = "" if test.statistic is None else f"χ²({test.df}) = {number(test.statistic)}"
            cells |= {"groups": "all groups", "n": str(test.n), "test": test.test, "statistic": statistic}
        case Effect():
            statistic = f"F({test.df}, {test.df_error}) = {number(test.f)}"
            cells |= {"effect": test.name.replace("_", " "), "statistic": statistic, "partial η²": Rounded(f"{test.eta:.2f}")}
    return cells


def _difference(compared: Compared) -> str:
    return f"difference [{compared.unit}]" if compared.unit not in ("", "1") else "difference"


def _short(p: str) -> str:
    """Return a p value for a column of them: `0.015`, `< 0.001`."""
    return p.removeprefix("p ").removeprefix("= ")


def _subject(compared: Compared) -> str:
    """Return what is compared."""
    threshold = compared.asked.threshold
    if threshold is None:
        return of_run(compared.measure, compared.column)
    return f"time until {compared.column} reaches {threshold:g}"


def _latex_picture(path: str, caption: str, label: str) -> str:
    lines = (
        r"\begin{figure}",
        r"\centering",
        rf"\includegraphics[width=\columnwidth]{{{path}}}",
        rf"\caption{{{escaped(caption)}}}",
        rf"\label{{{label}}}",
        r"\end{figure}",
    )
    return "\n".join(lines) + "\n"


def _html_picture(path: str, caption: str, label: str) -> str:
    return element("figure", element("img", src=path, alt=caption), element("figcaption", caption), id=label) + "\n"


PARAGRAPHS: Mapping[str, Callable[[str], str]] = {
    "latex": lambda text: escaped(text) + "\n{\\emergencystretch=3em\\par}\n",  # names do not stand out of a column
    "markdown": lambda text: as_markdown(text) + "\n",
    "html": lambda text: element("p", text) + "\n",
}
PICTURES: Mapping[str, Callable[[str, str, str], str]] = {
    "latex": _latex_picture,
    "markdown": lambda path, caption, label: f"![{as_markdown(caption)}](<{path}>)\n",
    "html": _html_picture,
}

"""Tables for papers: rounded, escaped, with units, n and the kind of interval, in the same bytes each time."""

from __future__ import annotations

import html.parser
import re
from collections.abc import Callable
from typing import Any

import pyarrow as pa
import pytest

import sierra
from sierra.deliverables.paper_tables import Latex, escaped, latex, markdown, page, paper_table
from sierra.errors import UsageError
from sierra.util.lazy_definitions import replace

FOUND = pa.table(
    {
        "experiment": [0, 1, 2],
        "axis 0": [-1, 2, 40],
        "axis 1": ["a_b", "c & d", "50 %"],
        "n": [5, 5, 5],
        "mean": [0.71362, 12.0, None],
        "mean_low": [0.69213, 11.0, None],
        "mean_high": [0.73511, 13.0, None],
        "mean_interval": ["t", "t", None],
        "median": [0.7, 1.5e-7, 3.0],
        "median_low": [0.65, 1.2e-7, None],
        "median_high": [0.78, 1.6e-7, None],
        "median_interval": ["order statistics", "order statistics", None],
    }
)
HEADERS = {
    "axis 0": ("population size",),
    "axis 1": ("controller",),
    "mean": ("speed [m/s]", "mean"),
    "median": ("speed [m/s]", "median"),
}
SHOWN = ("population size", "controller", "mean speed [m/s]", "median speed [m/s]")
TABLE = paper_table(FOUND, ["mean", "median"], HEADERS, "1 run missing", caption="Speed & more", label="tab:speed")


def test_a_table_in_latex() -> None:
    assert (
        latex(TABLE)
        == r"""\begin{table*}
\centering
\caption{Speed \& more}
\label{tab:speed}
\footnotesize\setlength{\tabcolsep}{4pt}%
\begin{tabular}{@{}rlrr@{}}
\toprule
 &  & \multicolumn{2}{c}{speed {[}m/s]} \\
\cmidrule(lr){3-4}
population &  &  &  \\
size & controller & mean & median \\
\midrule
$-$1 & a\_b & $0.714 \pm 0.021$ & $0.700\ [0.650, 0.780]$ \\
2 & c \& d & $12.0 \pm 1.0$ & $1.50 \times 10^{-7}\ [1.20, 1.60] \times 10^{-7}$ \\
40 & 50 \% & -- & $3$ \\
\bottomrule
\end{tabular}\par\smallskip
\noindent\parbox{\linewidth}{\raggedright n = 5; 95 \% intervals: mean t, median order statistics; 1 run missing}\par
\end{table*}
"""
    )


def test_a_table_in_markdown() -> None:
    assert (
        markdown(TABLE)
        == r"""Speed & more

| population size | controller | mean speed [m/s] | median speed [m/s] |
| --: | :-- | --: | --: |
| −1 | a\_b | 0.714 ± 0.021 | 0.700 [0.650, 0.780] |
| 2 | c & d | 12.0 ± 1.0 | 1.50 × 10⁻⁷ [1.20, 1.60] × 10⁻⁷ |
| 40 | 50 % | – | 3 |

n = 5; 95 % intervals: mean t, median order statistics; 1 run missing
"""
    )


class Reader(html.parser.HTMLParser):
    """The texts of the cells of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.cells: list[str] = []
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if data.strip():
            self.cells.append(data)


def test_a_table_in_html_is_well_formed_and_has_the_same_texts() -> None:
    reader = Reader()
    reader.feed(page(TABLE))
    assert reader.open == []
    assert reader.cells[:6] == ["Speed & more", *SHOWN, "−1"]
    assert reader.cells[9:13] == ["2", "c & d", "12.0 ± 1.0", "1.50 × 10⁻⁷ [1.20, 1.60] × 10⁻⁷"]
    assert reader.cells[-1].startswith("n = 5; 95 % intervals")


@pytest.mark.parametrize("text", ["<b>", "a & b", '"quoted"'])
def test_texts_do_not_become_html(text: str) -> None:
    table = paper_table(FOUND, ["mean"], {"mean": (text,)}, "", caption=text)
    reader = Reader()
    reader.feed(page(table))
    assert reader.cells[:2] == [text, text]


def test_characters_with_a_meaning_in_latex_are_escaped() -> None:
    assert escaped("\\ {x} ~ ^ # $ <|> [a] *\n±") == (
        r"\textbackslash{} \{x\} \textasciitilde{} \textasciicircum{} \# \$ \textless{}\textbar{}\textgreater{} {[}a] {*} $\pm$"
    )


def test_hyphens_before_numbers_are_minus_signs_and_others_stay() -> None:
    assert escaped("[-0.5, -.1], 1e-7, noise=-2, 2026-05-01, Mann-Whitney, a-1") == (
        r"{[}$-$0.5, $-$.1], 1e$-$7, noise=$-$2, 2026-05-01, Mann-Whitney, a-1"
    )


def test_latex_is_not_escaped_and_not_wrapped() -> None:
    headers = {**HEADERS, "axis 0": (Latex(r"$\lambda_{max}$ of a long name"),)}
    text = latex(replace(paper_table(FOUND, ["mean", "median"], headers, ""), caption=Latex(r"Speed $\pm$ more")))
    assert r"\caption{Speed $\pm$ more}" in text
    assert r"$\lambda_{max}$ of a long name & controller" in text


def test_unequal_numbers_of_runs_are_a_column() -> None:
    found = FOUND.set_column(3, "n", pa.array([5, 4, 0]))
    table = paper_table(found, ["mean"], {"axis 0": ("size",), "mean": ("speed",)}, "")
    assert table.headers == ("size", "speed", "n")
    assert [row[2] for row in table.rows] == ["5", "4", "0"]
    assert table.note == "95 % interval (t)"


def test_an_interval_without_an_upper_end_says_so() -> None:
    found = FOUND.slice(0, 1).set_column(6, "mean_high", pa.array([None], pa.float64()))
    table = paper_table(found, ["mean"], {"mean": ("time",)}, "")
    assert r"$0.714\ [0.692, \infty]$" in latex(table)


RUNS = r"""
seed=$(sed 's/.* seed="\([0-9]*\)".*/\1/' "$1")
printf 't,v_x\n1,%s\n' $((seed % 7)) > swarm.csv
"""


@pytest.mark.nightly
def test_the_stats_command_writes_tables_for_papers(simulate: Callable[..., Any]) -> None:
    project = simulate(RUNS)
    config = project.folder / "sierra.toml"
    config.write_text(config.read_text() + '[outputs.swarm]\nfile = "swarm.csv"\ntime = "t"\nunits = { v_x = "m/s" }\n')
    assert project.quick("run", "size=1,2", "--runs", "3", "--no-figures").returncode == 0
    words = ("stats", "swarm", "v_x")
    text = project.quick(*words, "--format", "markdown").stdout
    assert text.splitlines()[0] == "| size | v x [m/s] |"
    assert re.fullmatch(r"\| 1 \| [\d.]+ ± [\d.]+ \|", text.splitlines()[2])
    assert project.quick(*words, "--format", "markdown").stdout == text
    several = project.quick(*words, "-f", "latex", "-s", "mean,range", "--times", "own", "--caption", "V", "-o", "table.tex")
    assert (several.returncode, several.stdout) == (0, "")
    written = (project.folder / "table.tex").read_text()
    assert r" &  & \multicolumn{2}{c}{v x {[}m/s]} \\" in written
    assert r"size & t & mean & range \\" in written
    assert r"\caption{V}" in written
    late = project.quick(*words, "-f", "html", "-m", "time_to", "--threshold", "0", "-s", "km_median").stdout
    assert "<th>km median time until v x ≥ 0 m/s</th>" in late
    for more, told in (
        (("-f", "latex", "--label", "a b"), "label 'a b': use letters, digits"),
        (("-f", "csv", "--caption", "V"), "--caption and --label need a table for papers"),
        (
            ("-f", "html", "-m", "time_to", "--threshold", "0", "--times", "own"),
            "has no statistics to choose, and no table for papers",
        ),
    ):
        wrong = project.quick(*words, *more)
        assert (wrong.returncode, wrong.stdout) == (2, "")
        assert told in wrong.stderr
    opened = sierra.open(project.folder)
    with pytest.raises(UsageError, match="a table for papers needs chosen statistics"):
        opened.paper.table(opened.statistics(None, "swarm", "v_x"))
    with pytest.raises(UsageError, match="unknown format of a table 'docx'; known are latex, markdown, html"):
        opened.paper.table(opened.statistics(None, "swarm", "v_x", statistics=["mean"]), "docx")


@pytest.mark.integration
def test_a_table_has_the_number_of_runs_also_beside_a_variable_named_n_in_capitals(simulate: Callable[..., Any]) -> None:
    project = simulate()
    config = project.folder / "sierra.toml"
    config.write_text(config.read_text().replace('size = "', 'N = "'))
    assert project.quick("run", "N=3,5", "--runs", "2", "--no-figures").returncode == 0
    lines = project.quick("stats", "swarm", "v", "--format", "markdown").stdout.splitlines()
    assert lines[0] == "| N | v |"
    assert [line.split("|")[1].strip() for line in lines[2:4]] == ["3", "5"]
    assert lines[-1].startswith("n = 2; ")

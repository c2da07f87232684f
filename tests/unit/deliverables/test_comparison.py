"""`sierra compare` compares batches and values of variables, and says what it cannot compare."""

from __future__ import annotations

import json
import re
import shlex
import statistics
from pathlib import Path
from typing import Any

import pytest

import sierra
from sierra.deliverables import check, comparison
from sierra.deliverables.report import comparisons
from sierra.errors import UsageError
from tests import projects, stores

pytestmark = pytest.mark.integration

CONFIG = (
    projects.CONFIG
    + """
[queries.quiet]
criteria = ["population_size=1,2"]
runs = 8

[comparisons.sizes]
by = "population_size"
column = "coverage"
margin = 5

[tables.peaks]
sql = "SELECT run, max(coverage) AS peak FROM swarm GROUP BY run"
units = { peak = "m" }

[comparisons.batches]
groups = ["calm=quiet", "quiet"]
"""
)


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, str]:
    """Return a project with two batches of 8 runs in 2 experiments each, and their ids; tests only read its store."""
    root = projects.make(tmp_path_factory.mktemp("compared") / "project", CONFIG)
    project = sierra.open(root)
    batches = [
        project.run("population_size=1,2", runs=8, sets=sets, figures=False).batch for sets in ((), [("//noise", "0.2")])
    ]
    return root, *batches


def answer(root: Path, *words: str) -> dict[str, Any]:
    done = projects.quick(root, "compare", *words, "--json", "--no-figure")
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def refusal(root: Path, *words: str) -> tuple[int, str]:
    done = projects.quick(root, "compare", *words)
    assert done.stdout == ""
    return done.returncode, done.stderr


def test_batches_are_compared_in_each_experiment(compared: tuple[Path, str, str]) -> None:
    root, quiet, noisy = compared
    found = answer(root, f"quiet={quiet[:8]}", f"noisy={noisy[:8]}")
    assert found["batches"] == {"quiet": quiet, "noisy": noisy}
    assert found["paired"]
    assert [pair["point"] for pair in found["pairs"]] == [{"population_size": 1}, {"population_size": 2}]
    seeds = projects.sql(root, f"SELECT DISTINCT number, seed FROM batch_runs WHERE batch = '{quiet}' ORDER BY number")
    differences = sorted(0.1 * (row["seed"] % 100) for row in seeds)
    for pair in found["pairs"]:
        assert (pair["first"], pair["second"], pair["verdict"]) == ("quiet", "noisy", "different")
        assert differences[0] <= pair["low"] <= pair["difference"] <= pair["high"] <= differences[-1]
        assert pair["p"] == pytest.approx(2 / 2**8)
        assert pair["p_adjusted"] == pytest.approx(2 * pair["p"])
    assert any("the batches differ in --set; for details: sierra diff" in note for note in found["notes"])


def test_the_values_of_a_variable_are_compared_within_a_batch(compared: tuple[Path, str, str]) -> None:
    root, quiet, _ = compared
    (pair,) = answer(root, quiet[:8], "--by", "population_size")["pairs"]
    assert (pair["first"], pair["second"]) == ("population_size=1", "population_size=2")
    assert pair["difference"] == pytest.approx(4)
    (back,) = answer(root, quiet[:8], "--groups", "2,1")["pairs"]
    assert (back["first"], back["difference"]) == ("population_size=2", pytest.approx(-4))
    (against,) = answer(root, quiet[:8], "--against", "2", "--paired", "no")["pairs"]
    assert (against["first"], against["test"]) == ("population_size=2", "Mann-Whitney test")


def test_the_command_in_a_report_makes_the_same_comparison(compared: tuple[Path, str, str]) -> None:
    root, quiet, _ = compared
    made = sierra.open(root).comparisons.make(
        quiet, by=["population_size"], method="rank_sum", paired=False, alpha=0.1, margin=2.5
    )
    found = answer(root, *shlex.split(comparisons.again(made))[2:])
    assert [pair["test"] for pair in found["pairs"]] == [pair.test for pair in made.pairs]
    assert [pair["p"] for pair in found["pairs"]] == [pair.p for pair in made.pairs]
    assert found["text"] == made.text


def test_values_that_differ_in_late_digits_are_different_groups(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project", CONFIG)
    sierra.open(root).run("population_size=1000001,1000002,5", runs=2, figures=False)
    pairs = answer(root, "--by", "population_size")["pairs"]
    names = [f"population_size={value}" for value in (1000001, 1000002, 5)]
    assert [(pair["first"], pair["second"]) for pair in pairs] == [
        (names[0], names[1]),
        (names[0], names[2]),
        (names[1], names[2]),
    ]
    assert pairs[0]["difference"] == pytest.approx(4)


@pytest.mark.nightly
def test_the_unit_of_a_derived_table_is_said(compared: tuple[Path, str, str]) -> None:
    root, quiet, _ = compared
    found = answer(root, quiet[:8], "--by", "population_size", "--table", "peaks", "--column", "peak")
    assert found["text"].startswith("The final value of peak [m] was compared")


@pytest.mark.nightly
def test_a_variable_with_one_value_is_no_factor(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project", CONFIG.replace("[variables]", '[variables]\nsize = "/arena/@size"'))
    sierra.open(root).run("population_size=1,2", "noise=0.1,0.2", "size=10", runs=3, figures=False)
    assert len(answer(root, "--by", "population_size,noise")["effects"]) == 3
    status, said = refusal(root, "--by", "population_size,size")
    assert (status, "add noise to --by" in said) == (2, True)


def test_the_table_the_text_and_the_figure_are_made(compared: tuple[Path, str, str], tmp_path: Path) -> None:
    root = stores.copy(compared[0], tmp_path / "project")
    done = projects.quick(root, "compare", f"a={compared[1][:8]}", f"b={compared[2][:8]}")
    *table, empty, text = done.stdout.split("figures/")[0].splitlines()
    files = [line for line in done.stdout.splitlines() if line.startswith("figures/")]
    header, one, _, *note = table
    assert header.startswith("population size  groups  ")
    assert one.endswith("different")
    assert max(map(len, table)) <= 100
    assert "Wilcoxon signed-rank test" in " ".join(note)
    assert empty == ""
    assert text.startswith("The final value of coverage was compared between a and b in 2 experiments.")
    assert text.count(". ") < 5
    long = projects.quick(root, "compare", f"a={compared[1][:8]}", f"b={compared[2][:8]}", "--no-figure", "--long").stdout
    assert long.split()[:3] == ["population_size", "first", "second"]
    assert "The p values are corrected for 2 tests (Holm)." in long
    assert [Path(file).suffix for file in files] == [".png", ".pdf", ".svg", ".txt", ".tex"]
    assert sierra.open(root).plan("population_size=1,2", runs=8).batch.id == compared[1], "figures are no source"
    before = [(root / file).read_bytes() for file in files]
    assert compared[1].encode() in before[0]
    assert compared[2].encode() in before[0]
    projects.quick(root, "compare", f"a={compared[1][:8]}", f"b={compared[2][:8]}")
    assert [(root / file).read_bytes() for file in files] == before, "the same data give the same bytes"


@pytest.mark.nightly
def test_formats_for_papers_have_the_table_the_text_and_the_figure(compared: tuple[Path, str, str], tmp_path: Path) -> None:
    root = stores.copy(compared[0], tmp_path / "project")
    words = ("compare", f"a_1={compared[1][:8]}", f"b&={compared[2][:8]}", "--format")
    latex = projects.quick(root, *words, "latex", "--caption", "50 % more", "--label", "tab:noise").stdout
    table, text, figure = latex.split("\n\n")
    assert [line for line in table.splitlines() if line.startswith(r"\caption")] == [r"\caption{50 \% more}"]
    rows = [line for line in table.splitlines() if line.startswith("1 &")]
    groups, difference, a12, p, verdict = rows[0].removesuffix(r" \\").split(" & ", 1)[1].rsplit(" & ", 4)
    assert (groups, p, verdict) == (r"b\& $-$ a\_1", "0.016", "different")
    assert "n = 8 pairs; Wilcoxon signed-rank test; p values corrected (Holm)" in table
    assert re.fullmatch(r"\$\d\.\d+( \\pm .*|\\ \[.*\])\$", difference)
    assert re.fullmatch(r"\$\d\.\d\d\$", a12)
    assert text.startswith(r"The final value of coverage was compared between a\_1 and b\&")
    (path,) = re.findall(r"\\includegraphics\[width=\\columnwidth\]\{(.*)\}", figure)
    assert (root / path).is_file()
    assert path.endswith(".pdf")
    (root / "tables").mkdir()
    page = projects.quick(root, *words, "html", "-o", "tables/noise.html")
    assert (page.returncode, page.stdout) == (0, "")
    html = (root / "tables" / "noise.html").read_text()
    assert "<p>The final value of coverage was compared between a_1 and b&amp;" in html
    (image,) = re.findall(r'<img src="([^"]+)"', html)
    assert (root / "tables" / image).resolve().suffix == ".svg"
    markdown = projects.quick(root, *words, "markdown", "--no-figure").stdout
    assert markdown.startswith("| population size | groups | difference | A12 |")
    assert "![" not in markdown


@pytest.mark.nightly
def test_a_table_of_another_format_is_nothing_but_the_table(compared: tuple[Path, str, str]) -> None:
    root, quiet, noisy = compared
    words = ("compare", quiet[:8], noisy[:8], "--no-figure")
    rows = projects.quick(root, *words, "--format", "csv").stdout.splitlines()
    assert len(rows) == 3
    assert rows[0].endswith("p,p_adjusted,verdict")


@pytest.mark.nightly
def test_declared_comparisons_have_names(compared: tuple[Path, str, str]) -> None:
    root, quiet, _ = compared
    found = answer(root, "sizes", quiet[:8])
    assert (found["name"], found["margin"]) == ("sizes", 5)
    assert found["pairs"][0]["verdict"] == "different, equivalent"
    message = "sierra: sierra.toml declares the comparison 'sizes'; leave out --alpha, or change it there\n"
    assert refusal(root, "sizes", "--alpha", "0.01") == (2, message)
    code, said = refusal(root, "batches")
    assert (code, "a batch cannot be compared with itself" in said) == (2, True)


@pytest.mark.nightly
def test_the_python_api_returns_the_same(compared: tuple[Path, str, str]) -> None:
    root, quiet, noisy = compared
    found = sierra.open(root).comparisons.make(quiet, noisy, measure="mean", margin=100)
    assert [pair.verdict.value for pair in found.pairs] == ["different, equivalent"] * 2
    table = found.arrow()
    assert table.column("population_size").to_pylist() == [1, 2]
    assert table.column("difference").to_pylist() == [pair.difference for pair in found.pairs]
    assert found.measure == "mean"


def test_times_until_a_threshold_are_censored(compared: tuple[Path, str, str]) -> None:
    root, quiet, _ = compared
    (pair,) = answer(root, quiet[:8], "--measure", "time_to", "--threshold", "13.5")["pairs"]
    seeds = projects.sql(root, f"SELECT DISTINCT seed FROM batch_runs WHERE batch = '{quiet}'")
    late = [sum(4 * count + 0.1 * (row["seed"] % 100) < 13.5 for row in seeds) for count in (1, 2)]
    assert pair["test"] == "log-rank test"
    assert [pair["never_first"], pair["never_second"]] == late
    assert late[0] > late[1]


def test_the_difference_over_time_has_an_interval_at_each_time_and_one_test(compared: tuple[Path, str, str]) -> None:
    root, quiet, noisy = compared
    found = sierra.open(root).comparisons.make(quiet, noisy, column="coverage", over_time=True)
    assert (found.measure, found.time, len(found.bands), found.analysis.tests) == ("mean", "tick", 2, 2)
    for band, pair in zip(found.bands, found.pairs, strict=True):
        assert band.times.tolist() == [0, 1, 2, 3, 4]
        assert band.low[0] < pair.difference < band.high[0], "the noise of a run is the same at all times"
    with pytest.raises(UsageError, match="over_time"):
        sierra.open(root).comparisons.make(quiet, noisy, over_time=True, measure="final")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("{quiet}", "{quiet}"), "a batch cannot be compared with itself; name other batches, or one batch and --by VARIABLE"),
        (("{quiet}", "--by", "nois"), "this batch has no variable 'nois'; it has population_size"),
        (("{quiet}", "--column", "covrage"), "no output has 'covrage' as numeric columns (sierra sql 'SHOW TABLES')"),
        (("{quiet}", "--measure", "time_to"), 'measure "time_to" and "threshold" must be used together'),
        (("{quiet}", "--margin", "-1"), "margin"),
        (("{quiet}", "--alpha", "2"), "alpha"),
        (("{quiet}", "--against", "7"), "there is no group '7'; it has population_size=1, population_size=2"),
        (("{quiet}", "--groups", "1,1"), "a group is named twice: 1, 1"),
        (("x={quiet}", "x={noisy}"), "two groups have the name 'x'; give them different ones: LABEL=HASH"),
        (("{quiet}", "{noisy}", "--by", "population_size"), "--by compares the values of a variable within one batch"),
        (("={quiet}", "{noisy}"), "has no label before =; write LABEL=HASH"),
        (("nothing",), "nothing"),
    ],
)
def test_what_cannot_be_compared_is_one_line(compared: tuple[Path, str, str], words: tuple[str, ...], message: str) -> None:
    root, quiet, noisy = compared
    code, said = refusal(root, *(word.format(quiet=quiet[:8], noisy=noisy[:8]) for word in words))
    assert code == 2
    assert message in said
    assert said.count("\n") == 1


def test_batches_of_different_variables_are_refused(recorded: Path) -> None:
    sizes, _, noise = [row["batch"] for row in projects.sql(recorded, "SELECT batch FROM batches ORDER BY lamport")]
    code, said = refusal(recorded, sizes[:8], noise[:8], "--column", "coverage")
    assert code == 2
    assert "the batches have different variables: " in said
    assert "varies only in" in said


def test_experiments_that_only_one_batch_has_are_left_out_and_counted(recorded: Path) -> None:
    first, second, _ = [row["batch"] for row in projects.sql(recorded, "SELECT batch FROM batches ORDER BY lamport")]
    found = answer(recorded, first[:8], second[:8], "--column", "coverage")
    assert [pair["point"] for pair in found["pairs"]] == [{"population_size": 2}]
    assert "left out, because not in all batches: 2 of 3 experiments" in found["notes"]
    assert found["pairs"][0]["verdict"] == "too few runs"


def test_a_pilot_says_how_many_runs_are_needed(compared: tuple[Path, str, str]) -> None:
    root, quiet, _ = compared
    done = projects.quick(root, "plan-n", quiet[:8], "--half-width", "1", "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)["experiments"]
    seeds = [row["seed"] for row in projects.sql(root, f"SELECT DISTINCT number, seed FROM batch_runs WHERE batch = '{quiet}'")]
    sd = statistics.stdev(0.1 * (seed % 100) for seed in seeds)
    assert [one["sd"] for one in found] == pytest.approx([sd, sd])
    assert all(one["pilot"] == 8 and one["runs"] < one["safe_runs"] for one in found)
    shown = projects.quick(root, "plan-n", quiet[:8], "-w", "1").stdout
    assert shown.endswith(f"for final coverage ± 1: --runs {found[0]['safe_runs']}\n")


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (("-w", "0"), 2, "the half-width of an interval must be a number above 0, not 0"),
        (("-w", "1", "--measure", "time_to", "--threshold", "13.5"), 2, "some runs never reached the threshold"),
        ((), 2, "name --half-width W, or what to compare"),
    ],
)
def test_a_pilot_without_an_answer_is_one_line(
    compared: tuple[Path, str, str], words: tuple[str, ...], code: int, message: str
) -> None:
    done = projects.quick(compared[0], "plan-n", compared[1][:8], *words)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (code, "", 1)
    assert message in done.stderr


STAMPS = """\
import sys
from random import Random

arena = open(sys.argv[1]).read()
count, seed = (int(arena.split(f'<{key}="')[1].split('"')[0]) for key in ("swarm count", "random seed"))
late = 4_000_000 * count + int(Random(seed * 10 + count).gauss(0, 1_000_000))
ok = Random(seed).random() < 0.25 * count
with open("swarm.csv", "w") as file:
    print("tick,stamp,exact,plain,ok", file=file)
    for tick in range(3):
        stamp = 1_764_000_000_000_000_000 + late + tick
        exact = f"{10**15 + late + tick}.25"
        print(tick, stamp, exact, late + tick, "true" if ok else "false", sep=",", file=file)
"""


WIDE = """
[tables.wide]
sql = '''
SELECT run, stamp::HUGEINT * 1000000 AS huge, stamp::UBIGINT AS large, stamp + 0.125::DECIMAL(24, 3) AS decimals FROM swarm
'''
"""


@pytest.fixture(scope="module")
def stamped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a project whose runs wrote nanoseconds since 1970, the same without an offset, and flags."""
    root = projects.make(tmp_path_factory.mktemp("stamped") / "project", projects.CONFIG + WIDE, simulator=STAMPS)
    for sets in ((), [("//noise", "0.2")]):
        sierra.open(root).run("population_size=1,2,3", runs=12, sets=sets, figures=False)
    return root


@pytest.mark.parametrize("words", [(), ("--measure", "mean"), ("--paired", "no"), ("--margin", "100", "--measure", "mean")])
@pytest.mark.parametrize("column", ["stamp", "exact"])
def test_numbers_that_no_float_holds_are_subtracted_before_they_are_rounded(
    stamped: Path, column: str, words: tuple[str, ...]
) -> None:
    """The last digits of 64-bit whole numbers, and those of decimals with a large offset, count as others do."""
    found, plain = (answer(stamped, "--by", "population_size", "--column", one, *words) for one in (column, "plain"))
    assert [pair["verdict"] for pair in plain["pairs"]] == ["different"] * 3
    for one, other in zip(found["pairs"], plain["pairs"], strict=True):
        for name in ("p", "p_adjusted", "p_equivalent", "a12", "verdict"):
            assert one[name] == other[name]
        for name in ("difference", "low", "high"):
            assert one[name] == pytest.approx(other[name], abs=0.01 if column == "stamp" else 0.5)


@pytest.mark.parametrize(("column", "factor"), [("huge", 1e6), ("large", 1), ("decimals", 1)])
def test_all_types_of_exact_numbers_keep_their_digits(stamped: Path, column: str, factor: float) -> None:
    words = ("--by", "population_size", "--groups", "1,2", "--measure", "mean")
    found, plain = (
        answer(stamped, *words, "--table", *names) for names in (("wide", "--column", column), ("swarm", "--column", "plain"))
    )
    (one,), (other,) = found["pairs"], plain["pairs"]
    assert (one["p"], one["difference"] / factor, one["low"] / factor) == pytest.approx(
        (other["p"], other["difference"], other["low"])
    )


@pytest.mark.nightly
def test_batches_of_such_numbers_are_compared_over_time_too(stamped: Path) -> None:
    """The runs of both batches wrote the same, so each difference is 0, whatever was subtracted from each batch."""
    first, second = [row["batch"] for row in projects.sql(stamped, "SELECT batch FROM batches ORDER BY lamport")]
    project = sierra.open(stamped)
    found, plain = (project.comparisons.make(first, second, column=one, over_time=True) for one in ("stamp", "plain"))
    for one, other in zip(found.bands, plain.bands, strict=True):
        assert (one.mean.tolist(), one.low.tolist()) == (other.mean.tolist(), other.low.tolist())
    found, plain = (
        project.studies.runs_for_power(first, by=["population_size"], groups=["1", "2"], column=one).comparisons[0].runs
        for one in ("stamp", "plain")
    )
    assert found == plain


def test_flags_are_compared_as_rates(stamped: Path) -> None:
    found = answer(stamped, "--by", "population_size", "--column", "ok", "--paired", "no")
    assert (found["method"], found["version"], [one["test"] for one in found["omnibus"]]) == (
        *("fisher", 2),
        ["Fisher-Freeman-Halton test"],
    )
    assert {pair["test"] for pair in found["pairs"]} == {"Fisher's exact test"}
    assert "(difference of rates " in found["text"]
    assert "median difference" not in found["text"]
    paired = answer(stamped, "--by", "population_size", "--column", "ok", "--paired", "yes")
    assert (paired["method"], paired["omnibus"][0]["test"]) == ("mcnemar", "Cochran's Q test")
    planned = projects.quick(stamped, "plan-n", "--by", "population_size", "--groups", "1,3", "--column", "ok", "--json")
    assert json.loads(planned.stdout)["comparisons"][0]["test"] == "McNemar's exact test"


def test_an_interval_of_one_of_several_pairs_says_so_in_tables_for_papers(compared: tuple[Path, str, str]) -> None:
    text = projects.quick(
        compared[0], "compare", compared[1][:8], compared[2][:8], "--format", "markdown", "--no-figure"
    ).stdout
    assert "95 % CI of each alone (not corrected for 2 pairs)" in text
    assert "Each interval is of one pair alone, not corrected for 2 pairs." in text


@pytest.mark.nightly
def test_a_comparison_by_another_version_is_not_computed_again(compared: tuple[Path, str, str], tmp_path: Path) -> None:
    made, first, second = compared
    root = stores.copy(made, tmp_path / "project")
    with pytest.MonkeyPatch.context() as older:
        for module in (check, comparison):
            older.setattr(module, "VERSION", 3)
        assert projects.quick(root, "compare", f"old={first}", f"new={second}", "--column", "coverage").returncode == 0
        checked = projects.quick(root, "figures", first, "--check")
        written = projects.quick(root, "report", first, "--to", str(tmp_path / "report.html"))
    said = "it is by version 2 of its method, and this SIERRA has version 3; draw it again with: sierra compare"
    assert (checked.returncode, said in checked.stdout) == (1, True)
    assert written.returncode == 0, written.stderr
    page = (tmp_path / "report.html").read_text()
    assert f"could not be made: {said}; its recorded figure is figures/comparisons/" in page
    assert "follows from the store" in projects.quick(root, "figures", first, "--check").stdout


@pytest.mark.parametrize("words", [(), ("--over-time",)])
def test_the_figure_is_recorded_and_follows_from_the_store_until_data_change(
    compared: tuple[Path, str, str], tmp_path: Path, words: tuple[str, ...]
) -> None:
    made, first, second = compared
    root = stores.copy(made, tmp_path / "project")
    done = projects.quick(root, "compare", f"old={first}", f"new={second}", "--column", "coverage", *words)
    assert done.returncode == 0, done.stderr
    figure = max(root.glob("figures/comparisons/*.pdf"), key=lambda path: path.stat().st_mtime)
    shown = json.loads(projects.quick(root, "show", str(figure), "--json").stdout)
    assert (shown["deliverable_kind"], shown["batches"], shown["problem"]) == ("comparison", [first, second], None)
    assert shown["definition"]["groups"] == ["old", "new"]
    assert "follows from the store" in projects.quick(root, "figures", first, "--check").stdout
    (execution,) = sierra.open(root).sql("SELECT min(execution) AS e FROM effective WHERE batch = $b", b=second).column("e")
    assert projects.quick(root, "rm", execution.as_py(), "--yes").returncode == 0
    checked = projects.quick(root, "figures", first, "--check")
    assert checked.returncode == 1
    assert f"{figure.stem}: the store has other data now" in checked.stdout


def test_the_option_that_names_the_output_is_asked_for(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "p", simulator=projects.SIMULATOR + "import shutil\nshutil.copy('swarm.csv', 'copy.csv')\n")
    projects.run(root, "population_size=1,2", "--runs", "2")
    refused = projects.quick(root, "compare", "--by", "population_size", "--no-figure")
    assert (refused.returncode, refused.stdout) == (2, "")
    assert "name the output: set table (--table) to one of copy, swarm" in refused.stderr
    words = ("--by", "population_size", "--table", "copy", "--no-figure")
    assert projects.quick(root, "compare", *words).returncode == 0

"""Numbers in the text of a paper: a macro for each of `[numbers.NAME]`, which is never empty."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import sierra
from sierra.config import project_file
from sierra.errors import ConfigError
from tests import projects

CONFIG = (
    projects.CONFIG
    + """
[queries.sizes]
criteria = "population_size=1,2"
runs = 8
[comparisons.sizes]
query = "sizes"
by = "population_size"
column = "coverage"
[claims.two]
says = "Two cover 8."
paper = "Sec. 1"
query = "population_size=2"
runs = 4
[claims.two.value]
column = "coverage"
experiments = "population_size=2"
expected = 8
margin = "50 %"
"""
)
NUMBERS = """
[numbers.mean]
query = "sizes"
statistic = "mean"
column = "coverage"
experiments = "population_size=2"
[numbers.meanci]
query = "sizes"
statistic = "mean"
column = "coverage"
experiments = "population_size=2"
value = "interval"
unit = "m"
[numbers.gain]
comparison = "sizes"
groups = ["population_size=1", "population_size=2"]
[numbers.loss]
comparison = "sizes"
groups = ["population_size=2", "population_size=1"]
[numbers.p]
comparison = "sizes"
value = "p"
[numbers.rows]
query = "sizes"
sql = "SELECT count(*) FROM swarm"
[numbers.part]
query = "sizes"
sql = "SELECT 0.123"
format = ".1%"
[numbers.word]
query = "sizes"
sql = "SELECT 'a_b & 5 %'"
[numbers.verdict]
claim = "two"
value = "verdict"
"""


def macros(folder: Path) -> dict[str, str]:
    text = (folder / "paper" / "sierra" / "numbers.tex").read_text()
    return dict(re.findall(r"(?m)^\\newcommand\{\\([A-Za-z]+)\}\{(.*?)\}(?: %.*)?$", text))


def value(text: str) -> float:
    return float(text.strip("$").replace("−", "-"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = projects.make(tmp_path_factory.mktemp("numbers") / "project", CONFIG + NUMBERS)
    done = projects.quick(made, "paper")
    assert done.returncode == 0, done.stderr
    return made


@pytest.mark.integration
def test_each_number_is_a_macro(folder: Path) -> None:
    found = macros(folder)
    shown = projects.quick(folder, "stats", "swarm", "coverage", "--json").stdout
    assert shown, "the query of the claim was executed, too"
    assert found["sierraruns"] == "16", "runs that two batches have in common count once"
    assert found["sierrafailedruns"] == "0"
    assert found["sierraseeds"] == "8"
    assert found["sierrarows"] == "80"
    assert found["sierrapart"] == r"12.3\%"
    assert found["sierraword"] == r"a\_b \& 5 \%"
    assert found["sierraverdict"] in ("holds", "does not hold", "can't tell")
    low, high = map(float, re.fullmatch(r"\[(.+), (.+)\]~m", found["sierrameanci"]).groups())  # type: ignore[union-attr]
    assert low < value(found["sierramean"]) < high
    assert value(found["sierragain"]) == -value(found["sierraloss"]) > 0
    assert re.fullmatch(r"\$p (= 0\.\d+|< 0\.001)\$", found["sierrap"])
    assert "SELECT count(*) FROM swarm" in (folder / "paper" / "sierra" / "sql" / "numbers.sql").read_text()
    assert projects.quick(folder, "paper", "--check").returncode == 0
    shown = projects.quick(folder, "show", "paper/sierra/numbers.tex").stdout
    assert "follows from the store" in shown


@pytest.mark.integration
@pytest.mark.parametrize(
    ("number", "message"),
    [
        ('query = "sizes"\nstatistic = "mean"\ncolumn = "coverage"', "experiments = '' are 2, but a number is that of one"),
        ('query = "sizes"\nstatistic = "mean"\ncolumn = "nope"\nexperiments = "population_size=1"', "nope"),
        ('query = "sizes"\nsql = "SELECT * FROM swarm"', "a number is one row and one column"),
        ('query = "sizes"\nsql = "SELECT NULL"', "it has no value"),
        ('query = "sizes"\nsql = "SELECT 1"\nvalue = "interval"', "it has no interval"),
        ('comparison = "nope"', "no comparison 'nope' is bound to queries"),
        ('comparison = "sizes"\ngroups = ["a", "b"]', "there is no group 'a'"),
        ('claim = "nope"', "sierra.toml has no [claims.nope]"),
    ],
)
def test_a_number_that_cannot_be_computed_is_an_error(tmp_path: Path, number: str, message: str) -> None:
    made = projects.make(tmp_path / "p", CONFIG.replace("runs = 8", "runs = 2") + f"[numbers.x]\n{number}\n")
    done = projects.quick(made, "paper")
    assert done.returncode in (1, 2)
    assert "number x: " in done.stderr
    assert message in done.stderr
    assert not (made / "paper").exists()


@pytest.mark.parametrize(
    ("name", "number", "message"),
    [
        ("best_1", 'claim = "two"', "best_1"),
        ("best", 'claim = "two"\nsql = "SELECT 1"', "give exactly one of claim, comparison, statistic, sql; not claim and sql"),
        ("best", "", "give exactly one of"),
        ("best", 'sql = "SELECT 1"', '"sql" needs one "query"'),
        ("best", 'claim = "two"\nquery = "sizes"', 'leave out "query"'),
        ("best", 'query = "sizes"\nsql = "SELECT 1"\nvalue = "p"', 'value = "p" needs'),
        ("best", 'claim = "two"\ncolumn = "x"', '"column" needs "statistic"'),
        ("best", 'claim = "two"\nformat = "nope"', "is not a format of numbers"),
        ("best", 'claim = "two"\ngroups = ["a", "b"]', '"groups" are the two groups of a "comparison"'),
    ],
)
def test_keys_that_do_not_fit_are_refused(tmp_path: Path, name: str, number: str, message: str) -> None:
    made = projects.make(tmp_path / "p", CONFIG + f"[numbers.{name}]\n{number}\n")
    with pytest.raises(ConfigError, match=re.escape(message)):
        project_file.load(made)


@pytest.mark.integration
def test_the_id_of_the_package_is_a_macro(folder: Path, tmp_path: Path) -> None:
    here = shutil.copytree(folder, tmp_path / "project", symlinks=True)
    config, numbers = here / "sierra.toml", here / "paper" / "sierra" / "numbers.tex"
    config.write_text(config.read_text() + '[package]\ntitle = "T"\nauthors = [{ name = "Jane Doe" }]\nlicense = "MIT"\n')
    batch = next(iter(sierra.open(here).batches)).batch
    packed = sierra.open(here).packages.pack(batch, report=False, path=tmp_path / "x.zip")
    assert packed
    assert "sierrapackage" not in macros(here)
    config.write_text(config.read_text() + '[paper]\npackage = "../x.zip"\n')
    assert projects.quick(here, "paper", "--check").returncode == 1
    with zipfile.ZipFile(tmp_path / "x.zip") as file:
        file.extractall(tmp_path / "x")
    told = subprocess.run([sys.executable, tmp_path / "x/reproduce.py"], check=True, capture_output=True, text=True).stdout
    before = numbers.read_bytes()
    for text, status, message in (("../nope.zip", 3, "[paper] package: "), ("../y", 1, "y: member 'README.md' is not what")):
        config.write_text(config.read_text().replace("../x.zip", text))
        if text == "../y":
            shutil.copytree(tmp_path / "x", tmp_path / "y")
            (tmp_path / "y" / "README.md").write_text("damaged")
        for words in (("paper",), ("paper", "--check")) if text == "../y" else (("paper",),):
            done = projects.quick(here, *words)
            assert (done.returncode, message in done.stderr, done.stderr.count("\n")) == (status, True, 1), done.stderr
        assert numbers.read_bytes() == before
        if text == "../nope.zip":  # all else is checked
            numbers.write_text("edited")
            done = projects.quick(here, "paper", "--check")
            assert (done.returncode, "was edited" in done.stdout, "nope.zip does not exist; make it" in done.stdout) == (
                1,
                True,
                True,
            )
            numbers.write_bytes(before)
        config.write_text(config.read_text().replace(text, "../x.zip"))
    for place in ("../x.zip", "../x"):
        config.write_text(config.read_text().replace("../x.zip", place))
        done = projects.quick(here, "paper")
        assert done.returncode == 0, done.stderr
        assert f"id:      {macros(here)['sierrapackage']} " in told
        assert "follows from the store" in projects.quick(here, "show", "paper/sierra/numbers.tex").stdout
        assert projects.quick(here, "paper", "--check").returncode == 0


@pytest.mark.integration
def test_the_name_of_the_package_is_no_name_of_a_number(tmp_path: Path) -> None:
    made = projects.make(tmp_path / "project", CONFIG + NUMBERS.replace("[numbers.word]", "[numbers.package]"))
    done = projects.quick(made, "paper", "-n")
    assert (done.returncode, "[numbers.package] is the name of a macro" in done.stderr) == (2, True), done.stderr

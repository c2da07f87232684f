"""`sierra reproduce` makes figures, tables, comparisons and numbers from the reproduced runs, beside those of the package."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.browser import INJECTED, Browser
from tests.conftest import Simulated

pytestmark = pytest.mark.integration

TOML = """
[queries.main]
criteria = "size=1,2"
runs = 6
[figures.final]
query = "main"
kind = "summary"
column = "v"
formats = ["svg"]
[paper_tables.means]
query = "main"
column = "v"
[comparisons.sizes]
query = "main"
by = "size"
column = "v"
[claims.small]
says = "The values of size 1 are small."
figure = "final"
query = "main"
[claims.small.value]
column = "v"
experiments = "size=1"
expected = 0.0
margin = 200.0
[numbers.mean]
query = "main"
statistic = "mean"
column = "v"
experiments = "size=1"
format = ".0f"
[package]
title = "x"
authors = [{ name = "A B" }]
license = "MIT"
"""
SIMULATOR = """
seed=$(sed -n 's/.*seed="\\([0-9]*\\)".*/\\1/p' "$1")
size=$(sed -n 's/.*size="\\([0-9]*\\)".*/\\1/p' "$1")
factor=$(cat '{factor}')
name=$([ "$factor" = none ] && echo other || echo v)
[ "$factor" = none ] && factor=1
printf 't,%s\\n1,%s\\n' "$name" "$(((seed % 100 + 9 * size) * factor))" > swarm.csv
"""


@pytest.fixture
def packed(simulate: Callable[..., Simulated], tmp_path: Path) -> Simulated:
    """Return a project whose simulator reads a factor outside of it, with the package `x.zip`."""
    (tmp_path / "factor").write_text("1")
    project = simulate(SIMULATOR.format(factor=tmp_path / "factor"))
    file = project.folder / "sierra.toml"
    file.write_text(file.read_text() + TOML)
    ran = project.quick("run", "main", "--json")
    assert ran.returncode == 0, ran.stderr
    done = project.quick("package", json.loads(ran.stdout)["batch"], "--yes", "-o", str(tmp_path / "x.zip"))
    assert done.returncode == 0, done.stderr
    return project


def reproduced(project: Simulated, tmp_path: Path, code: int) -> tuple[dict[str, Any], str]:
    done = project.quick("reproduce", str(tmp_path / "x.zip"), "--into", str(tmp_path / "new"), "--yes", "--json")
    assert done.returncode == code, done.stdout + done.stderr
    return json.loads(done.stdout), (tmp_path / "new/index.html").read_text()


def test_the_same_values_are_shown_beside_the_packed_picture(packed: Simulated, tmp_path: Path) -> None:
    answer, page = reproduced(packed, tmp_path, 0)
    assert {(one["kind"], one["name"], one["same"], one["problem"]) for one in answer["drawn"]} == {
        ("figure", "final", True, ""),
        ("table", "means", True, ""),
        ("comparison", "sizes", True, ""),
    }
    assert "3 of 3 figures, tables and comparisons made from them" in answer["verdict"]
    assert answer["numbers"]["mean"]["recorded"] == answer["numbers"]["mean"]["reproduced"]
    assert "final.svg in the package" in page
    assert page.count("data:image/svg+xml;base64,") == 4
    assert not re.search(r"""(src|href)="(?!data:|#)""", page)


@pytest.mark.real
def test_the_page_fits_a_wide_and_a_narrow_window(packed: Simulated, tmp_path: Path, require: Callable[..., str]) -> None:
    reproduced(packed, tmp_path, 0)
    page = tmp_path / "new/index.html"
    with Browser(require("chromium"), tmp_path / "profile") as browser:
        for width in (1280, 390):
            browser.open(page, width=width)
            assert browser.console == []
            assert [url for url in browser.requests if not url.startswith("data:")] == [page.as_uri()]
            assert browser.run("document.documentElement.scrollWidth") == width
            assert browser.run("[...document.images].every(image => image.naturalWidth > 0)")
        beside = "[...document.querySelectorAll('#figures .figures')].map(one => getComputedStyle(one).gridTemplateColumns)"
        assert all(len(columns.split()) == 1 for columns in browser.run(beside))
        assert browser.run(INJECTED) == ["script-src-attr", "script-src-elem", 0]


def test_other_values_are_named_with_their_difference(packed: Simulated, tmp_path: Path) -> None:
    (tmp_path / "factor").write_text("100")
    answer, page = reproduced(packed, tmp_path, 1)
    drawn = {one["name"]: one for one in answer["drawn"]}
    assert [one["same"] for one in drawn.values()] == [False, False, False]
    assert re.fullmatch(r".* of v: at most \S+ \(9\.9e\+03 %\)", drawn["final"]["difference"])
    before, now = (float(answer["numbers"]["mean"][side]) for side in ("recorded", "reproduced"))
    assert now == pytest.approx(100 * before, abs=60)
    [claim] = answer["claims"]
    assert claim["verdict"] == "does not hold"
    assert page.index("holds</strong>") < page.index("does not hold</strong>")
    assert "other values" in page


def test_a_figure_of_several_queries_is_made_from_all_their_reproduced_runs(packed: Simulated, tmp_path: Path) -> None:
    more = '[queries.more]\ncriteria = "size=1,2"\nruns = 7\n[figures.both]\nquery = ["main", "more"]\nkind = "summary"\n'
    file = packed.folder / "sierra.toml"
    file.write_text(file.read_text() + more + 'column = "v"\n')
    for query in ("main", "more"):
        assert packed.quick("run", query, "--no-figures").returncode == 0
    batches = [row["batch"] for row in packed.sql("SELECT batch FROM batches")]
    (tmp_path / "x.zip").unlink()
    assert packed.quick("package", *batches, "--yes", "-o", str(tmp_path / "x.zip")).returncode == 0
    for factor, same in (("1", True), ("100", False)):
        (tmp_path / "factor").write_text(factor)
        words = ("reproduce", str(tmp_path / "x.zip"), "--into", str(tmp_path / factor), "--yes", "--json")
        drawn = {one["name"]: one for one in json.loads(packed.quick(*words).stdout)["drawn"]}
        assert (drawn["both"]["same"], drawn["both"]["problem"], set(drawn["both"]["batches"])) == (same, "", set(batches))


def test_a_figure_that_cannot_be_made_is_no_reproduction(packed: Simulated, tmp_path: Path) -> None:
    (tmp_path / "factor").write_text("none")
    answer, page = reproduced(packed, tmp_path, 1)
    drawn = {one["name"]: one for one in answer["drawn"]}
    assert not drawn["final"]["reproduced"]
    assert drawn["final"]["problem"].startswith("the reproduced runs: ")
    assert "not made" in page


def test_what_rests_on_runs_that_were_left_out_is_not_made(packed: Simulated, tmp_path: Path) -> None:
    (tmp_path / "factor").write_text("100")
    [row] = packed.sql("SELECT min(wall_s) AS shortest FROM executions")
    budget = f"{1.01 * row['shortest']:.6f}s"
    words = (
        "reproduce",
        str(tmp_path / "x.zip"),
        "--into",
        str(tmp_path / "new"),
        "--yes",
        "-j",
        "1",
        "--budget",
        budget,
        "--json",
    )
    answer = json.loads(packed.quick(*words).stdout)
    assert answer["left_out"]
    assert (answer["drawn"], answer["numbers"]) == ([], {})
    assert not (tmp_path / "new/index.html").exists()

"""Undeclared files become tables of their names; no two names become one table, and recorded tables keep theirs."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable
from pathlib import Path

import pytest

import sierra
from sierra.ingest.match_outputs import OutputMatcher
from sierra.model import OutputFile
from tests import projects

Names = list[tuple[str, str]]


def named(paths: Iterable[str], recorded: Iterable[tuple[str, str | None]] = ()) -> tuple[Names, OutputMatcher]:
    """Return the names of tables and their files for one execution with these files, and the matcher."""
    matcher = OutputMatcher({}, {}, lambda: recorded)
    result = type("", (), {"outputs": tuple(OutputFile(path, 0, "", 0, True, "") for path in paths), "robots": {}})()
    return [(name, file.path) for name, _, file in matcher.of(result)], matcher


@pytest.mark.parametrize(
    ("path", "name"),
    [
        ("é.csv", "é"),
        (unicodedata.normalize("NFD", "é.csv"), "é"),
        ("日本-1.csv", "日本_1"),
        ("_.csv", "_"),
        ("2 Grad°.csv", "_2_Grad_"),
    ],
)
def test_names_keep_letters_and_digits_of_any_script(path: str, name: str) -> None:
    assert named([path])[0] == [(name, path)]


@pytest.mark.parametrize(
    ("first", "second", "names"),
    [
        ("A.csv", "a.csv", ["A", "a_2"]),
        ("a b.csv", "a_b.csv", ["a_b", "a_b_2"]),
        ("É.csv", "é.csv", ["É", "é_2"]),
        ("a_2.csv", "A.csv", ["a_2", "A"]),
    ],
)
def test_files_whose_names_clash_become_two_tables(first: str, second: str, names: list[str]) -> None:
    found, matcher = named([first])
    assert (found, matcher.renamed) == ([(names[0], first)], {})
    found, matcher = named([first, second])
    assert sorted(found, key=lambda one: one[1] != first) == [(names[0], first), (names[1], second)]
    note = f"{second!r} makes the table {names[1]!r}, because the table {names[1][:-2]!r} is that of {Path(first).stem!r}"
    assert list(matcher.renamed.values()) == ([note] if names[1].endswith("_2") else [])


def test_recorded_tables_keep_their_names() -> None:
    assert named(["é.csv"], [("é.csv", "_")])[0] == [("_", "é.csv")]
    assert named(["a.csv"], [("A.csv", "A"), ("a.csv", "a_2")])[0] == [("a_2", "a.csv")]
    assert named(["a.csv"], [("A.csv", "A")])[0] == [("a_2", "a.csv")]
    assert named(["A.csv", "a.csv"], [("A.csv", "A"), ("a.csv", None)])[0] == [("A", "A.csv")]
    assert named(["a.csv"], [("a.csv", "declared")])[0] == [("a", "a.csv")]


@pytest.mark.nightly
def test_tables_of_two_experiments_with_clashing_names_stay_apart(tmp_path: Path) -> None:
    writes = """\
import sys
n = int(open(sys.argv[1]).read().split('count="')[1].split('"')[0])
open({1: "é.csv", 2: "_.csv", 3: "É.csv"}[n], "w").write("v\\n1,234\\n2,345\\n")
"""
    project = sierra.open(projects.make(tmp_path / "p", simulator=writes.replace('"v\\n1,234\\n2,345\\n"', 'f"v\\n{n}\\n"')))
    for n in (1, 2, 3):
        assert project.run(f"population_size={n}", figures=False).failed == 0
    tables = {"é": 1, "_": 2, "É_2": 3}
    for table, n in tables.items():
        assert set(project.sql(f'SELECT v FROM "{table}"').column(0).to_pylist()) == {n}
    assert project.maintenance.fsck().findings == ()
    assert projects.quick(project.root, "outputs", "--write").returncode == 0
    assert set(sierra.open(project.root).sql("SELECT v FROM É_2").column(0).to_pylist()) == {3}


@pytest.mark.integration
@pytest.mark.parametrize(
    ("cells", "said"),
    [
        (
            "1,234 2,345",
            "'1,234' can be 1234, with a separator of thousands, or 1.234, with a decimal comma; write '1234' or '1.234'",
        ),
        ("1,234 2,5", 'its numbers have a decimal comma ([outputs.t] file = "t.csv", decimal = "," reads them)'),
        ("1,234 1,234,567", "write '1,234,567' without separators between digits"),
    ],
)
def test_both_readings_of_a_comma_are_named(tmp_path: Path, cells: str, said: str) -> None:
    writes = f"open('t.csv', 'w').write('i;v\\n' + ''.join(f'{{i}};{{v}}\\n' for i, v in enumerate({cells.split()!r})))"
    root = projects.make(tmp_path / "p", simulator=writes)
    assert said in projects.quick(root, "run", "population_size=1", "--no-figures").stderr

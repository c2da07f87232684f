"""DuckDB reads exactly the named files: it derives no column, pattern or format from a path."""

from __future__ import annotations

import ast
import os
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

import sierra
from sierra.errors import Missing
from sierra.ingest.model import Shape, Written
from sierra.ingest.read import read
from sierra.store import duckdb_file_io
from sierra.store.connections import Connection, connect
from sierra.store.store import Store
from tests import projects

PACKAGE = Path(sierra.__file__).parent
DOOR = PACKAGE / "store" / "duckdb_file_io.py"
READS = re.compile(
    r"(?i:\b(?:read_(?!only)\w+|parquet_\w+|sniff_csv|glob|\w+_scan)\s*\()|\bCOPY\s+[(\w]|\bATTACH\s+'|\b(?:FROM|JOIN)\s+'"
)
GUESSES = re.compile(r"\b(?:read_table|ParquetDataset|write_to_dataset|pyarrow\.dataset|pyarrow import dataset)\b")
ODD_FOLDERS = (
    "v=7/p",
    "n=3",
    "run=zzz",
    "c1=77",
    "[x]",
    "a*b",
    "w?",
    "{a,b}",
    "b\\[c]",
    "quo'te",
    "new\nline",
    "-d",
    "~h",
    "ü x",
)
ODD_NAMES = (
    "robot[0]",
    "q*",
    "w?",
    "{a,b}",
    "v=7",
    "a b",
    "quo'te\"",
    "new\nline",
    "-lead",
    "b\\c",
    "b\\[",
    "ü",
    "[!r]",
    "~",
    "#1",
    "%41",
)
WRITES = """\
import sys
seed = int(open(sys.argv[1]).read().split('<random seed="')[1].split('"')[0])
for place, name in enumerate({names!r}):
    with open(name + ".csv", "w") as file:
        print("v,c1", *(f"{{1000 * place + row}},{{row}}" for row in range(place + 1)), sep="\\n", file=file)
"""


def _texts(path: Path) -> Iterator[str]:
    """Yield the string constants of a module, except docstrings."""
    tree = ast.parse(path.read_text())
    prose = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in prose:
            yield node.value


def _sql() -> Iterator[tuple[Path, str]]:
    """Yield all strings of the package that may be SQL."""
    for path in sorted(PACKAGE.rglob("*.sql")):
        yield path, re.sub("--.*", "", path.read_text())
    for path in sorted(PACKAGE.rglob("*.py")):
        yield from ((path, text) for text in _texts(path))


@pytest.mark.integration
def test_only_the_module_duckdb_file_io_names_functions_that_read_files() -> None:
    found = {(path.relative_to(PACKAGE), text) for path, text in _sql() if path != DOOR and READS.search(text)}
    assert found == set()


def test_every_automatic_detection_of_duckdb_is_turned_off_explicitly() -> None:
    scan = ("hive_partitioning = false", "hive_types_autocast = false", "union_by_name = ")
    text = ("compression = 'none'", "ignore_errors = false")
    assert all(word in duckdb_file_io.read_parquet(["/a"]) for word in (*scan, "filename = false", "file_row_number = false"))
    assert all(word in duckdb_file_io.parquet_given("# file") for word in scan)
    csv = duckdb_file_io.csv_given({"c0": "VARCHAR"}, "# file", delimiter=",", header=True)
    assert all(word in csv for word in (*scan, *text, "auto_detect = false", "null_padding = false"))
    assert all(word in duckdb_file_io.objects_given("# file") for word in (*scan, *text, "format = 'newline_delimited'"))
    assert all(
        word in duckdb_file_io.copy("SELECT 1", Path("/a")) for word in ("PER_THREAD_OUTPUT false", "PRESERVE_ORDER true")
    )


def test_pyarrow_never_reads_folders_as_data_sets() -> None:
    assert [path for path in PACKAGE.rglob("*.py") if GUESSES.search(path.read_text())] == []


def _written(folder: Path, name: str, lines: int) -> Written:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / name
    path.write_text("v\n" + "".join(f"{row}\n" for row in range(lines)))
    return Written(str(path), "r", name, name, "v", lines + 1, True, path.stat().st_size)


NAMES = st.text(st.sampled_from("ab0*?[]{}!=\\'\" \n~-^,%#ü"), min_size=1, max_size=8).filter(
    lambda name: name not in (".", "..")
)


@pytest.mark.nightly
@settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(folder=NAMES, names=st.sets(NAMES, min_size=1, max_size=4))
@example(folder="v=7", names={"robot[0]", "robot0", "robot[!1]", "robot*"})
@example(folder="[!a]", names={"a\\[b", "a\\*", "**", "?"})
def test_the_number_of_read_rows_equals_the_number_of_written_ones(
    tmp_path_factory: pytest.TempPathFactory, folder: str, names: set[str]
) -> None:
    root = tmp_path_factory.mktemp("odd") / folder
    files = [_written(root / "out=1", name, 2 + place) for place, name in enumerate(sorted(names))]
    target = root / "segment" / "output.t.parquet"
    target.parent.mkdir()
    connection = connect()
    reading = read(connection, files, Shape("csv", many=True), target)
    assert reading.faults == {}
    assert reading.rows == {(name, name): 2 + place for place, name in enumerate(sorted(names))}
    stored = f"SELECT file, count(*), max(filename) FROM {duckdb_file_io.read_parquet([str(target)], filename=True)} GROUP BY 1"
    assert {row[0]: row[1:] for row in connection.execute(stored).fetchall()} == {
        name: (2 + place, str(target)) for place, name in enumerate(sorted(names))
    }
    assert {path.name for path in target.parent.iterdir()} == {target.name}
    connection.close()


@pytest.mark.parametrize("name", ["plain", "[x]", "a*b", "b\\[c]"])
def test_a_connection_reads_only_its_own_folder_for_any_folder_name(tmp_path: Path, name: str) -> None:
    import duckdb

    mine, other = tmp_path / name / "segments", tmp_path / "other"
    for folder in (mine, other):
        folder.mkdir(parents=True)
        connect().execute(duckdb_file_io.copy("SELECT 1 AS a", folder / "a.parquet"))
    connection = Connection(mine)
    assert connection.cursor.execute(f"FROM {duckdb_file_io.read_parquet([str(mine / 'a.parquet')])}").fetchall() == [(1,)]
    with pytest.raises(duckdb.Error):
        connection.cursor.execute(f"FROM {duckdb_file_io.read_parquet([str(other / 'a.parquet')])}")
    connection.close()


def test_a_folder_that_replaced_another_is_read(tmp_path: Path) -> None:
    for number in (1, 2):
        folder = tmp_path / "[x]"
        folder.mkdir()
        connect().execute(duckdb_file_io.copy(f"SELECT {number} AS a", folder / "a.parquet"))
        found = connect().execute(f"FROM {duckdb_file_io.read_parquet([str(folder / 'a.parquet')])}").fetchall()
        assert found == [(number,)]
        folder.rename(tmp_path / f"old {number}")


def test_a_store_is_refused_in_a_folder_whose_name_duckdb_cannot_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(
        Missing, match=r"p\\xff/.sierra: a store cannot be in a folder whose name is not UTF-8; rename the folder"
    ):
        Store.create(Path(os.fsdecode(bytes(tmp_path) + b"/p\xff/.sierra")))
    monkeypatch.setattr(duckdb_file_io, "OPEN", str(tmp_path / "nowhere"))
    with pytest.raises(
        Missing, match=r"\[x\]/.sierra: cannot be read under this name here; rename files or folders with one of"
    ):
        Store.create(tmp_path / "[x]" / ".sierra")
    assert list(tmp_path.iterdir()) == []


def test_the_folder_of_temporary_files_may_have_any_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = Path(os.fsdecode(bytes(tmp_path) + b"/[t] \xff"))
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    files = [_written(tmp_path / "out", "a*b", 3)]
    target = tmp_path / "output.t.parquet"
    assert read(connect(), files, Shape("csv"), target).rows == {("a*b", "a*b"): 3}
    assert list(folder.iterdir()) == []


def _check(root: Path, names: tuple[str, ...]) -> None:
    """Execute two runs that write these files, and compare SQL, statistics and fsck with the files."""
    config = projects.CONFIG + '[outputs.odd]\nfile = "*.csv"\nmismatch = "ragged"\n'
    project = sierra.open(projects.make(root, config, simulator=WRITES.format(names=names)))
    summary = project.run("population_size=1")
    assert (summary.runs, summary.failed) == (2, 0), summary
    rows = project.sql("SELECT file, count(*) AS n, min(v) AS low, max(c1) AS high FROM odd GROUP BY 1").to_pylist()
    assert {row["file"]: (row["n"], row["low"], row["high"]) for row in rows} == {
        f"{name}.csv": (2 * (place + 1), 1000 * place, place) for place, name in enumerate(names)
    }
    report = project.maintenance.fsck()
    assert report.findings == (), report
    assert {one.verdict for one in project.replay(summary.batch, runs=1).experiments} == {"identical"}


@pytest.mark.nightly
def test_odd_names_of_outputs_do_not_change_results(tmp_path: Path) -> None:
    _check(tmp_path / "p", ("robot0", *ODD_NAMES))


@pytest.mark.integration
@pytest.mark.parametrize("folder", ["v=7/p", "[x]"])
def test_odd_names_of_folders_do_not_change_results(tmp_path: Path, folder: str) -> None:
    _check(tmp_path / folder, ("robot0", "robot[0]"))


@pytest.mark.nightly
@pytest.mark.parametrize("folder", ODD_FOLDERS)
def test_more_odd_names_of_folders_do_not_change_results(tmp_path: Path, folder: str) -> None:
    _check(tmp_path / folder, ("robot0", "robot[0]"))


INSIDE = """\
import os
os.makedirs("b=77/[0]")
for name in ("b=77/x.jsonl", "b=77/[0]/x.jsonl"):
    with open(name, "w") as file:
        print('{"a": 1, "b": 2}', file=file)
"""


@pytest.mark.nightly
def test_folders_within_the_output_folder_give_no_columns(tmp_path: Path) -> None:
    config = projects.CONFIG + '[outputs.x]\nfile = "*.jsonl"\n'
    project = sierra.open(projects.make(tmp_path / "p", config, simulator=INSIDE))
    project.run("population_size=1", figures=False)
    rows = project.sql("SELECT DISTINCT a, b, file FROM x ORDER BY file").to_pylist()
    assert rows == [{"a": 1, "b": 2, "file": "b=77/[0]/x.jsonl"}, {"a": 1, "b": 2, "file": "b=77/x.jsonl"}]

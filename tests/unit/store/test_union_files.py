"""Columns with numbers in some files and other values in others: numbers stay numbers, and no value is lost."""

from __future__ import annotations

import sys
from collections.abc import Callable
from decimal import Decimal
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import sierra
from sierra.api import Project
from sierra.errors import UsageError
from sierra.store.connections import connect
from sierra.store.union_files import Relation, relation
from tests import projects

WRITES = """\
import sys
arena = open(sys.argv[1]).read()
count = int(arena.split('<swarm count="')[1].split('"')[0])
cells = {cells!r}[count]
with open("t.csv", "w") as file:
    print("row,v", *(f"{{row}},{{cell}}" for row, cell in enumerate(cells)), sep="\\n", file=file)
"""


def _made(root: Path, cells: dict[int, list[str]], *queries: str) -> tuple[Project, list[str]]:
    """Return a project whose runs write these cells, by the number of robots, and the batches of the queries."""
    project = sierra.open(projects.make(root, simulator=WRITES.format(cells=cells)))
    return project, [project.run(query, figures=False).batch for query in queries]


CELLS = {1: ["7.5", "1000", "30"], 2: ["7.5", "NA", "1e5"]}


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> tuple[Project, list[str]]:
    """Return a project with a batch of numbers and a batch with one cell NA."""
    return _made(tmp_path_factory.mktemp("two") / "p", CELLS, "population_size=1", "population_size=2")


@pytest.mark.integration
def test_numbers_of_a_batch_stay_numbers_if_another_batch_has_texts(two: tuple[Project, list[str]]) -> None:
    project, (numbers, texts) = two
    assert project.sql("SELECT max(v) AS m FROM t", within=numbers).to_pylist() == [{"m": 1000.0}]
    ordered = project.sql("SELECT DISTINCT v FROM t ORDER BY v", within=numbers).column(0).to_pylist()
    assert ordered == [7.5, 30.0, 1000.0]
    assert project.sql("SELECT DISTINCT v FROM t ORDER BY v", within=texts).column(0).to_pylist() == ["1e5", "7.5", "NA"]
    assert project.statistics(numbers, "t", "v", measure="mean").column("mean").to_pylist() == pytest.approx([1037.5 / 3])


@pytest.mark.integration
def test_numbers_and_texts_of_all_batches_are_in_separate_columns(two: tuple[Project, list[str]]) -> None:
    project, _ = two
    rows = project.sql("SELECT DISTINCT v, v_text FROM t ORDER BY ALL").to_pylist()
    beside = [(7.5, "7.5"), (7.5, None), (30.0, None), (1000.0, None), (100000.0, "1e5"), (None, "NA")]
    assert [(row["v"], row["v_text"]) for row in rows] == beside
    assert project.sql("SELECT avg(v) AS m FROM t").column(0).to_pylist() == pytest.approx([(1037.5 + 100007.5) / 5])


@pytest.mark.nightly
def test_a_note_reports_a_column_of_mixed_types(two: tuple[Project, list[str]]) -> None:
    project, (numbers, _) = two
    told = "note: column 'v' of t has numbers in some runs and other values in others; the other values are in 'v_text'\n"
    asked = projects.quick(project.root, "sql", "SELECT max(v) FROM t")
    assert (asked.returncode, asked.stderr) == (0, told)
    assert projects.quick(project.root, "sql", "-b", numbers[:12], "SELECT max(v) FROM t").stderr == ""
    assert projects.quick(project.root, "sql", "SHOW TABLES").stderr == ""
    assert projects.quick(project.root, "sql", "SELECT run FROM runs").stderr == ""


@pytest.mark.nightly
def test_texts_in_one_experiment_do_not_change_the_numbers_of_others(tmp_path: Path) -> None:
    project, [batch] = _made(tmp_path / "p", CELLS, "population_size=1,2")
    assert project.sql("SELECT max(v) AS m FROM t", within=batch).to_pylist() == [{"m": 100000.0}]
    with pytest.raises(UsageError, match="'v' of output 't' has numbers in some runs and other values in others"):
        project.statistics(batch, "t", "v")
    files, notes = project.deliverables.draw(batch)
    assert not [file for file in files if "_v_" in file.name]
    assert [note for note in notes if "'v'" in note] == [
        "no figure of column 'v' of output 't': it has numbers in some runs and other values in others"
    ]


@pytest.mark.nightly
def test_axes_of_a_batch_keep_their_type_if_another_batch_has_texts(tmp_path: Path) -> None:
    config = projects.CONFIG.replace('noise = "//noise"\n', 'noise = "//noise"\nname = "//name"\n')
    template = projects.TEMPLATE.replace("<noise>", "<name>x</name><noise>")
    project = sierra.open(projects.make(tmp_path / "p", config, template=template))
    numbers, texts = (project.run(query, figures=False).batch for query in ("name=5,10", "name=low,high"))
    rows = project.sql("SELECT DISTINCT name FROM swarm ORDER BY 1", within=numbers)
    assert rows.column(0).to_pylist() == [5, 10]
    assert [row.values["name"] for row in project.records.show(numbers).experiments] == [5, 10]
    assert [row.values["name"] for row in project.records.show(texts).experiments] == ["low", "high"]
    table = project.statistics(numbers, "swarm", "coverage")
    assert table.column("name").to_pylist() == [5, 10]
    everywhere = project.sql("SELECT DISTINCT name, name_text FROM runs ORDER BY ALL").to_pylist()
    assert [(row["name"], row["name_text"]) for row in everywhere] == [(5, None), (10, None), (None, "high"), (None, "low")]


# ---------------------------------------------------------------- types of files


@pytest.fixture
def merged(tmp_path: Path) -> Callable[..., tuple[Relation, list[tuple[Any, ...]]]]:
    """Return a function that reads files with a column v of given values: the relation, and its rows in order."""

    def merged(*columns: pa.Array, where: str = "true") -> tuple[Relation, list[tuple[Any, ...]]]:
        files = [str(tmp_path / f"{place}.parquet") for place in range(len(columns))]
        for file, column in zip(files, columns, strict=True):
            pq.write_table(pa.table({"v": column, "place": pa.array([files.index(file)] * len(column))}), file)
        connection = connect()
        found = relation(lambda text: connection.execute(text).fetchall(), files, where)
        names = [name for name in found.types if name != "place"]
        rows = connection.execute(f"SELECT {', '.join(names)} FROM {found.sql} ORDER BY place").fetchall()
        connection.close()
        return found, rows

    return merged


GREAT = 2**53 + 1


@pytest.mark.parametrize(
    ("columns", "kind", "rows"),
    [
        ([pa.array([1]), pa.array([0.5])], "DOUBLE", [(1.0,), (0.5,)]),
        ([pa.array([GREAT]), pa.array([0.5])], "DOUBLE", [(float(GREAT), str(GREAT)), (0.5, None)]),
        ([pa.array([GREAT]), pa.array([0.5], pa.float32())], "DOUBLE", [(float(GREAT), str(GREAT)), (0.5, None)]),
        ([pa.array([GREAT]), pa.array([1e20])], "DOUBLE", [(float(GREAT), str(GREAT)), (1e20, None)]),
        ([pa.array([GREAT]), pa.array([-(2.0**63)])], "BIGINT", [(GREAT,), (-(2**63),)]),
        ([pa.array([GREAT]), pa.array([2.0**63])], "DOUBLE", [(float(GREAT), str(GREAT)), (2.0**63, None)]),
        ([pa.array([2**64 - 1], pa.uint64()), pa.array([1e19])], "UBIGINT", [(2**64 - 1,), (10**19,)]),
        ([pa.array([2**64 - 1], pa.uint64()), pa.array([-5.0])], "DOUBLE", [(2.0**64, str(2**64 - 1)), (-5.0, None)]),
        ([pa.array([2**64 - 1], pa.uint64()), pa.array([1e39])], "DOUBLE", [(2.0**64, str(2**64 - 1)), (1e39, None)]),
        ([pa.array([GREAT]), pa.array([Decimal(10**37)], pa.decimal128(38, 0))], "DECIMAL(38,0)", [(GREAT,), (10**37,)]),
        ([pa.array([Decimal("1.500")], pa.decimal128(18, 3)), pa.array([7])], "DOUBLE", [(1.5,), (7.0,)]),
        ([pa.array([7], pa.int32()), pa.array([GREAT])], "BIGINT", [(7,), (GREAT,)]),
        ([pa.array([True]), pa.array([2])], "BIGINT", [(None, "true"), (2, None)]),
        ([pa.array([None], pa.bool_()), pa.array([2])], "BIGINT", [(None,), (2,)]),
        ([pa.array([None], pa.bool_()), pa.array(["x"])], "VARCHAR", [(None,), ("x",)]),
        ([pa.array(["12"]), pa.array([2])], "BIGINT", [(12, "12"), (2, None)]),
        ([pa.array(["12_3"]), pa.array([2])], "BIGINT", [(None, "12_3"), (2, None)]),
        ([pa.array(["NA"]), pa.array([GREAT])], "BIGINT", [(None, "NA"), (GREAT, None)]),
        ([pa.array([True]), pa.array(["x"])], "VARCHAR", [("true",), ("x",)]),
        ([pa.array([5], pa.date32()), pa.array([2])], "BIGINT", [(None, "1970-01-06"), (2, None)]),
        ([pa.nulls(1), pa.array([2])], "BIGINT", [(None,), (2,)]),
    ],
)
def test_values_of_several_types_are_kept_exactly(
    merged: Callable[..., tuple[Relation, list[tuple[Any, ...]]]],
    columns: list[pa.Array],
    kind: str,
    rows: list[tuple[Any, ...]],
) -> None:
    found, held = merged(*columns)
    assert found.types["v"] == kind
    assert held == rows


@pytest.mark.parametrize(("other", "nans"), [(float("nan"), {"v"}), (2.0, set())])
def test_only_nan_is_said_to_be_missing_beside_large_whole_numbers(
    merged: Callable[..., tuple[Relation, list[tuple[Any, ...]]]], other: float, nans: set[str]
) -> None:
    found, _ = merged(pa.array([GREAT]), pa.array([other]))
    assert found.types["v"] == "BIGINT"
    assert found.nans == nans


def test_rows_that_are_filtered_out_do_not_decide_the_type(
    merged: Callable[..., tuple[Relation, list[tuple[Any, ...]]]],
) -> None:
    found, _ = merged(pa.array(["NA"]), pa.array([2]), where="place <> 0")
    assert dict(found.types) == {"v": "BIGINT", "place": "BIGINT"}
    found, _ = merged(pa.array(["NA"]), pa.array([2]), where="place <> 1")
    assert dict(found.types) == {"v": "VARCHAR", "place": "BIGINT"}


@pytest.mark.parametrize("where", ["place <> 0", "place > 1"])
def test_whole_numbers_that_are_filtered_out_leave_the_fractions(
    merged: Callable[..., tuple[Relation, list[tuple[Any, ...]]]], where: str
) -> None:
    found, _ = merged(pa.array([GREAT]), pa.array([0.5]), where=where)
    assert dict(found.types) == {"v": "DOUBLE", "place": "BIGINT"}


def test_columns_that_collide_in_case_or_with_text_columns_are_distinguished(tmp_path: Path) -> None:
    files = [str(tmp_path / name) for name in ("a.parquet", "b.parquet")]
    pq.write_table(pa.table({"v": [1], "V_TEXT": ["mine"]}), files[0])
    pq.write_table(pa.table({"V": ["x"], "other": [3]}), files[1])
    connection = connect()
    found = relation(lambda text: connection.execute(text).fetchall(), files)
    assert list(found.types) == ["v", "v_text_", "V_TEXT", "other"]
    rows = connection.execute(f"SELECT * FROM {found.sql} ORDER BY other NULLS FIRST").fetchall()
    assert rows == [(1, None, "mine", None), (None, "x", None, 3)]


@pytest.mark.integration
@pytest.mark.parametrize("kind", ["csv", "jsonl", "parquet"])
def test_integers_next_to_fractions_of_other_runs_keep_all_digits(tmp_path: Path, kind: str) -> None:
    script = (
        "import sys\nseed = int(open(sys.argv[1]).read().split('<random seed=\"')[1].split('\"')[0])\n"
        f"cells = [{GREAT}, 0.5, 7, 1e300][seed % 4]\n"
    )
    writes = {
        "csv": "open('t.csv', 'w').write(f'v\\n{cells}\\n')",
        "jsonl": "open('t.jsonl', 'w').write(f'{{\"v\": {cells}}}\\n')",
        "parquet": "import pyarrow as pa, pyarrow.parquet as pq\npq.write_table(pa.table({'v': [cells]}), 't.parquet')",
    }[kind]
    config = projects.CONFIG.replace("runs = 2", "runs = 12").replace("python3", sys.executable)
    project = sierra.open(projects.make(tmp_path / "p", config, simulator=script + writes))
    summary = project.run("population_size=1", figures=False)
    assert (summary.runs, summary.failed) == (12, 0)
    wrote = [[GREAT, 0.5, 7, 1e300][seed % 4] for seed in project.sql("SELECT seed FROM runs").column(0).to_pylist()]
    assert wrote.count(GREAT)
    assert wrote.count(0.5)
    rows = project.sql("SELECT v, v_text FROM t ORDER BY ALL", within=summary.batch).to_pylist()
    assert [row["v"] for row in rows] == sorted(map(float, wrote))
    assert [row["v_text"] for row in rows if row["v_text"]] == [str(GREAT)] * wrote.count(GREAT)
    assert project.statistics(summary.batch, "t", "v").column("n").to_pylist() == [12]
    assert project.maintenance.fsck().findings == ()

"""Values that stand for missing ones are missing in every format, and infinity and nan are numbers however they are written."""

from __future__ import annotations

import io
import json
import math
import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sierra.config.output_tables import Output
from sierra.ingest.model import Form, Shape
from sierra.ingest.read import read
from tests import plugins, samples
from tests.projects import CONFIG, make, quick
from tests.readings import read_file, written
from tests.tiers import of_extension

VALUES = [1.5, -1.0, 2.5, -2.0]


def _parquet(values: list[Any], kind: pa.DataType | None = None) -> bytes:
    stream = io.BytesIO()
    pq.write_table(pa.table({"v": pa.array(values, kind)}), stream)
    return stream.getvalue()


def _arrow(values: list[Any]) -> bytes:
    table = pa.table({"v": values})
    stream = io.BytesIO()
    with pa.ipc.new_file(stream, table.schema) as writer:
        writer.write_table(table)
    return stream.getvalue()


def npz(values: list[Any]) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, v=np.array(values))
    return stream.getvalue()


def sqlite(folder: Path, values: list[Any]) -> bytes:
    path = folder / "made.db"
    path.unlink(missing_ok=True)
    database = sqlite3.connect(path)
    database.execute("CREATE TABLE x (v)")
    database.executemany("INSERT INTO x VALUES (?)", [(value,) for value in values])
    database.commit()
    database.close()
    return path.read_bytes()


def _xml(texts: list[str]) -> bytes:
    return f"<a>{''.join(f'<s v={text!r}/>' for text in texts)}</a>".encode()


def graphml(texts: list[str]) -> bytes:
    nodes = "".join(f'<node id="{n}"><data key="k">{text}</data></node>' for n, text in enumerate(texts))
    key = '<key id="k" for="node" attr.name="v" attr.type="double"/>'
    return f"<graphml>{key}<graph>{nodes}</graph></graphml>".encode()


def _files(folder: Path) -> dict[str, tuple[bytes, dict[str, Any]]]:
    texts = ["1.5", "-1.00", "2.5", "-2"]
    return {
        "t.csv": ("\n".join(["t,v", *(f"0,{text}" for text in texts)]).encode(), {}),
        "t.xml": (_xml(texts), {"format": "xml", "rows": "//s"}),
        "t.jsonl": ("\n".join(f'{{"v": {text}}}' for text in texts).encode(), {}),
        "t.json": (json.dumps({"v": VALUES}).encode(), {"format": "json"}),
        "t.graphml": (graphml(texts), {"format": "graphml", "rows": "nodes"}),
        "t.parquet": (_parquet(VALUES), {}),
        "t.arrow": (_arrow(VALUES), {"format": "arrow"}),
        "t.npz": (npz(VALUES), {"format": "npy"}),
        "t.db": (sqlite(folder, VALUES), {"format": "sqlite", "rows": "x"}),
    }


OF_FORMATS = of_extension("formats", "t.graphml", "t.arrow", "t.npz", "t.db")
NAMES = ["t.csv", "t.xml", "t.jsonl", "t.json", "t.parquet", *OF_FORMATS]


@pytest.mark.parametrize("name", NAMES)
def test_number_that_stands_for_a_missing_value_is_missing_however_it_is_written(tmp_path: Path, name: str) -> None:
    content, keys = _files(tmp_path)[name]
    for na in [(-1,), (-1.0,)] if name == "t.csv" else [(-1,), (-1.0,), ("-1",), ("-1.00",), ("NA", "-1e0")]:
        reading, rows = read_file(tmp_path, name, content, na=na, **keys)
        assert not reading.faults
        assert [row["v"] for row in rows] == [1.5, None, 2.5, -2.0]
        assert list(reading.counted.values()) == [4]


def test_text_that_is_a_number_matches_in_a_csv_what_is_written_so(tmp_path: Path) -> None:
    _, rows = read_file(tmp_path, "t.csv", b"t,v\n0,-1\n0,-1.0\n0,2\n", na=("-1",))
    assert [row["v"] for row in rows] == [None, -1.0, 2.0]
    _, rows = read_file(tmp_path, "t.csv", b"t;v\n0;-1,00\n0;2,5\n", na=(-1,), decimal=",")
    assert [row["v"] for row in rows] == [None, 2.5]


@pytest.mark.parametrize(
    ("values", "kind", "na", "expected"),
    [
        ([0.1, 0.2], pa.float32(), (0.1,), [None, pytest.approx(0.2)]),
        ([1, 2, 3], pa.int8(), (2.5, 2, 1000), [1, None, 3]),
        ([True, False], None, ("true",), [None, False]),
        ([True, False], None, (1,), [True, False]),
        (["a", " NA ", "-1.0"], None, ("NA", -1), ["a", None, None]),
        ([2**62, -1], pa.int64(), (-1,), [2**62, None]),
        ([1.0, math.nan, math.inf], None, ("NaN", "Infinity"), [1.0, None, None]),
        ([-1, -1], None, (-1,), [None, None]),
        ([[-1.0, 2.0], None], None, (-1, "NA"), [[-1.0, 2.0], None]),
        ([["NA"], ["x"]], None, ("NA", "[NA]"), [["NA"], ["x"]]),
    ],
)
def test_value_is_missing_in_a_column_of_any_type(
    tmp_path: Path, values: list[Any], kind: pa.DataType | None, na: tuple[Any, ...], expected: list[Any]
) -> None:
    reading, rows = read_file(tmp_path, "t.parquet", _parquet(values, kind), na=na)
    assert [row["v"] for row in rows] == expected
    if expected == [None, None]:
        assert list(reading.columns.values()) == [{"v": "empty"}]


READER = """
import numpy as np
from sierra.plugin import NoOptions
class Made:
    contract = 1
    Options = NoOptions
    def __init__(self, options): pass
    def read(self, path):
        return {
            "mixed": [-1, "NA", 2.5, None],
            "typed": np.array([2**62, -1, 0, 7]),
            "own": [np.int64(-1), np.int64(3), np.int64(0), np.int64(-2)],
            "flag": [True, False, None, True],
        }
"""


def test_reader_of_another_package_has_missing_values(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(plugins.write(tmp_path / "lib", "marks", {"sierra.readers mark": "Made"}, READER)))
    shape = Shape("mark", reader=json.dumps({"package": "marks 1", "options": {}}), form=Form(na=(-1, "NA", 0)), name="t")
    (tmp_path / "target").mkdir()
    target = tmp_path / "target" / "table.parquet"
    reading = read(samples.database(2), [written(tmp_path / "t.mark", 0, b"x")], shape, target)
    assert not reading.faults
    found = {name: values for name, values in pq.read_table(target).to_pydict().items() if name not in ("run", "execution")}
    assert found == {
        "mixed": [None, None, 2.5, None],
        "typed": [2**62, None, None, 7],
        "own": [None, 3, None, -2],
        "flag": [True, False, None, True],
    }


def test_json_keeps_flags_and_lists_beside_missing_values(tmp_path: Path) -> None:
    content = b'{"f": true, "v": 1, "l": [1, -1]}\n{"f": false, "v": "NA", "l": []}\n'
    _, rows = read_file(tmp_path, "t.jsonl", content, na=(1, "NA"))
    assert [row["f"] for row in rows] == [True, False]
    assert [row["v"] for row in rows] == [None, None]
    assert [row["l"] for row in rows] == ["[1,-1]", "[]"]


INFINITE = {
    "1.#INF": math.inf, "-1.#INF": -math.inf, "1.#INF00": math.inf, "1.#INF000e+000": math.inf, "+1.#inf": math.inf,
    "-1.#IND": math.nan, "-1.#IND00": math.nan, "1.#QNAN": math.nan, "1.#SNAN": math.nan, "1.#QNAN0": math.nan,
    "Infinity": math.inf, "-Infinity": -math.inf, "NaN": math.nan, "inf": math.inf, "-nan": math.nan,
}  # fmt: skip


@pytest.mark.parametrize("form", ["csv", "blanks", "xml", "json", "jsonl", *of_extension("formats", "graphml")])
def test_infinity_and_nan_are_numbers_however_they_are_written(tmp_path: Path, form: str) -> None:
    texts = ["0.5", *INFINITE]
    made: dict[str, tuple[str, bytes, dict[str, Any]]] = {
        "csv": ("t.csv", "\n".join(["t,v", *(f"0,{text}" for text in texts)]).encode(), {}),
        "blanks": ("t.csv", "\n".join(["t v", *(f"0 {text}" for text in texts)]).encode(), {"delimiter": "blanks"}),
        "xml": ("t.xml", _xml(texts), {"format": "xml", "rows": "//s"}),
        "json": ("t.json", json.dumps([{"v": 0.5}, *({"v": text} for text in INFINITE)]).encode(), {"format": "json"}),
        "jsonl": ("t.jsonl", b"\n".join([b'{"v": 0.5}', *(json.dumps({"v": text}).encode() for text in INFINITE)]), {}),
        "graphml": ("t.graphml", graphml(texts), {"format": "graphml", "rows": "nodes"}),
    }
    name, content, keys = made[form]
    reading, rows = read_file(tmp_path, name, content, **keys)
    assert not reading.faults
    assert [row["v"] for row in rows] == pytest.approx([0.5, *INFINITE.values()], nan_ok=True)


def test_texts_beside_infinity_stay_texts(tmp_path: Path) -> None:
    _, rows = read_file(tmp_path, "t.jsonl", b'{"v": "Nan"}\n{"v": "Bob"}\n{"v": "1.#INF"}\n')
    assert [row["v"] for row in rows] == ["Nan", "Bob", "1.#INF"]
    _, rows = read_file(tmp_path, "t.csv", b"t,v\n0,1.#INFO\n0,1.#INF\n")
    assert [row["v"] for row in rows] == ["1.#INFO", "1.#INF"]


def test_whole_numbers_stay_whole_beside_nan_of_windows(tmp_path: Path) -> None:
    _, rows = read_file(tmp_path, "t.csv", f"t,v\n0,{2**62 + 1}\n0,-1.#IND\n".encode())
    assert [row["v"] for row in rows] == [2**62 + 1, None]


@pytest.mark.integration
@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=10)
@given(st.lists(st.sampled_from(["1", "-1", "-1.0", "1.#INF", "1.#QNAN", "NaN", "7", "abc", "-1_0"]), min_size=1, max_size=5))
def test_same_cells_are_the_same_values_in_all_text_formats(tmp_path: Path, cells: list[str]) -> None:
    texts = ["0.5", *cells]
    _, csv = read_file(tmp_path, "t.csv", "\n".join(["t,v", *(f"0,{cell}" for cell in texts)]).encode(), na=(-1,))
    _, xml = read_file(tmp_path, "t.xml", _xml(texts), format="xml", rows="//s", na=(-1,))
    assert repr([row["v"] for row in csv]) == repr([row["v"] for row in xml])


def test_na_needs_a_table() -> None:
    with pytest.raises(ValueError, match="na needs a format that makes a table"):
        Output(file="t.txt", format="file", na=("x",))
    for wrong in (True, math.nan, None):
        with pytest.raises(ValueError, match="na"):
            Output(file="t.csv", na=(wrong,))  # type: ignore[arg-type]


SIMULATOR = """\
import sys
n = int(open(sys.argv[1]).read().split('<swarm count="')[1].split('"')[0])
steps = "".join(f'<step time="{i}.00" travel="{"-1.00" if i < 5 else 50.0 * n}"/>' for i in range(8))
open("summary.xml", "w").write(f"<summary>{steps}</summary>")
values = ['"Infinity"' if i == 3 else '"NaN"' if i == 4 else n * i + 0.5 for i in range(8)]
open("out.jsonl", "w").write("".join('{"t": %d, "v": %s}\\n' % pair for pair in enumerate(values)))
open("saved.csv", "w").write("# t,v\\n" + "".join(f"{i / 2:e},{n * i:e}\\n" for i in range(4)))
flags = ["true", "1"] * 3
open("flags.csv", "w").write("t,done\\n" + "".join(f"{i},{flag}\\n" for i, flag in enumerate(flags)))
"""
SUMMARY = """
[outputs.summary]
file = "summary.xml"
format = "xml"
rows = "//step"
time = "time"
"""


@pytest.mark.integration
def test_statistics_count_no_missing_values_and_notes_propose_no_wrong_rates(tmp_path: Path) -> None:
    folder = make(tmp_path / "project", CONFIG + SUMMARY, simulator=SIMULATOR)
    done = quick(folder, "run", "population_size=1", "--no-figures")
    assert done.returncode == 0, done.stderr
    with (folder / "sierra.toml").open("a") as file:
        file.write("na = [-1]\n")
    assert "2 evaluated again" in quick(folder, "run", "population_size=1", "--no-figures").stdout
    travel = quick(folder, "stats", "summary", "travel", "--measure", "mean", "--statistic", "mean", "--format", "csv").stdout
    assert travel.splitlines()[1].split(",")[6] == "50.0"
    kind = quick(folder, "sql", "SELECT DISTINCT typeof(v) AS kind FROM out", "--format", "csv").stdout
    assert kind.split() == ["kind", "DOUBLE"]
    final = quick(folder, "stats", "saved", "v", "--times", "own", "--statistic", "mean", "--format", "csv")
    assert (final.returncode, len(final.stdout.splitlines())) == (0, 5)
    said = quick(folder, "figures").stderr
    assert "avg((lower(trim(done)) IN ('true', '1'))::INT) AS rate" in said
    assert "done = '1'" not in said

"""Columns whose names differ only in upper and lower case are told apart, in whatever order a run writes them."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import sierra
from sierra.store.sql_names import stored_name, stored_names
from tests import projects
from tests.projects import quick
from tests.readings import read_file
from tests.tiers import of_extension

DATA = {"t": [0, 1], "T": [300, 301], "v": [7, 8]}
STORED = [{"t_lower": 0, "T_upper": 300, "v": 7}, {"t_lower": 1, "T_upper": 301, "v": 8}]
Table = dict[str, list[int]]


def _csv(data: Table) -> bytes:
    return "\n".join([",".join(data), *(",".join(map(str, row)) for row in zip(*data.values(), strict=True)), ""]).encode()


def _objects(data: Table) -> list[dict[str, int]]:
    return [dict(zip(data, row, strict=True)) for row in zip(*data.values(), strict=True)]


def _jsonl(data: Table) -> bytes:
    return "".join(json.dumps(row) + "\n" for row in _objects(data)).encode()


def _xml(data: Table) -> bytes:
    cells = (" ".join(f'{name}="{value}"' for name, value in row.items()) for row in _objects(data))
    rows = "".join(f"<row {one}/>" for one in cells)
    return f"<rows>{rows}</rows>".encode()


def _parquet(data: Table) -> bytes:
    pq.write_table(pa.table(data), stream := io.BytesIO())
    return stream.getvalue()


def _arrow(data: Table) -> bytes:
    stream, table = io.BytesIO(), pa.table(data)
    with pa.ipc.new_file(stream, table.schema) as file:
        file.write_table(table)
    return stream.getvalue()


def _npz(data: Table) -> bytes:
    import numpy as np

    np.savez(stream := io.BytesIO(), **{name: np.array(values) for name, values in data.items()})
    return stream.getvalue()


def _hdf5(data: Table) -> bytes:
    import h5py

    with h5py.File(stream := io.BytesIO(), "w") as file:
        for name, values in data.items():
            file[name] = values
    return stream.getvalue()


FORMATS: dict[str, tuple[Callable[[Table], bytes], dict[str, str]]] = {
    "csv": (_csv, {}),
    "jsonl": (_jsonl, {}),
    "json": (lambda data: json.dumps(_objects(data)).encode(), {"format": "json"}),
    "xml": (_xml, {"format": "xml", "rows": "/rows/row"}),
    "parquet": (_parquet, {}),
    "arrow": (_arrow, {"format": "arrow"}),
    "npz": (_npz, {"format": "npy"}),
    "h5": (_hdf5, {"format": "hdf5", "rows": "/"}),
}


@pytest.mark.parametrize("ending", ["csv", "jsonl", "json", "xml", "parquet", *of_extension("formats", "arrow", "npz", "h5")])
def test_columns_are_told_apart_in_each_format(tmp_path: Path, ending: str) -> None:
    written, keys = FORMATS[ending]
    for data in (DATA, dict(reversed(DATA.items()))):
        reading, rows = read_file(tmp_path, f"o.{ending}", written(data), **keys)
        assert not reading.faults
        assert [{name: row[name] for name in STORED[0]} for row in rows] == STORED


def test_names_depend_on_names_only() -> None:
    assert stored_names(["t", "T", "v"]) == ("t_lower", "T_upper", "v")
    assert stored_names(["Temp", "tEmp", "TEMP"]) == ("Temp_upper_1", "tEmp_upper_2", "TEMP_upper")
    assert stored_names(["v", "V_"]) == ("v", "V_")
    assert (stored_name("t", ("t_lower", "T_upper")), stored_name("t", ("t",))) == ("t_lower", "t")


SIMULATOR = """\
import sys
count = int(open(sys.argv[1]).read().split('count="')[1].split('"')[0])
rows = [(place, 300 + count) for place in range(3)]
names = "t,T" if count < 3 else "T,t"
with open("o.csv", "w") as file:
    print(names, *(f"{t},{T}" if count < 3 else f"{T},{t}" for t, T in rows), sep="\\n", file=file)
"""


@pytest.mark.integration
def test_runs_may_write_the_columns_in_any_order(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project", simulator=SIMULATOR)
    with (root / "sierra.toml").open("a") as file:
        file.write('[outputs.o]\nfile = "o.csv"\ntime = "t"\n')
    ended = quick(root, "run", "population_size=2,3", "--no-figures")
    assert ended.returncode == 0
    said = "columns 't' and 'T' of output 'o' differ only in upper and lower case, which SQL ignores"
    assert f"{said}: they are 't_lower' and 'T_upper' in SQL" in ended.stderr
    rows = sierra.open(root).store.rows("SELECT population_size AS n, max(T_upper) AS most FROM o GROUP BY n ORDER BY n")
    assert rows == [{"n": 2, "most": 302}, {"n": 3, "most": 303}]
    batch = sierra.open(root).batches[-1].batch
    shown = quick(root, "outputs", batch).stdout
    assert "t_lower  BIGINT, time axis, t in the file\n  T_upper  BIGINT, T in the file\n" in shown
    assert quick(root, "stats", "o", "T_upper").returncode == 0
    assert quick(root, "files", batch, "o.csv", "--to", str(tmp_path / "out")).returncode == 0


KEYS = """\
import sys, time
seed = int(open(sys.argv[1]).read().split('seed="')[1].split('"')[0])
with open("o.csv", "w") as file:
    print("t,T,ok,OK", *(f"{t},{time.time_ns() % 10**9},{t},{seed % 2}" for t in range(3)), sep="\\n", file=file)
"""


@pytest.mark.nightly
def test_keys_of_outputs_take_the_names_in_the_file(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project", simulator=KEYS)
    with (root / "sierra.toml").open("a") as file:
        file.write('[outputs.o]\nfile = "o.csv"\ntime = "t"\nunits = { T = "K" }\nrates = ["OK"]\nvolatile = ["T"]\n')
    assert quick(root, "run", "population_size=2,3", "--runs", "4").returncode == 0
    [caption] = root.glob("figures/*/o_T_upper_summary.txt")
    assert "[K]" in caption.read_text()
    assert "Wilson" in quick(root, "stats", "o", "OK_upper", "-s", "mean").stdout
    again = quick(root, "replay", sierra.open(root).batches[-1].batch)
    assert again.returncode == 0, again.stdout

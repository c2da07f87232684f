"""Values that stand for missing ones in formats of this extension: not indices, and without another type of the column."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.readings import read_file
from tests.unit.ingest.test_missing_values import graphml, npz, sqlite


def test_hdf5_and_netcdf_have_missing_values(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "made.h5", "w") as file:
        file["v"] = np.array([1, -1, 3], "i4")
    _, rows = read_file(tmp_path, "t.h5", (tmp_path / "made.h5").read_bytes(), format="hdf5", rows="/v", na=(-1,))
    assert [row["v"] for row in rows] == [1, None, 3]


def test_netcdf_has_missing_values_and_indices_and_dimensions_are_none(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    scipy = pytest.importorskip("scipy.io")
    with scipy.netcdf_file(tmp_path / "made.nc", "w") as file:
        for name in ("t", "x"):
            file.createDimension(name, 2)
        file.createVariable("t", "d", ("t",))[:] = [0, 5]
        file.createVariable("v", "f", ("t", "x"))[:] = [[0, 1.5], [-999.9, 0]]
    keys: dict[str, Any] = {"format": "netcdf", "rows": "v"}
    _, rows = read_file(tmp_path, "t.nc", (tmp_path / "made.nc").read_bytes(), na=(0, -999.9), **keys)
    assert [tuple(row.values()) for row in rows] == [(0, 0, None), (0, 1, 1.5), (5, 0, None), (5, 1, None)]
    with h5py.File(tmp_path / "made.h5", "w") as file:
        file["v"] = np.array([0, 1, 3], "i4")
    _, rows = read_file(tmp_path, "t.h5", (tmp_path / "made.h5").read_bytes(), format="hdf5", rows="/v", na=(0,))
    assert [tuple(row.values()) for row in rows] == [(0, None), (1, 1), (2, 3)]
    _, rows = read_file(tmp_path, "t.npz", npz([0, 1, 3]), format="npy", na=(0,))
    assert [tuple(row.values()) for row in rows] == [(0, None), (1, 1), (2, 3)]


def test_sqlite_has_infinity_and_nan_as_texts_among_numbers(tmp_path: Path) -> None:
    content = sqlite(tmp_path, [0.5, "Infinity", "NaN", 2])
    _, rows = read_file(tmp_path, "t.db", content, format="sqlite", rows="x")
    assert [row["v"] for row in rows] == pytest.approx([0.5, math.inf, math.nan, 2.0], nan_ok=True)


@pytest.mark.parametrize("form", ["graphml", "sqlite"])
def test_text_for_a_missing_value_does_not_change_the_type_of_its_column(tmp_path: Path, form: str) -> None:
    if form == "graphml":
        _, rows = read_file(tmp_path, "t.graphml", graphml(["NA", "2"]), format="graphml", rows="nodes", na=("NA",))
    else:
        _, rows = read_file(tmp_path, "t.db", sqlite(tmp_path, ["NA", 2.0]), format="sqlite", rows="x", na=("NA",))
    assert [row["v"] for row in rows] == [None, 2.0]

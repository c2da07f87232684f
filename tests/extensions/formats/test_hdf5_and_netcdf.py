"""HDF5 and NetCDF become tables in long form; what names other files, is incomplete or damaged is an error of one line."""

from __future__ import annotations

import gzip
import io
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sierra.config.output_tables import Output
from sierra.ingest.model import Form
from sierra.testing import readers as conformance
from tests import projects
from tests.projects import quick
from tests.readings import read_file

h5py = pytest.importorskip("h5py")


def hdf5(make: Callable[[Any], object]) -> bytes:
    stream = io.BytesIO()
    with h5py.File(stream, "w") as file:
        make(file)
    return stream.getvalue()


def read(folder: Path, content: bytes, kind: str, rows: str, name: str = "") -> list[dict[str, Any]]:
    reading, found = read_file(folder, name or f"t.{kind}", content, format=kind, rows=rows)
    assert not reading.faults
    assert list(reading.counted.values()) == [len(found)]
    return found


def fault(folder: Path, content: bytes, kind: str, rows: str) -> str:
    reading, found = read_file(folder, f"t.{kind}", content, format=kind, rows=rows)
    assert found == []
    assert "\n" not in reading.faults["e0"]
    assert "failed: " not in reading.faults["e0"]
    return reading.faults["e0"].removeprefix(f"t.{kind}: ")


GRID = np.arange(4, dtype="i2").reshape(2, 2)
PAIRS = np.array([(1, b"x"), (2, b"y")], dtype=[("n", ">i2"), ("s", "S1")])


def test_datasets_keep_their_types_and_have_a_row_for_each_element(tmp_path: Path) -> None:
    def make(file: Any) -> None:
        file["run/grid"], file["run/pairs"], file["one"] = GRID, PAIRS, 0.5
        file["texts"], file["flags"], file["none"] = ["ä", "b"], np.array([True, False]), np.zeros((0, 3))
        file.create_dataset("zipped", data=np.arange(9.0), chunks=(2,), compression="gzip")
        file.create_dataset("state", data=[0, 1], dtype=h5py.enum_dtype({"idle": 0, "busy": 1}))
        file["short"] = h5py.SoftLink("/run/grid")
        file.create_group("both")["a"], file["both"]["b"] = [1, 2], [0.5, 1.5]

    content = hdf5(make)
    long = [{"i": i, "j": j, "grid": 2 * i + j} for i in (0, 1) for j in (0, 1)]
    assert read(tmp_path, content, "hdf5", "/run/grid") == long
    assert [row["short"] for row in read(tmp_path, content, "hdf5", "short")] == [0, 1, 2, 3]
    assert read(tmp_path, content, "hdf5", "run/pairs") == [{"i": 0, "n": 1, "s": "x"}, {"i": 1, "n": 2, "s": "y"}]
    assert read(tmp_path, content, "hdf5", "one") == [{"one": 0.5}]
    assert [row["texts"] for row in read(tmp_path, content, "hdf5", "texts")] == ["ä", "b"]
    assert [row["flags"] for row in read(tmp_path, content, "hdf5", "flags")] == [True, False]
    assert [row["state"] for row in read(tmp_path, content, "hdf5", "state")] == ["idle", "busy"]
    assert [row["zipped"] for row in read(tmp_path, content, "hdf5", "zipped")] == list(range(9))
    assert read(tmp_path, content, "hdf5", "none") == []
    assert read(tmp_path, content, "hdf5", "both") == [{"i": 0, "a": 1, "b": 0.5}, {"i": 1, "a": 2, "b": 1.5}]
    assert read(tmp_path, gzip.compress(content), "hdf5", "both", "t.h5.gz") == read(tmp_path, content, "hdf5", "both")


def external(file: Any) -> None:
    file["d"] = h5py.ExternalLink("/etc/passwd", "/d")


def stored_elsewhere(file: Any) -> None:
    file.create_dataset("d", (2,), "i4", external=[("/etc/passwd", 0, 8)])


def virtual(file: Any) -> None:
    layout = h5py.VirtualLayout((2,), "i4")
    layout[:] = h5py.VirtualSource("/etc/passwd", "d", (2,))
    file.create_virtual_dataset("d", layout)


def circular(file: Any) -> None:
    file["d"] = h5py.SoftLink("/d")


def huge(file: Any) -> None:
    file.create_dataset("d", (1 << 40,), "f8", chunks=(1024,))


def unwritten(file: Any) -> None:
    file.create_dataset("d", (100,), "f8", chunks=(10,))[:10] = 1.0


def never_written(file: Any) -> None:
    file.create_dataset("d", (100,), "f8")


def unequal(file: Any) -> None:
    file["d/a"], file["d/b"] = [1], [1, 2]


def complex_numbers(file: Any) -> None:
    file["d"] = [1j]


def lists(file: Any) -> None:
    file.create_dataset("d", (1,), h5py.vlen_dtype(np.int32))[0] = [1, 2]


def named_as_index(file: Any) -> None:
    file["d/i"] = [1]


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (external, "'d' is a link to another file, '/etc/passwd', which is not read"),
        (stored_elsewhere, "the dataset 'd' is stored in other files, which are not read"),
        (virtual, "the dataset 'd' is stored in other files, which are not read"),
        (circular, "is a link to itself"),
        (huge, "is larger than 1024 MiB"),
        (unwritten, "the dataset 'd' was not written completely"),
        (never_written, "the dataset 'd' was not written completely"),
        (unequal, "the dataset 'b' has the shape (2,), but 'a' has (1,)"),
        (complex_numbers, "which a table cannot hold"),
        (lists, "which a table cannot hold"),
        (named_as_index, "the dataset 'i' has the name of an index"),
        (lambda file: file.create_group("d"), "the group 'd' has no dataset; it has nothing"),
        (lambda file: file.create_group("e"), "has no 'd'; '/' has 'e'"),
    ],
)
def test_hostile_or_incomplete_hdf5_is_refused_in_one_line(tmp_path: Path, make: Callable[[Any], object], said: str) -> None:
    assert said in fault(tmp_path, hdf5(make), "hdf5", "d")


@pytest.mark.parametrize("kept", [0, 4, 100, 0.5, -1])
def test_truncated_hdf5_is_refused_in_one_line(tmp_path: Path, kept: float) -> None:
    content = hdf5(lambda file: file.create_dataset("d", data=np.arange(5000.0)))
    cut = content[: int(kept * len(content)) if isinstance(kept, float) else kept]
    said = fault(tmp_path, cut, "hdf5", "d")
    assert said.startswith(("is truncated, damaged, or not HDF5", "is empty"))


def netcdf4(file: Any) -> None:
    """Write a file as the NetCDF library does: dimensions are dimension scales."""
    file["time"], file["id"] = np.array([0.0, 0.5]), np.zeros(2, "f4")
    for name, text in (("time", "time"), ("id", "This is a netCDF dimension but not a netCDF variable.         2")):
        file[name].make_scale(text)
    file["speed"] = np.array([[1, 2], [3, -99]], "i2")
    file["speed"].attrs["_FillValue"] = np.array([-99], "i2")
    file["speed"].attrs["scale_factor"] = 0.5
    file["height"] = np.array([[1.0, np.nan], [9.969209968386869e36, 4.0]])
    for name in ("speed", "height"):
        for place, scale in enumerate(("time", "id")):
            file[name].dims[place].attach_scale(file[scale])


TABLE = [
    {"time": 0.0, "id": 0, "speed": 0.5},
    {"time": 0.0, "id": 1, "speed": 1.0},
    {"time": 0.5, "id": 0, "speed": 1.5},
    {"time": 0.5, "id": 1, "speed": None},
]


def netcdf3(folder: Path, version: int = 1) -> bytes:
    from scipy.io import netcdf_file

    with netcdf_file(folder / "made.nc", "w", version=version) as file:
        file.createDimension("time", None)
        file.createDimension("id", 2)
        file.createVariable("time", "d", ("time",))[:] = [0.0, 0.5]
        speed = file.createVariable("speed", "h", ("time", "id"))
        speed[:] = [[1, 2], [3, -99]]
        speed._FillValue, speed.scale_factor = np.int16(-99), 0.5
        file.createVariable("single", "c", ("id",))[:] = [b"a", b"b"]
    return (folder / "made.nc").read_bytes()


def test_netcdf_of_both_formats_has_the_values_of_its_dimensions_and_no_fill_values(tmp_path: Path) -> None:
    assert read(tmp_path, hdf5(netcdf4), "netcdf", "speed") == TABLE
    for version in (1, 2):
        assert read(tmp_path, netcdf3(tmp_path, version), "netcdf", "speed") == TABLE
    assert read(tmp_path, netcdf3(tmp_path), "netcdf", "time") == [{"time": 0.0}, {"time": 0.5}]
    both = read(tmp_path, hdf5(netcdf4), "netcdf", "height, speed")
    assert list(both[0]) == ["time", "id", "height", "speed"]
    assert [row["height"] for row in both if row["height"] == row["height"]] == [1.0, None, 4.0]
    assert read(tmp_path, gzip.compress(netcdf3(tmp_path)), "netcdf", "speed", "t.nc.gz") == TABLE


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ("nothing", "has no variable 'nothing'; it has "),
        ("time,speed", "the variable 'speed' has the dimensions (time, id), but 'time' has (time)"),
    ],
)
def test_unknown_or_unequal_variables_are_refused(tmp_path: Path, rows: str, said: str) -> None:
    for content in (hdf5(netcdf4), netcdf3(tmp_path)):
        assert said in fault(tmp_path, content, "netcdf", rows)


def test_texts_of_single_characters_and_plain_hdf5_are_refused(tmp_path: Path) -> None:
    assert "write strings" in fault(tmp_path, netcdf3(tmp_path), "netcdf", "single")
    plain = hdf5(lambda file: file.create_dataset("d", data=[1, 2]))
    assert 'for HDF5, set format = "hdf5"' in fault(tmp_path, plain, "netcdf", "d")


@pytest.mark.parametrize("kept", [0, 3, 7, 12, 60, 150, -1])
def test_truncated_netcdf_is_refused_in_one_line(tmp_path: Path, kept: int) -> None:
    assert "trunc" in fault(tmp_path, netcdf3(tmp_path)[:kept], "netcdf", "speed")


@pytest.mark.integration
def test_both_are_readers(tmp_path: Path) -> None:
    good = hdf5(lambda file: file.create_dataset("d", data=[1, 2]))
    other = hdf5(lambda file: file.create_dataset("d", data=[3]))
    tables = {good: {"i": [0, 1], "d": [1, 2]}, other: {"i": [0], "d": [3]}}
    conformance.check("hdf5", tables, [good[:200], hdf5(external)], tmp_path / "a", form=Form(rows="d"))
    long = {name: [row[name] for row in TABLE] for name in TABLE[0]}
    conformance.check("netcdf", {netcdf3(tmp_path): long}, [netcdf3(tmp_path)[:70]], tmp_path / "b", form=Form(rows="speed"))


@pytest.mark.parametrize(("kind", "named"), [("hdf5", "HDF5"), ("netcdf", "NetCDF")])
def test_missing_extra_is_named_before_anything_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, named: str
) -> None:
    monkeypatch.setitem(sys.modules, "h5py", None)
    projects.make(tmp_path, projects.CONFIG + f'[outputs.o]\nfile = "o.bin"\nformat = "{kind}"\nrows = "d"\n')
    ended = quick(tmp_path, "run", "population_size=1")
    said = f"outputs in {named} need the package h5py: pip install 'sierra-experiments[{kind}]'"
    assert (ended.returncode, ended.stderr.splitlines()) == (3, [f"sierra: {said}"])
    assert not (tmp_path / ".sierra").exists()


@pytest.mark.parametrize("kind", ["hdf5", "netcdf"])
def test_rows_must_be_named(kind: str) -> None:
    with pytest.raises(ValueError, match="needs rows"):
        Output.model_validate({"file": "a", "format": kind})

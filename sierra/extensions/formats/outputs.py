"""Outputs in formats of this extension: what they need, and the endings of their files."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from sierra.config.output_tables import Output


class ArrowOutput(Output):
    """An output in an Arrow file."""

    endings: ClassVar[Mapping[str, str]] = dict.fromkeys(("arrow", "feather"), 'format = "arrow"')


class NumpyOutput(Output):
    """An output in a file of NumPy."""

    endings: ClassVar[Mapping[str, str]] = dict.fromkeys(("npy", "npz"), 'format = "npy"')


class GraphMlOutput(Output):
    """An output in GraphML."""

    takes: ClassVar[tuple[str, ...]] = ("rows",)
    endings: ClassVar[Mapping[str, str]] = {"graphml": 'format = "graphml", rows = "edges"'}

    def check_own_keys(self) -> None:
        if self.rows not in ("nodes", "edges", "graph"):
            raise ValueError('format = "graphml" needs rows = "nodes", rows = "edges", or rows = "graph" for both')


class SqliteOutput(Output):
    """An output in a database of SQLite."""

    takes: ClassVar[tuple[str, ...]] = ("rows",)
    endings: ClassVar[Mapping[str, str]] = dict.fromkeys(("sqlite", "sqlite3", "db"), 'format = "sqlite", rows = "TABLE"')

    def check_own_keys(self) -> None:
        if not self.rows:
            raise ValueError('format = "sqlite" needs rows, the name of a table or a SELECT statement')


class Hdf5Output(Output):
    """An output in HDF5."""

    takes: ClassVar[tuple[str, ...]] = ("rows",)
    endings: ClassVar[Mapping[str, str]] = dict.fromkeys(("h5", "hdf5", "hdf"), 'format = "hdf5", rows = "/DATASET"')
    needs: ClassVar[tuple[str, str, str] | None] = ("HDF5", "h5py", "hdf5")

    def check_own_keys(self) -> None:
        if not self.rows.strip(" ,"):
            raise ValueError('format = "hdf5" needs rows, the path of a dataset or group')


class NetcdfOutput(Output):
    """An output in NetCDF."""

    takes: ClassVar[tuple[str, ...]] = ("rows",)
    endings: ClassVar[Mapping[str, str]] = dict.fromkeys(("nc", "nc4", "cdf"), 'format = "netcdf", rows = "VARIABLE"')
    needs: ClassVar[tuple[str, str, str] | None] = ("NetCDF", "h5py", "netcdf")

    def check_own_keys(self) -> None:
        if not self.rows.strip(" ,"):
            raise ValueError('format = "netcdf" needs rows, one or more variables, separated by commas')

"""The reader of NetCDF files, in long form: a row for each element of a variable, with the values of its dimensions.

`rows` has the names of one or more variables with the same dimensions, separated by commas. The column of a dimension has the
values of the variable of that name, or else indices. Fill values are missing values; `scale_factor` and `add_offset` are
applied. NetCDF-4 files are HDF5 files; SciPy reads NetCDF-3. The number of rows follows a second time from the lengths of the
dimensions.
"""

from __future__ import annotations

import io
import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Protocol

from sierra.extensions.formats.columnar import Columnar
from sierra.extensions.formats.hdf5_datasets import LARGEST, check, opened, resolve, values
from sierra.extensions.formats.hdf5_datasets import MAGIC as HDF5
from sierra.extensions.formats.numpy_arrays import plain
from sierra.ingest.base import UnreadableError
from sierra.ingest.rewriting import OriginalFile
from sierra.util.lazy_definitions import dataclass, replace

if TYPE_CHECKING:
    import h5py
    import numpy as np
    import pyarrow as pa

CLASSIC = (b"CDF\x01", b"CDF\x02")
UNFILLED = {"f": 9.969209968386869e36, "i2": -32767, "i4": -2147483647, "u2": 65535, "u4": 4294967295}
UNFILLED |= {"i8": -9223372036854775806, "u8": 18446744073709551614}
"""NetCDF's own fill values by type, for variables without `_FillValue`; bytes have none."""


@dataclass(frozen=True, slots=True)
class Variable:
    """One variable: its dimensions in order, its values, and its attributes."""

    dimensions: tuple[str, ...]
    values: np.ndarray
    attributes: Mapping[str, object]


class _Contents(Protocol):
    """An open file."""

    def variable(self, name: str) -> Variable | None:
        """Return a variable; None if there is none of that name. Raises UnreadableError."""
        ...

    def length(self, variable: str, place: int) -> int:
        """Return the length of a dimension of a variable, as the dimension itself states it."""
        ...

    def names(self) -> Sequence[str]: ...


class NetcdfVariables(Columnar):
    """The reader of NetCDF files."""

    def table(self, source: OriginalFile) -> pa.Table:
        import numpy as np
        import pyarrow as pa

        with _contents(source) as file:
            variables = {name: _required(file, name) for name in self._names}
            first, *_ = variables
            dimensions = variables[first].dimensions
            for name, variable in variables.items():
                if variable.dimensions != dimensions:
                    mine, others = (", ".join(names) for names in (variable.dimensions, dimensions))
                    raise UnreadableError(f"the variable {name!r} has the dimensions ({mine}), but {first!r} has ({others})")
            size = variables[first].values.shape
            axes = [(name, file.variable(name)) for name in dimensions]
        places = np.indices(size).reshape(len(size), -1) if size else ()
        columns: dict[str, pa.Array] = {}
        for (name, axis), index in zip(axes, places, strict=True):
            if axis is None or axis.dimensions != (name,):
                columns[name] = plain(name, index)
            else:
                columns[name] = _column(name, axis).take(pa.array(index))
        own = {name: _column(name, variable) for name, variable in variables.items() if name not in columns}
        if len(columns) < len(dimensions):
            raise UnreadableError(f"the variable {first!r} has a dimension twice")
        self.shape = replace(self.shape, places=dimensions)
        return pa.table(columns | own)

    def count(self, source: OriginalFile, written: int) -> int:
        with _contents(source) as file:
            first = self._names[0]
            return math.prod(file.length(first, place) for place in range(len(_required(file, first).dimensions)))

    @property
    def _names(self) -> tuple[str, ...]:
        return tuple(name.strip() for name in self.shape.form.rows.split(","))


def _required(file: _Contents, name: str) -> Variable:
    found = file.variable(name)
    if found is None:
        raise UnreadableError(f"has no variable {name!r}; it has {', '.join(map(repr, list(file.names())[:10])) or 'none'}")
    return found


def _column(name: str, variable: Variable) -> pa.Array:
    """Return the values of a variable by rows, without fill values, and scaled. Raises UnreadableError."""
    import numpy as np
    import pyarrow as pa

    flat = variable.values.reshape(-1)
    flat = flat.astype(flat.dtype.newbyteorder("="))
    kind = flat.dtype.kind
    if kind == "S":
        raise UnreadableError(f"the variable {name!r} has single characters, which a table cannot hold; write strings")
    if kind not in "iuf":
        return plain(name, flat)
    if kind == "i" and str(variable.attributes.get("_Unsigned", "false")).lower() == "true":
        flat = flat.view(flat.dtype.str.replace("i", "u"))
    missing = np.zeros(len(flat), dtype=bool)
    for fill in _fills(variable, flat.dtype):
        missing |= np.isnan(flat) if fill != fill else flat == np.asarray(fill).astype(flat.dtype)
    scale, offset = (_number(name, variable, key) for key in ("scale_factor", "add_offset"))
    if scale is not None or offset is not None:
        flat = flat.astype("f8") * (1.0 if scale is None else scale) + (offset or 0.0)
    column = plain(name, flat)
    return pa.compute.if_else(pa.array(missing), pa.scalar(None, column.type), column) if missing.any() else column


def _fills(variable: Variable, kind: np.dtype) -> Iterator[object]:
    """Yield the values that stand for missing ones."""
    import numpy as np

    own = variable.attributes.get("_FillValue")
    for declared in (own, variable.attributes.get("missing_value")):
        if declared is not None:
            yield from np.asarray(declared).reshape(-1).tolist()
    if own is None and (fill := UNFILLED.get("f" if kind.kind == "f" else kind.str[1:])) is not None:
        yield fill


def _number(name: str, variable: Variable, key: str) -> float | None:
    import numpy as np

    value = variable.attributes.get(key)
    if value is None:
        return None
    array = np.asarray(value)
    if array.size != 1 or array.dtype.kind not in "iuf":
        raise UnreadableError(f"the variable {name!r} has a {key} that is not one number")
    return float(array.reshape(-1)[0])


@contextmanager
def _contents(source: OriginalFile) -> Iterator[_Contents]:
    head = next(source.pieces(), b"")[:8]
    if head.startswith(HDF5):
        with opened(source) as file:
            yield _Hdf5(file)
    elif head[:4] in CLASSIC:
        try:
            yield _Classic(source.content())
        except UnreadableError:
            raise
        except (OSError, ValueError, TypeError, LookupError, struct.error, MemoryError, OverflowError, AssertionError) as error:
            raise UnreadableError(f"is truncated or damaged ({' '.join(str(error).split())})") from error
    else:
        raise UnreadableError("is not NetCDF-3 or NetCDF-4, or is truncated")


class _Hdf5:
    """A NetCDF-4 file, whose dimensions are dimension scales of HDF5."""

    def __init__(self, file: h5py.File) -> None:
        self._file = file

    def names(self) -> Sequence[str]:
        return list(self._file)

    def variable(self, name: str) -> Variable | None:
        dataset = self._dataset(name)
        if dataset is None:
            return None
        check(name, dataset, filled=True)
        dimensions = tuple(self._scale(name, place).name.rpartition("/")[2] for place in range(len(dataset.shape)))
        return Variable(dimensions, values(dataset), dict(dataset.attrs))

    def _dataset(self, name: str) -> h5py.Dataset | None:
        import h5py

        if name.partition("/")[0] not in self._file and not name.startswith("/"):
            return None
        found = resolve(self._file, name)
        bare = bytes(found.attrs.get("NAME", b"")).startswith(b"This is a netCDF dimension but not a netCDF variable")
        return None if bare or not isinstance(found, h5py.Dataset) else found

    def _scale(self, name: str, place: int) -> h5py.Dataset:
        """Return the dimension of a variable as HDF5's dataset."""
        dataset = resolve(self._file, name)
        scales = dataset.dims[place]
        if len(scales):
            return scales[0]
        if dataset.is_scale and len(dataset.shape) == 1:
            return dataset
        raise UnreadableError(f'the variable {name!r} has no dimensions of NetCDF; for HDF5, set format = "hdf5"')

    def length(self, variable: str, place: int) -> int:
        return int(self._scale(variable, place).shape[0])


class _Classic:
    """A NetCDF-3 file."""

    def __init__(self, content: bytes) -> None:
        from scipy.io import netcdf_file

        self._lengths = dict(_dimensions(content))
        if math.prod(length for length in self._lengths.values() if length) > LARGEST * len(content):
            raise UnreadableError("has dimensions that do not fit its size")
        self._file = netcdf_file(io.BytesIO(content), "r", mmap=False, maskandscale=False)

    def names(self) -> Sequence[str]:
        return list(self._file.variables)

    def variable(self, name: str) -> Variable | None:
        import numpy as np

        found = self._file.variables.get(name)
        if found is None:
            return None
        attributes = {key: _text(value) for key, value in found._attributes.items()}
        return Variable(tuple(found.dimensions), np.array(found.data), attributes)

    def length(self, variable: str, place: int) -> int:
        return self._lengths[self._file.variables[variable].dimensions[place]]


def _text(value: object) -> object:
    return value.decode(errors="replace") if isinstance(value, bytes) else value


def _dimensions(content: bytes) -> Iterator[tuple[str, int]]:
    """Yield the dimensions of a NetCDF-3 file and their lengths, read without SciPy.

    See https://docs.unidata.ucar.edu/netcdf-c/current/file_format_specifications.html. A record dimension has the length 0.
    """
    records, tag, count = struct.unpack_from(">iii", content, 4)
    offset = 16
    for _ in range(count if tag == 10 else 0):
        [size] = struct.unpack_from(">i", content, offset)
        name = content[offset + 4 : offset + 4 + size].decode()
        offset += 4 + size + -size % 4
        [length] = struct.unpack_from(">i", content, offset)
        offset += 4
        yield name, length or records

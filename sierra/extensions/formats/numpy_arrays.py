"""The reader of NumPy arrays (NPY, NPZ), in long form: a row for each element, with its indices.

An array of two dimensions has the columns `i`, `j` and `value`. The arrays of an NPZ file have the same shape, and each is a
column of its name instead of `value`. The fields of a structured array are columns too. Arrays of objects are pickles, which
could execute code; they are refused. The number of rows follows a second time from the headers of the files.
"""

from __future__ import annotations

import io
import math
import struct
import zipfile
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from sierra.extensions.formats.columnar import Columnar
from sierra.ingest.base import UnreadableError
from sierra.ingest.rewriting import OriginalFile
from sierra.util.lazy_definitions import regex

if TYPE_CHECKING:
    import numpy as np
    import pyarrow as pa

MAGIC = b"\x93NUMPY"
INDICES = "ijklmnop"
SHAPE = regex(rb"'shape': *\(([0-9, ]*)\)")
VALUE = "value"


class NumpyArrays(Columnar):
    """The reader of NumPy arrays."""

    def table(self, source: OriginalFile) -> pa.Table:
        import numpy as np
        import pyarrow as pa

        arrays = fields_of({name: _loaded(name, content) for name, content in _members(source.content()).items()})
        shapes = {name: array.shape for name, array in arrays.items()}
        first = next(iter(shapes), "")
        for name, shape in shapes.items():
            if shape != shapes[first]:
                raise UnreadableError(f"the array {name!r} has the shape {shape}, but {first!r} has {shapes[first]}")
        if not arrays:
            return pa.table({})
        size = shapes[first]
        if len(size) > len(INDICES):
            raise UnreadableError(f"has {len(size)} dimensions; {len(INDICES)} is the maximum")
        places = np.indices(size).reshape(len(size), -1) if size else ()
        indices = dict(zip(INDICES, places, strict=False))
        if twice := sorted(indices.keys() & arrays.keys()):
            raise UnreadableError(f"the array {twice[0]!r} has the name of an index")
        self.shape = replace(self.shape, places=tuple(indices))
        return pa.table(indices | {name: plain(name, array) for name, array in arrays.items()})

    def count(self, source: OriginalFile, written: int) -> int:
        first = next(iter(_members(source.content()).values()), b"")
        if not first:
            return 0
        found = SHAPE.search(first[:65_536])
        if found is None:
            raise UnreadableError("its header has no shape")
        return math.prod(int(length) for length in found[1].split(b",") if length.strip())


def _members(content: bytes) -> Mapping[str, bytes]:
    """Return the NPY files in a file by their names. Raises UnreadableError."""
    if content.startswith(MAGIC):
        return {VALUE: content}
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            return {info.filename.removesuffix(".npy"): archive.read(info) for info in archive.infolist()}
    except (zipfile.BadZipFile, OSError, EOFError, NotImplementedError, RuntimeError, ValueError, struct.error) as error:
        raise UnreadableError(f"is truncated, or neither NPY nor NPZ ({error})") from error
    except Exception as error:  # zlib.error and the like
        raise UnreadableError(f"is damaged ({error})") from error


def _loaded(name: str, content: bytes) -> np.ndarray:
    """Return an array. Raises UnreadableError if it is damaged, or a pickle."""
    import numpy as np

    stream = io.BytesIO(content)
    try:
        array = np.lib.format.read_array(stream, allow_pickle=False)
    except (ValueError, EOFError, TypeError, OSError, SyntaxError, MemoryError) as error:
        if "pickle" in str(error) or "Object arrays" in str(error):
            raise UnreadableError(f"the array {name!r} has objects, which are pickles and are not read") from error
        raise UnreadableError(f"the array {name!r} is truncated or damaged ({' '.join(str(error).split())})") from error
    if stream.read(1):
        raise UnreadableError(f"the array {name!r} has bytes after its end")
    return array


def fields_of(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the arrays, with an array for each field of a structured one."""
    found: dict[str, np.ndarray] = {}
    for name, array in arrays.items():
        fields = array.dtype.names
        inner = {name: array} if fields is None else {field: array[field] for field in fields}
        if twice := sorted(found.keys() & inner.keys()):
            raise UnreadableError(f"two arrays or fields are named {twice[0]!r}")
        found |= inner
    return found


def plain(name: str, array: np.ndarray) -> pa.Array:
    """Return the elements of an array in their order, by rows."""
    import pyarrow as pa

    kind = array.dtype.kind
    if kind not in "biufUSMm" or (array.dtype.itemsize > 8 and kind in "iuf"):
        raise UnreadableError(f"the array {name!r} has elements of type {array.dtype}, which a table cannot hold")
    flat = array.reshape(-1)
    if kind == "S":
        try:
            return pa.array([bytes(cell).decode() for cell in flat.tolist()], pa.string())
        except UnicodeDecodeError as error:
            raise UnreadableError(f"the array {name!r} has texts that are not UTF-8") from error
    if kind == "U":
        return pa.array(flat.tolist(), pa.string())
    try:
        return pa.array(flat.astype("f4" if flat.dtype.itemsize == 2 and kind == "f" else flat.dtype.newbyteorder("=")))
    except (pa.ArrowException, TypeError, ValueError) as error:
        raise UnreadableError(f"the array {name!r} cannot be stored: {' '.join(str(error).split())}") from error

"""Columns of Arrow tables as NumPy arrays, without pandas: pyarrow's own `to_numpy` imports pandas wherever it is installed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy.typing as npt
    import pyarrow as pa


def numpy_of(column: pa.ChunkedArray) -> npt.NDArray[Any]:
    """Return a column of numbers; with a missing value, all are floats and the missing one is NaN."""
    import numpy as np
    import pyarrow as pa

    if not (pa.types.is_integer(column.type) or pa.types.is_floating(column.type)):
        return np.array(column.to_pylist())
    whole = column if not column.null_count else column.cast(pa.float64())
    chunks = [filled(chunk, float("nan")) for chunk in whole.chunks if len(chunk)]
    return np.concatenate(chunks) if chunks else np.empty(0, whole.type.to_pandas_dtype())


def filled(array: pa.Array, fill: float) -> npt.NDArray[Any]:
    """Return an array of numbers with `fill` for missing values; an array with missing values has 64-bit numbers.

    The bits of the first buffer of an Arrow array say which values are not missing.
    """
    import numpy as np
    import pyarrow as pa

    if not array.null_count:
        values: npt.NDArray[Any] = np.from_dlpack(array)
        return values
    validity, content = array.buffers()
    span = slice(array.offset, array.offset + len(array))
    known = np.unpackbits(np.frombuffer(validity, np.uint8), bitorder="little")[span] == 1
    given = np.frombuffer(content, np.float64 if pa.types.is_floating(array.type) else np.int64)[span]
    return np.where(known, given, fill).astype(given.dtype, copy=False)

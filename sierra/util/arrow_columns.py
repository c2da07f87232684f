"""Columns of Arrow tables as NumPy arrays and as Python values, without pandas.

pyarrow's own `to_numpy` imports pandas wherever it is installed, and its `to_pylist` needs pandas for nanoseconds.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy.typing as npt
    import pyarrow as pa


def rows_of(table: pa.Table) -> list[dict[str, Any]]:
    """Return the rows of a table by column, with values as `values_of` returns them."""
    columns = [values_of(column) for column in table.columns]
    return [dict(zip(table.column_names, row, strict=True)) for row in zip(*columns, strict=True)]


def values_of(column: pa.Array | pa.ChunkedArray) -> list[Any]:
    """Return the values of a column; times with nanoseconds, and intervals, are texts, because Python has no type for them."""
    import pyarrow as pa

    if pa.types.is_timestamp(column.type) and column.type.unit == "ns" and column.type.tz:
        texts = column.cast(pa.timestamp("ns", "UTC")).cast(pa.timestamp("ns")).cast(pa.string()).to_pylist()
        return [None if text is None else f"{text}+00" for text in texts]
    kind = _with_texts(column.type)
    values = (column if kind == column.type else column.cast(kind)).to_pylist()
    return list(map(_plain, values)) if "month_day_nano" in str(kind) else values


def without_intervals(table: pa.Table) -> pa.Table:
    """Return a table with texts in place of intervals, which Parquet files cannot hold."""
    import pyarrow as pa

    for place, field in enumerate(table.schema):
        if pa.types.is_interval(field.type):
            table = table.set_column(place, field.name, pa.array(values_of(table.column(place)), pa.string()))
    return table


def _with_texts(kind: pa.DataType) -> pa.DataType:
    """Return a type with texts for times with nanoseconds, also within lists and structures."""
    import pyarrow as pa

    if pa.types.is_list(kind) or pa.types.is_large_list(kind):
        return pa.list_(_with_texts(kind.value_type)) if _with_texts(kind.value_type) != kind.value_type else kind
    if pa.types.is_struct(kind):
        fields = [kind.field(index) for index in range(kind.num_fields)]
        return pa.struct([field.with_type(_with_texts(field.type)) for field in fields])
    exact = (pa.types.is_timestamp(kind) or pa.types.is_time64(kind)) and kind.unit == "ns"
    return pa.string() if exact else kind


def _plain(value: Any) -> Any:
    """Return a value with texts in place of intervals of months, days and nanoseconds."""
    match value:
        case list():
            return list(map(_plain, value))
        case dict():
            return {name: _plain(inner) for name, inner in value.items()}
        case (months, days, nanoseconds) if hasattr(value, "nanoseconds"):
            return interval(months, days, nanoseconds)
        case _:
            return value


def interval(months: int, days: int, nanoseconds: int) -> str:
    """Return an interval as text, as DuckDB writes it: `1 year 2 days 00:00:01.5`."""
    years, months = (int(part) for part in (months / 12, months % 12 if months >= 0 else -(-months % 12)))
    parts = {"year": years, "month": months, "day": days}
    words = [f"{count} {name}{'s' * (abs(count) != 1)}" for name, count in parts.items() if count]
    seconds, fraction = divmod(abs(nanoseconds), 10**9)
    clock = f"{seconds // 3600:02}:{seconds // 60 % 60:02}:{seconds % 60:02}"
    clock += f".{fraction:09}".rstrip("0") if fraction else ""
    return " ".join([*words, *(["-" * (nanoseconds < 0) + clock] if nanoseconds or not words else [])])


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

"""The hash of a table's data: equal for equal data, whatever order the rows came in.

The SHA-256 covers, in this order,

    sierra data 1\\n                           the version of this rule
    columns                                  as JSON: a list of [name, type], in their order
    the number of rows                       8 bytes, little-endian, as all numbers below
    for each column, its rows in sorted order: a byte for each row (1: it has a value), then the values

Numbers, times and flags are 8 bytes each: whole numbers as such, times in their unit, floats by their bits (so that 0 and −0
differ), where all NaN have the same bits. The width of a number does not count. Values of other types are texts: the number of
bytes, then UTF-8 text; lists and structs are JSON in which floats are the hexadecimal digits of their bits. A missing value is
0, or the empty text. Rows are sorted by these values, so that their order does not depend on the order in which a query returns
them.
"""

from __future__ import annotations

import hashlib
import json
import math
import struct
from collections.abc import Sequence
from typing import TYPE_CHECKING

from sierra.util.arrow_columns import filled

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt
    import pyarrow as pa

    Keys = npt.NDArray[np.int64]

VERSION = b"sierra data 1\n"
AT_A_TIME = 65536
"""The number of texts that are added to a hash at a time."""
NAN = 0x7FF8000000000000
"""The bits of the NaN that stands for all."""


def data_hash(table: pa.Table) -> str:
    """Return the hash of a table's columns, types and rows as 64 hexadecimal digits; the order of the rows does not count."""

    columns = [_Column(table.column(index).combine_chunks()) for index in range(table.num_columns)]
    names = [[field.name, column.type] for field, column in zip(table.schema, columns, strict=True)]
    digest = hashlib.sha256(VERSION)
    digest.update(json.dumps(names, ensure_ascii=False, separators=(",", ":")).encode())
    digest.update(struct.pack("<q", table.num_rows))
    order = _order([key for column in columns for key in (column.present, column.keys)], table.num_rows)
    for column in columns:
        column.update(digest, order)
    return digest.hexdigest()


def _order(keys: Sequence[Keys], rows: int) -> Keys:
    """Return the order of rows by their keys; only so many of the first keys are used as tell all rows apart."""
    import numpy as np

    keys = [key for key in keys if rows and key.min() < key.max()]
    order, used = np.arange(rows), 0
    while used < len(keys):
        used = max(2, 2 * used)
        order = np.lexsort(keys[:used][::-1])
        if np.any([key[order][1:] != key[order][:-1] for key in keys[:used]], axis=0).all():
            break
    return order


class _Column:
    """A column as whole numbers by which rows can be sorted; those of texts are the ranks of the texts."""

    def __init__(self, values: pa.Array | pa.ChunkedArray) -> None:
        import pyarrow as pa
        from pyarrow import types

        if isinstance(values, pa.ChunkedArray):  # combine_chunks keeps those that are too large for one array
            values = pa.chunked_array([values.cast(pa.large_string())]).combine_chunks()
        kind = values.type
        if types.is_dictionary(kind):
            values, kind = values.dictionary_decode(), kind.value_type
        self.present = filled(values.is_valid().cast(pa.int64()), 0)
        self.texts: Sequence[bytes] = ()
        if types.is_floating(kind):
            self.type, self.keys = "float", _bits(values)
        elif types.is_boolean(kind) or (types.is_integer(kind) and not types.is_uint64(kind)):
            self.type = "boolean" if types.is_boolean(kind) else "integer"
            self.keys = _whole(values)
        elif types.is_temporal(kind) and not types.is_interval(kind):
            self.type, self.keys = str(kind), _whole(values.cast(pa.int32() if kind.bit_width == 32 else pa.int64()))
        else:
            self.type = "text" if _is_text(kind) else str(kind)
            self.texts, self.keys = _ranked(values)

    def update(self, digest: hashlib._Hash, order: Keys) -> None:
        """Add the column to a hash, in this order of the rows."""
        digest.update(self.present[order].astype("uint8").tobytes())
        if not self.texts:
            digest.update(self.keys[order].astype("<i8").tobytes())
            return
        parts = [struct.pack("<q", len(text)) + text for text in self.texts]
        for begin in range(0, len(order), AT_A_TIME):
            digest.update(b"".join([parts[place] for place in self.keys[order[begin : begin + AT_A_TIME]].tolist()]))


def _whole(values: pa.Array) -> Keys:
    """Return whole numbers, times or flags as numbers of 64 bits; those of missing values are 0."""
    import pyarrow as pa

    keys: Keys = filled(values.cast(pa.int64()), 0)
    return keys


def _bits(values: pa.Array) -> Keys:
    """Return the bits of floats as whole numbers; those of missing values are 0."""
    import numpy as np
    import pyarrow as pa

    floats = filled(values.cast(pa.float64()), 0.0).copy()
    bits: Keys = floats.view(np.int64)
    bits[np.isnan(floats)] = NAN
    return bits


def _is_text(kind: pa.DataType) -> bool:
    from pyarrow import types

    return bool(types.is_string(kind) or types.is_large_string(kind) or types.is_string_view(kind))


def _ranked(values: pa.Array) -> tuple[Sequence[bytes], Keys]:
    """Return the different texts of values in the order of their bytes, and the place of each value's text among them."""
    import numpy as np
    import pyarrow as pa

    places: Keys = np.arange(len(values)) + 1
    if _is_text(values.type):
        coded = values.cast(pa.large_string()).dictionary_encode()
        values, places = coded.dictionary, filled(coded.indices.cast(pa.int64()), -1) + 1
    words = ("" if value is None else _text(value) for value in ("", *values.to_pylist()))
    texts = [word.encode("utf-8", "surrogateescape") for word in words]
    known = sorted(set(texts))
    ranks = {text: rank for rank, text in enumerate(known)}
    return known, np.array([ranks[text] for text in texts], dtype=np.int64)[places]


def _text(value: object) -> str:
    """Return a value as text: texts as they are, all others as JSON in which no digit of a float is lost."""
    return value if isinstance(value, str) else json.dumps(_plain(value), ensure_ascii=False, separators=(",", ":"))


def _plain(value: object) -> object:
    match value:
        case float():
            return struct.pack(">d", math.nan if math.isnan(value) else value).hex()
        case dict():
            return {str(name): _plain(inner) for name, inner in value.items()}
        case list() | tuple():
            return [_plain(inner) for inner in value]
        case bytes():
            return value.hex()
        case bool() | int() | str() | None:
            return value
        case _:
            return str(value)

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
NAN = 0x7FF8000000000000
"""The bits of the NaN that stands for all."""


def data_hash(table: pa.Table) -> str:
    """Return the hash of a table's columns, types and rows as 64 hexadecimal digits; the order of the rows does not count."""
    import numpy as np

    columns = [_Column(table.column(place).combine_chunks()) for place in range(table.num_columns)]
    names = [[field.name, column.type] for field, column in zip(table.schema, columns, strict=True)]
    digest = hashlib.sha256(VERSION)
    digest.update(json.dumps(names, ensure_ascii=False, separators=(",", ":")).encode())
    digest.update(struct.pack("<q", table.num_rows))
    keys = [key for column in columns for key in (column.present, column.keys)]
    order = np.lexsort(keys[::-1]) if keys and table.num_rows else np.arange(table.num_rows)
    for column in columns:
        column.update(digest, order)
    return digest.hexdigest()


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
            self.texts, self.keys = _ranked(["" if one is None else _text(one) for one in values.to_pylist()])

    def update(self, digest: hashlib._Hash, order: Keys) -> None:
        """Add the column to a hash, in this order of the rows."""
        digest.update(self.present[order].astype("uint8").tobytes())
        if not self.texts:
            digest.update(self.keys[order].astype("<i8").tobytes())
            return
        for place in self.keys[order].tolist():
            text = self.texts[place]
            digest.update(struct.pack("<q", len(text)))
            digest.update(text)


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


def _ranked(texts: Sequence[str]) -> tuple[Sequence[bytes], Keys]:
    """Return the different texts in the order of their bytes, and the place of each row's text among them."""
    import numpy as np

    known = sorted({text.encode("utf-8", "surrogateescape") for text in texts})
    places = {text: place for place, text in enumerate(known)}
    keys = (places[text.encode("utf-8", "surrogateescape")] for text in texts)
    return known, np.fromiter(keys, dtype=np.int64, count=len(texts))


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

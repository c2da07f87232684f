"""The readers of JSON documents, and of JSON lines with nested values: each object becomes a row.

A document is a list of objects, an object of columns (lists of the same length), or one object, which is one row. `rows` names
a part of it, such as `results.steps`. Nested objects become columns such as `pose.x`. `unnest` names a list in each object and
makes a row of each of its items; an object without items stays one row.

The rows are written as JSON lines, which the reader of that format reads. DuckDB's parser counts them in the original.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import BinaryIO

from sierra.ingest.base import UnreadableError
from sierra.ingest.independent_row_count import count_filled
from sierra.ingest.jsonl import Jsonl
from sierra.ingest.missing_values import MissingValues
from sierra.ingest.model import PLAIN, Shape
from sierra.ingest.rewriting import OriginalFile, Rewriter
from sierra.ingest.shipped_reader_base import TableReader
from sierra.store.connections import Database

DOT = "."
Object = Mapping[str, object]
Objects = Iterable[tuple[int, Object]]
"""Objects, each with its number, or the number of its line."""


class JsonDocument(Rewriter):
    """The reader of JSON documents."""

    word = "row"

    def __init__(self, shape: Shape, connection: Database) -> None:
        super().__init__(shape, connection)
        self._missing = MissingValues(shape.form.na)

    @classmethod
    def reader(cls) -> type[TableReader]:
        return Jsonl

    def plain(self) -> Shape:
        return replace(self.shape, format="jsonl", form=PLAIN)

    @property
    def _flat(self) -> bool:
        """True if nested objects become columns."""
        return self.shape.form.flatten is not False

    def rewrite(self, source: OriginalFile, target: BinaryIO) -> int:
        rows = 0
        for _, row in self._rows(source):
            target.write(json.dumps(row, separators=(",", ":")).encode() + b"\n")
            rows += 1
        return rows

    def place(self, source: OriginalFile, line: int) -> str:
        number = next((number for row, (number, _) in enumerate(self._rows(source), 1) if row == line), line)
        return f"{self.word} {number}"

    def objects(self, source: OriginalFile) -> Objects:
        """Return the objects in the file. Raises UnreadableError."""
        document = _part(parsed(source.content()), self.shape.form.rows)
        return enumerate(_objects_of(document, columns=not self.shape.form.unnest), 1)

    def count(self, source: OriginalFile, written: int) -> int:
        return self.counted(source.content().decode("utf-8-sig"), _keys(self.shape.form.rows))

    def counted(self, text: str, keys: Sequence[str]) -> int:
        """Return the number of rows in a part of a document, by DuckDB's parser."""
        length, names = self._lengths(text, _pointer(keys)), _keys(self.shape.form.unnest)
        if length is not None:
            return self._items(text, _pattern(keys, names), length) if names else length
        if names:
            return max(self._lengths(text, _pointer([*keys, *names])) or 0, 1)
        column_keys = self._asked("SELECT unnest(json_keys($text, $path))", text, _pointer(keys))
        columns = [self._lengths(text, _pointer([*keys, str(key)])) for [key] in column_keys]
        lengths = [length for length in columns if length is not None]
        return min(lengths, default=0) if len(lengths) == len(columns) else 1

    def _lengths(self, text: str, path: str) -> int | None:
        """Return the length of the list at this place; None if there is no list."""
        what = "CASE WHEN json_type($text, $path) = 'ARRAY' THEN json_array_length($text, $path) END"
        [[length]] = self._asked(f"SELECT {what}", text, path)
        return None if length is None else int(str(length))

    def _items(self, text: str, path: str, objects: int) -> int:
        """Return the number of items of the lists of so many objects; an object without items is one row."""
        lengths = self._asked("SELECT unnest(json_array_length($text, $path))", text, path)
        return sum(max(int(str(length)), 1) for [length] in lengths) + objects - len(lengths)

    def _asked(self, statement: str, text: str, path: str) -> list[Sequence[object]]:
        try:
            return list(self.sql.execute(statement, {"text": text, "path": path}).fetchall())
        except Exception as error:
            raise UnreadableError(f"a second parser does not read it: {error}") from error

    def _rows(self, source: OriginalFile) -> Iterator[tuple[int, Object]]:
        """Yield the rows, each with the number of its object."""
        nested = self._nested(source) if self._flat else frozenset()
        for number, json_object in self._split(source):
            row = {name: value for name, value in json_object.items() if value is not None or name not in nested}
            if self._missing:
                row = {name: None if self._missing.has_value(value) else value for name, value in row.items()}
            yield number, row

    def _nested(self, source: OriginalFile) -> frozenset[str]:
        """Return the names of the objects that became columns. Where such an object is null, it is no column itself."""
        names = {name for _, row in self._split(source) for name in row if DOT in name}
        return frozenset(name[:index] for name in names for index, character in enumerate(name) if character == DOT)

    def _split(self, source: OriginalFile) -> Iterator[tuple[int, Object]]:
        """Yield the rows of each object, with the object's number: several if its list is unnested."""
        for number, json_object in self.objects(source):
            try:
                for row in _unnested(json_object, _keys(self.shape.form.unnest)):
                    yield number, flattened(row) if self._flat else row
            except ValueError as error:
                raise UnreadableError(f"{self.word} {number}: {error}") from error


class JsonLines(JsonDocument):
    """The reader of JSON lines whose nested values become columns or rows, and of compressed ones."""

    word = "line"

    @property
    def _flat(self) -> bool:
        return bool(self.shape.form.flatten)

    def objects(self, source: OriginalFile) -> Objects:
        for number, line in enumerate(source.lines(), 1):
            if line.strip():
                try:
                    [json_object] = _objects_of([parsed(line)], columns=False)
                except UnreadableError as error:
                    raise UnreadableError(f"line {number}: {error}") from error
                yield number, json_object

    def count(self, source: OriginalFile, written: int) -> int:
        content = source.content()
        if not self.shape.form.unnest:
            return count_filled(content)
        lines = (line.decode("utf-8-sig") for line in content.split(b"\n") if line.strip())
        return self.counted(f"[{','.join(lines)}]", ())


def parsed(content: bytes) -> object:
    """Return a JSON document. Raises UnreadableError if it is damaged, or has a key twice."""
    try:
        text = content.decode("utf-8-sig")
        return json.loads(text, object_pairs_hook=_once, parse_float=_finite, parse_int=_whole)
    except UnicodeDecodeError as error:
        raise UnreadableError(f"is not UTF-8 (byte {error.start})") from error
    except RecursionError as error:
        raise UnreadableError("is nested too deeply") from error
    except json.JSONDecodeError as error:
        position = f"line {error.lineno}, column {error.colno}: " if error.lineno > 1 else f"column {error.colno}: "
        raise UnreadableError(f"{position}is truncated or not JSON ({error.msg})") from error
    except ValueError as error:
        raise UnreadableError(str(error)) from error


def flattened(json_object: Object) -> dict[str, object]:
    """Return an object with the values of nested objects, such as `pose.x`. Raises ValueError if a name occurs twice."""
    flat: dict[str, object] = {}
    for key, value in json_object.items():
        inner = (
            {f"{key}{DOT}{name}": nested for name, nested in flattened(value).items()}
            if isinstance(value, dict)
            else {key: value}
        )
        if twice := flat.keys() & inner.keys():
            raise ValueError(f"two values are named {min(twice)!r}")
        flat |= inner
    return flat


def _unnested(json_object: Object, keys: Sequence[str]) -> Iterator[Object]:
    """Yield an object for each item of the list at this place, with the item instead of the list."""
    if not keys or (value := json_object.get(keys[0])) is None:
        yield json_object
    elif len(keys) > 1:
        if not isinstance(value, dict):
            raise ValueError(f"{keys[0]!r} is not an object")
        for inner in _unnested(value, keys[1:]):
            yield {**json_object, keys[0]: inner}
    elif not isinstance(value, list):
        raise ValueError(f"{keys[0]!r} is not a list")
    else:
        for item in value or [None]:
            yield {**json_object, keys[0]: item}


def _part(document: object, rows: str) -> object:
    """Return the part of a document that `rows` names."""
    for key in _keys(rows):
        if not isinstance(document, dict) or key not in document:
            raise UnreadableError(f"has no {rows!r} (rows in [outputs.…])")
        document = document[key]
    return document


def _objects_of(document: object, *, columns: bool) -> Sequence[Object]:
    """Return the objects of a list, of an object of columns, or a single object."""
    if isinstance(document, dict) and columns and all(isinstance(value, list) for value in document.values()):
        lengths = {name: len(values) for name, values in document.items()}
        for name, length in lengths.items():
            if length != next(iter(lengths.values())):
                raise UnreadableError(
                    f"the column {name!r} has {length} values, but the first has {next(iter(lengths.values()))}"
                )
        return [dict(zip(document, values, strict=True)) for values in zip(*document.values(), strict=True)]
    items: list[object] = document if isinstance(document, list) else [document]
    return [_object(item, f"item {number}: " if len(items) > 1 else "") for number, item in enumerate(items, 1)]


def _object(value: object, position: str) -> Object:
    if not isinstance(value, dict):
        raise UnreadableError(f"{position}is not an object: {json.dumps(value)[:80]}")
    return value


def _once(pairs: Sequence[tuple[str, object]]) -> dict[str, object]:
    json_object = dict(pairs)
    if len(json_object) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"the key {next(name for name in names if names.count(name) > 1)!r} occurs twice")
    return json_object


def _finite(text: str) -> float:
    """Return a number written with a point or an exponent. Raises ValueError if it is too large for DOUBLE.

    A whole number such as 9007199254740993.0 becomes an int if DOUBLE cannot hold it.
    """
    number = float(text)
    if math.isinf(number):
        raise ValueError(f"the number {text[:80]} is too large")
    whole, _, rest = text.partition(".")
    return int(whole) if abs(number) >= 2**53 and rest and not rest.strip("0") and int(whole) != number else number


def _whole(text: str) -> float:
    return -0.0 if text == "-0" else int(text)


def _keys(dotted: str) -> list[str]:
    return dotted.split(DOT) if dotted else []


def _pointer(keys: Sequence[str]) -> str:
    """Return the JSON pointer of a place."""
    return "".join("/" + key.replace("~", "~0").replace("/", "~1") for key in keys) or "$"


def _pattern(keys: Sequence[str], within: Sequence[str]) -> str:
    """Return the JSON path of a place within each item of a list."""
    if any('"' in key or "\\" in key for key in (*keys, *within)):
        raise UnreadableError("rows and unnest cannot have quotes or backslashes")
    first, second = ("".join(f'."{key}"' for key in some) for some in (keys, within))
    return f"${first}[*]{second}"

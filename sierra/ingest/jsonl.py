"""The reader of JSON lines, with one object per line."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from sierra.ingest.independent_row_count import count_lines, lines_of
from sierra.ingest.messages import shown
from sierra.ingest.model import Part, Written
from sierra.ingest.shipped_reader_base import FILE
from sierra.ingest.text_table_reader import Text
from sierra.store.duckdb_file_io import objects_given
from sierra.store.duckdb_messages import first_line
from sierra.store.sql_names import identifier, quote
from sierra.store.type_inference import VISUAL_C

UNBOUNDED = rf"[-+]?(?i:inf|infinity|nan)|{VISUAL_C}"
"""Infinity and nan, which JSON can only write as texts in quotes."""


class Jsonl(Text):
    """The reader of JSON lines, with one object per line."""

    as_written = False  # DuckDB's parser turns 1.582218195625939e18 into 1582218195625939000.0

    def sort(self, files: Sequence[Written]) -> Mapping[str, Part | None]:
        try:
            keys = self._keys(files)
        except self.error:
            self.halve(files, self._keys, lambda file, error: self.first_fault(file, (), {}) or first_line(error))
            keys = self._keys(self.sound(files))
        return {file.path: Part(tuple(keys[file.path])) if file.path in keys else None for file in files}

    def _keys(self, files: Sequence[Written]) -> dict[str, dict[str, None]]:
        """Return the keys of each file's objects, by path."""
        rows = self.fetch(
            f"SELECT DISTINCT {identifier(FILE)}, CASE WHEN json_type(json) <> 'OBJECT' THEN error('not an object') "
            "WHEN len(json_keys(json)) <> len(list_distinct(json_keys(json))) THEN error('a key occurs twice') "
            f"ELSE json_keys(json) END FROM {self._objects()}",
            files,
        )
        by_path: dict[str, dict[str, None]] = {}
        for path, keys in sorted(rows, key=lambda row: -len(row[1])):
            by_path.setdefault(path, {}).update(dict.fromkeys(keys))
        return by_path

    def _objects(self) -> str:
        return objects_given(FILE)

    def relation(self, names: Sequence[str], types: Mapping[str, str]) -> str:
        pointers = ("/" + name.replace("~", "~0").replace("/", "~1") for name in names)
        values = (f"nullif(json_extract(json, {quote(pointer)})::VARCHAR, 'null')" for pointer in pointers)
        cells = "".join(f"{_bare(value)} AS c{index}, " for index, value in enumerate(values))
        return f"(SELECT {cells}{identifier(FILE)} FROM {self._objects()})"

    def text(self, cell: str) -> str:
        return f"CASE WHEN starts_with({cell}, '\"') THEN json_extract_string({cell}, '$') ELSE {cell} END"

    def count(self, file: Written, read: int) -> int | str:
        return read if lines_of(file) == read else count_lines(file)

    def first_fault(self, file: Written, names: Sequence[str], types: Mapping[str, str]) -> str | None:
        with Path(file.path).open(encoding="utf-8", errors="surrogateescape") as lines:
            for line, text in enumerate(lines, 1):
                if not text.strip():
                    continue
                try:
                    pairs = json.loads(text, object_pairs_hook=_Pairs)
                except (ValueError, RecursionError):
                    return f"line {line}: is truncated or not JSON: {shown(text.strip())[:80]!r}"
                if not isinstance(pairs, _Pairs):
                    return f"line {line}: is not an object: {text.strip()[:80]!r}"
                doubled = [key for key, count in Counter(key for key, _ in pairs).items() if count > 1]
                if doubled:
                    return f"line {line}: the key {doubled[0]!r} occurs twice"
                for key, value in pairs:
                    number = value is None or (isinstance(value, int | float) and not isinstance(value, bool))
                    number = number or (isinstance(value, str) and re.fullmatch(UNBOUNDED, value) is not None)
                    if types.get(key) == "DOUBLE" and not number:
                        return f"line {line}: text in the numeric column {key!r}: {str(value)[:80]!r}"
        return None


def _bare(cell: str) -> str:
    """Return the SQL expression for a cell without the quotes around infinity or nan."""
    pattern = quote(f'"({UNBOUNDED})"')
    is_quoted = f"starts_with({cell}, '\"') AND regexp_full_match({cell}, {pattern})"
    return f"CASE WHEN {is_quoted} THEN trim({cell}, '\"') ELSE {cell} END"


class _Pairs(list[tuple[str, object]]):
    """The key-value pairs of a JSON object, including duplicate keys."""

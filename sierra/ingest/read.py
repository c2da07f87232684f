"""Reading output files into tables: many files at once, each checked; differences are reported, none is averaged away.

The files of one output that have the same columns form a *part*, which is one Parquet file. Columns may differ between
experiments. If they may differ between two runs of an experiment is decided later (see
`sierra.ingest.consistency.find_inconsistent`). A part without faults is read by one statement. Otherwise, the faulty files are
found by halving, and each fault is reported with its line. A file is at fault if a line has too few or too many fields, if its
last line is cut short, or if it cannot be read at all.

The kind of values in a column (numbers, flags, texts) is not a fault here, because that would depend on which files are read
together. Files with other kinds go into separate Parquet files, and `find_inconsistent` decides. If most of a file's siblings
have text in a column, the file's numbers are kept as text, unchanged: as numbers, 007 and 1e5 would become other texts.

Whole numbers are BIGINT (DECIMAL(38,0) if they are too large), other numbers DOUBLE, `true`/`false` BOOLEAN, dates with a time
in a CSV TIMESTAMP, with or without a time zone, and all other values VARCHAR. Columns that an earlier version recorded as texts
stay texts in their store. Whole numbers that DOUBLE cannot hold keep their digits: beside them, nan is NULL, and beside
fractions, the texts of the numbers are recorded too (see `sierra.store.union_files`). An empty field is NULL. A column without
any value is BOOLEAN, which every other type can hold. Types are inferred from a few files but checked in all, because DuckDB
would round 1.5 to fit BIGINT and read 1 as true. JSON's lists and objects are kept as JSON. A column whose name is a SIERRA
column, or differs from another only in case, gets a trailing underscore.

Also: rotated files, the parts of one file (`data.csv`, `data.csv.1`, `data.csv.2.gz`), as one table, oldest rows first.

The parts of each run are joined before they are read. The header of the oldest part counts; another part may repeat it. Each
part but the newest must end with a line feed. The lines of the joined file are counted a second time, in the parts.
"""

from __future__ import annotations

import gzip
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from sierra.config.output_tables import NUMBERED, part_of
from sierra.config.plugin_registry import READERS
from sierra.ingest.base import UnreadableError, recorded
from sierra.ingest.csv_as_found import BLANKS, CsvAsFound
from sierra.ingest.independent_row_count import described
from sierra.ingest.json_rows import JsonLines
from sierra.ingest.messages import shown
from sierra.ingest.model import PLAIN, Reading, Shape, Siblings, Written
from sierra.ingest.rewriting import OriginalFile, Rewriter, is_compressed, read_rewritten
from sierra.ingest.shipped_reader_base import TableReader
from sierra.store.connections import Database
from sierra.store.duckdb_file_io import Aliases
from sierra.store.segments import disk_errors

BOM = b"\xef\xbb\xbf"


def by_age(files: Iterable[Written], base: str) -> list[Written]:
    """Return the parts of a file, the oldest first: the highest number, or the first date; the file itself is the newest."""
    return sorted(files, key=lambda file: part_of(base, file.name) or ())


def join(files: Sequence[Written], shape: Shape, target: Path) -> Written:
    """Write the parts of one run, which are sorted by age, into one file; return it under the name of the newest part.

    Raises UnreadableError.
    """
    _check_parts(files, shape.rotated)
    if len(files) == 1:
        return files[0]
    whole, lines = bytearray(), 0
    head: Sequence[bytes] = ()
    for index, file in enumerate(files):
        content = OriginalFile(file).content()
        content = content.removeprefix(BOM) if index else content
        if content and not content.endswith(b"\n") and index < len(files) - 1:
            raise UnreadableError(f"its part {shown(file.name)} does not end with a line feed")
        count = content.count(b"\n")
        own, until = _head(content, shape)
        if not index:
            head = own
        elif head and own == head:
            content = content.split(b"\n", until)[-1]
            count -= until
        lines += count
        whole += content
    if whole.count(b"\n") != lines:
        raise UnreadableError("its parts have other lines than the joined file")
    newest = files[-1]
    if is_compressed(newest.name):
        import pyarrow as pa

        packed = (
            gzip.compress(whole) if newest.name.lower().endswith(".gz") else pa.compress(bytes(whole), "zstd", asbytes=True)
        )
        target.write_bytes(packed)
    else:
        target.write_bytes(whole)
    return described(newest, target)


def _check_parts(files: Sequence[Written], base: str) -> None:
    """Raise UnreadableError if two files are the same part, such as `data.csv.1` and `data.csv.1.gz`, or if one is missing."""
    names: dict[tuple[int, int, str] | None, str] = {}
    for file in files:
        first = names.setdefault(part_of(base, file.name), file.name)
        if first != file.name:
            raise UnreadableError(f"its parts {shown(first)} and {shown(file.name)} are the same part; keep one of them")
    numbers = sorted(-part[1] for part in names if part and part[0] == NUMBERED)
    absent = next((number for number in range(1, max(numbers, default=0)) if number not in numbers), None)
    if absent is not None:
        raise UnreadableError(f"its part {absent} is missing, but there is {numbers[-1]}")


def _head(content: bytes, shape: Shape) -> tuple[Sequence[bytes], int]:
    """Return the header of a part without comments, and the number of lines until its end; nothing if it has none."""
    if shape.format != "csv" or not shape.header or shape.form.lines:
        return (), 0
    form = shape.form
    marks = tuple(comment.encode() for comment in form.comments)
    header: list[bytes] = []
    for number, line in enumerate(content.removeprefix(BOM).split(b"\n")[:-1], 1):
        if number > form.skip and line.strip() and not line.lstrip(b" \t").startswith(marks):
            header.append(line)
        if len(header) == form.header_lines + form.units_row:
            return header, number
    return (), 0


AS_FOUND: Mapping[str, type[Rewriter]] = {"csv": CsvAsFound, "jsonl": JsonLines}
"""The rewriters of files that are not as a shipped reader needs them, by format."""


def read(
    connection: Database, files: Sequence[Written], shape: Shape, target: Path, siblings: Siblings | None = None
) -> Reading:
    """Read all files into Parquet files, without those of executions that are at fault.

    The first Parquet file is `target`. If columns or kinds differ, there are others beside it (`target~2`, …).
    Raises Missing if valid rows cannot be written.
    """
    if shape.rotated:
        return _read_rotated(connection, files, shape, target, siblings)
    connection.execute("SET disabled_optimizers = 'join_order,build_side_probe_side'")  # rows keep their order
    reader = _reader(shape, files)
    with Aliases() as aliases:
        named = [file if (path := aliases.of(file.path)) == file.path else replace(file, path=path) for file in files]
        if issubclass(reader, Rewriter):
            return read_rewritten(reader(shape, connection), connection, named, target, siblings or Siblings())
        return reader(connection, shape, target, siblings or Siblings()).read(named)


def _read_rotated(
    connection: Database, files: Sequence[Written], shape: Shape, target: Path, siblings: Siblings | None
) -> Reading:
    """Read the parts of each run's rotated file as one file, under the name of the newest part."""
    parts: dict[str, list[Written]] = {}
    for file in files:
        parts.setdefault(file.execution, []).append(file)
    faults: dict[str, str] = {}
    joined: list[Written] = []
    with tempfile.TemporaryDirectory(prefix="sierra-") as folder, disk_errors(Path(folder)):
        for number, run_parts in enumerate(parts.values()):
            aged = by_age(run_parts, shape.rotated)
            try:
                joined.append(join(aged, shape, Path(folder, str(number))))
            except UnreadableError as error:
                faults[aged[-1].execution] = f"{shown(aged[-1].name)}: {error}"
        reading = read(connection, joined, replace(shape, rotated=""), target, siblings)
    for execution, fault in reading.faults.items():
        lines = "" if len(parts[execution]) < 2 else " (lines are counted from the oldest part on)"
        faults[execution] = fault + lines
    return replace(reading, faults=faults, shape=replace(reading.shape, rotated=shape.rotated))


def _reader(shape: Shape, files: Sequence[Written]) -> type[TableReader] | type[Rewriter]:
    """Return the reader of a format, or the rewriter of files that are not plain."""
    with recorded(shape.format, shape.reader):
        reader: type = READERS.load(shape.format)
    if not issubclass(reader, TableReader | Rewriter):
        from sierra.ingest.parquet import Converted

        return Converted
    if shape.form.lines:
        from sierra.ingest.matching_lines import MatchingLines

        return MatchingLines
    plain = shape.form == PLAIN and shape.delimiter != BLANKS and not any(is_compressed(file.name) for file in files)
    if issubclass(reader, Rewriter) or plain or shape.format not in AS_FOUND:
        return reader
    rewriter: type[Rewriter] = AS_FOUND[shape.format]
    return rewriter

"""The reader of delimited text."""

from __future__ import annotations

import csv
import io
import tempfile
from collections import Counter
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from sierra.ingest.delimiters import PADDED, delimiter_of, reads_as_number, split
from sierra.ingest.independent_row_count import any_size, count_records, csv_reader, described, lines_of
from sierra.ingest.json_lists import in_words
from sierra.ingest.messages import shown
from sierra.ingest.model import Found, Part, Reading, Shape, Siblings, Written
from sierra.ingest.shipped_reader_base import FILE
from sierra.ingest.text_headers import READ, keys_of
from sierra.ingest.text_table_reader import Text
from sierra.store.connections import Database
from sierra.store.duckdb_file_io import csv_given
from sierra.store.segments import disk_errors
from sierra.store.sql_names import unmarked
from sierra.util.lazy_definitions import regex

HEAD_BYTES = 4096
"""The number of bytes of a first line that a worker reports."""
SMALL = 1 << 20
"""The size in bytes of files that are read at once."""
COMMENTS = 'if such lines are comments, set comment = "#" in [outputs.…]'
QUOTING = "put fields that contain quotes in quotes, and double the quotes inside"
BLANK_END = regex(rb"(\r?\n)(?:(?:\r?\n)+\r?|\r)|(\r)\r+")
"""The end of a line, with lines without a character after it."""
CONTROL = regex(r"[\x00-\x08\x0e-\x1f]")
"""Control characters that are not allowed in column names."""


class Csv(Text):
    """The reader of delimited text."""

    times = True
    _longest = 0
    """The length of the longest line of the part in bytes; determined only for files of megabytes."""

    def __init__(self, connection: Database, shape: Shape, target: Path, siblings: Siblings) -> None:
        super().__init__(connection, shape, target, siblings)
        self._records: dict[str, int | str] = {}
        """The number of records in each file, or an error message, by path."""
        self._padded: set[tuple[str, str]] = set()
        """The executions and names of files whose cells keep the blanks around them, as an earlier version recorded them."""
        self._trims = False
        """True if the cells of the part that is being read lose them."""

    def read(self, files: Sequence[Written]) -> Reading:
        with tempfile.TemporaryDirectory(prefix="sierra-") as folder, disk_errors(Path(folder)):
            reading = super().read(list(self._without_blank_ends(files, Path(folder))))
        return replace(reading, padded=self._padded)

    def _without_blank_ends(self, files: Sequence[Written], folder: Path) -> Iterator[Written]:
        """Yield the files; of one with a single column and blank lines at its end, a copy without these lines.

        Other blank lines in such a file are rows without a value. Files are read as before if the store has a sibling whose
        blank lines at the end were recorded as rows.
        """
        counted = None
        for number, file in enumerate(files):
            sound = file.lines and not (file.quotes or 0) % 2
            if (file.blank == 0 and file.ended) or not sound or not self._is_single_column(file):
                yield file
                continue
            content = Path(file.path).read_bytes()
            whole = _without_blank_end(content)
            if len(whole) < len(content):
                counted = self._counts_blank_ends() if counted is None else counted
            if len(whole) == len(content) or counted:
                yield file
                continue
            copy = folder / str(number)
            copy.write_bytes(whole)
            yield described(file, copy)

    def _is_single_column(self, file: Written) -> bool:
        if self.shape.names:
            return len(self.shape.names) == 1
        head = _first_record(file)
        return len(split(head, self.shape.delimiter or delimiter_of(head))) == 1

    def _counts_blank_ends(self) -> bool:
        """Check if blank lines at the end of a sibling were recorded as rows, by an earlier version."""
        content, rows = self.siblings.example() or (b"", 0)
        whole = _without_blank_end(content)
        return len(whole) < len(content) and rows > whole.count(b"\n") - self.shape.header

    def sort(self, files: Sequence[Written]) -> Mapping[str, Part | None]:
        for file in files:
            if file.bytes == 0 and self.shape.header:
                self.fault(file, "is empty and has no header")
        self._cut(self.sound(files))
        heads = {file.path: _first_record(file) for file in self.sound(files)}
        described = self._described(Counter(heads.values()))
        for file in self.sound(files):
            part = described[heads[file.path]]
            if isinstance(part, str):
                self.fault(file, f"line 1: {part}")
        return {path: part for path, head in heads.items() if not isinstance(part := described[head], str)}

    def fault(self, file: Written, what: str) -> None:
        super().fault(file, what + self._advice(file, what))

    def _advice(self, file: Written, what: str) -> str:
        """Return the keys that read a file whose names are not in its first line; "" if a message already names them."""
        with Path(file.path).open("rb") as content:
            keys = keys_of(content.read(READ + 1))
        if not self.shape.header:
            keys = {name: value for name, value in (keys or {}).items() if name != "header"}
        if not keys or not self.shape.name or all(f"{key} = " in what for key in keys):
            return ""
        named = keys if self.shape.declared else {"file": file.name, **keys}
        return f" (set {in_words(named)} in [outputs.{self.shape.name}])"

    def key(self, part: Part) -> Hashable:
        return part.names, part.delimiter

    def _described(self, heads: Counter[str]) -> dict[str, Part | str | None]:
        """Return the columns that each first line describes, or an error message."""
        if self.shape.header:
            return {head: self._named(head) for head in heads}
        delimiter = self.shape.delimiter or delimiter_of(heads.most_common(1)[0][0] if heads else "")
        return {head: self._numbered(head, delimiter) for head in heads}

    def _named(self, head: str) -> Part | str:
        delimiter = self.shape.delimiter or delimiter_of(head)
        names = self._unmarked(split(head, delimiter))
        if not any(names):
            return "is empty, but must contain the column names"
        if "\ufffd" in head or CONTROL.search(head):
            return f"is not UTF-8 text (is it compressed?): {head[:80]!r}"
        if head.count('"') % 2:
            return f"quotes are not closed: {head[:80]!r}"
        if all(reads_as_number(name) for name in names):
            return "numbers instead of column names (if the file has no header, set header = false in [outputs.…])"
        names = tuple(name or f"column{index}" for index, name in enumerate(names))
        doubled = [name for name, count in Counter(names).items() if count > 1]
        if doubled:
            return f"the column {doubled[0]!r} occurs twice"
        return Part(names, delimiter)

    def _unmarked(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """Return the names without the mark of a comment before the first one, unless the table has been recorded with it."""
        first = unmarked(names[0]) if names else ""
        is_sentence = len(names) == 1 and len(first.split()) > 1
        taken = {name.lower() for name in names[1:]}
        if not names or first == names[0] or is_sentence or first.lower() in taken or names[0] in self.siblings.names():
            return names
        return (first, *names[1:])

    def _numbered(self, head: str, delimiter: str) -> Part | None:
        """Return the columns of a file without header: as declared, or one for each field of its first line."""
        width = len(split(head, delimiter))
        if self.shape.names or width:
            return Part(self.shape.names or tuple(f"column{number}" for number in range(width)), delimiter)
        return None

    def read_part(self, files: Sequence[Written]) -> None:
        for file in files:
            if fault := self._misquoted(file):
                self.fault(file, fault)
        self._quoted_well(self.sound(files))

    def _misquoted(self, file: Written) -> str | None:
        """Return the error in the quotes of a file, or None. DuckDB may silently skip rows after such an error."""
        if file.quotes == 0:
            return None
        if (file.quotes or 0) % 2:
            return self._unquoted(file)
        counted = self._records_in(file)
        return counted if isinstance(counted, str) else None

    def _quoted_well(self, files: Sequence[Written]) -> None:
        if not files:
            return
        large = [file for file in files if file.bytes >= 2_000_000]
        self._longest = max(map(_longest_line, large), default=0)
        padded = self.part.delimiter == PADDED
        self._trims = padded and self.siblings.texts_without("trimmed").isdisjoint(self.part.names)
        self._padded |= {(file.execution, file.name) for file in files if padded and not self._trims}
        super().read_part(files)

    def count(self, file: Written, read: int) -> int | str:
        header = int(self.shape.header)
        lines = None if file.quotes else lines_of(file, empty=self._empty)
        if lines is not None and max(lines - header, 0) == read:
            return read
        counted = self._records_in(file)
        return max(counted - header, 0) if isinstance(counted, int) else counted

    def _records_in(self, file: Written) -> int | str:
        """Return the number of records that Python's csv reads in a file, its header included, or an error message."""
        if (known := self._records.get(file.path)) is None:
            try:
                known = count_records(file, self._delimiter, empty=self._empty)
            except csv.Error:
                known = self._unquoted(file)
            self._records[file.path] = known
        return known

    @property
    def _empty(self) -> bool:
        """True if an empty line is a row without a value."""
        return len(self.part.names) == 1

    @property
    def _delimiter(self) -> str:
        """The delimiter of the part that is being read; any delimiter for a file without columns."""
        return self.part.delimiter or ","

    def miscount(self, file: Written, counted: int, read: int) -> str:
        if not self.part.names:
            return f"line 1: is empty, but {counted} rows follow; name the columns (set columns = [...] in [outputs.…])"
        message = self.first_fault(file, self.part.names, dict.fromkeys(self.part.names, "VARCHAR"))
        return message or f"{super().miscount(file, counted, read)} ({QUOTING}, and end all lines in the same way)"

    def _unquoted(self, file: Written) -> str:
        """Return the position of the first error in quotes; if all quotes have a partner, the first line with an odd number."""
        for line, record, _ in _read_slowly(file, self._delimiter):
            if isinstance(record, str):
                return f"line {line}: {record}"
        with Path(file.path).open(encoding="utf-8", errors="surrogateescape", newline="") as lines:
            odd = ((line, text) for line, text in enumerate(lines, 1) if text.count('"') % 2)
            line, text = next(odd, (1, ""))
        return f"line {line}: an odd number of quotes: {shown(text.strip())[:80]!r} ({QUOTING})"

    def contradictions(self, files: Sequence[Written], found: Found) -> Iterator[tuple[Written, str]]:
        """Yield the files that repeat their header, for example because a run appended to them; then all columns are text."""
        names = [name for index, name in enumerate(self.part.names) if name != f"column{index}" and not reads_as_number(name)]
        for file in files if self.shape.header else ():
            if names and all(found[name].get(file.path) == "VARCHAR" for name in names) and (line := self._header_again(file)):
                message = f"line {line}: the header is repeated: {_first_record(file)[:80]!r}"
                yield file, f"{message} (did the run append to the file? write the header once, before all rows)"

    def _header_again(self, file: Written) -> int | None:
        """Return the first line that repeats the header; None if a single column of texts contains the name as a value."""
        again = None

        def fields(line: str) -> tuple[str, ...]:
            return split(line.removeprefix("\ufeff").rstrip("\n"), self._delimiter)

        with Path(file.path).open(encoding="utf-8", errors="replace") as lines, any_size():
            names = fields(next(lines))
            for number, line in enumerate(lines, 2):
                if fields(line) == names:
                    again = again or number
                elif len(self.part.names) == 1 and line.strip() and not reads_as_number(line):
                    return None
        return again

    def relation(self, names: Sequence[str], types: Mapping[str, str]) -> str:
        columns = {f"c{index}": "DOUBLE" if types[name] == "DOUBLE" else "VARCHAR" for index, name in enumerate(names)}
        longest = self._longest + 1 if self._longest >= 2_000_000 else None
        given = csv_given(columns, FILE, delimiter=self.part.delimiter, header=self.shape.header, longest=longest)
        bare = ", ".join(f"nullif(trim({name}), '') AS {name}" for name, kind in columns.items() if kind == "VARCHAR")
        return f"(SELECT * REPLACE ({bare}) FROM {given})" if self._trims and bare else given

    def has_underscores(self, file: Written) -> bool:
        if file.bytes < SMALL:  # there may be many thousands of such files
            with io.FileIO(file.path) as small:
                content = small.readall()
            return b"_" in (content.partition(b"\n")[2] if self.shape.header else content)
        with Path(file.path).open("rb") as data:
            if self.shape.header:
                data.readline()
            return any(b"_" in piece for piece in iter(lambda: data.read(1 << 20), b""))

    def _cut(self, files: Sequence[Written]) -> None:
        """Mark files whose last line has no line feed as faulty, if at least half of all files end with one."""
        cut = [file for file in files if not file.ended]
        ended = len(files) - len(cut) + self.shape.ended
        if ended >= len(cut) + self.shape.files - self.shape.ended:
            for file in cut:
                self.fault(file, f"line {file.lines + 1}: the last line is truncated (it does not end with a line feed)")

    def first_fault(self, file: Written, names: Sequence[str], types: Mapping[str, str]) -> str | None:
        ends: set[str] = set()
        only_comments = True
        for line, record, end in _read_slowly(file, self._delimiter):
            if isinstance(record, str):
                return f"line {line}: {record}"
            if not record:
                continue
            is_comment = record[0].startswith("#")
            if line == 1 and self.shape.header:
                only_comments = is_comment
                continue
            if fault := self._fault_in(record, names, types):
                if only_comments and line > 1 and not is_comment:
                    first = "the column names" if self.shape.header else "the first row"
                    return f"line 1: is a comment, but {first} must be here: {_first_record(file)[:80]!r} ({COMMENTS})"
                about = f" ({COMMENTS})" if is_comment else ""
                return f"line {line}: {fault}{about}"
            only_comments &= is_comment
            ends.add(end)
        return "some lines end in CR LF, and some in LF" if len(ends) > 1 else None

    def _fault_in(self, record: Sequence[str], names: Sequence[str], types: Mapping[str, str]) -> str | None:
        """Return the error in the fields of a line, or None."""
        text = self._delimiter.join(record)
        if any("\udc80" <= character <= "\udcff" for character in text):
            return f"is not UTF-8: {shown(text)[:80]!r}"
        if len(record) != len(names) and not (len(record) == len(names) + 1 and not record[-1]):
            few = "too few" if len(record) < len(names) else "too many"
            return f"{few} fields ({len(record)}, not {len(names)}): {text[:80]!r}"
        for name, cell in zip(names, record, strict=False):
            if types[name] == "DOUBLE" and cell and not reads_as_number(cell):
                return f"text in the numeric column {name!r}: {cell[:80]!r}"
        return None


def _without_blank_end(content: bytes) -> bytes:
    filled = content.rstrip(b"\r\n")
    match = BLANK_END.fullmatch(content, len(filled))
    return content if match is None else filled + (match[1] or match[2])


def _first_record(file: Written) -> str:
    """Return the whole header of a CSV. A worker reports only its beginning, and a quoted name may contain a line feed."""
    head = file.head
    if len(head.encode()) < HEAD_BYTES - 4 and head.count('"') % 2 == 0:
        return head.removeprefix("\ufeff").partition("\r")[0]
    with Path(file.path).open(encoding="utf-8-sig", errors="replace", newline="") as text:
        line = next(text, "")
        while line.count('"') % 2 and (more := next(text, "")):
            line += more
    return line.rstrip("\r\n")


def _longest_line(file: Written) -> int:
    with Path(file.path).open("rb") as lines:
        return max(map(len, lines), default=0)


def _read_slowly(file: Written, delimiter: str) -> Iterator[tuple[int, list[str] | str, str]]:
    """Yield each record of a CSV with its first line's number and its line ending; at an error, a message instead."""
    ends: list[str] = []

    def lines(text: Iterable[str]) -> Iterator[str]:
        for line in text:
            ends.append("\r\n" if line.endswith("\r\n") else line[-1])
            yield line

    line = 1
    with Path(file.path).open(encoding="utf-8-sig", errors="surrogateescape", newline="") as text, any_size():
        reader = csv_reader(lines(text), delimiter)
        try:
            for record in reader:
                yield line, record, "\n" if reader.line_num > line and not file.ended else _end(ends)
                line = reader.line_num + 1
        except csv.Error as error:
            yield line, f"quotes are not closed or not valid in CSV ({error})", ""


def _end(ends: list[str]) -> str:
    """Return the ending of the last line that was read; a last line without one gets that of the line before."""
    end = ends[-1]
    return end if end in ("\n", "\r", "\r\n") else (ends[-2] if len(ends) > 1 else "\n")

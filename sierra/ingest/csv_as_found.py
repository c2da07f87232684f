"""The reader of text tables as programs write them, which are not always plain CSV.

They may have comments, a line of units, several header lines, decimal commas, texts for missing values, and columns of fixed
width or separated by blanks. They may be compressed.

Such a file is rewritten as a CSV with one header line. Lines are taken over unchanged, except if their cells must be changed.
The lines that are taken over are counted a second time, by searches in the whole file.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import islice
from typing import BinaryIO

from sierra.ingest.base import UnreadableError
from sierra.ingest.csv import Csv
from sierra.ingest.delimiters import COMMA, PADDED, POINT, delimiter_of, reads_as_number, split
from sierra.ingest.independent_row_count import any_size, csv_reader
from sierra.ingest.json_lists import in_words
from sierra.ingest.messages import shown
from sierra.ingest.missing_values import MissingValues
from sierra.ingest.model import PLAIN, Shape
from sierra.ingest.rewriting import OriginalFile, Rewriter
from sierra.ingest.shipped_reader_base import TableReader
from sierra.ingest.text_headers import keys_of
from sierra.store.connections import Database

BLANKS = "blanks"
"""The delimiter that stands for one or more blanks or tabs."""
BOM = b"\xef\xbb\xbf"
Line = tuple[int, bytes]
"""A line and its number in the original file."""
Row = tuple[int, bool, Sequence[str]]
"""The number of a row's first line, whether its last line ends with a line feed, and its cells."""


class CsvAsFound(Rewriter):
    """The reader of text tables as programs write them."""

    def __init__(self, shape: Shape, connection: Database) -> None:
        super().__init__(shape, connection)
        self._missing = MissingValues(shape.form.na, as_written=True)

    @classmethod
    def reader(cls) -> type[TableReader]:
        return Csv

    def plain(self) -> Shape:
        return replace(self.shape, form=PLAIN, delimiter=self._written_delimiter if self._remade else self.shape.delimiter)

    @property
    def _written_delimiter(self) -> str:
        """The delimiter of lines that are written again. With `|`, the reader of the plain file decides on blanks."""
        return PADDED if self.shape.delimiter == PADDED else ","

    @property
    def _aligned(self) -> bool:
        """True if no single character separates the columns. Then quotes have no meaning, and blank lines are no rows."""
        return bool(self.shape.form.widths) or self.shape.delimiter == BLANKS

    @property
    def _remade(self) -> bool:
        """True if each line is written again from its cells."""
        return self._aligned or self.shape.form.decimal == "," or bool(self.shape.form.na)

    def rewrite(self, source: OriginalFile, target: BinaryIO) -> int:
        lines = 0
        for _, text in self._written(source):
            target.write(text)
            lines += _size(text)
        return lines

    def place(self, source: OriginalFile, line: int) -> str:
        before = 0
        for number, text in self._written(source):
            if line <= before + _size(text):
                return f"line {number + line - before - 1}"
            before += _size(text)
        return f"line {line}"

    def _written(self, source: OriginalFile) -> Iterator[Line]:
        """Yield the texts of the plain file, each with the number of the line that it comes from."""
        form, lines = self.shape.form, self._kept(source)
        head = list(islice(lines, form.header_lines)) if self.shape.header else []
        if self.shape.header and len(head) < form.header_lines:
            raise UnreadableError(
                f"has {len(head)} of {form.header_lines} header lines" if head else "is empty and has no header"
            )
        first = head or list(islice(lines, 1))
        if not first:
            return
        delimiter = self._delimiter(_text(first[0][1]))
        names = self._names(head, delimiter)
        if form.units_row:
            self._check_units(next(lines, None), len(names), delimiter)
        if self._aligned and names[:1] in (["#"], ["%"]):  # `# t v` above two columns
            lines, row = _peeked(lines)
            names = names[1:] if row and len(self._split(row, delimiter)) == len(names) - 1 else names
        if head:
            yield head[0][0], self._header(head, names, delimiter)
        body = lines if head else _both(first, lines)
        yield from self._rows(body, delimiter) if self._remade else body

    def _kept(self, source: OriginalFile) -> Iterator[Line]:
        """Yield the lines that are neither skipped nor comments; texts in quotes are never comments."""
        form, quoted, begun = self.shape.form, False, not self.shape.header
        comments = tuple(comment.encode() for comment in form.comments)
        for number, line in enumerate(source.lines(), 1):
            text = line.removeprefix(BOM) if number == 1 else line
            is_comment = not quoted and text.lstrip(b" \t").startswith(comments)
            is_blank = not text.strip(b" \t\r\n") and (self._aligned or not begun)
            if number > form.skip and not is_comment and not is_blank:
                begun = True
                quoted ^= not self._aligned and text.count(b'"') % 2 == 1
                yield number, text

    def advice(self, source: OriginalFile) -> str:
        form = self.shape.form
        own = {"delimiter": self.shape.delimiter, "header": self.shape.header}
        now = {**own, "comment": form.comment, "skip": form.skip, "units_row": form.units_row}
        try:
            keys = keys_of(next(source.pieces(), b"")) or {}
        except UnreadableError:
            return ""
        keys = {
            name: value for name, value in keys.items() if (tuple(value) if isinstance(value, list) else value) != now[name]
        }
        return f" (set {in_words(keys)} in [outputs.{self.shape.name}])" if keys else ""

    def count(self, source: OriginalFile, written: int) -> int:
        form, content = self.shape.form, source.content().removeprefix(BOM)
        for _ in range(form.skip):
            content = content.partition(b"\n")[2]
        begins = b"|".join(re.escape(comment.encode()) for comment in form.comments)
        comment = rb"[ \t]*(?:" + begins + rb")[^\n]*" if begins else rb"(?!)"
        blank = rb"[ \t\r]*"
        left_out = 0
        if self.shape.header:
            begin = re.compile(rb"(?:(?:" + comment + rb"|" + blank + rb")\n)*").match(content)
            content = content[begin.end() if begin else 0 :]
        without = (
            rb"^" + comment + rb"$|^" + blank + rb"(?:\n|(?<=[ \t\r])\Z)" if self._aligned else rb'"[^"]*"|^' + comment + rb"$"
        )
        for match in re.compile(without, re.MULTILINE).finditer(content):
            left_out += not match[0].startswith(b'"')
        joined = form.header_lines - 1 + form.units_row
        unended = bool(content) and not content.endswith(b"\n")
        return content.count(b"\n") + unended - left_out - joined if content else 0

    def _delimiter(self, first: str) -> str:
        if self._aligned or self.shape.delimiter:
            return self.shape.delimiter
        if self.shape.form.decimal == ",":
            delimiter = delimiter_of(first.replace(",", ""))
            return ";" if delimiter == "," and not (self.shape.header and "," in first) else delimiter
        return delimiter_of(first)

    def _split(self, line: Line, delimiter: str) -> tuple[str, ...]:
        """Return the cells of a line that has no line feed in quotes."""
        number, text = line[0], _text(line[1])
        if self.shape.form.widths:
            return _cut(number, text, self.shape.form.widths)
        if delimiter == BLANKS:
            if '"' in text:
                raise UnreadableError(f'line {number}: has a quote, which delimiter = "blanks" does not support: {text[:80]!r}')
            return tuple(text.split())
        return split(text, delimiter)

    def _names(self, head: Sequence[Line], delimiter: str) -> list[str]:
        """Return the column names: the texts of the header lines, joined by a dot."""
        rows = [self._split(line, delimiter) for line in head]
        for (number, _), row in zip(head, rows, strict=True):
            if len(row) != len(rows[0]):
                raise UnreadableError(f"line {number}: {len(row)} column names, but the first header line has {len(rows[0])}")
            if self.shape.form.comments and (numbers := [name for name in row if reads_as_number(name)]):
                message = f"line {number}: the number {numbers[0]!r} among the column names"
                raise UnreadableError(f"{message} (if a comment has the names, set header = false, and columns)")
        return [".".join(filter(None, texts)) for texts in zip(*rows, strict=True)]

    def _header(self, head: Sequence[Line], names: Sequence[str], delimiter: str) -> bytes:
        if not self._remade and len(head) == 1:
            return head[0][1]
        ended = head[-1][1].endswith(b"\n")
        return csv_line(names, self._written_delimiter if self._remade else delimiter, ended=ended, quoting=csv.QUOTE_ALL)

    def _check_units(self, line: Line | None, columns: int, delimiter: str) -> None:
        """Check that a line has units, and not the numbers of a row."""
        if line is None:
            raise UnreadableError("ends before the line with units (units_row = true)")
        cells = self._split(line, delimiter)
        if len(cells) != columns:
            raise UnreadableError(f"line {line[0]}: {len(cells)} units, but {columns} columns (units_row = true)")
        if numbers := [cell for cell in cells if reads_as_number(cell) and cell != "1"]:
            raise UnreadableError(f"line {line[0]}: the number {numbers[0]!r} instead of a unit (units_row = true)")

    def _rows(self, body: Iterable[Line], delimiter: str) -> Iterator[Line]:
        """Yield each row, written again."""
        written = self._written_delimiter
        trims = delimiter == PADDED != written
        for number, ended, cells in self._aligned_cells(body) if self._aligned else _csv_cells(body, delimiter):
            bare = [cell.strip(" ") for cell in cells] if trims else cells
            yield number, csv_line([self._changed(cell, number) for cell in bare], written, ended=ended)

    def _aligned_cells(self, body: Iterable[Line]) -> Iterator[Row]:
        for line in body:
            yield line[0], line[1].endswith(b"\n"), self._split(line, self.shape.delimiter)

    def _changed(self, cell: str, number: int) -> str:
        """Return a cell with a decimal point, or empty if it stands for a missing value."""
        bare = cell.strip()
        if self._missing.has(bare):
            return ""
        if self.shape.form.decimal == ",":
            if COMMA.fullmatch(bare):
                pointed = bare.replace(",", ".")
                return "" if self._missing.has(pointed) else pointed
            if POINT.fullmatch(bare):
                raise UnreadableError(f'line {number}: {bare!r} has a decimal point, but decimal = ","')
        return cell


def _csv_cells(body: Iterable[Line], delimiter: str) -> Iterator[Row]:
    taken: list[Line] = []
    """The lines of the row that is being read."""

    def texts() -> Iterator[str]:
        for line in body:
            taken.append(line)
            yield line[1].decode("utf-8", "surrogateescape")

    with any_size():
        try:
            for cells in csv_reader(texts(), delimiter):
                yield taken[0][0], taken[-1][1].endswith(b"\n"), cells
                taken.clear()
        except csv.Error as error:
            raise UnreadableError(f"line {taken[0][0]}: quotes are not closed or not valid in CSV ({error})") from error


def _cut(number: int, text: str, widths: Sequence[int]) -> tuple[str, ...]:
    """Return the cells of a line of fixed width. Raises UnreadableError if the line does not fit."""
    if "\t" in text:
        raise UnreadableError(f"line {number}: has a tab, but widths counts characters: {shown(text)[:80]!r}")
    ends = [sum(widths[: index + 1]) for index in range(len(widths))]
    if len(text) <= ends[-1] - widths[-1] or text[ends[-1] :].strip():
        few = "few" if len(text) <= ends[-1] else "many"
        raise UnreadableError(f"line {number}: too {few} characters ({len(text)}; widths has {ends[-1]}): {shown(text)[:80]!r}")
    return tuple(text[end - width : end].strip() for end, width in zip(ends, widths, strict=True))


def csv_line(cells: Sequence[str], delimiter: str = ",", *, ended: bool = True, quoting: int = csv.QUOTE_MINIMAL) -> bytes:
    """Return the line of a CSV with these cells."""
    text = io.StringIO(newline="")
    csv.writer(text, delimiter=delimiter, lineterminator="\n" if ended else "", quoting=quoting).writerow(cells)  # type: ignore[arg-type]
    return text.getvalue().encode("utf-8", "surrogateescape")


def _text(line: bytes) -> str:
    return line.rstrip(b"\r\n").decode("utf-8", "surrogateescape")


def _size(text: bytes) -> int:
    """Return the number of lines in a text."""
    return text.count(b"\n") + (not text.endswith(b"\n"))


def _peeked(lines: Iterator[Line]) -> tuple[Iterator[Line], Line | None]:
    """Return the lines, and the first of them."""
    first = next(lines, None)
    return (lines, None) if first is None else (_both([first], lines), first)


def _both(first: Iterable[Line], others: Iterable[Line]) -> Iterator[Line]:
    yield from first
    yield from others

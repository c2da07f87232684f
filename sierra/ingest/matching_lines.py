"""The reader of lines in which a regular expression matches: each is a row, and the named groups are its columns.

The rows are written as a CSV. RE2 matches the lines (see `sierra.config.line_patterns`), as Arrow calls it; DuckDB splits the
original file once more, and counts the lines that match there. A line that leaves doubt is an error: if the expression matches
twice in it, if a value is only a part of a number, is not UTF-8 or has control characters, such as those of colours.
Other lines are in no table, whatever they contain; `UnmatchedLines` counts them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import reduce
from typing import TYPE_CHECKING

from sierra.config import line_patterns
from sierra.ingest.base import UnreadableError
from sierra.ingest.csv_as_found import BOM, CsvAsFound, Line, csv_line
from sierra.ingest.delimiters import reads_as_number
from sierra.ingest.messages import shown
from sierra.ingest.model import PLAIN, Shape
from sierra.ingest.rewriting import PIECE, OriginalFile
from sierra.util.lazy_definitions import dataclass, field, regex
from sierra.util.text import counted, one_line, verb

if TYPE_CHECKING:
    import pyarrow as pa

Groups = Mapping[str, Sequence[int] | None]
"""The first byte and the length of each group in a line; None for one that is not in the match."""
CONTROL = regex(r"[\x00-\x08\x0a-\x1f\x7f]")
GOES_ON = regex(rb"\d|[.,_]\d|[eE][-+]?\d|[dD][-+]\d")
"""The rest of a number, after its last digit here."""
HEXADECIMAL = regex(rb"[xX][0-9a-fA-F]")
BEGINS_EARLIER = regex(rb"\d[.,_]?\Z|(?<![\w.)\]}])\.\Z|(?<![\w)\]}])(?:[-+]|\xe2\x88\x92)\Z")
"""The beginning of a number, before digits here: digits, a decimal point, a sign (also that of Unicode)."""
EXPONENT = regex(rb"\d\.?[eE][-+]?\Z")
BEFORE = 8
"""The number of bytes before a value that are searched."""
SHOWN = 80
BLOCK = 16 << 20
"""The approximate number of bytes of lines that are counted at a time."""
COUNT = """
SELECT count(*) FROM (SELECT unnest(string_split($text, chr(10))) AS line)
WHERE regexp_matches(CASE WHEN ends_with(line, chr(13)) THEN left(line, -1) ELSE line END, $pattern)
"""
"""SQL: the number of lines of a text that match. The text after the last line feed is an empty line, which never matches."""
TWICE = """
SELECT min(place) FROM (SELECT unnest($lines::VARCHAR[]) AS line, unnest(range(len($lines))) AS place)
WHERE len(regexp_extract_all(line, $pattern)) > 1
"""
"""SQL: the place of the first line in which a pattern matches several times; Arrow would let `^` match after each match."""


class MatchingLines(CsvAsFound):
    """The reader of lines in which a regular expression matches."""

    def plain(self) -> Shape:
        return replace(self.shape, form=PLAIN, delimiter=",")

    def _written(self, source: OriginalFile) -> Iterator[Line]:
        """Yield the lines of the CSV; the last one has a line feed only if the file ends with one."""
        line = 1, csv_line(line_patterns.columns(self.shape.form.lines))
        for following in self._rows_of(source):
            yield line
            line = following
        ended = source.file.ended or source.compressed
        yield line if ended else (source.file.lines + 1, line[1].removesuffix(b"\n"))

    def _rows_of(self, source: OriginalFile) -> Iterator[Line]:
        changes = self._remade
        for first, lines in _blocks(source):
            matches = list(_matches(lines, self.shape.form.lines))
            twice = self._twice([_text(lines[index]) for index, _ in matches])
            for nth, (index, groups) in enumerate(matches):
                if fault := _fault(lines[index], groups, twice=nth == twice):
                    raise UnreadableError(f"line {first + index}: {fault}")
                values = [_within(lines[index], span) for name, span in groups.items() if name != line_patterns.WHOLE]
                yield first + index, csv_line([self._changed(value, first + index) for value in values] if changes else values)

    def _twice(self, lines: Sequence[str]) -> int | None:
        """Return the place of the first line in which the pattern matches several times; None if there is none."""
        [[index]] = (
            self.sql.execute(TWICE, {"lines": lines, "pattern": self.shape.form.lines}).fetchall() if lines else [[None]]
        )
        return None if index is None else int(index)

    def count(self, source: OriginalFile, written: int) -> int:
        content, at, matching = source.content().removeprefix(BOM), 0, 0
        while at < len(content):
            end = content.find(b"\n", at + BLOCK) + 1 or len(content)
            block = {"text": content[at:end].decode("utf-8", "replace"), "pattern": self.shape.form.lines}
            [[number]] = self.sql.execute(COUNT, block).fetchall()
            matching, at = matching + int(number), end
        return matching + 1

    def advice(self, source: OriginalFile) -> str:
        return ""


@dataclass(slots=True)
class UnmatchedLines:
    """The lines that are not blank, and in which no `lines` of any output of their file matches."""

    lines: int = 0
    runs: set[str] = field(default_factory=set)
    files: dict[str, None] = field(default_factory=dict)
    example: str = ""

    def add(self, run: str, source: OriginalFile, patterns: Iterable[str]) -> None:
        """Count the lines of a file that no pattern matches."""
        for _, lines in _blocks(source):
            others = [line for line, matches in zip(lines, _any(lines, patterns), strict=True) if line.strip() and not matches]
            if others:
                self.lines += len(others)
                self.runs.add(run)
                self.files[shown(source.file.name)] = None
                self.example = self.example or one_line(_text(others[0]).strip())[:SHOWN]

    def notes(self) -> Iterator[str]:
        if self.lines:
            where = next(iter(self.files)) if len(self.files) == 1 else counted(len(self.files), "file")
            of = f"{counted(self.lines, 'line')} of {where} in {counted(len(self.runs), 'run')}"
            yield f"{of} {verb(self.lines, 'is', 'are')} in no table, because no lines of [outputs] match: {self.example!r}"


def _blocks(source: OriginalFile) -> Iterator[tuple[int, Sequence[bytes]]]:
    """Yield some lines at a time, without their ends, with the number of the first one."""
    first, size, lines = 1, 0, list[bytes]()
    for number, line in enumerate(source.lines(), 1):
        lines.append((line.removeprefix(BOM) if number == 1 else line).removesuffix(b"\n").removesuffix(b"\r"))
        size += len(line)
        if size >= PIECE:
            yield first, lines
            first, size, lines = number + 1, 0, []
    if lines:
        yield first, lines


def _matches(lines: Sequence[bytes], pattern: str) -> Iterator[tuple[int, Groups]]:
    """Yield the places of the lines that match, with the places of the groups in them."""
    import pyarrow.compute as pc

    spans = pc.extract_regex_span(_array(lines), pattern=f"(?P<{line_patterns.WHOLE}>{pattern})")
    return zip(pc.indices_nonzero(spans.is_valid()).to_pylist(), spans.drop_null().to_pylist(), strict=True)


def _fault(line: bytes, groups: Groups, *, twice: bool) -> str:
    """Return the doubt about a line that matches; "" if there is none."""
    text = _text(line)
    if "\ufffd" in text and text.encode() != line:
        return f"is not UTF-8: {text[:SHOWN]!r}"
    for name, span in groups.items():
        value = "" if name == line_patterns.WHOLE else _within(line, span)
        if CONTROL.search(value):
            return f"the column {name!r} has control characters: {value[:SHOWN]!r}"
        if part := _is_part(line, name, groups) if value else "":
            return f"the column {name!r} would be {value!r}, but the number {part}: {text[:SHOWN]!r}"
    if twice:
        return f"lines matches several times in it, but it is one row; begin lines with ^ or end it with $: {text[:SHOWN]!r}"
    return ""


def _is_part(line: bytes, name: str, groups: Groups) -> str:
    """Return how the number in a group continues in the line, unless another group has that part; "" if it is whole."""
    start, end = _ends(groups[name])
    number, before = line[start:end], max(start - BEFORE, 0)
    left = EXPONENT.search(line, before, start)
    if not left and number[:1] not in b"+- ":
        left = BEGINS_EARLIER.search(line, before, start)
    right = GOES_ON.match(line, end) if number[-1:] != b" " else None
    if number.lstrip(b"+-") == b"0":
        right = right or HEXADECIMAL.match(line, end)
    if not (left or right) or not reads_as_number(_within(line, groups[name]).replace(",", ".")):
        return ""
    others = [_ends(span) for other, span in groups.items() if other not in (name, line_patterns.WHOLE) and span and span[1]]
    left_is_other = bool(left and any(left.start() < other <= start for _, other in others))
    right_is_other = bool(right and any(end <= other < right.end() for other, _ in others))
    if (left_is_other or right_is_other) and line[start - 1 : start] == line[end : end + 1] == b".":
        return ""  # a number has no two points: these are parts of a version
    if left and not left_is_other:
        return "begins earlier"
    return "goes on" if right and not right_is_other else ""


def _ends(span: Sequence[int] | None) -> tuple[int, int]:
    """Return the first byte of a group, and the one after its last."""
    return (span[0], span[0] + span[1]) if span else (0, 0)


def has_match(text: bytes, patterns: Iterable[str]) -> bool:
    """Return True if a pattern matches in a line of a text, whatever the reader thinks of the line."""
    lines = text.removeprefix(BOM).split(b"\n")
    return any(_any([line.removesuffix(b"\r") for line in lines], patterns))


def _any(lines: Sequence[bytes], patterns: Iterable[str]) -> Sequence[bool]:
    """Return for each line if a pattern matches in it."""
    import pyarrow.compute as pc

    texts = _array(lines)
    matches: Sequence[bool] = reduce(pc.or_, (pc.match_substring_regex(texts, pattern=each) for each in patterns)).to_pylist()
    return matches


def _array(lines: Sequence[bytes]) -> pa.Array:
    import pyarrow as pa

    return pa.array([_text(line) for line in lines], pa.large_string())


def _within(line: bytes, span: Sequence[int] | None) -> str:
    """Return the text of a group; "" for a group that is not in the match. `span`: its first byte and its length."""
    return "" if span is None else line[span[0] : span[0] + span[1]].decode("utf-8", "replace")


def _text(line: bytes) -> str:
    return line.decode("utf-8", "replace")

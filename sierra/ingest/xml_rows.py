"""The reader of XML: each element at the path `rows` becomes a row, as in SUMO's tripinfo, queue and summary outputs.

The columns of a row are

- the attributes of its element, under their own names;
- the element's text, under the name of the element;
- the attributes and texts of elements within it, such as `emissions.CO2`;
- the attributes of elements around it except the root, such as `data.timestep`.

expat reads the file piece by piece. The rows are written as a CSV, whose reader finds the types. A document type declaration is
refused, because it could define entities. The rows are counted a second time by a search for tags.
"""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import BinaryIO, Protocol
from xml.parsers import expat

from sierra.ingest.base import UnreadableError
from sierra.ingest.csv import Csv
from sierra.ingest.missing_values import MissingValues
from sierra.ingest.model import PLAIN, Part, Shape, Written
from sierra.ingest.rewriting import OriginalFile, Rewriter
from sierra.ingest.shipped_reader_base import TableReader
from sierra.store.connections import Database
from sierra.util.lazy_definitions import dataclass, field, regex, replace

STEP = regex(r"(//?)([^/]+)")
TAG = regex(
    rb"<!--.*?-->|<!\[CDATA\[.*?\]\]>|<\?.*?\?>"
    rb"|<(?P<end>/?)(?P<name>[^\s<>/!?]+)(?:[^<>\"']|\"[^\"]*\"|'[^']*')*?(?P<empty>/?)>",
    re.DOTALL,
)
"""A tag; comments and the like match without a name."""
Row = Mapping[str, str]


class XmlRows(Rewriter):
    """The reader of XML."""

    def __init__(self, shape: Shape, connection: Database) -> None:
        super().__init__(shape, connection)
        self._path = pattern(shape.form.rows)
        self._missing = MissingValues(shape.form.na)
        self._orders: dict[frozenset[str], list[str]] = {}
        """The columns in the order of the first file that has these columns, by their set."""
        self._around: set[str] = set()
        """The paths of elements around rows."""
        self._empty = Counter[str]()
        """The number of elements that have no row within, by path."""

    @property
    def bare(self) -> int:
        return sum(self._empty[path] for path in self._around)

    @classmethod
    def reader(cls) -> type[TableReader]:
        return _Rows

    def plain(self) -> Shape:
        return replace(self.shape, format="csv", form=PLAIN, delimiter=",", header=True, names=())

    def rewrite(self, source: OriginalFile, target: BinaryIO) -> int:
        names = dict.fromkeys(name for _, row in self._rows(source) for name in row)
        order = self._orders.setdefault(frozenset(names), list(names))
        return sum(target.write(text) > 0 for text in _texts(order, self._rows(source)) if order) - bool(order)

    def count(self, source: OriginalFile, written: int) -> int:
        counted, around, empty = count_tags(source.content(), self._path)
        self._around |= around
        self._empty += empty
        return counted

    def place(self, source: OriginalFile, line: int) -> str:
        before = 1
        for number, row in self._rows(source):
            before += 1 + sum(value.count("\n") for value in row.values())
            if line <= before:
                return f"line {number}"
        return f"line {line}"

    def _rows(self, source: OriginalFile) -> Iterator[tuple[int, Row]]:
        found = elements(source, Elements(self._path))
        if not self._missing:
            return found
        return ((line, {n: "" if self._missing.has(text) else text for n, text in row.items()}) for line, row in found)


class _Rows(Csv):
    """The reader of the CSV; a file without rows has no columns either."""

    times = False

    def sort(self, files: Sequence[Written]) -> Mapping[str, Part | None]:
        without = {file.path: None for file in files if not file.bytes}
        return {**super().sort([file for file in files if file.bytes]), **without}


@dataclass(slots=True)
class Elements:
    """The rows of an XML file, filled by a parser's events."""

    path: re.Pattern[str]
    rows: list[tuple[int, Row]] = field(default_factory=list)
    """The complete rows, each with the number of its line."""
    _stack: list[tuple[str, Mapping[str, str]]] = field(default_factory=list)
    _texts: list[list[str]] = field(default_factory=list)
    _paths: list[str] = field(default_factory=lambda: [""])
    _known: dict[str, bool] = field(default_factory=dict)
    """By path, whether it is that of a row."""
    _row: dict[str, str] = field(default_factory=dict)
    _depth: int = 0
    """The depth of the row's element; 0 outside rows."""
    _line: int = 0

    def start(self, name: str, attributes: Mapping[str, str], line: int) -> None:
        """Begin an element."""
        path = f"{self._paths[-1]}/{name}"
        self._paths.append(path)
        if (matches := self._known.get(path)) is None:
            matches = self._known.setdefault(path, self.path.fullmatch(path) is not None)
        if matches and self._depth:
            raise UnreadableError(f"line {line}: a row within the row of line {self._line}: <{name}>")
        if matches:
            self._row, self._depth, self._line = {}, len(self._paths), line
            for around, its in self._stack[1:]:
                self._add(f"{around}.", its)
        self._stack.append((name, attributes))
        self._texts.append([])
        if self._depth:
            self._add(self._within(), attributes)

    def text(self, text: str) -> None:
        """Take a piece of text."""
        if self._depth:
            self._texts[-1].append(text)

    def end(self, name: str) -> None:
        """End an element."""
        if self._depth and (text := "".join(self._texts[-1]).strip()):
            self._add("", {self._within().removesuffix(".") or name: text})
        if len(self._paths) == self._depth:
            self.rows.append((self._line, self._row))
            self._depth = 0
        for some in (self._stack, self._texts, self._paths):
            some.pop()

    def _within(self) -> str:
        """Return the prefix of names for the current element of a row."""
        return "".join(f"{name}." for name, _ in self._stack[self._depth - 1 :])

    def _add(self, prefix: str, values: Mapping[str, str]) -> None:
        for key, value in values.items():
            name = prefix + key
            if key.partition(":")[0] == "xmlns":
                continue
            if name in self._row:
                raise UnreadableError(f"line {self._line}: the row has two values for {name!r} (choose a deeper path for rows)")
            self._row[name] = value


class Handler(Protocol):
    """A receiver of a parser's events; it may raise UnreadableError."""

    def start(self, name: str, attributes: Mapping[str, str], line: int) -> None:
        """Begin an element."""
        ...

    def text(self, text: str) -> None:
        """Take a piece of text."""
        ...

    def end(self, name: str) -> None:
        """End an element."""
        ...


def elements(source: OriginalFile, found: Elements) -> Iterator[tuple[int, Row]]:
    """Yield the rows of an XML file, each with the number of its line. Raises UnreadableError."""
    for _ in parse(source.pieces(), found):
        yield from found.rows
        found.rows.clear()


def parse(pieces: Iterable[bytes], handler: Handler) -> Iterator[None]:
    """Parse an XML document; yield after each piece of it. Raises UnreadableError if it is damaged, cut short or hostile."""
    parser = expat.ParserCreate()
    parser.buffer_text = True
    parser.StartElementHandler = lambda name, attributes: handler.start(name, attributes, parser.CurrentLineNumber)
    parser.EndElementHandler = handler.end
    parser.CharacterDataHandler = handler.text
    parser.StartDoctypeDeclHandler = _refuse
    first = True
    for piece in _and_end(pieces):
        if first and b"\0" in piece[:4]:
            raise UnreadableError("is UTF-16 or UTF-32; only encodings that contain ASCII are supported")
        first = False
        try:
            parser.Parse(piece, not piece)
        except expat.ExpatError as error:
            what = expat.ErrorString(error.code)
            raise UnreadableError(f"line {error.lineno}: is truncated or not XML ({what})") from error
        yield


def pattern(path: str) -> re.Pattern[str]:
    """Return the regular expression for the paths of elements, such as /root/a, that `//a` and the like select."""
    steps = (
        ("(?:/[^/]+)*" if above == "//" else "") + "/" + ("[^/]+" if name == "*" else re.escape(name))
        for above, name in STEP.findall(path)
    )
    return re.compile("".join(steps))


def _texts(names: Sequence[str], rows: Iterator[tuple[int, Row]]) -> Iterator[bytes]:
    """Yield a CSV's header and its rows."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(names)
    yield text.getvalue().encode("utf-8", "surrogateescape")
    for _, row in rows:
        text.seek(0)
        text.truncate()
        writer.writerow([row.get(name, "") for name in names])
        yield text.getvalue().encode("utf-8", "surrogateescape")


def count_tags(content: bytes, path: re.Pattern[str]) -> tuple[int, set[str], Counter[str]]:
    """Return the number of elements at a path, by a search for tags.

    Also return the paths of the elements around them, and by path how many elements have none within: if these are at a path
    around others, their attributes are in no row.
    """
    count, within, rows, empty = 0, [""], [0], Counter[str]()
    around: set[str] = set()
    for tag in TAG.finditer(content):
        if tag["name"] is None:
            continue
        if not tag["end"]:
            within.append(f"{within[-1]}/{tag['name'].decode('utf-8', 'replace')}")
            rows.append(count)
            if path.fullmatch(within[-1]) is not None:
                count += 1
                around.update(within[1:-1])
        if tag["end"] or tag["empty"]:
            empty[within.pop()] += rows.pop() == count
    return count, around, empty


def _refuse(*_: object) -> None:
    raise UnreadableError("has a document type declaration, which is refused because it can define entities")


def _and_end(pieces: Iterable[bytes]) -> Iterator[bytes]:
    """Yield the pieces that are not empty, and an empty one at the end."""
    yield from filter(None, pieces)
    yield b""

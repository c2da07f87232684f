"""Files that are rewritten before they are read: each becomes a plain file that a shipped reader reads.

A `Rewriter` writes each file as a plain CSV, JSON lines or Parquet file, without changing its meaning. It counts what the new
file must contain a second time, from the original file and by other means. If the counts differ, the file is at fault. The
reader of the plain format then counts the rows of the new file, as always. So no row can be lost in between.

Messages name places in the original file.
"""

from __future__ import annotations

import tempfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO, ClassVar, TypeVar

from sierra.config.field_types import Table
from sierra.config.plugin_registry import NoOptions
from sierra.ingest.base import UnreadableError
from sierra.ingest.independent_row_count import described
from sierra.ingest.messages import shown
from sierra.ingest.model import PLAIN, Reading, Shape, Siblings, Written
from sierra.ingest.shipped_reader_base import TableReader
from sierra.store.connections import Database
from sierra.store.segments import disk_errors
from sierra.util.lazy_definitions import regex

LINE = regex(r"\bline (\d+): ")
COMPRESSED = (".gz", ".zst")
"""The endings of names of compressed files."""
PIECE = 1 << 20
Value = TypeVar("Value")


class Rewriter:
    """The base class of readers whose files are rewritten first."""

    Options: ClassVar[type[Table]] = NoOptions

    def __init__(self, shape: Shape, connection: Database) -> None:
        self.shape = shape
        self.sql = connection

    @property
    def bare(self) -> int:
        """The number of elements around rows that have no row within, in all files that were counted."""
        return 0

    @classmethod
    def reader(cls) -> type[TableReader]:
        """Return the reader of the plain files."""
        raise NotImplementedError

    def plain(self) -> Shape:
        """Return how to read the plain files."""
        return replace(self.shape, form=PLAIN)

    def rewrite(self, source: OriginalFile, target: BinaryIO) -> int:
        """Write the plain file; return the number of its rows, or of its lines, whatever `count` counts.

        Raises UnreadableError with one line if the file is cut short, damaged, or not understood.
        """
        raise NotImplementedError

    def count(self, source: OriginalFile, written: int) -> int:
        """Return what `rewrite` should have returned, counted in the original file by other means.

        `written` is what it has returned. Raises UnreadableError.
        """
        raise NotImplementedError

    def advice(self, source: OriginalFile) -> str:
        """Return the keys that would read a file that cannot be read, in brackets; "" if none are known."""
        return ""

    def place(self, source: OriginalFile, line: int) -> str:
        """Return the words for the place in the original file that became this line of the plain file."""
        return f"line {line}"


class OriginalFile:
    """The original file: its bytes, decompressed if its name says that it is compressed."""

    def __init__(self, file: Written) -> None:
        self.file = file

    @property
    def path(self) -> Path:
        return Path(self.file.path)

    @property
    def compressed(self) -> bool:
        return is_compressed(self.file.name)

    def pieces(self) -> Iterator[bytes]:
        """Yield the bytes in pieces. Raises UnreadableError if a compressed file is damaged or cut short."""
        try:
            with _opened(self.path, self.file.name) as stream:
                yield from iter(lambda: stream.read(PIECE), b"")
        except (OSError, EOFError, ValueError, zlib.error) as error:
            if not self.compressed:
                raise
            raise UnreadableError(f"cannot be decompressed: {' '.join(str(error).split())}") from error

    def lines(self) -> Iterator[bytes]:
        """Yield the lines with their line feeds; a line ends only at a line feed."""
        rest = b""
        for piece in self.pieces():
            *lines, rest = (rest + piece).split(b"\n")
            for line in lines:
                yield line + b"\n"
        if rest:
            yield rest

    def content(self) -> bytes:
        return b"".join(self.pieces())


def is_compressed(name: str) -> bool:
    """Check if the name of a file says that it is compressed."""
    return name.lower().endswith(COMPRESSED)


def _opened(path: Path, name: str) -> BinaryIO:
    if name.lower().endswith(".gz"):
        import gzip
        from typing import cast

        return cast(BinaryIO, gzip.open(path, "rb"))
    if name.lower().endswith(".zst"):
        return _unpacked(path)
    return path.open("rb")


def _unpacked(path: Path) -> BinaryIO:
    """Return the decompressed bytes of a Zstandard file. Raises OSError or UnreadableError if it is damaged."""
    import io

    import pyarrow as pa

    with pa.OSFile(str(path)) as file, pa.CompressedInputStream(file, "zstd") as stream:
        return io.BytesIO(stream.read())


def read_rewritten(
    rewriter: Rewriter, connection: Database, files: Sequence[Written], target: Path, siblings: Siblings
) -> Reading:
    """Rewrite the files, and read the results as `sierra.ingest.read.read` does."""
    with tempfile.TemporaryDirectory(prefix="sierra-") as name, disk_errors(Path(name)):
        return _Rewriting(rewriter, Path(name)).read(connection, files, target, siblings)


class _Rewriting:
    """The rewriting of some files into a folder."""

    def __init__(self, rewriter: Rewriter, folder: Path) -> None:
        self._rewriter = rewriter
        self._folder = folder
        self._faults: dict[str, str] = {}
        self._sources: dict[tuple[str, str], OriginalFile] = {}

    def read(self, connection: Database, files: Sequence[Written], target: Path, siblings: Siblings) -> Reading:
        rewritten = [new for number, file in enumerate(files) if (new := self._rewritten(file, number)) is not None]
        sound = [file for file in rewritten if file.execution not in self._faults]
        reading = self._rewriter.reader()(connection, self._rewriter.plain(), target, siblings).read(sound)
        mine = self._rewriter.shape
        theirs = reading.shape
        shape = replace(mine, parts=theirs.parts, files=theirs.files, ended=theirs.ended, nans=theirs.nans)
        shape = replace(shape, bare=mine.bare + self._rewriter.bare)
        faults = self._faults | {execution: self._placed(fault, execution) for execution, fault in reading.faults.items()}
        hints = {key: self._hints(key, texts) for key, texts in reading.hints.items()}
        return replace(reading, shape=shape, faults=faults, hints=hints)

    def _rewritten(self, file: Written, number: int) -> Written | None:
        """Return the plain file, or None if the file is at fault."""
        path, source = self._folder / str(number), OriginalFile(file)
        self._sources[file.execution, shown(file.name)] = source
        try:
            with path.open("wb") as stream:
                written = self._rewriter.rewrite(source, stream)
            counted = self._rewriter.count(source, written)
        except UnreadableError as error:
            fault = " ".join(f"{error}{self._rewriter.advice(source)}".split())
        except OSError:
            raise
        except Exception as error:
            fault = " ".join(f"the reader {self._rewriter.shape.format!r} failed: {type(error).__name__}: {error}".split())
        else:
            if counted == written:
                return described(file, path)
            fault = f"it contains {counted} rows, but {written} were found: it can be understood in more than one way"
        self._faults.setdefault(file.execution, f"{shown(file.name)}: {fault}")
        return None

    def _hints(self, key: tuple[str, str], texts: Mapping[str, str]) -> dict[str, str]:
        return {column: self._placed(text, key[0]) for column, text in texts.items()}

    def _placed(self, message: str, execution: str) -> str:
        """Return a message of the plain format's reader with the place in the original file."""
        named = (name for one, name in self._sources if one == execution and message.startswith(f"{name}: "))
        name = max(named, key=len, default="")
        found = LINE.match(message, len(name) + 2)
        if not name or found is None:
            return message
        place = self._rewriter.place(self._sources[execution, name], int(found[1]))
        return f"{name}: {place}: {message[found.end() :]}"

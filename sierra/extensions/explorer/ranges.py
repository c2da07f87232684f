"""The part of a file that a browser asks for: one range of bytes (RFC 9110, section 14)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from http import HTTPStatus

from sierra.util.lazy_definitions import dataclass, regex

ONE = regex(r"bytes=(?:(?P<first>\d{1,18})-(?P<last>\d{0,18})|-(?P<end>\d{1,18}))")
PIECE = 1 << 18
"""The number of bytes that are read at a time."""


class BadRange(ValueError):
    """A range that begins behind the end of the file."""


@dataclass(frozen=True, slots=True)
class Range:
    """The bytes from `start` to before `stop` of a file of `size` bytes."""

    start: int
    stop: int
    size: int
    whole: bool = False

    @classmethod
    def of(cls, header: str | None, size: int) -> Range:
        """Return the range of a header; the whole file if there is none, or one that asks for something else."""
        match = ONE.fullmatch(header or "")
        if match is None:
            return cls(0, size, size, whole=True)
        if match["end"]:
            start, stop = max(0, size - int(match["end"])), size
        else:
            start, stop = int(match["first"]), min(size, int(match["last"]) + 1 if match["last"] else size)
        if start >= stop:
            raise BadRange(f"the file has {size:,} bytes")
        return cls(start, stop, size)

    @property
    def length(self) -> int:
        return self.stop - self.start

    @property
    def status(self) -> HTTPStatus:
        return HTTPStatus.OK if self.whole else HTTPStatus.PARTIAL_CONTENT

    @property
    def headers(self) -> Mapping[str, str]:
        part = {} if self.whole else {"Content-Range": f"bytes {self.start}-{self.stop - 1}/{self.size}"}
        return {"Accept-Ranges": "bytes", **part}

    def pieces(self) -> Iterator[int]:
        """Yield the lengths of the pieces in which the range is read."""
        for start in range(self.start, self.stop, PIECE):
            yield min(PIECE, self.stop - start)

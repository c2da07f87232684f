"""Addresses that the server gives out for what a browser can only load by an address: pages and videos.

Each contains random letters, so that nobody can guess it. The last ones stay valid: those of pages as long as all of them
together do not take too much memory, and very many of those of files.
"""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable
from io import BytesIO
from itertools import accumulate
from typing import BinaryIO

from sierra.extensions.explorer.checked_files import CheckedFile
from sierra.util.lazy_definitions import dataclass

MOST_FILES = 10_000
"""The largest number of addresses of files that are valid at a time: a batch may have a hundred videos."""
MOST_BYTES = 100 << 20
"""The largest size of all pages in memory; the last one may be larger."""
PREFIX = "/made/"
ServedContent = bytes | CheckedFile | Callable[[], bytes]
"""Content in memory, in a file, or read again for each request."""


@dataclass(frozen=True, slots=True)
class ServedFile:
    """A page or a file."""

    kind: str
    """Its media type."""
    content: ServedContent

    def open(self) -> BinaryIO:
        """Return the content as an open file. Raises FileNotFoundError if it was removed or changed, and errors of reading."""
        match self.content:
            case CheckedFile():
                return self.content.open()
            case bytes():
                return BytesIO(self.content)
            case _:
                return BytesIO(self.content())


class Tickets:
    """The pages and files that the server has given out addresses for."""

    def __init__(self) -> None:
        self._made: dict[str, ServedFile] = {}
        self._one = threading.Lock()

    def issue(self, made: ServedFile) -> str:
        """Return the address of a page or a file."""
        address = f"{PREFIX}{secrets.token_urlsafe(32)}"
        with self._one:
            self._made[address] = made
            for old in self._outdated():
                del self._made[old]
        return address

    def _outdated(self) -> list[str]:
        """Return the oldest addresses, which are to be dropped: of pages beyond `MOST_BYTES`, of files beyond `MOST_FILES`."""
        pages = [(address, len(made.content)) for address, made in self._made.items() if isinstance(made.content, bytes)]
        files = [address for address, made in self._made.items() if not isinstance(made.content, bytes)]
        totals = accumulate(size for _, size in reversed(pages))  # of the last page, of the last two, and so on
        kept_pages = max(1, sum(total <= MOST_BYTES for total in totals))
        return [*(address for address, _ in pages[:-kept_pages]), *files[:-MOST_FILES]]

    def find(self, address: str) -> ServedFile | None:
        return self._made.get(address)

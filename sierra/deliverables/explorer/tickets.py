"""Addresses that the server gives out for what a browser can only load by an address: pages and videos.

Each contains random letters, so that nobody can guess it. The last ones stay valid.
"""

from __future__ import annotations

import secrets
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

MOST = 256
"""The largest number of addresses that are valid at a time."""
PREFIX = "/made/"
Content = bytes | Path | Callable[[], bytes]
"""What is in memory, in a file, or to be read each time that it is wanted."""


@dataclass(frozen=True, slots=True)
class Made:
    """A page or a file."""

    kind: str
    """Its media type."""
    content: Content

    def open(self) -> BinaryIO:
        """Return the content as an open file. Raises FileNotFoundError if it has been removed, and the errors of reading."""
        match self.content:
            case Path():
                return self.content.open("rb")
            case bytes():
                return BytesIO(self.content)
            case _:
                return BytesIO(self.content())


class Tickets:
    """What the server has given out addresses for."""

    def __init__(self) -> None:
        self._made: OrderedDict[str, Made] = OrderedDict()

    def issue(self, made: Made) -> str:
        """Return the address of a page or a file."""
        address = f"{PREFIX}{secrets.token_urlsafe(32)}"
        self._made[address] = made
        while len(self._made) > MOST:
            self._made.popitem(last=False)
        return address

    def find(self, address: str) -> Made | None:
        return self._made.get(address)

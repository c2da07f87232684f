"""Addresses that the server gives out for what a browser can only load by an address: pages and videos.

Each contains random letters, so that nobody can guess it. The last ones stay valid.
"""

from __future__ import annotations

import secrets
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path

MOST = 64
"""The largest number of addresses that are valid at a time."""
PREFIX = "/made/"


@dataclass(frozen=True, slots=True)
class Made:
    """A page in memory, or a file on the disk."""

    kind: str
    """Its media type."""
    content: bytes | Path


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

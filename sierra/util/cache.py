"""A small file of facts in the user's cache folder. It can be deleted at any time, because the facts can be found again."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

from sierra.util.fs import read_sealed, write_whole
from sierra.util.hashing import sealed
from sierra.util.json_types import JsonView


class Cache:
    """A cache of the most recently used JSON facts by text key. Errors of reading and writing are ignored."""

    def __init__(self, path: Path, max_entries: int) -> None:
        self.path = path
        self._max_entries = max_entries
        self._known = _read(path)
        self._new = False

    def get(self, key: str) -> JsonView:
        """Return the fact for a key, or None."""
        fact = self._known.pop(key, None)
        if fact is not None:
            self._known[key] = fact  # at the end: most recently used
        return fact

    def put(self, key: str, fact: JsonView) -> None:
        self._known.pop(key, None)
        self._known[key] = fact
        self._new = True

    def save(self) -> None:
        """Write the cache if it has new facts. Of two processes that write at the same time, the facts of one are lost."""
        if not self._new:
            return
        kept = dict(list(self._known.items())[-self._max_entries :])
        with contextlib.suppress(OSError):
            self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            write_whole(self.path, sealed(json.dumps(kept).encode()))
        self._new = False


def _read(path: Path) -> dict[str, JsonView]:
    with contextlib.suppress(ValueError, RecursionError):
        known = json.loads(read_sealed(path) or b"{}")
        if isinstance(known, dict):
            return known
    return {}

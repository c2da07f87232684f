"""What was found out and can be found out again: a small file in the user's cache folder, which may vanish at any time."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import Any

from sierra.util.fs import write_whole
from sierra.util.hashing import sealed, unsealed


class Cache:
    """Facts by a text, JSON each; the `most` that were used last are kept. What cannot be read or written is forgotten."""

    def __init__(self, path: Path, most: int) -> None:
        self._path = path
        self._most = most
        self._known = _read(path)
        self._new = False

    def get(self, key: str) -> Any:
        """What is known of a key, or None."""
        if key not in self._known:
            return None
        self._known[key] = self._known.pop(key)  # to the end: used last
        return self._known[key]

    def put(self, key: str, fact: Any) -> None:
        self._known.pop(key, None)
        self._known[key] = fact
        self._new = True

    def save(self) -> None:
        """Write what is new. Of two processes that do so at once, one forgets what it found."""
        if not self._new:
            return
        kept = dict(list(self._known.items())[-self._most :])
        with contextlib.suppress(OSError):
            self._path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            write_whole(self._path, sealed(json.dumps(kept).encode()))
        self._new = False


def _read(path: Path) -> dict[str, Any]:
    with contextlib.suppress(OSError, ValueError, RecursionError):
        known = json.loads(unsealed(path.read_bytes()) or b"{}")
        if isinstance(known, dict):
            return known
    return {}

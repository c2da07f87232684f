"""Files: names that must stay inside a folder, records that are read back, and files that appear whole."""

from __future__ import annotations

import json
import os
from pathlib import Path, PurePosixPath
from typing import Any

from sierra.errors import Damaged


def inside(root: Path, name: str, *, link: bool = False) -> Path:
    """Return the path that a name from a record has in the folder `root`. Every such name goes through here before it is used.

    Raises Damaged for a name that leads outside: an absolute one, one with `..` in it, one that passes through a symbolic link
    to somewhere else; and for an empty one, or one with the character NUL. `link`: the last part may be a link to anywhere,
    because the caller does not follow it.
    """
    parts = PurePosixPath(name).parts
    if not parts or "\0" in name or parts[0].startswith("/") or ".." in parts:
        raise Damaged(_outside(root, name))
    path = root.joinpath(*parts)
    try:
        end = (path.parent if link else path).resolve()
    except (OSError, RuntimeError) as error:  # a link to itself
        raise Damaged(_outside(root, name)) from error
    if not end.is_relative_to(root.resolve()):
        raise Damaged(_outside(root, name))
    return path


def _outside(root: Path, name: str) -> str:
    return f"the record names the path {name!r}, which is not inside {root}; whoever made the record did not use SIERRA for it"


def read_record(path: Path) -> dict[str, Any]:
    """Return the JSON object that a file of a session holds. Raises FileNotFoundError, and Damaged for what is none."""
    try:
        found = json.loads(path.read_bytes())
        if isinstance(found, dict):
            return found
    except (ValueError, RecursionError):  # no UTF-8, no JSON, or one that never ends
        pass
    raise Damaged(f"{path}: holds no record that SIERRA wrote; move {path.parent} away, what is in it is not recorded yet")


def write_whole(path: Path, data: bytes) -> Path:
    """Write a file that appears whole, in the place of what was there, or not at all."""
    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        unfinished.write_bytes(data)
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)
    return path

"""The lines of `sierra.toml` that declare what the page shows, and their addition to that file."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from sierra.config import project_file
from sierra.config.find_project import ProjectFolder
from sierra.config.project_file import LoadedProject
from sierra.errors import UsageError
from sierra.store.layout import PYPROJECT
from sierra.util.fs import write_whole
from sierra.util.hashing import sha256
from sierra.util.json_types import JsonView

Kind = Literal["figures", "comparisons"]


def lines(file: Path, kind: Kind, name: str, keys: Mapping[str, JsonView]) -> str:
    """Return the lines that declare a figure or a comparison in a project's file."""
    import tomlkit

    declared = tomlkit.table()
    for key, value in keys.items():
        declared.add(key, list(value) if isinstance(value, tuple) else value)
    inner: dict[str, object] = {kind: {name: declared}}
    return tomlkit.dumps({"tool": {"sierra": inner}} if file.name == PYPROJECT else inner)


def append(project: LoadedProject, kind: Kind, name: str, keys: Mapping[str, JsonView], file: str) -> LoadedProject:
    """Append these lines to the project's file, which must still have the hash `file`; return the project with them.

    Raises UsageError if the file has changed, has one of this name, or would be invalid.
    """
    project.check_written()
    if hash_of(project.file) != file:
        raise UsageError(f"{project.file.name} has changed since this was drawn; draw it again")
    if name in getattr(project.config, kind):
        raise UsageError(f"{project.file.name} has a {kind[:-1]} {name!r} already; choose another name")
    after = project.file.read_bytes().rstrip() + b"\n\n" + lines(project.file, kind, name, keys).encode()
    found = _declared(project, after)
    write_whole(project.file, after)
    return found


def hash_of(file: Path) -> str:
    """Return the SHA-256 of a file; "" if there is none."""
    return sha256(file.read_bytes()) if file.is_file() else ""


def _declared(project: LoadedProject, data: bytes) -> LoadedProject:
    """Return the project whose file has other content. Raises ConfigError if that is invalid."""
    try:
        table = tomllib.loads(data.decode())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UsageError(f"nothing can be appended to {project.file.name}: {error}") from error
    own = table["tool"]["sierra"] if project.file.name == PYPROJECT else table
    return project_file.of_table(ProjectFolder(project.root, project.file), own)

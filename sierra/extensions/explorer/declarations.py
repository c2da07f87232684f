"""The lines of `sierra.toml` that declare what the page shows, and their addition to that file."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from sierra.config import project_file
from sierra.config.find_project import ProjectFolder
from sierra.config.project_file import LoadedProject
from sierra.config.project_file_changes import replace_content
from sierra.errors import UsageError
from sierra.store.layout import PYPROJECT
from sierra.util.hashing import sha256
from sierra.util.json_types import JsonView
from sierra.util.text import visible

Kind = Literal["figures", "comparisons"]


def lines(file: Path, kind: Kind, name: str, keys: Mapping[str, JsonView]) -> str:
    """Return the lines that declare a figure or a comparison in a project's file."""
    import tomlkit

    declared = tomlkit.table()
    for key, value in keys.items():
        declared.add(key, list(value) if isinstance(value, tuple) else value)
    inner: dict[str, object] = {kind: {name: declared}}
    return _plain(tomlkit.dumps({"tool": {"sierra": inner}} if file.name == PYPROJECT else inner))


def _plain(toml: str) -> str:
    """Return lines in which the characters that `visible` escapes are escapes of TOML, with which TOML has the same text.

    All strings and quoted keys that `lines` writes are basic ones, in which such escapes are allowed.
    """
    return "".join(c if visible(c) == c else f"\\U{ord(c):08x}" for c in toml)


def append(project: LoadedProject, kind: Kind, name: str, keys: Mapping[str, JsonView], file: str) -> LoadedProject:
    """Append these lines to the project's file, which must have the hash `file`; return the project with them.

    Raises UsageError if the file has changed, also since the project was read, has one of this name, or would be invalid.
    """
    project.check_written()
    if hash_of(project) != file:
        raise UsageError(f"{project.file.name} has changed since this was drawn; draw it again")
    if name in getattr(project.config, kind):
        raise UsageError(f"{project.file.name} has a {kind[:-1]} {name!r} already; choose another name")
    after = project.content.rstrip() + b"\n\n" + lines(project.file, kind, name, keys).encode()
    declared = _declared(project, after)
    replace_content(project.file, project.content, after)
    return declared


def hash_of(project: LoadedProject) -> str:
    """Return the SHA-256 of the project's file as it was read; "" if there is none."""
    return sha256(project.content) if project.written else ""


def _declared(project: LoadedProject, data: bytes) -> LoadedProject:
    """Return the project whose file has other content. Raises ConfigError if that is invalid."""
    try:
        table = tomllib.loads(data.decode())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise UsageError(f"nothing can be appended to {project.file.name}: {error}") from error
    own = table["tool"]["sierra"] if project.file.name == PYPROJECT else table
    return project_file.of_table(ProjectFolder(project.root, project.file), own)

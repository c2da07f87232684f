"""The folder that a command works on: the nearest project, or the nearest store.

Commands that only read the store need no more than the folder, so they start without the models of `sierra.toml`.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import NamedTuple

from sierra.errors import ConfigError, Missing
from sierra.store.layout import CONFIG, PYPROJECT, STORE, user_packages
from sierra.util.float_range import out_of_range
from sierra.util.regular_files import read_regular

TOO_DEEP = "lists and tables are nested too deeply"
WITHOUT_STORE = (".gitignore", "try")
"""The contents of a store's folder that make no store: `sierra try` leaves them."""


class ProjectFolder(NamedTuple):
    """The root of a project (absolute), and its file."""

    root: Path
    file: Path
    written: bool = True
    """True if the file exists. A store without a file can be read too."""

    @property
    def is_package(self) -> bool:
        """True for a folder in the user's cache that a package was extracted to, which somebody else may have made."""
        return self.root.parent == user_packages().resolve()


def find(folder: Path) -> ProjectFolder:
    """Return the project that contains `folder`: the nearest `sierra.toml` or `[tool.sierra]` here or above.

    Raises Missing if there is none.
    """
    folder = folder.resolve()
    for root in (folder, *folder.parents):
        if (file := root / CONFIG).is_file() or ((file := root / PYPROJECT).is_file() and settings(file) is not None):
            return ProjectFolder(root, file)
    raise Missing(f"no {CONFIG} in {folder} or above it; create one with: sierra init")


def find_store(folder: Path) -> ProjectFolder:
    """Return the project that contains `folder`, like `find`, or the nearest store without a project.

    Raises Missing if there is neither.
    """
    try:
        return find(folder)
    except Missing:
        for root in (folder.resolve(), *folder.resolve().parents):
            if any((root / name).exists() for name in (CONFIG, PYPROJECT)):
                raise
            if _holds_store(root / STORE):
                return ProjectFolder(root, root / CONFIG, written=False)
        raise


def _holds_store(folder: Path) -> bool:
    """Return whether a store may be in a folder, which has more than what a try or an init without a project has left."""
    return folder.is_dir() and any(path.name not in WITHOUT_STORE for path in folder.iterdir())


def settings(file: Path) -> dict[str, object] | None:
    """Return the settings in a project's file; None if a `pyproject.toml` has none. Raises as `read_toml` does."""
    return settings_in(content(file), file)


def settings_in(data: bytes, file: Path) -> dict[str, object] | None:
    """Return the settings in the content of a project's file, as `settings` does. Raises ConfigError."""
    table = _parsed(data, file)
    if file.name != PYPROJECT:
        return table
    tools = table.get("tool")
    found = tools.get("sierra") if isinstance(tools, dict) else None
    if found is not None and not isinstance(found, dict):
        raise ConfigError(f"{file}: tool.sierra must be a table: [tool.sierra]")
    return found


def read_toml(file: Path) -> dict[str, object]:
    """Return the content of a TOML file. Raises ConfigError if it is not TOML, Missing if it cannot be read."""
    return _parsed(content(file), file)


def content(file: Path) -> bytes:
    """Return the bytes of a file. Raises Missing if it cannot be read."""
    try:
        return read_regular(file)
    except OSError as error:
        raise Missing(f"{file}: {error.strerror}") from error


def _parsed(data: bytes, file: Path) -> dict[str, object]:
    try:
        return tomllib.loads(data.decode(), parse_float=lambda text: _float(text, file))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: not TOML: {error}") from error
    except RecursionError as error:
        raise ConfigError(f"{file}: {TOO_DEEP}") from error


def _float(text: str, file: Path) -> float:
    """Return a number of a TOML file. Raises ConfigError for one that would become infinite, or 0."""
    if why := out_of_range(text):
        raise ConfigError(f"{file}: the number {text[:40]} is outside the range of floats: {why}")
    return float(text)

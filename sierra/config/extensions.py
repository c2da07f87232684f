"""The names that extensions add. What a name stands for is imported when the name is used.

An extension is a folder in `sierra/extensions` that can be deleted. `ADDS` gives its names as another package gives entry
points in its `pyproject.toml`: reading them imports nothing, and no other module knows an extension. An extension whose folder
does not exist adds nothing; its names are only used to say where an unknown key of `sierra.toml` belongs.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

ADDS: Mapping[str, Mapping[str, Mapping[str, str]]] = {
    "videos": {
        "commands": {"video": "command:video", "open video": "of_package:video"},
        "options": {"package --no-videos": "command:left_out"},
        "tables": {"videos": "table:TABLE"},
        "deliverables": {"video": "deliverable:Videos"},
    },
}
"""By extension and kind (see `sierra.plugin`): names, each with its place in the extension's folder, as `module:attribute`."""
FOLDER = Path(__file__).parents[1] / "extensions"


@cache
def added(kind: str) -> Mapping[str, str]:
    """Return all names that extensions add to a kind, each with its place, as `module:attribute`."""
    return {name: f"sierra.extensions.{owner}.{place}" for owner, names in _present(kind) for name, place in names.items()}


def load(kind: str, name: str) -> Any:
    """Return what a name stands for."""
    module, _, attribute = added(kind)[name].partition(":")
    return getattr(import_module(module), attribute)


def home(key: str) -> str | None:
    """Return the extension that a key of `sierra.toml` belongs to, also one that is not there."""
    return next((extension for extension, adds in ADDS.items() if key in adds.get("tables", {})), None)


def without_absent(table: Mapping[str, Any], where: str = "") -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return the settings of a package without the keys of extensions that do not exist here, and a note for each of these.

    No id depends on such keys, so the package can be read and executed without them.
    """
    absent = {key: extension for key in table if key not in added("tables") and (extension := home(key))}
    kept = {key: value for key, value in table.items() if key not in absent}
    notes = [
        f"sierra.toml: {where}{key} of the package is ignored: the extension {extension!r} is not installed"
        for key, extension in absent.items()
    ]
    if isinstance(targets := kept.get("targets"), Mapping):
        for name, target in targets.items():
            if isinstance(target, Mapping):
                own, more = without_absent(target, f"{where}targets.{name}.")
                kept["targets"] = {**kept["targets"], name: own}
                notes += more
    return kept, tuple(notes)


def _present(kind: str) -> Iterator[tuple[str, Mapping[str, str]]]:
    """Yield the extensions that exist, each with its names of a kind. `Path.is_dir` would take longer."""
    yield from ((name, adds.get(kind, {})) for name, adds in ADDS.items() if os.path.isdir(FOLDER / name))  # noqa: PTH112

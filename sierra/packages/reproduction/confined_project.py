"""The project of a received package, without the keys of its `sierra.toml` that reach outside the package.

A package must not choose where runs execute, what SIERRA starts on this machine besides the recorded commands, which of its
files containers can read, or which of its variables are recorded. Such keys are removed, also those of targets, and named.
Clusters and engines are those of the user's own configuration.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

from sierra.config import extensions, project_file, user
from sierra.config.find_project import ProjectFolder, settings
from sierra.config.project_file import LoadedProject
from sierra.store.layout import CONFIG, PYPROJECT

PLUGINS = "plugins"
REMOVED = {
    ("runners",): "clusters are those of your own configuration",
    ("engines",): "engines are used with their own defaults",
    (PLUGINS,): "Python code of a package is never imported",
    ("programs",): "programs of this machine are asked for their versions as usual",
    ("store", "work_folder"): "runs execute below the given folder",
    ("environment", "record"): "your variables are not recorded",
}
"""Keys that are removed, with the reason."""


def load(root: Path) -> tuple[LoadedProject, tuple[str, ...]]:
    """Return the project in `root` without these keys, and a line for each removed key. Raises ConfigError."""
    file = next((root / name for name in (CONFIG, PYPROJECT) if (root / name).is_file()), root / CONFIG)
    whole = settings(file) or {}
    table, absent = extensions.without_absent(whole)
    notes = [*absent, *_confine(table, "")]
    targets = table.get("targets")
    for name, target in targets.items() if isinstance(targets, dict) else ():
        if isinstance(target, dict):
            notes += _confine(target, f"targets.{name}.")
    if clusters := user.load().runners:
        table["runners"] = dict(clusters)
    project = project_file.of_table(ProjectFolder(root, file), table)
    return replace(project, received=True, lacking=extensions.lacking(whole)), tuple(notes)


def _confine(table: dict[str, Any], where: str) -> Iterator[str]:
    """Remove the keys from a table; yield a line for each."""
    for (*folders, key), reason in REMOVED.items():
        inner = _table(table, folders)
        if key in inner:
            if key != PLUGINS:  # their names are valid, but whatever uses one is refused
                del inner[key]
            yield f"sierra.toml: {where}{'.'.join((*folders, key))} of the package is ignored: {reason}"
    mounts = _table(table, ["container", "mounts"])
    for target, source in list(mounts.items()):
        if not isinstance(source, str) or _leads_out(source):
            del mounts[target]
            yield f"sierra.toml: {where}container.mounts {target} of the package is ignored: {source} is outside the package"
    yield from _without_templates(table, where)


def _without_templates(table: dict[str, Any], where: str) -> Iterator[str]:
    """Remove templates outside the package; recorded inputs are used anyway. Yield a line for each."""
    if isinstance(path := table.get("template"), str) and _leads_out(path):
        del table["template"]
        yield f"sierra.toml: {where}template of the package is ignored: {path} is outside the package"


def _table(table: dict[str, Any], names: list[str]) -> dict[str, Any]:
    """Return an inner table; an empty one if there is none."""
    for name in names:
        found = table.get(name)
        table = found if isinstance(found, dict) else {}
    return table


def _leads_out(path: str) -> bool:
    """Check whether a path leads out of the project. A package has no links."""
    return PurePosixPath(path).is_absolute() or path.startswith("~") or ".." in PurePosixPath(path).parts

"""The Python packages that a project's runs need, as `requires` in `sierra.toml` names them.

They are checked before anything executes, in the Python that `{python}` stands for: the one that executes SIERRA. In a
container, the image has its own packages, so that nothing is checked.
"""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from importlib import metadata

from sierra.config.project_file import Project
from sierra.util.lazy_definitions import regex

NAME = regex(r"[A-Za-z0-9][\w.-]*")
PYTHON = "{python}"


def missing(project: Project, *, contained: bool) -> tuple[str, ...]:
    """Return those of a project's required packages that are not installed, as `sierra.toml` writes them.

    A project without a command has that of its platform, and what it requires is for `{python}`.
    """
    if contained or project.command[:1] not in ((), (PYTHON,)):
        return ()
    return tuple(text for text in project.requires if not _is_installed(text))


def remedy(packages: Sequence[str]) -> str:
    """Return the command that installs packages."""
    return f"pip install {shlex.join(packages)}"


def _is_installed(text: str) -> bool:
    name = NAME.match(text)
    try:
        return name is not None and bool(metadata.version(name[0]))
    except metadata.PackageNotFoundError:
        return False

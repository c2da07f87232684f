"""SIERRA: from a research question to results that anyone can verify.

>>> import sierra
>>> project = sierra.open(".")
>>> summary = project.run("population_size=1,2", runs=2)
>>> print(project.sql("SELECT count(*) AS rows FROM swarm", within=summary.batch).to_pylist())
[{'rows': 20}]

All names here are loaded when they are first used, so that `import sierra` is fast.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from sierra.util.version import __version__

if TYPE_CHECKING:
    import os

    from sierra.api import Project
    from sierra.errors import (
        ConfigError,
        Damaged,
        Missing,
        NotFound,
        QueryError,
        SierraError,
        SqlError,
        TemplateError,
        UsageError,
    )
    from sierra.execution.observer import Observer, Progress
    from sierra.execution.plan import Plan
    from sierra.execution.summary import Summary
    from sierra.replay.verdicts import Replay
    from sierra.store.public_result import Result

HOMES = {
    "ConfigError": "sierra.errors",
    "Damaged": "sierra.errors",
    "Missing": "sierra.errors",
    "NotFound": "sierra.errors",
    "Observer": "sierra.execution.observer",
    "Plan": "sierra.execution.plan",
    "Progress": "sierra.execution.observer",
    "Project": "sierra.api",
    "QueryError": "sierra.errors",
    "Replay": "sierra.replay.verdicts",
    "Result": "sierra.store.public_result",
    "SierraError": "sierra.errors",
    "SqlError": "sierra.errors",
    "Summary": "sierra.execution.summary",
    "TemplateError": "sierra.errors",
    "UsageError": "sierra.errors",
}
"""The module that defines each public name."""


def open(path: str | os.PathLike[str] = ".") -> Project:
    """Return the project that contains `path`, with its store; see `Project`.

    Raises Missing if neither a `sierra.toml` nor a store is in that folder or above it.

    >>> project = open(".")
    >>> sorted(project.config.variables)
    ['noise', 'population_size']
    """
    from sierra.api import Project

    return Project(path)


def __getattr__(name: str) -> Any:
    if name not in HOMES:
        raise AttributeError(f"module 'sierra' has no attribute {name!r}")
    return getattr(importlib.import_module(HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *HOMES})


__all__ = [
    "ConfigError",
    "Damaged",
    "Missing",
    "NotFound",
    "Observer",
    "Plan",
    "Progress",
    "Project",
    "QueryError",
    "Replay",
    "Result",
    "SierraError",
    "SqlError",
    "Summary",
    "TemplateError",
    "UsageError",
    "__version__",
    "open",
]

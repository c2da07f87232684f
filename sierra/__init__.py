"""SIERRA: from a research question to results that anyone can verify.

import sierra

project = sierra.open(".")
summary = project.run("population_size.Log8", runs=10)
project.statistics(summary.batch, "swarm", "coverage").to_pandas()
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from sierra.version import __version__

if TYPE_CHECKING:
    import os

    from sierra.project import Project


def open(path: str | os.PathLike[str] = ".") -> Project:
    """Return the project that contains `path`, with its store; see `sierra.project.Project`.

    Raises sierra.errors.Missing if neither a `sierra.toml` nor a store is in that folder or above it.
    """
    from sierra.project import Project

    return Project(path)


__all__ = ["__version__", "open"]

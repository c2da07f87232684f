"""The folders and names of the files that runs of a plan would use now."""

from __future__ import annotations

import os
from pathlib import Path

from sierra.execution import commands
from sierra.execution.observation.current_files import Current
from sierra.execution.plan import Plan
from sierra.execution.project_source import not_in_checkouts
from sierra.provenance import pythons
from sierra.provenance.dependency_model import Programs
from sierra.util.regular_files import read_regular


def folders(root: Path, programs: Programs, search: str) -> dict[str, Path]:
    """Return the folders that names of observed files refer to, by name.

    `root` is the folder of the code, `search` the PATH of the runs.
    """
    home = Path.home()
    cache = Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache")
    named = {"project": root.resolve(), "home": home.resolve(), "cache": cache.resolve()}
    environment = pythons.environment(programs, search)
    return {**named, "prefix": environment} if environment else named


def current(plan: Plan) -> Current:
    """Return where files are now."""
    return Current(
        folders=folders(plan.project.root, plan.programs, _search(plan)),
        search=_search(plan),
        declared="PATH" in plan.batch.spec.environment,
        program=plan.programs.all[0].path if plan.programs.all else "",
        words=_words(plan),
        lacking=frozenset(not_in_checkouts(plan.project)),
    )


def _search(plan: Plan) -> str:
    """Return the PATH of the runs."""
    return commands.search_path(commands.declared(plan.batch.spec.environment, plan.project.root, plan.project.root))


def _words(plan: Plan) -> str:
    """Return all texts of a plan that may name modules of Python."""
    spec, templates = plan.batch.spec, plan.project.config.template_paths
    texts = (_text(plan.project.root / template) for template in templates)
    return " ".join((*spec.words, *spec.environment.values(), plan.text, *texts))


def _text(file: Path) -> str:
    try:
        return read_regular(file).decode(errors="replace")
    except OSError:
        return ""

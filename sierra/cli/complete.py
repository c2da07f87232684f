"""Shell completion of ids, names in `sierra.toml`, tables and columns.

It must answer within the time of a key press. It looks at file names first, and queries the store only for data that file
names do not contain: the columns of an existing table, and ids of runs after 4 digits. On any error it prints nothing, because
its output would appear in the line that the user types.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from sierra.util.lazy_definitions import regex

if TYPE_CHECKING:
    from sierra.config.project_file import LoadedProject

SESSION = regex("[0-9a-f]{16}")
IGNORED = (Exception, SystemExit)
"""Errors that are ignored: then there are no completions."""


MOST = 50
"""The largest number of completions that are read from the store."""
DIGITS = regex("[0-9a-f]{4,}")
IDS = """
SELECT DISTINCT left(id, greatest(10, length($p) + 2)) AS id FROM (
    SELECT run AS id FROM batch_runs UNION ALL SELECT experiment FROM experiments UNION ALL SELECT execution FROM executions
    UNION ALL SELECT study FROM studies UNION ALL SELECT claim FROM registered_claims
) WHERE starts_with(id, $p) LIMIT $most
"""
COLUMNS = "SELECT column_name AS id FROM information_schema.columns WHERE table_name = $t LIMIT $most"


def batches(incomplete: str) -> list[str]:
    """Return prefixes of batches' ids."""
    found: set[str] = set()
    with contextlib.suppress(*IGNORED):
        found = {segment.partition("-")[0][:10] for segment in _segments()} - {"0" * 10}  # the segments that belong to no batch
    return _beginning(found, incomplete.lower())


def ids(incomplete: str) -> list[str]:
    """Return prefixes of batches' ids; if there are none, and 4 digits are given, those of experiments, runs and executions."""
    return batches(incomplete) or (_from_store(IDS, p=incomplete.lower()) if DIGITS.fullmatch(incomplete.lower()) else [])


def sessions(incomplete: str) -> list[str]:
    """Return prefixes of batches' ids, and ids of sessions that have not ended."""
    return [*batches(incomplete), *_sessions(incomplete, "work")]


def anything(incomplete: str) -> list[str]:
    """Return prefixes of ids of any kind."""
    return [*batches(incomplete), *_sessions(incomplete, "logs")] or ids(incomplete)


def _sessions(incomplete: str, folder: str) -> list[str]:
    """Return the ids of the sessions that have something in a folder of the store."""
    found: set[str] = set()
    with contextlib.suppress(*IGNORED):
        found = {path.stem for path in (_folder().parent / folder).iterdir() if SESSION.fullmatch(path.stem)}
    return _beginning(found, incomplete.lower())


def criteria(incomplete: str) -> list[str]:
    """Return the names of queries, and those of variables with a dot at the end; after 4 digits, also ids of batches."""
    found: list[str] = []
    with contextlib.suppress(*IGNORED):
        config = _project().config
        groups = [f"{name}=" for name in ("controller", "scenario") if getattr(config, f"{name}s")]
        found = [*config.queries, *(f"{name}." for name in config.variables), *groups, "montecarlo.C"]
    return [*_beginning(found, incomplete), *(batches(incomplete) if DIGITS.match(incomplete) else ())]


def controllers(incomplete: str) -> list[str]:
    """Return the names of controllers."""
    return _groups("controllers", incomplete)


def scenarios(incomplete: str) -> list[str]:
    """Return the names of scenarios."""
    return _groups("scenarios", incomplete)


def targets(incomplete: str) -> list[str]:
    """Return the names of targets, after those that are complete."""
    before, comma, last = incomplete.rpartition(",")
    found: tuple[str, ...] = ()
    with contextlib.suppress(*IGNORED):
        found = _project().targets
    return [f"{before}{comma}{name}" for name in _beginning(found, last) if name not in before.split(",")]


def batches_and_figures(incomplete: str) -> list[str]:
    """Return prefixes of batches, and the names of figures and tables in `sierra.toml`."""
    return [*batches(incomplete), *figures(incomplete), *_named("paper_tables", incomplete)]


def comparison_methods(incomplete: str) -> list[str]:
    """Return the names of comparison methods."""
    from sierra.config.plugin_registry import COMPARISONS

    return _beginning(COMPARISONS.names(), incomplete)


def figures(incomplete: str) -> list[str]:
    """Return the names of the figures in `sierra.toml`."""
    return _named("figures", incomplete)


def models(incomplete: str) -> list[str]:
    """Return the names of the models in `sierra.toml`."""
    return _named("models", incomplete)


def claims(incomplete: str) -> list[str]:
    """Return the names of the claims in `sierra.toml`."""
    return _named("claims", incomplete)


def comparisons(incomplete: str) -> list[str]:
    """Return the names of the comparisons and queries in `sierra.toml`, and prefixes of batches' ids."""
    return [*_named("comparisons", incomplete), *_named("queries", incomplete), *batches(incomplete)]


def runners(incomplete: str) -> list[str]:
    """Return the names of runners."""
    from sierra.config.plugin_registry import RUNNERS, SCHEDULERS

    return sorted({*_named("runners", incomplete), *_beginning((*RUNNERS.shipped, *SCHEDULERS.shipped), incomplete)})


def columns(context: typer.Context, incomplete: str) -> list[str]:
    """Return the columns of the table that precedes in the command line."""
    table = context.params.get("output")
    return _beginning(_from_store(COLUMNS, t=table), incomplete) if table in tables("") else []


def tables(incomplete: str) -> list[str]:
    """Return the names of tables that runs have written, and of derived tables."""
    from sierra.store.segments import on_disk

    found: set[str] = set()
    with contextlib.suppress(*IGNORED):
        found = {table for segment in on_disk(_folder()) for table, _ in segment.outputs()}
    return _beginning({*found, *_named("tables", "")}, incomplete)


def _from_store(statement: str, **parameters: str) -> list[str]:
    """Return the ids or names that a statement finds in the store."""
    with contextlib.suppress(*IGNORED):
        from sierra.cli.open_project import project

        return project().store.values(str, statement, most=MOST, **parameters)
    return []


def _named(section: str, incomplete: str) -> list[str]:
    """Return the names in a section of `sierra.toml`."""
    found: list[str] = []
    with contextlib.suppress(*IGNORED):
        found = list(getattr(_project().config, section))
    return _beginning(found, incomplete)


def _groups(section: str, incomplete: str) -> list[str]:
    """Return the names of controllers or scenarios that can be chosen; of a name with parameters, the text before them."""
    from sierra.config.group_names import is_category

    names = _named(section, "")
    return _beginning({name.partition("{")[0] for name in names if not is_category(name, names)}, incomplete)


def _project() -> LoadedProject:
    from sierra.config import project_file

    return project_file.load(Path())


def _folder() -> Path:
    from sierra.store.layout import ProjectPaths, StorePaths

    return StorePaths(ProjectPaths(_project().root).store).segments


def _segments() -> Iterator[str]:
    """Yield the names of segments, including replaced ones."""
    yield from (path.name for path in _folder().iterdir() if path.is_dir())


def _beginning(names: Iterable[str], incomplete: str) -> list[str]:
    return sorted(name for name in names if name.startswith(incomplete))

"""Texts that may become part of the inputs of runs, and so may name files."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

from sierra.config.change_tables import OWN_PLACEHOLDERS
from sierra.config.project_file import Project
from sierra.execution import commands
from sierra.model import IN_PROJECT, Design, Set

WRITTEN = ("value", "xml", "per_run")
"""Keys whose texts may become part of an input. Texts of other keys are XPaths and names, and `/x` is not a file there."""


def written(config: Project) -> Iterator[str]:
    """Yield the texts that the project's changes may put into a template, for any query."""
    changes = config.model_dump(include={"variables", "changes", "run_changes", "per_run", "controllers", "scenarios"})
    pending: list[tuple[bool, object]] = [(False, changes)]
    while pending:
        match pending.pop():
            case True, str() as text:
                yield text
            case stands, dict() as table:
                pending.extend((stands or key in WRITTEN, value) for key, value in table.items())
            case stands, list() | tuple() as items:
                pending.extend((stands, item) for item in items)


def set_by(designed: Design) -> set[str]:
    """Return the texts that a query puts into the template: values of `--set`, and values of axes that are not numeric."""
    names = [axis.name for axis in designed.axes if not axis.numeric]
    values = {change.value for change in designed.query.sets}
    for cell in designed.cells if names else ():
        for change in cell.changes:
            if isinstance(change, Set):
                filled = change.value
                for name in names:
                    filled = filled.replace(f"{{{name}}}", str(cell.values[name]))
                values.add(filled)
    return values


def given_by(designed: Design, command: Sequence[str]) -> set[str]:
    """Return the texts in which the command of a run contains a value, from the project's root."""
    words = [word for word in command if commands.NAMED.search(word)]
    found: set[str] = set()
    for cell in designed.cells if words else ():
        texts = {name: str(value) for name, value in cell.values.items() if name not in OWN_PLACEHOLDERS}
        for word in words:
            [filled] = commands.with_texts((word,), texts)
            found.update(part.removeprefix(IN_PROJECT) for part in re.split("[:;,=]", filled) if filled != word)
    return found

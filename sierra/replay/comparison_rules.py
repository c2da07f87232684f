"""Rules for the comparison of outputs: tolerances and columns that do not count."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

from sierra.config.output_tables import Output
from sierra.config.project_file import LoadedProject
from sierra.errors import UsageError
from sierra.replay.find_record import Record
from sierra.replay.verdicts import Tolerances
from sierra.store.sql_names import stored_name
from sierra.util.text import like


def declared_rules(record: Record, project: LoadedProject, tolerances: Tolerances) -> dict[str, Output]:
    """Return the rules for the comparison, by output.

    These are the recorded declarations, overridden by the project's current ones and by the requested tolerances.
    Raises UsageError for an unknown output or column.
    """
    declared = {**record.of.outputs, **project.config.outputs}
    known = sorted({*declared, *record.tables})
    if unknown := tolerances.keys() - {"*", *known}:
        raise UsageError(f"--set-tolerance: unknown output {min(unknown)!r}; known outputs: {', '.join(known) or 'none'}")
    for name, columns in tolerances.items():
        _check_columns(name, columns, record.tables)
    for name, output in declared.items():
        record.notes += _unused(name, output, record.tables.get(name))
    for name in known if tolerances else ():
        output = declared.get(name) or Output(file=name)
        asked = {**output.tolerance, **tolerances.get("*", {}), **tolerances.get(name, {})}
        declared[name] = output.model_copy(update={"tolerance": asked})
    return declared


def _check_columns(output: str, columns: Iterable[str], tables: Mapping[str, list[str]]) -> None:
    """Raise UsageError for a column that no table of that output has; `*` stands for all outputs, or for all columns."""
    known = sorted({name for table, names in tables.items() if output in ("*", table) for name in names})
    for column in columns:
        if known and column not in ("*", *known):
            where = "no output" if output == "*" else f"output {output!r}"
            has = "has the" if output == "*" else "has no"
            raise UsageError(f"--set-tolerance: {where} {has} column {column!r}; {like(column, known)}")


def _unused(name: str, output: Output, columns: list[str] | None) -> Iterator[str]:
    """Yield a line for each column that an output's declaration names and its table does not have."""
    for key, names in (("tolerance", output.tolerance), ("volatile", output.volatile)) if columns else ():
        for column in names:
            if column not in ("*", *(columns or ())) and stored_name(column, columns or ()) not in (columns or ()):
                yield f"[outputs.{name}] {key}: the table has no column {column!r}; {like(column, columns or ())}"

"""The printed form of how a batch's outputs were read."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

from sierra.cli.output import readable
from sierra.util.hashing import short
from sierra.util.text import counted, few

if TYPE_CHECKING:
    from sierra.execution.outputs_taken import TakenOutputs, TakenTable
    from sierra.execution.unread_files import UnreadFiles

COLUMNS = 6
"""Number of columns that a line names; others are only counted."""
TABLES = 8
UNREAD = 4


def short_lines(taken: TakenOutputs) -> Iterator[str]:
    """Yield a few lines for the summary of a batch: a line for each table, and one for each kind of other files."""
    for table in taken.tables[:TABLES]:
        columns = few([f"{readable(column.name)} {column.type}" for column in table.columns], COLUMNS)
        time = f"; time axis: {readable(table.time)}" if table.time else ""
        yield f"table {readable(table.name)} from {readable(table.file)}: {table.rows}; {columns or 'no columns'}{time}"
    if more := len(taken.tables) - TABLES:
        yield from [f"and {counted(more, 'more table')}"] if more > 0 else []
    unread = [kind for kind in taken.unread if not kind.noted]
    yield from unread_lines(taken.runs, unread[:UNREAD])
    if len(unread) > UNREAD:
        yield f"and {len(unread) - UNREAD} more kinds of files"
    if taken.tables or unread:
        undeclared = any(not table.declared for table in taken.tables) or any(kind.keys for kind in taken.unread)
        write = "; sierra outputs --write declares these tables in sierra.toml" if undeclared else ""
        yield f"(sierra outputs {short(taken.batch)} shows all of this again{write})"


def lines(found: TakenOutputs) -> Iterator[str]:
    """Yield all that is known about the outputs of a batch."""
    tables = counted(len(found.tables), "table")
    target = f" (target {found.target})" if found.target else ""
    runs = f"{counted(found.runs, 'run')}{', which all failed' if found.all_failed else ' with results'}"
    yield f"batch {short(found.batch)}{target}: {tables} from {runs}"
    for table in found.tables:
        yield from _table(table, found.runs)
    yield from unread_lines(found.runs, found.unread)


def unread_lines(runs: int, unread: Iterable[UnreadFiles]) -> Iterator[str]:
    """Yield why files became no table."""
    for one in unread:
        yield f"not a table: {readable(one.path)}{_others(one.files, runs)}: {readable(one.why)}"


def _table(table: TakenTable, runs: int) -> Iterator[str]:
    declared = "declared" if table.declared else "not declared"
    wrote = "" if table.runs == runs else f", in {table.runs} of {counted(runs, 'run')}"
    yield f"table {readable(table.name)} from {readable(table.file)} ({table.format}, {declared}): {table.rows}{wrote}"
    if table.units_row:
        yield "  a line with units follows the column names"
    width = max((len(readable(column.name)) for column in table.columns), default=0)
    for column in table.columns:
        unit = f" in {readable(column.unit)}" if column.unit else ""
        time = ", time axis" if column.name == table.time else ""
        original = f", {readable(column.original)} in the file" if column.original else ""
        yield f"  {readable(column.name).ljust(width)}  {column.type}{unit}{time}{original}"


def _others(files: int, runs: int) -> str:
    return f" and {counted(files - 1, 'other file')}" if files > max(runs, 1) else ""

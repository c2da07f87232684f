"""`sierra sql`: query the store with SQL."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sierra.cli import complete
from sierra.cli.arguments import Format, Long
from sierra.cli.output import as_json, cells, note, short_id, table, terminal_width
from sierra.errors import UsageError
from sierra.util.fs import write_whole
from sierra.util.lazy_definitions import dataclass

if TYPE_CHECKING:
    import pyarrow as pa

    from sierra.store.sql_result import Answer, SqlValue
    from sierra.store.store import Store

SHOWN_ROWS = 200


def sql(
    statement: Annotated[
        str | None,
        typer.Argument(metavar="STATEMENT", help="One SQL statement; - reads it from standard input (default: a prompt)."),
    ] = None,
    format: Annotated[Format, typer.Option("--format", "-f", help="Output format.")] = Format.table,
    batch: Annotated[
        str | None,
        typer.Option(
            "--batch",
            "-b",
            metavar="HASH",
            autocompletion=complete.batches,
            help="Query only the runs and outputs of this batch.",
        ),
    ] = None,
    long: Long = False,
    output: Annotated[Path | None, typer.Option("--output", "-o", metavar="FILE", help="Write the result to a file.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Same as --format json.")] = False,
) -> None:
    """Query the store with SQL (DuckDB's dialect).

    Statements cannot change anything, and can read nothing except the store. Without --batch, outputs are those of all
    batches, regardless of their code and settings. A column v that has numbers in some runs and texts in others becomes two
    columns: v has the numbers, and v_text has the texts.

    \b
    Examples:
      sierra sql "SHOW TABLES"
      sierra sql "DESCRIBE executions"
      sierra sql -b 9e1c "SELECT noise, avg(coverage) FROM swarm GROUP BY 1"
      sierra sql "FROM runs" --format parquet -o runs.parquet
      sierra sql -b 9e1c "FROM distances"    # made by [tables.distances]
      sierra sql - < snapshot.sql
    """
    from sierra.cli.open_project import project

    opened = project()
    within = None if batch is None else opened.records.batch(batch)
    if statement is None:
        from sierra.cli.sql_prompt import prompt

        prompt(lambda text: write(_ask(opened.store, text, within, Format.table), Format.table, None, long=long))
        return
    text = sys.stdin.read() if statement == "-" else statement
    if not text.strip():
        raise UsageError('no SQL statement; give one, for example: sierra sql "SHOW TABLES"')
    format = Format.json if as_json else format
    write(_ask(opened.store, text, within, format), format, output, long=long)


def _ask(store: Store, text: str, within: str | None, format: Format) -> Printable:
    """Return the result of a statement."""
    convert = Printable.of_table if format is Format.parquet else Printable.of_rows
    with store.snapshot(within, theirs=True) as snapshot:
        return snapshot.ask(text, {}, convert, theirs=True)


@dataclass(frozen=True, slots=True)
class Printable:
    """A result that is printed or written: rows, or for Parquet an Arrow table."""

    columns: list[str]
    rows: Sequence[tuple[SqlValue, ...]]
    numeric: list[str]
    notes: str
    table: pa.Table | None = None

    @classmethod
    def of_rows(cls, answer: Answer) -> Printable:
        return cls(answer.columns, answer.rows(), answer.numeric, answer.notes)

    @classmethod
    def of_table(cls, answer: Answer) -> Printable:
        return cls(answer.columns, (), [], answer.notes, answer.arrow())

    @classmethod
    def of_arrow(cls, table: pa.Table) -> Printable:
        """Return the result that an Arrow table holds, with the notes in its metadata."""
        from pyarrow import types

        from sierra.store.store import NOTE
        from sierra.util.arrow_columns import rows_of

        kinds = (types.is_integer, types.is_floating, types.is_decimal)
        numeric = [field.name for field in table.schema if any(is_kind(field.type) for is_kind in kinds)]
        notes = (table.schema.metadata or {}).get(NOTE.encode(), b"").decode()
        return cls(table.column_names, [tuple(row.values()) for row in rows_of(table)], numeric, notes, table)


def write(answer: Printable, format: Format, output: Path | None, *, long: bool = False) -> None:
    """Write a result in a format to a file or to standard output, and its notes to standard error."""

    if answer.notes:
        note(answer.notes)
    if output is None and format is Format.parquet and sys.stdout.isatty():
        raise UsageError("Parquet cannot be printed on a terminal; write it to a file with -o FILE")
    brief = output is None and format is Format.table and sys.stdout.isatty() and not long
    data = _table(answer, brief=True) if brief else FORMATS[format](answer)
    if output is not None:
        write_whole(output, data)
        return
    _print(data)


def write_text(text: str, output: Path | None) -> None:
    """Write a text to a file or to standard output."""
    if output is not None:
        write_whole(output, text.encode())
    else:
        _print(text.encode())


def _print(data: bytes) -> None:
    if sys.stdout.isatty():
        print(data.decode("utf-8", "replace"), end="")
        return
    sys.stdout.flush()
    sys.stdout.buffer.write(data)
    sys.stdout.buffer.flush()


def _table(answer: Printable, *, brief: bool = False) -> bytes:
    """Return a text table; with `brief`, ids are shortened and texts are cut for a terminal."""
    import contextlib
    import io

    text, width = io.StringIO(), terminal_width() if brief else 0
    rows = [[short_id(value) if brief else value for value in row] for row in answer.rows[:SHOWN_ROWS]]
    with contextlib.redirect_stdout(text):
        table(answer.columns, rows, right=answer.numeric, width=width)
        if len(answer.rows) > SHOWN_ROWS:
            print(f"({len(answer.rows)} rows, {SHOWN_ROWS} of them shown; --format csv writes all)")
    return text.getvalue().encode()


def _csv(answer: Printable) -> bytes:
    import csv
    import io

    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(answer.columns)
    writer.writerows(answer.rows)
    return text.getvalue().encode()


def _json(answer: Printable) -> bytes:
    return as_json([dict(zip(answer.columns, row, strict=True)) for row in answer.rows]).encode() + b"\n"


def _markdown(answer: Printable) -> bytes:
    lines = [answer.columns, ["---"] * len(answer.columns)]
    lines += [[text.replace("|", "\\|") for text in row] for row in cells(answer.rows)]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines).encode()


def _parquet(answer: Printable) -> bytes:
    import io

    import pyarrow.parquet as pq

    from sierra.util.arrow_columns import without_intervals

    data = io.BytesIO()
    if answer.table is not None:
        pq.write_table(without_intervals(answer.table), data, compression="zstd")
    return data.getvalue()


FORMATS = {
    Format.table: _table,
    Format.csv: _csv,
    Format.json: _json,
    Format.markdown: _markdown,
    Format.parquet: _parquet,
}

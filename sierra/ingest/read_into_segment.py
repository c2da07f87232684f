"""The tables of several executions, read into one segment."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from sierra.config.output_tables import Output
from sierra.ingest import robot_files
from sierra.ingest.base import LaterError, UnreadableError
from sierra.ingest.consistency import siblings
from sierra.ingest.match_outputs import OutputMatcher
from sierra.ingest.messages import shown
from sierra.ingest.model import Reading, Shape, Written
from sierra.ingest.read import read
from sierra.ingest.recording_context import Context
from sierra.ingest.rewriting import OriginalFile
from sierra.ingest.success import Judgement
from sierra.model import ACCEPTED, OutputFile, Result, Status
from sierra.store.layout import RUN_OUTPUT
from sierra.store.row_types import ArtifactRow
from sierra.store.segments import OUTPUT, Writer
from sierra.store.store import Store
from sierra.store.table_layout import TableLayout
from sierra.util.lazy_definitions import dataclass, field, replace

if TYPE_CHECKING:
    from sierra.ingest.archives import Unpacking


class TableFile(NamedTuple):
    """A file that belongs to a table, as it is recorded in its artifact."""

    output: str | None
    rows: int | None
    """The number of rows that the file added to its table; None if nothing could be read from it."""
    counted: int | None
    """The number of rows by a count of the file itself."""
    layout: str | None
    member: str | None = None
    """The file in an archive that was read; None if it was the file itself."""


class _Named(NamedTuple):
    path: str
    output: str | None


NAMED = """
SELECT DISTINCT path, output FROM all_artifacts
WHERE kind IN ('table', 'file') AND NOT coalesce(ends_with(output, $accepted), false)
    AND regexp_matches(path, '^([0-9]{1,9}/)?[^/]+[.](csv|tsv|parquet|jsonl|ndjson)$', 'i')
ORDER BY ALL
"""


def recorded_names(store: Store) -> list[_Named]:
    """Return the recorded files that could be undeclared tables, each with its table, or None."""
    with store.snapshot() as snapshot:
        return snapshot.select(_Named, NAMED, accepted=ACCEPTED) if snapshot.holds("artifacts") else []


TEXTS = ("csv", "jsonl")
"""The formats of which each line ends with a line feed."""
NAME_TAKEN = "{path}: makes the table {name!r}, as rows of accepted ends do ([success] accept); give it another name"
NO_TABLE = TableFile(None, None, None, None)


@dataclass(frozen=True, slots=True)
class TableIngest:
    """The files that belong to tables, by execution and path."""

    outputs: Mapping[str, Output]
    files: dict[tuple[str, str], list[TableFile]] = field(default_factory=dict)
    faults: dict[str, str] = field(default_factory=dict)
    """The reasons why executions are at fault."""
    rest: list[Judgement] = field(default_factory=list)
    """The last executions, if there was no space to unpack their archives beside those of the others; they are not read."""

    def of(self, execution: str, file: OutputFile) -> Sequence[TableFile]:
        """Return the tables that were made from a file: one, several of a bag, or `NO_TABLE`."""
        return self.files.get((execution, file.path), (NO_TABLE,))

    def judged(self, judgement: Judgement) -> Judgement:
        """Return the judgement after the tables were read."""
        execution = judgement.result.execution
        if judgement.status is Status.ACCEPTED:  # a program that did not come to its end may have written anything
            return judgement
        if execution in self.faults:
            return Judgement(judgement.result, Status.MISMATCH, self.faults[execution])
        files = judgement.result.outputs if judgement.status is Status.OK else ()
        for path, table in ((file.path, table) for file in files for table in self.of(execution, file)):
            output = self.outputs.get(table.output or "")
            name = f"{path}/{table.member}" if table.member else path
            if output and table.rows is not None and (few := too_few(name, table.rows, str(table.output), output)):
                return Judgement(judgement.result, Status.FAILED, few)
        return judgement


def _layout(reading: Reading, file: Written) -> str:
    """Return the layout of a table for comparison with its siblings. Only a CSV's columns have an order."""
    key = file.execution, file.name
    columns, csv = reading.columns[key], reading.shape.format == "csv"
    name = None if reading.shape.many else shown(file.name)
    return TableLayout(
        name,
        columns if csv else dict(sorted(columns.items())),
        file.ended or not csv,
        reading.hints.get(key, {}),
        "text" in columns.values() and key in reading.timed,
        csv and "text" in columns.values() and key not in reading.padded,
    ).dump()


def too_few(path: str, rows: int, name: str, output: Output) -> str | None:
    """Return the message that a file has fewer rows than its output requires; None if it has enough."""
    if output.lines and output.required and not rows:
        return f"{path}: no line matches {output.lines!r} (lines in [outputs.{name}]; required = false allows this)"
    if rows >= output.min_rows:
        return None
    return f"{path}: {rows} rows; [outputs.{name}] min_rows asks for {output.min_rows}"


def artifact_rows(result: Result, tables: TableIngest) -> Iterator[ArtifactRow]:
    """Yield the rows of `artifacts` for the files of an execution except its logs."""
    for file in result.outputs:
        yield from file_rows(result, file, tables)


def file_rows(result: Result, file: OutputFile, tables: TableIngest) -> Iterator[ArtifactRow]:
    """Yield the row of `artifacts` for a file; for a file of several tables, one for each."""
    for table in tables.of(result.execution, file):
        yield ArtifactRow(
            execution=result.execution,
            run=result.run,
            path=shown(file.path),
            kind="file" if table.rows is None else "table",
            output=table.output,
            size=file.bytes,
            sha256=file.sha256,
            rows=table.rows,
            table_layout=table.layout,
            counted_rows=table.counted,
            member=table.member,
        )


def tabled(
    executions: Sequence[Judgement],
    writer: Writer,
    store: Store,
    context: Context,
    assigning: OutputMatcher,
    shapes: dict[str, Shape],
) -> TableIngest:
    """Read all tables of executions that are results into a segment; add new tables to `shapes`.

    The rows of accepted ends are in tables of their own: the programs may not have come to the end of their files.
    """
    from sierra.store.connections import connect

    with _unpacking(context.outputs) as unpacking:
        tables = TableIngest(context.outputs)
        files: dict[str, list[Written]] = {}
        optional = set[str]()
        patterns: dict[Written, list[str]] = {}
        for number, judged in enumerate(executions):
            try:
                written_files = list(_files(judged, context, assigning, unpacking, tables.faults))
            except LaterError:
                tables.rest.extend(executions[number:])
                break
            for output, shape, written in written_files:
                name = output if judged.status is Status.OK else output + ACCEPTED
                if judged.status is Status.ACCEPTED and not written.ended and shape.format in TEXTS:
                    continue  # it was cut off in its last line, which may look whole
                if judged.status is Status.OK and context.success.accept and name.lower().endswith(ACCEPTED):
                    tables.faults.setdefault(judged.result.execution, NAME_TAKEN.format(path=shown(written.name), name=name))
                shapes.setdefault(name, replace(shape, name=name) if shape.name else shape)
                files.setdefault(name, []).append(written)
                if shape.form.lines:
                    patterns.setdefault(written, []).append(shape.form.lines)
                    optional |= set() if context.outputs[output].required else {name}
        if not files:
            return tables
        for written, several in patterns.items():
            with contextlib.suppress(UnreadableError):  # the reader says so
                assigning.unmatched.add(written.run, OriginalFile(written), several)
        connection = connect()
        try:
            for name, table_files in files.items():
                twice = dict(_twice(table_files, shapes[name]))
                for execution, fault in twice.items():
                    tables.faults.setdefault(execution, fault)
                single = [file for file in table_files if file.execution not in twice]
                reading = read(connection, single, shapes[name], writer.path(OUTPUT + name), siblings(store, context, name))
                shapes[name] = reading.shape
                for file in single:
                    rows = reading.rows.get(key := (file.execution, file.name))
                    if name in optional and rows == 0:
                        continue
                    made_of = TableFile(name, None, None, None)
                    if rows is not None:
                        member = file.name.removeprefix(f"{file.archive}/") if file.archive else None
                        made_of = TableFile(name, rows, reading.counted.get(key), _layout(reading, file), member)
                    of_file = tables.files.setdefault((file.execution, file.archive or file.name), [])
                    of_file += [] if made_of in of_file else [made_of]
                for execution, fault in reading.faults.items():
                    tables.faults.setdefault(execution, fault)
        finally:
            connection.close()
        return tables


def _unpacking(outputs: Mapping[str, Output]) -> AbstractContextManager[Unpacking | None]:
    """Return the context in which files in archives are read; None if no output is in an archive."""
    if not any(output.archive for output in outputs.values()):
        return contextlib.nullcontext()
    from sierra.ingest.archives import Unpacking

    return Unpacking(outputs)


def _files(
    judged: Judgement, context: Context, assigning: OutputMatcher, unpacking: Unpacking | None, faults: dict[str, str]
) -> Iterator[tuple[str, Shape, Written]]:
    """Yield the files of an execution that become tables, also those in archives; add the fault of an archive to `faults`."""
    result = judged.result
    written: dict[str, list[str]] = {}
    for name, shape, file in assigning.of(result) if judged.status.is_result else ():
        output = context.outputs.get(name)
        several: Sequence[Written] = ()
        if unpacking is None or output is None or not output.opens(file.path):
            several = (_written(result, file, output),)
        else:
            try:
                several = unpacking.files(result, file, name)
            except UnreadableError as error:
                faults.setdefault(result.execution, f"{shown(file.path)}: {error}")
        for table in several:
            written.setdefault(name, []).append(table.name)
            yield name, shape, table
    whole = judged.status is Status.OK and result.execution not in faults
    if whole and unpacking is not None and (lack := unpacking.lacking(result, written)) is not None:
        faults[result.execution] = lack


def _twice(files: Iterable[Written], shape: Shape) -> Iterator[tuple[str, str]]:
    """Yield the executions that wrote two files with the same numbers in their names, each with an error message."""
    seen: dict[tuple[str, tuple[int, ...]], str] = {}
    for one in files if shape.ticks else ():
        if (first := seen.setdefault((one.execution, one.ticks), one.name)) != one.name:
            same = ", ".join(f"{name} {number}" for name, number in zip(shape.ticks, one.ticks, strict=True))
            yield one.execution, f"{shown(one.name)}: is {same}, as {shown(first)} is"


def _written(result: Result, file: OutputFile, output: Output | None) -> Written:
    path = str(Path(result.directory, RUN_OUTPUT, file.path))
    seen = (file.head, file.lines, file.ended, file.bytes, file.quotes, file.blank, file.alike)
    ticks = output.ticks_of(file.path) if output is not None and output.ticks else None
    if output is None and result.robots and (place := robot_files.place_of(file.path)) is not None:
        ticks = (place,)
    return Written(path, result.run, result.execution, file.path, *seen, ticks or ())

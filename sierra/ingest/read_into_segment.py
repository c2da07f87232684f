"""The tables of several executions, read into one segment."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from sierra.config.project_file import Output
from sierra.ingest.consistency import known
from sierra.ingest.match_outputs import OutputMatcher
from sierra.ingest.messages import shown
from sierra.ingest.model import Reading, Shape, Written
from sierra.ingest.read import read
from sierra.ingest.recording_context import Context
from sierra.ingest.success import Judgement
from sierra.model import OutputFile, Result, Status
from sierra.store.layout import RUN_OUTPUT
from sierra.store.records import ArtifactRow
from sierra.store.segments import OUTPUT, Writer
from sierra.store.store import Store
from sierra.store.table_layout import TableLayout


@dataclass(frozen=True, slots=True)
class TableIngest:
    """The assignment of files to tables, and the results of reading them."""

    outputs: Mapping[str, Output]
    belongs: dict[tuple[str, str], str] = field(default_factory=dict)
    """The table of each file, by execution and path."""
    readings: dict[str, Reading] = field(default_factory=dict)
    faults: dict[str, str] = field(default_factory=dict)
    """The reasons why executions are at fault."""

    def judged(self, one: Judgement) -> Judgement:
        """Return the judgement after the tables were read."""
        execution = one.result.execution
        if execution in self.faults:
            return Judgement(one.result, Status.MISMATCH, self.faults[execution])
        for file in one.result.outputs if one.status is Status.OK else ():
            name = self.table(execution, file)
            output, count = self.outputs.get(name or ""), self.rows(execution, file)
            if output and count is not None and count < output.min_rows:
                return Judgement(one.result, Status.FAILED, too_few(file.path, count, str(name), output))
        return one

    def table(self, execution: str, file: OutputFile) -> str | None:
        """Return the table of a file, even if nothing could be read from it."""
        return self.belongs.get((execution, file.path))

    def rows(self, execution: str, file: OutputFile) -> int | None:
        """Return the number of rows that a file added to its table; None for a file without a table."""
        name = self.table(execution, file)
        return self.readings[name].rows.get((execution, file.path)) if name else None

    def counted(self, execution: str, file: OutputFile) -> int | None:
        """Return the number of rows by a count of the file itself; None for a file without a table."""
        name = self.table(execution, file)
        return self.readings[name].counted.get((execution, file.path)) if name else None

    def form(self, execution: str, file: OutputFile) -> str:
        """Return the properties of a table as JSON, for comparison with its siblings. Only a CSV's columns have an order."""
        reading = self.readings[self.belongs[execution, file.path]]
        columns = reading.columns[execution, file.path]
        csv = reading.shape.format == "csv"
        return TableLayout(
            None if reading.shape.many else shown(file.path),
            columns if csv else dict(sorted(columns.items())),
            file.ended or not csv,
            reading.hints.get((execution, file.path), {}),
        ).dump()


def too_few(path: str, rows: int, name: str, output: Output) -> str:
    """Return the message that a file has fewer rows than its output requires."""
    return f"{path}: {rows} rows; [outputs.{name}] min_rows asks for {output.min_rows}"


def artifact_rows(result: Result, tables: TableIngest) -> Iterator[ArtifactRow]:
    """Yield a row of `artifacts` for each file of an execution except its logs."""
    for file in result.outputs:
        count = tables.rows(result.execution, file)
        yield ArtifactRow(
            execution=result.execution,
            run=result.run,
            path=shown(file.path),
            kind="file" if count is None else "table",
            output=tables.table(result.execution, file),
            size=file.bytes,
            sha256=file.sha256,
            rows=count,
            table_layout=None if count is None else tables.form(result.execution, file),
            counted_rows=None if count is None else tables.counted(result.execution, file),
        )


def tabled(
    executions: Iterable[Judgement],
    writer: Writer,
    store: Store,
    context: Context,
    assigning: OutputMatcher,
    shapes: dict[str, Shape],
) -> TableIngest:
    """Read all tables of successful executions into a segment; add new tables to `shapes`."""
    from sierra.store.connections import connect

    made = TableIngest(context.outputs)
    files: dict[str, list[Written]] = {}
    for result in (one.result for one in executions if one.status is Status.OK):
        for name, shape, file in assigning.of(result):
            made.belongs[result.execution, file.path] = name
            shapes.setdefault(name, shape)
            files.setdefault(name, []).append(_written(result, file))
    if not files:
        return made
    connection = connect()
    try:
        for name, written in files.items():
            reading = read(connection, written, shapes[name], writer.path(OUTPUT + name), known(store, context, name))
            shapes[name], made.readings[name] = reading.shape, reading
            for execution, fault in reading.faults.items():
                made.faults.setdefault(execution, fault)
    finally:
        connection.close()
    return made


def _written(result: Result, file: OutputFile) -> Written:
    path = str(Path(result.directory, RUN_OUTPUT, file.path))
    seen = (file.head, file.lines, file.ended, file.bytes, file.quotes, file.blank, file.alike)
    return Written(path, result.run, result.execution, file.path, *seen)

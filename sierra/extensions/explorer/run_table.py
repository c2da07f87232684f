"""The table of all runs, which the page sorts, filters and shows in windows: a store can have a million runs.

A run that belongs to several experiments has a row for each. The rows are computed once for each state of the store, and their
order once for each condition and sort column. A window is then a range of this order, so that its costs do not depend on its
place. The final value of an output's column is that of the run's last time, as in statistics: a missing value is not
replaced by an earlier one. There is none for several rows at the last time, several robots, and times that are no numbers.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from sierra.config.project_file import LoadedProject
from sierra.errors import SierraError, UsageError
from sierra.ingest.robot_files import FOLDERS
from sierra.store.batch_data import FLAG, NUMERIC
from sierra.store.sql_names import column_names, identifier, quote, row_name, stored_name
from sierra.store.sql_result import Answer
from sierra.store.statement import check_condition
from sierra.store.store import Snapshot
from sierra.store.time_axis import names_time
from sierra.util.json_types import JsonView
from sierra.util.lazy_definitions import dataclass

if TYPE_CHECKING:
    import pyarrow as pa

WINDOW = 200
"""The largest number of rows of a window."""
RUNS = """
CREATE TEMP TABLE "# runs" AS
WITH members AS (
    SELECT row_number() OVER (ORDER BY b.lamport DESC, b.batch, m.ordinal, m.number, m.run) AS "# place", m.*
    FROM (SELECT DISTINCT batch, ordinal, number, run, seed FROM batch_runs) m JOIN batches b USING (batch)
), last AS (
    SELECT run, arg_max(execution, lamport) AS execution FROM executions WHERE purpose <> 'capture' GROUP BY run
)
SELECT "# place", m.run, m.batch, x.experiment, m.ordinal, m.number, m.seed{axes}, r.status, r.outcome,
       e.reason AS {reason}, e.started AS {started}, e.wall_s AS {wall_s}, r.executions
FROM members m JOIN runs r USING (run) JOIN experiments x USING (batch, ordinal) LEFT JOIN last l ON l.run = m.run
LEFT JOIN executions e ON e.execution = coalesce(r.execution, l.execution) ORDER BY "# place"
"""
FINAL = """
CREATE TEMP TABLE {table} AS
WITH "# last" AS (SELECT run, max({time}) AS "# time" FROM {output} WHERE isfinite({time}) GROUP BY run)
SELECT run, {{{columns}}} AS {output} FROM {output} JOIN "# last" USING (run) WHERE {time} = "# time" GROUP BY run
"""
"""The final values of an output as fields, so that no condition means them by a bare name; NULL for several rows at the end."""
VALUE = "{text}: if(count(*) = 1, first({name}), NULL)"
UNKNOWN = "{text}: NULL::DOUBLE"
CURVES = """
SELECT run, {time}::DOUBLE AS time, avg({column})::DOUBLE AS value, count(*) AS rows FROM ({output})
WHERE run IN (SELECT unnest($runs)) AND {column} IS NOT NULL AND {time} IS NOT NULL GROUP BY ALL ORDER BY run, time
"""
SHOWN = """
CREATE OR REPLACE TEMP TABLE "# shown" AS
SELECT row_number() OVER (ORDER BY {order}runs."# place") AS position, runs."# place" FROM {rows}{chosen}
"""
CHOSEN = ' WHERE runs."# place" IN (SELECT runs."# place" FROM {rows} WHERE (\n{where}\n))'
HIDDEN = "# place"
LAST = ("reason", "started", "wall_s")
"""Columns of the execution, which have other names if variables have these."""
DEFAULTS = 5
"""The largest number of variables that are shown by default."""


class ConditionError(UsageError):
    """A condition or a column that cannot be used, which leaves the table as it is."""


@dataclass(frozen=True, slots=True)
class Column:
    """A column that the page can show: of the rows themselves, or the final value of an output's column."""

    name: str
    output: str = ""

    @property
    def key(self) -> str:
        return f"{self.output}.{self.name}" if self.output else self.name

    @property
    def sql(self) -> str:
        table = f"{final(self.output)}.{identifier(self.output)}" if self.output else "runs"
        return f"{table}.{identifier(self.name)}"


@dataclass(frozen=True, slots=True)
class Wanted:
    """The rows and columns that the page shows."""

    where: str
    order: str
    descending: bool
    columns: Sequence[str]


class RunTable:
    """The table in one snapshot of a store."""

    def __init__(self, snapshot: Snapshot, project: LoadedProject) -> None:
        self._snapshot = snapshot
        self._outputs = project.config.outputs
        self._types: dict[str, dict[str, str]] = {}
        """The types of columns by table, which do not change in a snapshot."""
        self._final: set[str] = set()
        """The outputs whose final values are in a table."""
        self._shown: tuple[str, str, bool] | None = None
        self.counts: dict[str, int] = {}
        """The numbers of ordered rows by status."""
        snapshot.run("SET preserve_insertion_order = false")  # takes much less memory
        snapshot.views.make(("batch_runs", "batches", "experiments", "executions", "runs", *snapshot.views.outputs))
        self.axes = snapshot.views.axes()
        self._last = dict(zip(LAST, column_names(LAST, taken=self.axes), strict=True))
        snapshot.run(RUNS.format(axes="".join(f", x.{identifier(axis)}" for axis in self.axes), **self._last))
        self.columns = {column.key: column for column in self._columns()}

    def unlock(self) -> None:
        self._snapshot.unlock()

    def verify(self) -> None:
        self._snapshot.verify()

    def __exit__(self, *about: None) -> None:
        self._snapshot.__exit__(*about)

    def _columns(self) -> Iterator[Column]:
        for name in self._kinds('"# runs"'):
            if name != HIDDEN:
                yield Column(name)
        for output in self._snapshot.views.outputs:
            yield from (Column(name, output) for name in self._numbers(output))

    def _kinds(self, table: str) -> dict[str, str]:
        """Return the types of a table's columns."""
        if table not in self._types:
            self._types[table] = {name: kind for name, kind, *_ in self._snapshot.run(f"DESCRIBE FROM {table}")}
        return self._types[table]

    def _own(self, output: str) -> dict[str, str]:
        """Return the columns of an output that are its own, in order, with their types."""
        others = {"run", "number", "execution", row_name(self.axes), *self.axes}
        return {name: kind for name, kind in self._kinds(identifier(output)).items() if name not in others}

    def _numbers(self, output: str) -> list[str]:
        """Return the numeric columns of an output that are its own."""
        return [name for name, kind in self._own(output).items() if re.fullmatch(NUMERIC, kind)]

    def _named_time(self, output: str) -> str:
        """Return the time column that is declared for an output, or else its first column if that has such a name; else ""."""
        own, declared = self._own(output), getattr(self._outputs.get(output), "time", "")
        first = next(iter(own), "")
        return stored_name(declared, own) if declared else first if names_time(first) else ""

    def time(self, output: str) -> str:
        """Return the time of an output, as statistics find it; the number of the row if there is none or if it is no number."""
        named = self._named_time(output)
        return named if named in self._numbers(output) and self._own(output)[named] != FLAG else row_name(self.axes)

    def is_final_known(self, output: str) -> bool:
        """Return whether final values can be told: not those of several robots, nor those at times that are no numbers."""
        several = any(mark.rstrip("/") in getattr(self._outputs.get(output), "file", "") for mark in FOLDERS)
        return not several and (not self._named_time(output) or self.time(output) != row_name(self.axes))

    @property
    def choices(self) -> JsonView:
        """Return the columns to choose from, with those that are shown by default."""
        outputs: dict[str, list[str]] = {}
        for output in self._snapshot.views.outputs:
            outputs[output] = [column.name for column in self.columns.values() if column.output == output]
        own = [key for key, column in self.columns.items() if not column.output]
        shown = ("batch", *self.axes[:DEFAULTS], "number", "status", self._last["wall_s"])
        timed = (column.key for column in self.columns.values() if column.output and self._is_timed(column))
        return {"own": own, "variables": self.axes, "outputs": outputs, "default": shown, "curve": next(timed, "")}

    def _is_timed(self, column: Column) -> bool:
        return self.time(column.output) not in (column.name, row_name(self.axes))

    def order(self, wanted: Wanted) -> None:
        """Compute the order of the rows. Raises ConditionError if the condition or a column cannot be used."""
        key = (wanted.where, wanted.order, wanted.descending)
        if key == self._shown:
            return
        order = self._column(wanted.order) if wanted.order else None
        rows, chosen = self._rows([order] if order else [], ""), ""
        if wanted.where.strip():
            chosen = CHOSEN.format(rows=self._rows([], wanted.where), where=wanted.where)
            self._check(wanted.where, f'SELECT 1 FROM "# runs" AS runs{chosen} LIMIT 0')
        by = f"{order.sql} {'DESC' if wanted.descending else 'ASC'} NULLS LAST, " if order else ""
        self._shown = None
        self._snapshot.run(SHOWN.format(order=by, rows=rows, chosen=chosen))
        counts = 'SELECT status, count(*) FROM "# shown" JOIN "# runs" USING ("# place") GROUP BY status ORDER BY 2 DESC'
        self.counts = dict(self._snapshot.run(counts))
        self._shown = key

    def _check(self, where: str, statement: str) -> None:
        try:
            check_condition(self._snapshot.connection, where)
            self._snapshot.run(statement)
        except SierraError as error:
            raise ConditionError(str(error)) from error

    def window(self, wanted: Wanted, first: int, convert: Callable[[Answer], Mapping[str, Any]]) -> Mapping[str, Any]:
        """Return the converted rows from the position `first` on; before the columns, each has the run's id."""
        columns = [self._column(key) for key in dict.fromkeys(wanted.columns)]
        shown = ", ".join(f"{column.sql} AS {identifier(f'c{index}')}" for index, column in enumerate(columns))
        rows = self._rows(columns, "")
        part = f'(SELECT * FROM "# shown" WHERE position > {first:d} AND position <= {first + WINDOW:d})'
        joined = f'{part} AS "# w" JOIN {rows} ON runs."# place" = "# w"."# place" ORDER BY "# w".position'
        statement = f"SELECT runs.run{', ' * bool(shown)}{shown} FROM {joined}"
        answer = self._snapshot.ask(statement, {}, convert)
        numeric = [column.key for index, column in enumerate(columns) if f"c{index}" in answer["numeric"]]
        return {**answer, "columns": [column.key for column in columns], "numeric": numeric}

    def names(self, runs: Sequence[str]) -> dict[str, str]:
        """Return what tells runs apart, in words: variables and number, by run."""
        parts = [f"{quote(axis + ' = ')} || {identifier(axis)}::VARCHAR" for axis in self.axes]
        words = f"concat_ws(', ', {', '.join((*parts, quote('run ') + ' || number'))})"
        statement = f'SELECT run, any_value({words}) FROM "# runs" WHERE run IN (SELECT unnest($runs)) GROUP BY run'
        return dict(self._snapshot.run(statement, {"runs": list(runs)}))

    def curves(self, runs: Sequence[str], key: str) -> tuple[str, pa.Table]:
        """Return the name of the time, and a table of an output's column with the columns run, time, value and rows."""
        column = self._column(key)
        if not column.output:
            raise UsageError(f"{key!r} is no column of an output")
        time = self.time(column.output)
        names = {"time": identifier(time), "column": identifier(column.name), "output": self._numbered(column.output)}
        return time, self._snapshot.ask(CURVES.format(**names), {"runs": list(runs)}, Answer.arrow)

    def _numbered(self, output: str) -> str:
        """Return the query for an output in which each run has rows from 0 on: in a file, a run may follow another one."""
        row = identifier(row_name(self.axes))
        return f"SELECT * REPLACE ({row} - min({row}) OVER (PARTITION BY run) AS {row}) FROM {identifier(output)}"

    def _column(self, key: str) -> Column:
        if key not in self.columns:
            raise ConditionError(f"there is no column {key!r}")
        return self.columns[key]

    def _rows(self, columns: Sequence[Column], where: str) -> str:
        """Return the relation of rows, with the final values that columns or a condition need."""
        outputs = {column.output for column in columns if column.output}
        outputs |= {output for output in self._snapshot.views.outputs if _is_named(output, where)}
        return f'"# runs" AS runs{"".join(f" LEFT JOIN {self._final_values(name)} USING (run)" for name in sorted(outputs))}'

    def _final_values(self, output: str) -> str:
        """Return the table with the final values of an output, which is computed when it is needed first."""
        if output not in self._final:
            time = identifier(self.time(output))
            value = VALUE if self.is_final_known(output) else UNKNOWN
            values = ", ".join(value.format(text=quote(name), name=identifier(name)) for name in self._numbers(output))
            self._snapshot.run(FINAL.format(table=final(output), time=time, columns=values, output=identifier(output)))
            self._final.add(output)
        return final(output)


def final(output: str) -> str:
    """Return the name of the table with the final values of an output."""
    return identifier(f"# final {output}")


def _is_named(output: str, where: str) -> bool:
    """Return whether a condition may use columns of an output: they are written as OUTPUT.COLUMN."""
    return re.search(rf'(?<!\w){re.escape(output)}"?\s*\.', where, re.IGNORECASE) is not None

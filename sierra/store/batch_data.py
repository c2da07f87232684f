"""The data of one batch for statistics: its runs, and the columns of its outputs and derived tables as samples over time.

Only one execution of a run is effective: see the table `effective`. A run without an effective execution is reported as
missing. The rows of a derived table belong to the runs that its column `run` names.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Container, Hashable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from decimal import Decimal
from functools import partial, wraps
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, TypeVar, cast

from sierra.errors import Damaged, Missing, NotFound, SierraError, SqlError, UsageError
from sierra.model import ACCEPTED, Axis, Value
from sierra.store import captures, clock_times, robot_means, rounded_times, time_axis
from sierra.store.clock_times import TimeKind
from sierra.store.derived_tables import BuiltTable, Definition
from sierra.store.duckdb_messages import explain
from sierra.store.recorded_files import OUTPUT_FOLDER, ChosenExecution, Recorded, contents, recorded
from sierra.store.row_mapper import R
from sierra.store.row_types import CaptureRow
from sierra.store.schema import RECORDED
from sierra.store.segments import disk_errors, is_first_part
from sierra.store.sql_names import column_names, identifier, quote
from sierra.store.sql_result import INTEGER, NUMBER, RawRow
from sierra.store.statement import check_condition
from sierra.store.store import Snapshot, Store
from sierra.store.union_files import Relation, relation
from sierra.store.verified_files import verify
from sierra.store.view_sql import OUTCOME
from sierra.store.views import files_with
from sierra.util.arrow_columns import numpy_of
from sierra.util.lazy_definitions import dataclass, field
from sierra.util.scratch import scratch
from sierra.util.text import counted, like, one_line

if TYPE_CHECKING:
    import duckdb
    import pyarrow as pa

T = TypeVar("T")
P = ParamSpec("P")
MEMBERS = "SELECT judgement FROM membership"
ON_ROBOTS = "SELECT 1 FROM batches JOIN specs USING (spec) WHERE batch = $b AND robots IS NOT NULL LIMIT 1"
MIXED = "has numbers in some runs and other values in others"
FLAG, NUMERIC = "BOOLEAN", rf"BOOLEAN|{NUMBER}"
"""DuckDB's types of the columns that statistics use, as regular expressions; flags are 0 and 1."""
EXACT = rf"{INTEGER}|DECIMAL\(\d+,\d+\)"
"""The types of numbers that may have more digits than a float holds."""
HALF_RANGE = Decimal(2**126)
"""Numbers below this have differences that are whole numbers of 128 bits, the widest type."""
NO_VALUES = ("run", "number", "row", "seed", "execution", "file", "batch", "experiment", "ordinal")
"""Columns of derived tables that say where a row belongs, and are no values; the axes are others."""


FAILED = """
SELECT (SELECT count(*) FROM membership) AS successful, count(*) AS runs, count(last.run) AS failed,
       coalesce(arg_min(coalesce(last.reason, last.status), (w.ordinal, w.number)), '') AS reason
FROM wanted w LEFT JOIN (
    SELECT run, arg_max(reason, lamport) AS reason, arg_max(status, lamport) AS status
    FROM all_judgements WHERE purpose = 'run' AND run IN (SELECT run FROM batch_runs WHERE batch = $b) GROUP BY run
) last USING (run)
"""
"""SQL: the number of successful runs, of all runs and of executed runs, and the reason of the first one that was executed."""


ENDS = "SELECT experiment, outcome, count(*) FROM membership WHERE outcome <> 'success' GROUP BY ALL"


class AllFailed(SierraError):
    """A batch without a successful run, so that it has no output; the message is the same for all that need one."""


class NoRuns(UsageError):
    """A derived table whose rows do not belong to runs, which SQL can use but statistics cannot."""


def _once(method: Callable[Concatenate[BatchData, P], T]) -> Callable[Concatenate[BatchData, P], T]:
    """Call a method once for the same arguments, because the data of a batch do not change."""

    @wraps(method)
    def remembered(data: BatchData, /, *args: P.args, **options: P.kwargs) -> T:
        return data.once((method.__name__, *args, *options.items()), partial(method, data, *args, **options))

    return remembered


@dataclass(frozen=True, slots=True)
class OutputTable:
    """An output of a batch, or a derived table: its numeric columns, and the number of rows of its longest run.

    Flags are numeric: 0 and 1.
    """

    name: str
    columns: tuple[str, ...]
    all_columns: tuple[str, ...]
    rows: int
    files: int
    """The largest number of files that one run has."""
    mixed: tuple[str, ...]
    """The columns that hold numbers in some runs, and other values in others."""
    flags: tuple[str, ...] = ()
    """The numeric columns that hold only flags: true or false."""
    fewest: int = 0
    """The number of rows of its shortest run."""
    others: Mapping[str, str] = field(default_factory=dict)
    """The columns that are no numbers, with their types in SQL, without those of `mixed` and the texts beside them."""
    unordered: bool = False
    """True if the order of a run's rows has no meaning, because the statement of a derived table does not order them."""


@dataclass(frozen=True, slots=True)
class ChosenRun:
    """A run of a batch, and what counts of it."""

    experiment: int
    """The position of its experiment in the batch."""
    number: int
    run: str
    judgement: str | None
    """The judgement of its effective execution; None if it has none."""


class BatchData:
    """The runs of a batch and the tables that they wrote, loaded when they are first used; a context manager."""

    def __init__(self, store: Store, batch: str, these: Mapping[str, str] | None = None) -> None:
        """`these`: the execution, or the judgement of it, to use for each run instead of the effective one."""
        self.batch = batch
        self._folder = store.paths.extracted
        self._read_tables: set[str] = set()
        self._snapshot: Snapshot = store.snapshot(batch, theirs=True)
        self._computed: dict[Hashable, object] = {}
        """The results of `once`."""
        self.problems: dict[str, SierraError] = {}
        """Why derived tables cannot be used for statistics, by name; known after `outputs`."""
        with ExitStack() as opening:
            opening.enter_context(self._snapshot)
            self._read(these)
            self._closing = opening.pop_all()

    def _read(self, these: Mapping[str, str] | None) -> None:
        self._snapshot.views.make(("batch_runs", "all_judgements", "experiments", "batches", "specs"))
        self._members(these)
        self._on_robots = bool(self._snapshot.run(ON_ROBOTS, {"b": self.batch}))
        """True if the runs of the batch take robots."""
        self._files = self._output_files()
        """The files of each output, by name; a derived table has none."""
        taken = {name.lower() for name in self._files}
        tables = self._snapshot.derived.definitions
        self._files |= {one.name: [] for name, one in tables.items() if name not in taken}

    def __enter__(self) -> BatchData:
        return self

    def __exit__(self, *error: Any) -> None:
        self._closing.__exit__(*error)

    def unlock(self) -> None:
        """Free the lock that protects the segments from removal. Whoever uses the data afterwards must hold it."""
        self._snapshot.unlock()

    def verify(self) -> None:
        """Raise Damaged if a file that has been read has been damaged since."""
        self._snapshot.verify()
        verify(path for table in self._read_tables for path in self._files.get(table, ()))

    def _members(self, these: Mapping[str, str] | None) -> None:
        run = self._snapshot.run
        taken = "(SELECT ordinal, run, judgement, outcome FROM effective WHERE batch = $b)"
        if these is not None:
            self._snapshot.add_table("these", run=these, judgement=these.values())
            self._snapshot.views.define("effective", THESE.format(batch=quote(self.batch), outcome=OUTCOME))
            taken = "(SELECT ordinal, run, judgement, outcome FROM effective)"
        self._snapshot.views.make(("effective",))
        run(
            "CREATE TEMP TABLE wanted AS SELECT DISTINCT ordinal, number, run FROM batch_runs WHERE batch = $b",
            {"b": self.batch},
        )
        run(
            "CREATE TEMP TABLE membership AS SELECT w.ordinal::INTEGER AS experiment, w.run, w.number::INTEGER AS number, "
            f"c.judgement, c.outcome, e.batch FROM wanted w JOIN {taken} c ON c.run = w.run AND c.ordinal = w.ordinal "
            "JOIN all_judgements e ON e.judgement = c.judgement",
            {"b": self.batch} if these is None else {},
        )

    @_once
    def failure(self) -> str | None:
        """Return why the batch has no results, if no run was successful and some failed: with the reason of the first one."""
        [(successful, runs, failed, reason)] = self._snapshot.run(FAILED, {"b": self.batch})
        if successful or not failed:
            return None
        all_failed = f"all {counted(runs, 'run')} failed"
        which = all_failed if failed == runs else f"no run was successful, and {failed} of {runs} failed"
        return f"{which}: {one_line(reason)}"

    def _output_files(self) -> dict[str, list[str]]:
        """Return the files of each output, from the segments that hold an effective execution."""
        batches = {row[0][:12] for row in self._snapshot.run("SELECT DISTINCT batch FROM membership")}
        files: dict[str, list[str]] = {}
        for segment in self._snapshot.recording(MEMBERS, batches):
            for name, path in segment.outputs():
                files.setdefault(name, []).append(path)
        return {name: self._counting(paths) for name, paths in files.items()}

    def _counting(self, files: list[str]) -> list[str]:
        """Return the files with an effective execution, if the columns of the files differ; else all files."""
        if all(map(is_first_part, files)):
            return files
        found = self._snapshot.run(files_with(files, MEMBERS))
        return [file for file in files if (file,) in found] or files

    @_once
    def axes(self) -> tuple[Axis, ...]:
        """Return the batch's axes with their values in order; labels and units come from the project. Raises NotFound."""
        cells = self.cells().values()
        return tuple(Axis(name, tuple(dict.fromkeys(cell[name] for cell in cells))) for name in self.axis_names)

    @property
    def axis_names(self) -> list[str]:
        """The names of the batch's independent variables. Raises NotFound."""
        for (names,) in self._snapshot.run("SELECT axes FROM batches WHERE batch = $b", {"b": self.batch}):
            return list(names)
        raise NotFound(f"no batch {self.batch[:12]}")

    @_once
    def cells(self) -> Mapping[int, Mapping[str, Value]]:
        """Return the values of the axes for each experiment, by its position in the batch."""
        fixed = {column.name for column in RECORDED["experiments"].columns}
        table = self._snapshot.connection.sql(
            "SELECT * FROM experiments WHERE batch = $b ORDER BY ordinal", params={"b": self.batch}
        ).to_arrow_table()
        return {
            row["ordinal"]: {name: value for name, value in row.items() if name not in fixed and value is not None}
            for row in table.to_pylist()
        }

    def seeds(self) -> dict[tuple[int, str], int]:
        """Return the seed of each run, by the position of its experiment and its id."""
        rows = self._snapshot.run("SELECT ordinal, run, seed FROM batch_runs WHERE batch = $b", {"b": self.batch})
        return {(ordinal, run): seed for ordinal, run, seed in rows}

    def counts(self) -> dict[int, tuple[int, int]]:
        """Return by experiment position how many runs were successful, and how many runs there are."""
        rows = self._snapshot.run(
            "SELECT w.ordinal, count(*) FILTER (m.outcome = 'success'), count(*) FROM wanted w LEFT JOIN membership m "
            "ON m.run = w.run AND m.experiment = w.ordinal GROUP BY w.ordinal"
        )
        return {row[0]: (row[1], row[2]) for row in rows}

    @_once
    def accepted(self) -> Mapping[int, Mapping[str, int]]:
        """Return the number of runs by an end that is a result but no success, by the experiment's position."""
        ends: dict[int, dict[str, int]] = {}
        for experiment, outcome, runs in self._snapshot.run(ENDS):
            ends.setdefault(experiment, {})[outcome] = runs
        return ends

    def accepted_beside(self, table: str) -> Mapping[int, Mapping[str, int]]:
        """Return the accepted ends of runs whose rows are not in this output, but in a table beside it, by experiment."""
        return self.accepted() if table in self.written and not self.is_of_accepted(table) else {}

    def first_and_last_inputs(self) -> tuple[tuple[int, str], ...]:
        """Return pairs of the position of an experiment and the SHA-256 of an input: those of its first and of its last run."""
        rows = self._snapshot.run(
            "SELECT ordinal, min_by(input, number), max_by(input, number) FROM batch_runs WHERE batch = $b GROUP BY ordinal "
            "ORDER BY ordinal",
            {"b": self.batch},
        )
        return tuple((ordinal, digest) for ordinal, *digests in rows for digest in dict.fromkeys(digests))

    def runs(self) -> list[ChosenRun]:
        """Return all runs of the batch by experiment and number, also those without an effective execution."""
        rows = self._snapshot.run(
            "SELECT w.ordinal, w.number, w.run, m.judgement FROM wanted w LEFT JOIN membership m "
            "ON m.run = w.run AND m.experiment = w.ordinal ORDER BY w.ordinal, w.number, w.run"
        )
        return [ChosenRun(*row) for row in rows]

    def rows_of_run(self, table: str, run: ChosenRun, time: str) -> str:
        """Return the relation of the rows of one run in an output, without reading those of other runs.

        It has all columns of the output, the time `"# t"`, and the order of the rows: `"# file"`, `"# row"`. Raises NotFound.
        """
        files = self._files_of(table)
        source, kind = self._relation(table), self.time_kind(table, time)
        t = f"{identifier(time)}::DOUBLE" if kind is None else clock_times.seconds(time, kind, "run")
        if not files:
            return f'(SELECT *, {t} AS "# t", 0 AS "# file", rowid AS "# row" FROM {source.sql} WHERE run = {quote(run.run)})'
        mine = f"execution = {quote(run.judgement or '')}"
        return f'(SELECT *, {t} AS "# t", filename AS "# file", file_row_number AS "# row" FROM {source.sql} WHERE {mine})'

    def files_of_run(self, run: ChosenRun) -> list[Recorded]:
        """Return the files that the effective execution of a run left, with their paths below `output/`."""
        chosen = ChosenExecution("", run.experiment, run.number, run.run, None, None, "counts", run.judgement)
        return [file for file in recorded(self._snapshot, [chosen]) if file.path.startswith(OUTPUT_FOLDER)]

    def captures(self, runs: Sequence[ChosenRun]) -> Mapping[str, CaptureRow]:
        """Return the last capture with frames of each run that has one, by the judgement of its effective execution."""
        return captures.newest(self._snapshot, [run.judgement for run in runs if run.judgement is not None])

    def extracted(self, files: Sequence[Recorded]) -> list[Path]:
        """Write recorded files to a temporary folder, which exists until these data are closed; return their paths in order.

        A path has the ending of the file in lower case, and nothing else of its name. Raises Damaged, Missing.
        """
        with disk_errors(self._folder):
            self._folder.mkdir(exist_ok=True)
            folder = self._closing.enter_context(scratch(self._folder, "frame-"))
        paths = [folder / f"{number}{PurePosixPath(file.path).suffix.lower()}" for number, file in enumerate(files)]
        places = {id(file): path for file, path in zip(files, paths, strict=True)}
        for content in contents(self._snapshot, files):
            with disk_errors(folder), places[id(content.file)].open("wb") as written:
                written.writelines(content.pieces)
        return paths

    @property
    def written(self) -> list[str]:
        """The names of the outputs that runs wrote, without derived tables."""
        return sorted(name for name, files in self._files.items() if files)

    @property
    def names(self) -> list[str]:
        """The names of all outputs and derived tables."""
        return sorted(self._files)

    def derive(self, definition: Definition) -> None:
        """Add a derived table to these data only: that of one figure, for example."""
        self._snapshot.derived.add(definition)
        self._files[definition.name] = []

    def table_of(self, definition: Definition) -> pa.Table:
        """Return the rows of a derived table that need not belong to runs, for these data only. Raises SierraError."""
        self._snapshot.derived.add(definition)
        self._snapshot.derived.make(definition.name)
        return self.sql(f"FROM {identifier(definition.name)}")

    def outputs_with(self, column: str) -> list[str]:
        """Return the outputs that runs wrote with this column; derived tables do not count."""
        having = [name for name in self.written if column in self._relation(name).types]
        return [name for name in having if not self.is_of_accepted(name)]

    def is_of_accepted(self, table: str) -> bool:
        """Return whether a table has the rows of accepted ends, so that it is only used where it is named."""
        return table.endswith(ACCEPTED) and bool(self.accepted())

    def first_inputs(self) -> dict[int, list[tuple[str, str]]]:
        """Return the name and the SHA-256 of each input file of the first run of each experiment."""
        self._snapshot.views.make(("specs",))
        rows = self._snapshot.run(
            "SELECT ordinal, files, [input] || other_inputs FROM batch_runs JOIN specs USING (spec) WHERE batch = $b "
            "QUALIFY row_number() OVER (PARTITION BY ordinal ORDER BY number) = 1 ORDER BY ordinal",
            {"b": self.batch},
        )
        return {ordinal: list(zip(files, digests, strict=True)) for ordinal, files, digests in rows}

    def statements(self, table: str) -> str:
        """Return the SQL of a derived table and of those that it needs; "" for an output."""
        return self._snapshot.derived.statements(table) if not self._files.get(table) else ""

    def outputs(self, only: Container[str] | None = None) -> tuple[OutputTable, ...]:
        """Return the tables that the batch's runs wrote, and the derived tables; `only` those with these names."""
        names = [name for name in self.names if only is None or name in only]
        tables = (self._output(name) if self._files[name] else self._derived_output(name) for name in names)
        return tuple(table for table in tables if table is not None)

    def once(self, key: Hashable, compute: Callable[[], T]) -> T:
        """Return what `compute` returns for this key. It is called once, because the data do not change."""
        if key not in self._computed:
            self._computed[key] = compute()
        return cast("T", self._computed[key])

    @_once
    def durations(self, table: str) -> list[str]:
        """Return the columns of an output that have durations, in nanoseconds; a derived table has none."""
        return self._snapshot.durations(table, MEMBERS)

    @_once
    def _output(self, name: str) -> OutputTable:
        """Return a table that runs wrote."""
        source = self._relation(name)
        robot = self.column_of_robots(name)
        hidden = ("run", "execution", "file", robot)
        columns = {column: kind for column, kind in source.types.items() if column not in hidden}
        many = "count(DISTINCT file)" if "file" in source.types else "1"
        each = f"execution, {robot}" if robot else "execution"
        sizes = f"SELECT count(*) AS rows, {many} AS files FROM {source.sql} WHERE execution IN ({MEMBERS}) GROUP BY {each}"
        [(rows, most, fewest)] = self._snapshot.run(
            f"SELECT coalesce(max(rows), 0), coalesce(max(files), 0), coalesce(min(rows), 0) FROM ({sizes})"
        )
        mixed = _mixed(source)
        numeric, flags = _numeric_and_flags({column: kind for column, kind in columns.items() if column not in mixed})
        others = {c: kind for c, kind in columns.items() if c not in (*numeric, *source.texts, *source.texts.values())}
        return OutputTable(name, numeric, tuple(columns), rows, most, mixed, flags, fewest, others)

    def _derived_output(self, name: str) -> OutputTable | None:
        """Return a derived table, if it can be used for statistics; else None, and remember why not."""
        try:
            derived = self._derived(name)
        except (Damaged, Missing):
            raise
        except SierraError as error:
            self.problems[name] = error
            return None
        hidden = {*NO_VALUES, *(axis.lower() for axis in self.axis_names)}
        columns = {column: kind for column, kind in derived.columns.items() if column.lower() not in hidden}
        numeric, flags = _numeric_and_flags(columns)
        others = {column: kind for column, kind in columns.items() if column not in numeric}
        sizes = f"SELECT count(*) AS rows FROM {identifier(name)} GROUP BY run"
        [(rows, fewest)] = self._snapshot.run(f"SELECT max(rows), min(rows) FROM ({sizes})")
        return OutputTable(name, numeric, tuple(columns), rows, 1, (), flags, fewest, others, unordered=not derived.ordered)

    def _derived(self, name: str) -> BuiltTable:
        """Return a derived table after checking that its rows belong to runs of the batch. Raises SierraError."""
        derived = self._snapshot.derived.make(name)
        origin = self._snapshot.derived.definitions[name.lower()].origin
        if "run" not in map(str.lower, derived.columns):
            raise NoRuns(
                f"{origin}: it has no column 'run', so there are no statistics over runs; add run to its SELECT (and GROUP BY)"
            )
        if not derived.rows:
            raise SierraError(f"{origin}: its statement returns no rows for batch {self.batch[:10]}")
        others = f"SELECT run FROM {identifier(name)} WHERE run IS NULL OR run::VARCHAR NOT IN (SELECT run FROM wanted) LIMIT 1"
        for (run,) in self._snapshot.run(others):
            which = "without a run" if run is None else f"of {str(run)[:20]!r}, which is no run of batch {self.batch[:10]}"
            raise UsageError(f"{origin}: it has a row {which}; its column 'run' must be that of the runs")
        return derived

    def _files_of(self, table: str) -> list[str]:
        """Return the files of an output; a derived table has none. Raises NotFound."""
        if table not in self._files:
            raise NotFound(f"no output {table!r} in this batch; it has {', '.join(self.names) or 'none'}")
        return self._files[table]

    @_once
    def _relation(self, table: str) -> Relation:
        """Return all rows of an output, effective or not, or those of a derived table."""
        if not (files := self._files[table]):
            return Relation(identifier(table), self._derived(table).columns)
        self._read_tables.add(table)
        return relation(self._snapshot.run, files, f"execution IN ({MEMBERS})", rows=True)

    def shared_axis(self, table: str, columns: Sequence[str]) -> str | None:
        """Return the first of these numeric columns of an output that behaves like a time; None if none does."""
        data = self.rows(table)
        if robot := self.column_of_robots(table):  # each robot has a time of its own; the first one's rows follow each other
            data = f"(SELECT * FROM {data} WHERE {robot} = (SELECT min({robot}) FROM {data}))"
        return time_axis.shared_axis(self.run, data, columns)

    @_once
    def offset(self, table: str, column: str) -> int:
        """Return a whole number to subtract from a column before its values become floats; 0 if floats hold its digits.

        It is the median of a column of whole numbers or decimals, of which some have more than 53 bits. Raises NotFound.
        """
        data, kind = self.rows(table), self._type(table, column)
        if not re.fullmatch(EXACT, kind):
            return 0
        value = identifier(column)
        [ends] = self._snapshot.run(f"SELECT min({value})::VARCHAR, max({value})::VARCHAR FROM {data}")
        digits = int(match[1]) if (match := re.search(r",(\d+)", kind)) else 0
        largest = max((abs(Decimal(end)) for end in ends if end is not None), default=Decimal(0))
        if largest.scaleb(digits) <= 2**53 or not 1 < largest < HALF_RANGE:
            return 0
        [(middle,)] = self._snapshot.run(f"SELECT quantile_disc({value}, 0.5)::VARCHAR FROM {data}")
        return int(Decimal(middle))

    def _type(self, table: str, column: str) -> str:
        types = self._relation(table).types
        return next((kind for name, kind in types.items() if name.lower() == column.lower()), "")

    def samples(
        self, table: str, column: str, time: str = "", where: str = "", offset: int = 0, *, shared: bool = False
    ) -> None:
        """Create the view `samples` of one column of one output. Raises NotFound for an unknown output or column.

        `where` is a condition on the columns of the output and on variables; rows without it do not count. `offset` is a whole
        number that is subtracted from all values before they become floats. `shared`: the column `shared_t` has the times that
        rows share with other runs, if they differ by rounding only.
        """
        data = self.rows(table)
        if column in _mixed(self._relation(table)):
            raise NotFound(f"column {column!r} of output {table!r} {MIXED}")
        known = self._columns(data)
        if column.lower() not in map(str.lower, known):
            raise NotFound(f"output {table!r} has no column {column!r}; {like(column, known)}")
        if time and time.lower() not in map(str.lower, known):
            raise NotFound(
                f"output {table!r} has no column {time!r} for its time ([outputs.{table}] time); {like(time, known)}"
            )
        t = self._time(table, time, shared=False)
        shared_t = self._time(table, time) if shared else t
        try:
            values = self._values(table, column, time, (t, shared_t), where, offset)
            self._snapshot.run(f"CREATE OR REPLACE TEMP VIEW samples AS {values}")
        except Damaged:
            raise
        except Exception as error:
            self._snapshot.run("DROP VIEW IF EXISTS samples")
            where = f"output {table!r}, column {column!r} over {time or 'its rows'!r}"
            raise NotFound(f"{where}: {explain(error)}") from error

    def _values(self, table: str, column: str, time: str, times: tuple[str, str], where: str, offset: int) -> str:
        """Return the query for the values of a column: those of each row, or the means of the robots of a run.

        `times` are the expressions for a row's own time, and for the time that it shares with rows of other runs.
        """
        value, data = identifier(column), self.rows(table, where)
        if offset:
            kind = self._type(table, column)
            wide = kind if kind.startswith("DECIMAL") else "HUGEINT"
            value = f"({value}::{wide} - '{offset}'::{wide})"
        is_of_robots = bool(self.column_of_robots(table))
        t, shared_t = times if not is_of_robots else (self._time(table, time), "t")
        aligned = self._same_times(table, time, where) if is_of_robots else None
        if aligned is None:
            own = '"# experiment" AS experiment, run, "# number" AS number'
            order = self._order(table)
            return f"SELECT {own}, {t} AS t, {shared_t} AS shared_t, {value}::DOUBLE AS value, {order} FROM {data}"
        template = robot_means.SAME_TIMES if aligned else robot_means.OTHER_TIMES
        return f"SELECT *, t AS shared_t FROM ({template.format(rows=self._of_robots(table, value, time, where))})"

    def _time(self, table: str, time: str, *, shared: bool = True) -> str:
        """Return the SQL expression for the time of a row. If `shared`, times that differ by rounding only are one."""
        if not time:
            return '"# place"::DOUBLE'
        own = f"{identifier(time)}::DOUBLE" if self.time_kind(table, time) is None else self._seconds(table, time)
        return self._shared_time(table, own) if shared else own

    @_once
    def time_kind(self, table: str, time: str) -> TimeKind | None:
        """Return the form of times that are no numbers; None for numbers. Raises NotFound for texts that are no times."""
        kind, data = self._type(table, time), self.rows(table)
        if not kind or re.fullmatch(NUMERIC, kind):
            return None
        form = clock_times.kind_of(self._snapshot.run, data, time, kind)
        if form is None:
            [(example,)] = self._snapshot.run(f"SELECT min({identifier(time)})::VARCHAR FROM {data}")
            raise NotFound(
                f"output {table!r}: its time {time!r} has {'no value' if example is None else f'values such as {example!r}'}, "
                f"which are neither numbers nor times; name another column (time in [outputs.{table}]), or let the run write "
                "seconds, 00:00:10 or 2024-05-01T10:00:00"
            )
        return form

    def _seconds(self, table: str, time: str) -> str:
        """Return the name of a column of the table's rows that has the seconds of a time that is no number."""
        return self.once(("seconds", table, time.lower()), partial(self._add_seconds, table, time))

    def _add_seconds(self, table: str, time: str) -> str:
        kind = self.time_kind(table, time)
        if kind is None:
            return identifier(time)
        rows, name = identifier("rows " + table), identifier(clock_times.SECONDS + time)
        value = clock_times.seconds(time, kind, 'run, "# experiment"')
        self._snapshot.run(f"ALTER TABLE {rows} ADD COLUMN {name} DOUBLE")
        self._snapshot.run(
            f'UPDATE {rows} SET {name} = s."# value" FROM (SELECT rowid AS "# id", {value} AS "# value" FROM {rows}) s '
            f'WHERE {rows}.rowid = s."# id"'
        )
        self._snapshot.run(SHOWN.format(data=identifier("data " + table), rows=rows))
        return name

    @_once
    def _shared_time(self, table: str, time: str) -> str:
        """Return `time`, or an expression that looks it up in a table of the times that differ by rounding only."""
        data, robot = self.rows(table), self.column_of_robots(table)
        rows = rounded_times.rows(data, time, robot)
        try:
            if self._snapshot.run(rounded_times.SHARED.format(rows=rows))[0][0] in (True, None):
                return time
            steps = self._snapshot.connection.sql(rounded_times.STEPS.format(rows=rows)).to_arrow_table()
        except Damaged:
            raise
        except Exception as error:
            raise NotFound(f"output {table!r}, time {time}: {explain(error)}") from error
        same = dict(rounded_times.same(numpy_of(steps.column("t")), numpy_of(steps.column("step"))))
        if not same:
            return time
        name = f"times {len(self._computed)}"
        self._snapshot.add_table(name, own=same, shown=same.values())
        return f"coalesce((SELECT shown FROM {identifier(name)} WHERE own = {time}), {time})"

    def _order(self, table: str) -> str:
        """Return the columns that say where a row is: its file, and its place there; NULL in derived tables."""
        if not self._files[table]:
            return "NULL::VARCHAR AS file, NULL::BIGINT AS place"
        file = "file" if "file" in self._relation(table).types else "NULL::VARCHAR"
        return f'{file} AS file, "# place" AS place'

    @_once
    def column_of_robots(self, table: str) -> str:
        """Return the column with the robot's place, if the robots of each run write a table together; "" if not."""
        if not self._files.get(table):
            return ""
        source = self._relation(table)
        possible = robot_means.COLUMNS if self._on_robots else (robot_means.SIMULATED,)
        named = [column for column in possible if {column, "file"} <= source.types.keys()]
        rows = f"(SELECT * FROM {source.sql} WHERE execution IN ({MEMBERS}))"
        is_robot = robot_means.IS_PLACE if self._on_robots else robot_means.HAS_OWN_FILE
        tests = {column: is_robot.format(column=column, data=rows) for column in named}
        return next((column for column, test in tests.items() if self._snapshot.run(test)[0][0]), "")

    def _of_robots(self, table: str, value: str, time: str, where: str) -> str:
        """Return the query for the rows of the robots that count."""
        robot, t = self.column_of_robots(table), self._time(table, time)
        return robot_means.rows(self.rows(table, where), robot, value, t, simulated=not self._on_robots)

    def robots_note(self, table: str, time: str = "") -> str:
        """Return a note about the statistics of a table; "" if robots did not write it together."""
        if not self.column_of_robots(table) or (aligned := self._same_times(table, time, "")) is None:
            return ""
        rows = self._of_robots(table, "NULL", time, "")
        [(partial,)] = self._snapshot.run(robot_means.PARTIAL.format(rows=rows))
        return robot_means.note(table, same_times=aligned, partial=partial)

    @_once
    def _same_times(self, table: str, time: str, where: str) -> bool | None:
        """Return whether the robots of each run have the same times; None if a robot has two rows at one time."""
        rows = self._of_robots(table, "NULL", time, where)
        [(doubled, same)] = self._snapshot.run(robot_means.TIMES.format(rows=rows))
        return None if doubled else same

    def data(self, table: str, time: str = "", where: str = "", *, timed: bool = True) -> None:
        """Create the view `data` of all rows of one output, with all columns. Raises NotFound for an unknown output.

        It also has the number of the experiment `"# experiment"`, of the run `"# number"`, of the row in its run `"# place"`,
        and the time `"# t"`, in which times that differ by rounding only are one if `timed`.
        """
        rows, t = self.rows(table, where), self._time(table, time, shared=timed)
        self._snapshot.run("DROP VIEW IF EXISTS data")
        self._snapshot.run(f'CREATE TEMP VIEW data AS SELECT *, {t} AS "# t" FROM {rows}')

    def experiments_with(self, table: str, where: str) -> set[int]:
        """Return the positions of the experiments that a condition does not exclude by the values of their variables.

        So an experiment whose runs have all failed is found too.
        """
        self.rows(table, where)  # checks the condition
        data = self.rows(table)
        none = f"(SELECT *{_renaming(self._named_like_variables(data))} FROM {data} LIMIT 0)"
        with self._limited(where) as connection:
            rows = connection.execute(
                f'SELECT v."# ordinal" FROM "# variables" v LEFT JOIN {none} d ON v."# ordinal" = d."# experiment" '
                f"WHERE (\n{where}\n) IS DISTINCT FROM false"
            ).fetchall()
        return {ordinal for (ordinal,) in rows}

    def rows(self, table: str, where: str = "") -> str:
        """Return the relation of the rows of an output that fulfil a condition. Raises UsageError for an invalid one.

        In the condition, a name that a variable and a column share is the variable; the column's name gets a `_`, as in SQL.
        The rows are loaded when they are first used. Raises NotFound for an unknown output.
        """
        data = self._load(table)
        if not where:
            return data
        return f'(SELECT * FROM {data} WHERE "# rowid" IN (SELECT "# rowid" FROM {self._choose(data, where)}))'

    @_once
    def _choose(self, data: str, where: str) -> str:
        """Make a temporary table of the rows that fulfil a condition, so that only this statement evaluates it.

        Return the table's name. Raises UsageError.
        """
        chosen = identifier(f"chosen {len(self._computed)}")
        renamed = f"(SELECT *{_renaming(self._named_like_variables(data))} FROM {data})"
        try:
            check_condition(self._snapshot.connection, where)
        except SqlError as error:
            raise UsageError(f"where = {where!r}: {error}") from error
        with self._limited(where) as connection:
            connection.execute(
                f'CREATE TEMP TABLE {chosen} AS SELECT d."# rowid" FROM {renamed} d '
                f'JOIN "# variables" v ON v."# ordinal" = d."# experiment" WHERE (\n{where}\n)'
            )
        return chosen

    @contextmanager
    def _limited(self, where: str) -> Iterator[duckdb.DuckDBPyConnection]:
        """Yield the connection for a statement with a condition, with the limits of derived tables. Raises UsageError."""
        try:
            with self._snapshot.errors(), self._snapshot.derived.limited(f"where = {where!r}") as connection:
                yield connection
        except SqlError as error:
            raise UsageError(str(error)) from error

    def _named_like_variables(self, data: str) -> dict[str, str]:
        """Return the columns of a relation that have the name of a variable, and their names in conditions: with a `_`."""
        columns = self._columns(data)
        names = column_names(columns, taken=self._variables())
        return {old: new for old, new in zip(columns, names, strict=True) if old != new}

    @_once
    def _variables(self) -> list[str]:
        """Make the temporary table `"# variables"` of the values of variables, and return its columns."""
        fixed = ", ".join(identifier(column.name) for column in RECORDED["experiments"].columns)
        self._snapshot.run(
            f'CREATE TEMP TABLE "# variables" AS SELECT ordinal AS "# ordinal", * EXCLUDE ({fixed}) FROM experiments '
            "WHERE batch = $b",
            {"b": self.batch},
        )
        return self._columns('"# variables"')

    @_once
    def _columns(self, relation: str) -> list[str]:
        """Return the columns of a relation that does not change any more."""
        return [name for name, *_ in self._snapshot.run(f"DESCRIBE {relation}") if not name.startswith("# ")]

    @_once
    def _load(self, table: str) -> str:
        """Load the rows of an output, and return their relation. Raises NotFound."""
        files, run = self._files_of(table), self._snapshot.run
        source = self._relation(table)
        data, rows = identifier("data " + table), identifier("rows " + table)
        shown = SHOWN.format(data=data, rows=rows)
        if not files:
            run(LOAD.format(rows=rows, table=identifier(table)))
            run(shown)
            return data
        keys = ("execution", "file") if "file" in source.types else ("execution",)
        own = ", ".join(f"o.{key}" for key in keys)
        run("CREATE TEMP TYPE IF NOT EXISTS run_name AS ENUM (SELECT DISTINCT run FROM membership ORDER BY run)")
        run(f"CREATE OR REPLACE TEMP TABLE spans AS {SPANS.format(keys=', '.join(keys), source=source.sql)}")
        row_number = 'o.file_row_number - s."# first"'
        if not run('SELECT bool_and("# together") FROM spans')[0][0]:
            row_number = f'row_number() OVER (PARTITION BY {own}, s."# experiment" ORDER BY o.filename, o.file_row_number) - 1'
        run(
            f'CREATE TEMP TABLE {rows} AS SELECT s."# experiment", s."# number", {row_number} AS "# place", '
            'o.* EXCLUDE (execution, filename, file_row_number) REPLACE (s."# run" AS run) '
            f"FROM {source.sql} o JOIN spans s ON {' AND '.join(f'o.{key} = s.{key}' for key in keys)}"
        )
        run(shown)
        return data

    def run(self, statement: str) -> list[RawRow]:
        """Return the rows of a statement, on `rows` for example. Raises SqlError."""
        return self._snapshot.run(statement)

    def select(self, kind: type[R], text: str, **parameters: object) -> list[R]:
        """Return the rows of one statement on the tables of the store as instances of a row class. Raises SqlError."""
        return self._snapshot.select(kind, text, **parameters)

    def sql(self, text: str, **parameters: object) -> pa.Table:
        """Return the result of a statement on `samples`. Raises SqlError, Damaged."""
        with self._snapshot.errors():
            return self._snapshot.connection.sql(text, params=parameters).to_arrow_table()


THESE = """
SELECT m.batch, m.ordinal, m.run, e.execution, e.judgement, e.ended AS submitted, e.lamport, {outcome} AS outcome
FROM batch_runs m JOIN these t ON t.run = m.run JOIN all_judgements e ON e.judgement = t.judgement WHERE m.batch = {batch}
"""
"""The table `effective`, if statistics use given executions instead."""

SHOWN = 'CREATE OR REPLACE TEMP VIEW {data} AS SELECT * REPLACE (run::VARCHAR AS run), rowid AS "# rowid" FROM {rows}'

LOAD = """
CREATE TEMP TABLE {rows} AS SELECT w.ordinal::INTEGER AS "# experiment", w.number::INTEGER AS "# number",
    row_number() OVER (PARTITION BY w.run, w.ordinal ORDER BY d.rowid) - 1 AS "# place", d.* REPLACE (w.run AS run)
FROM {table} d JOIN wanted w ON d.run = w.run
"""

SPANS = """
SELECT s.*, m.experiment AS "# experiment", m.number AS "# number", m.run::run_name AS "# run" FROM (
    SELECT {keys}, min(file_row_number) AS "# first",
        count(DISTINCT filename) = 1 AND max(file_row_number) - min(file_row_number) + 1 = count(*) AS "# together"
    FROM {source} WHERE execution IN (SELECT judgement FROM membership) GROUP BY {keys}
) s JOIN membership m ON s.execution = m.judgement
"""
"""The first row of each execution in its file, and whether its rows follow each other there; then no rows need to be sorted."""


def _renaming(names: Mapping[str, str]) -> str:
    """Return the clause after `*` that gives columns other names."""
    pairs = (f"{identifier(old)} AS {identifier(new)}" for old, new in names.items())
    return f" RENAME ({', '.join(pairs)})" if names else ""


@dataclass(frozen=True, slots=True)
class RecordedColumn:
    """One column of one output for statistics, with the column's values in `samples`."""

    data: BatchData
    table: str
    column: str
    time: str
    where: str = ""
    offset: int = 0
    """The number that is subtracted from all values: see `BatchData.offset`."""

    def sql(self, text: str, /, **parameters: object) -> pa.Table:
        self.data.samples(self.table, self.column, self.time, self.where, self.offset, shared="shared_t" in text)
        return self.data.sql(text, **parameters)


def _numeric_and_flags(types: Mapping[str, str]) -> tuple[tuple[str, ...], ...]:
    """Return the numeric columns, and those of them that have only flags."""
    return tuple(tuple(name for name, kind in types.items() if re.fullmatch(kinds, kind)) for kinds in (NUMERIC, FLAG))


def _mixed(relation: Relation) -> tuple[str, ...]:
    return tuple(name for name in relation.texts if name not in relation.rounded)

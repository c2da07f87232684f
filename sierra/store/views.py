"""SQL views over the files of segments, created only for the tables that a statement names."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property, partial
from typing import TYPE_CHECKING

from sierra.errors import Damaged
from sierra.store import view_sql
from sierra.store.duckdb_file_io import read_parquet
from sierra.store.duckdb_messages import check_shortage, first_line
from sierra.store.index_reader import IN_SEGMENTS, Index
from sierra.store.listing import Listing
from sierra.store.rest_rows import RestRows
from sierra.store.row_types import Key
from sierra.store.schema import DERIVED, LATER, RECORDED, Column, columns_with
from sierra.store.segments import Segment, is_first_part
from sierra.store.sql_names import column_names, identifier, quote, row_name
from sierra.store.sql_result import RawRow
from sierra.store.union_files import Fetch, IndexedRows, Relation, RowSource, relation
from sierra.store.verified_files import verify
from sierra.util.lazy_definitions import regex

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

ONCE = columns_with(Key.YES)
"""Tables to which two writers may add the same record, with the columns that identify a record."""

KEPT_OBJECTS = "kept objects"
"""The table of recorded files without their contents, for whoever asks only what the store has. No output has such a name."""
SETTLED = "settled"
"""The schema of tables that replace views: see `Views.settle`."""
FIRST = {"batches": "lamport", "findings": "lamport", "imports": "lamport", "imported_sessions": "lamport"}


INVALID_TRIAL = "invalid trial"
"""The beginning of the reasons of executions that people marked as invalid."""
RESULTS = ("effective", "points", "runs", "counted")
"""The results that an index holds: these views, and each run's effective execution with the run's number and variables."""
RESULTS_FROM = frozenset(
    (
        "batches",
        "batch_runs",
        "executions",
        "experiments",
        "findings",
        "imported_sessions",
        "judgements",
        "reused_executions",
        "sessions",
        "stale_sessions",
        "trials",
    )
)
"""The tables of records from which they follow."""


class Views:
    """The views of one connection; each is created once."""

    def __init__(
        self,
        connection: Callable[[], DuckDBPyConnection],
        listing: Listing,
        within: str | None = None,
        replays: Sequence[str] = (),
        index: Index | None = None,
        rest: RestRows | None = None,
    ) -> None:
        """`connection` returns the connection, free for a statement. `replays` are those that count: see `Store.replayed`.

        `index`: the index of the segments that are not in `listing.rest`. `rest`: the rows of these that the connection holds.
        """
        self._connection = connection
        self._within = within
        self._replays = replays
        self._index = index
        self._rest = rest
        self._files: dict[str, list[str]] = {}
        self._outputs: dict[str, list[str]] = {}
        first = dict(index.spellings()) if index else {}
        for segment in listing.rest:
            for name, path in segment.files.items():
                self._files.setdefault(name, []).append(path)
            for name, path in segment.outputs():
                self._outputs.setdefault(name.lower(), []).append(path)
                first[name] = min(first.get(name, place_of(path)), place_of(path))
        self.outputs = sorted(first)
        """The names of the tables that runs wrote."""
        self._spelled = {name.lower(): name for name in sorted(first, key=lambda name: first[name], reverse=True)}
        self._listing = listing
        self.sql_names: dict[str, dict[str, str]] = {}
        """The names of an output's columns in SQL, by output (in lower case) whose view exists."""
        self.notes: list[str] = []
        """Notes for the user on columns with several types."""
        self._unsaid: list[str] = []
        """Notes on the experiments, while no statement has needed these."""
        self.unchecked: set[str] = set()
        """Tables whose files are not verified, because the caller does so."""
        self._read: dict[str, list[str]] = {}
        """The files of the outputs whose view exists, by output."""
        self._settled = False
        self._doubtful: set[str] | None = None
        """The indexed segments with judgements that do not count, if somebody has asked for them."""
        self._made: set[str] = set()
        self.made: list[str] = []
        """The existing views as SQL identifiers."""
        self._defined = False
        self._from_rest: set[str] = set()
        """The tables of records whose views read rows that the connection holds."""
        self._from_files: set[str] = set()
        """The tables of records whose views read files."""

    @property
    def depends_on_cursor(self) -> bool:
        """True if some views are not those of every snapshot of the same segments, or if notes on them would be lost."""
        touched = self.__dict__.get("_partly_stored", False)
        return self._defined or self._settled or touched or bool(self.unchecked or self.notes or self._unsaid)

    def forget_contents(self) -> list[str]:
        """Forget the views of recorded contents, which are made by what exists at that time; return them as SQL identifiers."""
        found = [name for name in ("objects", KEPT_OBJECTS) if name in self._made]
        self._made.difference_update(found)
        names = [identifier(name) for name in found]
        self.made = [name for name in self.made if name not in names]
        return names

    def inherit(self, kept: Views) -> bool:
        """Use the views that an earlier snapshot has made, if they are those that this one would make; return whether they are.

        So they are if this snapshot has the same segments, or further ones whose rows the connection holds.
        """
        mine, theirs = self._listing, kept._listing
        same = (mine.without, self._within, self._replays) == (theirs.without, kept._within, kept._replays)
        if not same or mine.facts is not theirs.facts or self._files.keys() != kept._files.keys():
            return False
        added = {name for name, files in self._files.items() if files != kept._files[name]}
        if added & kept._from_files or (added and kept._read):
            return False
        try:
            verify(path for name in kept._reads for path in (*self._files_of(name), *kept._read.get(name, ())))
            if not all(self._held(name) for name in added & kept._from_rest):
                return False
        except Damaged:  # whoever makes a view of that file says so
            return False
        self._made, self.made, self._read, self.sql_names = kept._made, kept.made, kept._read, kept.sql_names
        self._from_files, self._from_rest = kept._from_files, kept._from_rest
        return True

    def _execute(self, statement: str, parameters: Mapping[str, str] | None = None) -> DuckDBPyConnection:
        """Execute a statement of these views. Raises Damaged for errors in the store's files, Missing for a lack."""
        import duckdb

        try:
            return self._connection().execute(statement, parameters or {})
        except duckdb.Error as error:
            check_shortage(error)
            raise Damaged(f"the store cannot be read: {first_line(error)}") from error

    def make(self, names: Iterable[str] | None = None) -> None:
        """Create the views of these tables and of the tables that they need; of all tables if `names` is None."""
        wanted = None if names is None else {name.lower() for name in names}
        for name in (*RECORDED, *DERIVED, *sorted(self._spelled.values())):
            if wanted is None or name.lower() in wanted:
                self._make(name)
        if wanted is not None and KEPT_OBJECTS in wanted:
            self._make(KEPT_OBJECTS)

    def verify(self) -> None:
        """Verify the files of the existing views again, which may have changed since. Raises Damaged."""
        verify(path for name in self._reads for path in (*self._files_of(name), *self._read.get(name, ())))

    @property
    def _reads(self) -> set[str]:
        """The tables whose files the existing views read, or whose rows the connection holds: also others than their own."""
        return self._made | self._from_files | self._from_rest

    def holds(self, table: str) -> bool:
        """Check whether the store has any record of a table; much faster than a query."""
        return table in self._files or (self._index is not None and self._index.holds(table))

    def define(self, name: str, body: str) -> None:
        """Create the view of a table from another query than usual. No view that needs this table may exist yet."""
        self._made.add(name)
        self._defined = True
        self._execute(f"CREATE VIEW {identifier(name)} AS {body}")
        self.made.append(identifier(name))

    def settle(self) -> None:
        """Compute now which executions are effective, and the variables of runs, which each statement on an output needs.

        To be called before the view of any output exists.
        """
        self._execute(f"CREATE SCHEMA {SETTLED}")
        for name in ("effective", "points"):
            self._make(name)
            self._execute(f"CREATE TABLE {SETTLED}.{name} AS FROM {name}")
            self._execute(f"CREATE OR REPLACE VIEW {name} AS FROM {SETTLED}.{name}")
        self._execute(f"CREATE TABLE {SETTLED}.counted AS {self._counted_points}")
        self._settled = True

    def axes(self) -> list[str]:
        """Return the axes that are columns: of all batches, as in `experiments`; or of one batch, in its order."""
        if self._within is not None:
            self._make("batches")
            found = self._execute("SELECT unnest(axes) FROM batches WHERE batch = $batch", {"batch": self._within})
            return [row[0] for row in found.fetchall()]
        self._make("experiments")
        fixed = {column.name for column in RECORDED["experiments"].columns}
        return [row[0] for row in self._fetch("DESCRIBE experiments") if row[0] not in fixed]

    def _make(self, name: str) -> None:
        if name == "experiments":
            self.notes += self._unsaid
            self._unsaid = []
        if name in self._made:
            return
        self._made.add(name)
        try:
            self._create(name)
        except BaseException:
            self._made.discard(name)
            raise

    def _create(self, name: str) -> None:
        """Create a view. If no file of records has the later columns, use the query that takes longer to prepare."""
        import duckdb

        if name in RECORDED or name in DERIVED or name == KEPT_OBJECTS:
            body = self._body(name, older=False)
        elif self._spelled.get(name.lower()) == name:
            body = self._output(name)
        else:
            return
        for needed in view_sql.tables_in(body):
            if needed != name:
                self._make(needed)
        view = f"CREATE VIEW {identifier(name)} AS "
        try:
            self._connection().execute(view + body)
        except duckdb.Error as error:
            check_shortage(error)
            self._execute(view + (self._body(name, older=True) if name not in self._read else body))
        self.made.append(identifier(name))

    def _body(self, name: str, *, older: bool) -> str:
        """Return the query of a view other than an output's."""
        if stored := self._stored(name):
            if name != "effective":
                self._make("experiments")  # for its notes
            return f"FROM {stored}"
        if name in RESULTS and self._partly_stored:
            return self._beside_stored(name)
        match name:
            case "runs":
                return self._runs()
            case "points":
                return self._points()
            case "effective":
                return view_sql.effective()
            case "ended":
                return view_sql.ended()
            case "all_candidates":
                return self._candidates
            case "sessions" if self._imported:
                return view_sql.query(name)
            case "origins":
                return view_sql.query(name) if self._imported else _empty(DERIVED[name].columns)
            case "nondeterminism" | "robot_clocks":
                return view_sql.query(name)
            case "all_judgements":
                return self._all_judgements(older=older)
            case "all_artifacts" | "all_trials":
                table = name.removeprefix("all_")
                return f"SELECT * FROM {self._records(table, older=older)}" if self.holds(table) else f"FROM {table}"
            case "all_sessions":
                return self._recorded("sessions", older=older)
        return self._kept_objects() if name == KEPT_OBJECTS else self._recorded(name, older=older)

    def _recorded(self, name: str, *, older: bool) -> str:
        if not self.holds(name):
            return _empty(RECORDED[name].columns)
        source = self._experiments() if name == "experiments" else self._records(name, older=older)
        if name in ONCE:
            keys = ONCE[name]
            others = [c for c in self._columns(name, source) if c not in keys]
            picked = "".join(f", {_pick(c, FIRST.get(name))} AS {identifier(c)}" for c in others)
            return f"SELECT {', '.join(keys)}{picked} FROM {source} GROUP BY {', '.join(keys)}"
        if name == "trials":
            return f"SELECT * FROM {source} QUALIFY row_number() OVER (PARTITION BY execution ORDER BY lamport DESC) = 1"
        if name == "executions":
            return self._executions(source)
        if name == "artifacts" and self._reevaluated:
            last = view_sql.query("last_judgements")
            return f"SELECT a.* REPLACE (l.execution AS execution) FROM {source} a JOIN ({last}) l ON a.execution = l.judgement"
        if name == "batch_runs" and self._within is not None:
            return f"SELECT * FROM {source} WHERE batch = {quote(self._within)}"
        return f"SELECT * FROM {source}"

    def _records(self, name: str, *, older: bool) -> str:
        """Return the relation of records in all segments; `older`: no file has the later columns."""
        parts = [self._index.rows(name)] if self._index and self._index.holds(name) and name not in IN_SEGMENTS else []
        if held := self._held(name):
            self._from_rest.add(name)
            parts.append(held)
        elif files := self._files_of(name):
            self._from_files.add(name)
            source = (
                records(name, files) if older else read_parquet(files, union=name in LATER, check=name not in self.unchecked)
            )
            if name in LATER:
                later = ", ".join(f"{column} AS {column}" for column in LATER[name])  # DuckDB refuses columns that no file has
                source = f"(SELECT * REPLACE ({later}) FROM {source})"
            parts.append(source)
        source = parts[0] if len(parts) == 1 else f"(SELECT * FROM {parts[0]} UNION ALL BY NAME SELECT * FROM {parts[1]})"
        return counting(source, self._replays) if name == "executions" and self._replays else source

    def _held(self, name: str) -> str:
        """Return the relation of the rows in the files of a table that the connection holds; "" if it does not."""
        import duckdb

        files = self._files.get(name)
        if self._rest is None or not files or name in (*IN_SEGMENTS, "experiments") or self.unchecked:
            return ""
        try:
            return self._rest.relation(name, files, self._connection().execute)
        except duckdb.Error as error:  # whoever reads the files tells more
            check_shortage(error)
            return ""

    def _files_of(self, name: str) -> list[str]:
        """Return the files of a table of records that are read, in the order of their segments."""
        if self._index and name in IN_SEGMENTS:
            return sorted([*self._files.get(name, ()), *self._index.files(name)], key=segment_of)
        return self._files.get(name, [])

    def _experiments(self) -> str:
        """Return the relation of axis values: unchanged for one batch, with numbers split from texts for all batches."""
        self._from_files.add("experiments")
        found = relation(self._fetch, self._experiment_sources(self._within) or self._experiment_sources())
        self._note("experiments", found, {name: name for name in found.types})
        return found.sql if self._within is None else f"(SELECT * FROM {found.sql} WHERE batch = {quote(self._within)})"

    def _experiment_sources(self, batch: str | None = None) -> list[RowSource]:
        """Return the files and the indexed rows of experiments in the order of their segments; those of one batch, if named."""
        files = [file for file in self._files.get("experiments", ()) if batch is None or segment_of(file)[:12] == batch[:12]]
        indexed = self._index.experiments(batch) if self._index and self._index.holds("experiments") else []
        return sorted([*files, *indexed], key=lambda one: one.first if isinstance(one, IndexedRows) else segment_of(one))

    def _stored(self, name: str) -> str:
        """Return the relation of a result in the index; "" if there is none that holds for all segments."""
        if self._index is None or self._within is not None or name not in RESULTS:
            return ""
        return self._index.stored(name) if RESULTS_FROM.isdisjoint(self._files) else ""

    @cached_property
    def _partly_stored(self) -> bool:
        """True if the results in the index hold for all batches but some. Then the tables with these and their runs exist."""
        stored = self._index.stored("points") if self._index and self._within is None else ""
        many = self._index is not None and self._index.count("batch_runs") >= view_sql.LARGE
        if not (stored and many and view_sql.only_added(self._listing.rest, RESULTS_FROM)):
            return False
        said = len(self.notes)
        for needed in ("batch_runs", "experiments", "batches", "reused_executions"):
            self._make(needed)
        same = self._fetch(f"DESCRIBE {self._points()}") == self._fetch(f"DESCRIBE FROM {stored}")
        self._unsaid = self.notes[said:]
        del self.notes[said:]
        if not same:
            return False
        for statement in view_sql.touched(self._listing.rest):
            self._execute(statement)
        return True

    def _beside_stored(self, name: str) -> str:
        """Return the query for a result, of which the index has the part that no other segment touches."""
        by_run = {table: view_sql.BY_RUN.format(table=table) for table in ("batch_runs", "effective", "executions")}
        if name == "effective":
            judged = view_sql.JUDGEMENTS
            candidates = {"all_judgements": judged, "all_candidates": self._candidates}
            return view_sql.joined(name, view_sql.effective(), batch_runs=view_sql.BY_BATCH, **candidates)
        if name == "counted":
            return view_sql.joined(name, self._points_of(self._last_effective, self._points()), **by_run)
        return view_sql.joined(name, self._points() if name == "points" else self._runs(), **by_run)

    @property
    def _candidates(self) -> str:
        """The query for judgements of the own executions of sessions, and of those that they reused."""
        if self.holds("reused_executions"):
            return view_sql.query("all_candidates")
        return "SELECT NULL::VARCHAR AS reusing, * FROM all_judgements"

    def results(self) -> Iterable[tuple[str, str]]:
        """Yield the results that an index holds, and a query for each."""
        self.make(RESULTS)
        yield from ((name, f"FROM {name}") for name in RESULTS if name != "counted")
        yield "counted", self._counted_points

    def _fetch(self, statement: str) -> list[RawRow]:
        return self._execute(statement).fetchall()

    def _note(self, table: str, rows: Relation, sql_names: Mapping[str, str]) -> None:
        """Note which columns have a `_text` column, and which were several that differ only in upper and lower case."""
        for name, spelled in rows.spellings.items():
            several = " and ".join(map(repr, spelled))
            self.notes.append(f"column {sql_names[name]!r} of {table} is {several}, because SQL ignores upper and lower case")
        for name, text in rows.texts.items():
            column, beside = f"column {sql_names[name]!r} of {table}", repr(sql_names[text])
            split = "numbers in some runs and other values in others; the other values are"
            if name in rows.rounded:
                split = "fractions and very large whole numbers in different rows; the exact digits are"
            self.notes.append(f"{column} has {split} in {beside}")
        for name in sorted(rows.nans):
            split = "very large whole numbers, and nan in some runs; nan is NULL"
            self.notes.append(f"column {sql_names[name]!r} of {table} has {split}")

    @property
    def _imported(self) -> bool:
        """True if any session came in a package."""
        return self.holds("imported_sessions")

    @property
    def _counted(self) -> str:
        """The query for each run's effective execution."""
        if self._stored("counted") or self._partly_stored:
            return f"SELECT DISTINCT run, execution, judgement FROM ({self._counted_points})"
        return self._last_effective

    @property
    def _last_effective(self) -> str:
        """The query for each run's effective execution, from those of its batches."""
        return view_sql.query("counted_by_origin" if self._imported else "counted")

    @property
    def _reevaluated(self) -> bool:
        """True if any execution was evaluated by changed rules."""
        return self.holds("judgements")

    def _executions(self, source: str) -> str:
        if not self._reevaluated:
            return "SELECT * EXCLUDE (judgement, judged_at, place, packages) FROM all_judgements"
        last_values = "l.status AS status, l.reason AS reason, l.ingest_rules AS ingest_rules"
        return (
            f"SELECT e.* REPLACE ({last_values}) FROM {source} e JOIN ({view_sql.query('last_judgements')}) l USING (execution)"
        )

    def _all_judgements(self, *, older: bool) -> str:
        """Return the query for all judgements, the first and the later ones, with findings that were added afterwards."""
        if not self.holds("executions"):
            return _empty(DERIVED["all_judgements"].columns)
        source = self._records("executions", older=older)
        first = f"SELECT execution AS judgement, ended AS judged_at, lamport AS place, * FROM {source}"
        if self._reevaluated:
            theirs = ", ".join(f"j.{name} AS {name}" for name in ("batch", "status", "reason", "ingest_rules"))
            later = (
                f"SELECT j.judgement, j.judged_at, j.lamport AS place, e.* REPLACE ({theirs}) "
                f"FROM judgements j JOIN {source} e USING (execution)"
            )
            first = f"{first} UNION ALL BY NAME {later}"
        if self.holds("findings"):
            first = (
                "SELECT e.* REPLACE (coalesce(f.status, e.status) AS status, coalesce(f.reason, e.reason) AS reason) "
                f"FROM ({first}) e LEFT JOIN findings f ON f.execution = e.judgement"
            )
        if self.holds("trials"):
            first = view_sql.query("judged_by_people", judgements=first, beginning=quote(INVALID_TRIAL))
        if self._imported:
            return f"SELECT e.*, i.packages AS packages FROM ({first}) e LEFT JOIN imported_sessions i ON i.session = e.session"
        return f"SELECT *, NULL::VARCHAR[] AS packages FROM ({first})"

    def _kept_objects(self) -> str:
        columns = [column for column in RECORDED["objects"].columns if column.type != "BLOB"]
        names = ", ".join(identifier(column.name) for column in columns)
        files = self._files.get("objects", [])
        parts = [f"SELECT {names} FROM {read_parquet(files, check='objects' not in self.unchecked)}"] if files else []
        parts += [f"SELECT {names} FROM {self._index.rows('objects')}"] if self._index and self._index.holds("objects") else []
        return " UNION ALL ".join(parts) or _empty(columns)

    def contents(self, digests: Iterable[str]) -> str:
        """Return the relation of `objects` in files that have all contents with these SHA-256s."""
        digests = set(digests)
        indexed = self._of_index(self._index.holding(digests, first=True)) if self._index else []
        if self._index and not all(map(os.path.exists, indexed)):  # one was lost; others may have the same contents
            indexed = list(filter(os.path.exists, self._of_index(self._index.holding(digests))))
        files = [*self._files.get("objects", ()), *indexed]
        if files:
            return read_parquet(sorted(files, key=segment_of))
        return f"({_empty(RECORDED['objects'].columns)})"

    def _of_index(self, names: Iterable[str]) -> list[str]:
        """Return the paths of recorded contents in indexed segments."""
        return [f"{self._listing.folders[0]}/{name}/objects.parquet" for name in names]

    def _columns(self, name: str, source: str) -> list[str]:
        if name != "experiments":
            return [column.name for column in RECORDED[name].columns]
        return [row[0] for row in self._fetch(f"DESCRIBE SELECT * FROM {source}")]

    def _runs(self) -> str:
        axes = "".join(f"{_only(_value(axis))} AS {identifier(axis)}, " for axis in self.axes())
        return view_sql.query("runs", axes=axes, counted=self._last_effective, success=view_sql.SUCCESS)

    def _points(self) -> str:
        axes = self.axes()
        names = [identifier(axis) for axis in axes]
        return view_sql.query(
            "points",
            values="".join(f", {_value(axis)} AS {identifier(axis)}" for axis in axes),
            merged="".join(f", max({name}) AS {name}" for name in names),
            axes="".join(f", {name}" for name in names),
            alike=" AND ".join(f"min({name}) IS NOT DISTINCT FROM max({name})" for name in names) or "true",
        )

    @property
    def _counted_points(self) -> str:
        """The query for each run's effective execution with the run's number and variables."""
        if stored := self._stored("counted"):
            return f"FROM {stored}"
        if self._partly_stored:
            return self._beside_stored("counted")
        return self._points_of(self._last_effective, "FROM points")

    def _points_of(self, counted: str, points: str) -> str:
        return f"SELECT p.*, c.execution, c.judgement FROM ({counted}) c JOIN ({points}) p ON c.run = p.run"

    def _output(self, name: str) -> str:
        for needed in ("effective", "origins", "points"):
            self._make(needed)
        known = self._output_files(name)
        files = self._read[name] = self._holding(list(known))
        columns = {file: theirs for file, theirs in known.items() if theirs}
        counts = f"execution IN (SELECT judgement FROM ({self._counted}))"
        answers = partial(self._answers, name.lower())
        rows = relation(self._fetch, files, counts, rows=True, known=columns, answers=answers)
        axes = self.axes()
        theirs = list(rows.types)
        free = column_names(theirs, taken=axes)
        renamed = ", ".join(f"{identifier(c)} AS {identifier(n)}" for c, n in zip(theirs, free, strict=True) if c != n)
        rename = f" RENAME ({renamed})" if renamed else ""
        row = row_name((*axes, *free))
        self.sql_names[name.lower()] = dict(zip(theirs, free, strict=True))
        self._note(name, rows, self.sql_names[name.lower()])
        ours = "".join(f"c.{identifier(axis)}, " for axis in axes)
        counted = f"{SETTLED}.counted" if self._settled else f"({self._counted_points})"
        return (
            f"SELECT {ours}c.number, o.file_row_number AS {identifier(row)}, "
            f"o.* EXCLUDE (file_row_number, filename) REPLACE (c.run AS run, c.execution AS execution){rename} "
            f"FROM {rows.sql} o JOIN {counted} c ON o.execution = c.judgement"
        )

    def _answers(self, output: str, files: Sequence[str], question: str) -> dict[str, int]:
        """Return what the index has of the values of an SQL expression over files all of whose rows count."""
        if self._index is None:
            return {}
        if self._doubtful is None:
            counted = f"SELECT judgement FROM ({self._counted})"
            others = f"SELECT DISTINCT segment FROM ({self._index.judgements()}) WHERE judgement NOT IN ({counted})"
            self._doubtful = {segment for (segment,) in self._fetch(others)}
        known = self._index.answers(output, question)
        return {file: known[file] for file in files if file in known and segment_of(file) not in self._doubtful}

    def _output_files(self, name: str) -> dict[str, Mapping[str, str]]:
        """Return the files of an output in the order of their segments, with their columns if the index has them."""
        found: dict[str, Mapping[str, str]] = {file: {} for file in self._outputs.get(name.lower(), ())}
        if self._index:
            found |= {file.path: file.columns for file in self._index.outputs(name)}
        return {file: found[file] for file in sorted(found, key=segment_of)} if self._index else found

    def _holding(self, files: list[str]) -> list[str]:
        """Return the files that have an effective execution, if columns may differ; columns of other files are not visible."""
        if self._within is not None:
            mine = self._of_batch(files)
            files = [file for file in files if file in mine] or files
        elif all(map(is_first_part, files)) and not (self.holds("findings") or self._reevaluated or self._imported):
            return files
        found = {row[0] for row in self._fetch(files_with(files, f"SELECT judgement FROM ({self._counted})"))}
        return [file for file in files if file in found] or files

    def _of_batch(self, files: Sequence[str]) -> set[str]:
        """Return the files of batches that recorded an effective execution."""
        batches = {
            row[0][:12]
            for row in self._fetch(f"SELECT DISTINCT batch FROM all_judgements SEMI JOIN ({self._counted}) USING (judgement)")
        }
        return {file for file in files if segment_of(file)[:12] in batches}


def _empty(columns: Iterable[Column]) -> str:
    """Return the query for no rows of these columns."""
    return f"SELECT {', '.join(f'NULL::{column.type} AS {identifier(column.name)}' for column in columns)} WHERE false"


def _value(axis: str) -> str:
    """Return the SQL expression for an axis's value in an experiment; controller and scenario may be the batch's."""
    return f"coalesce(x.{axis}, b.{axis})" if axis in ("controller", "scenario") else f"x.{identifier(axis)}"


def _only(column: str) -> str:
    """Return the SQL expression for the single value of a column in a group; NULL if there are several."""
    return f"CASE WHEN min({column}) = max({column}) THEN max({column}) END"


def _pick(column: str, first: str | None) -> str:
    """Return the SQL expression that picks a column's value from duplicate records: the first record's, if an order is known.

    DuckDB does not read columns that a query does not use.
    """
    name = identifier(column)
    return f"any_value({name})" if first is None else f"min({name})" if column == first else f"arg_min({name}, {first})"


def place_of(file: str) -> str:
    """Return the names of a file's segment and of the file itself: files are read in this order."""
    return "/".join(file.rsplit("/", 2)[1:])


def segment_of(file: str) -> str:
    """Return the name of a file's segment."""
    return file.rpartition("/")[0].rpartition("/")[2]


def files_with(files: Sequence[str], judgements: str, column: str = "execution") -> str:
    """Return the statement that lists the files with a row of the judgements; `judgements` is a query for them."""
    return f"SELECT DISTINCT filename FROM {read_parquet(files, filename=True)} WHERE {column} IN ({judgements})"


def recording(fetch: Fetch, segments: Sequence[Segment], judgements: str) -> list[Segment]:
    """Return the segments that contain first or later judgements of executions; `judgements` is a query for these."""
    found: set[str] = set()
    for name, column in (("executions", "execution"), ("judgements", "judgement")):
        files = {segment.files[name]: segment.name for segment in segments if name in segment.files}
        if files:
            found |= {files[row[0]] for row in fetch(files_with(list(files), judgements, column))}
    return [segment for segment in segments if segment.name in found]


def records(name: str, files: Sequence[str], *, filename: bool = False, check: bool = True) -> str:
    """Return the relation of files of records with all current columns; columns that older files lack are NULL.

    With a schema, DuckDB takes twice as long to prepare it.
    """
    schema = {column.name: column.type for column in RECORDED[name].columns} if name in LATER else None
    return read_parquet(files, union=name == "experiments", schema=schema, filename=filename, check=check)


def counting(executions: str, replays: Sequence[str]) -> str:
    """Return the relation of executions in which those of some replays count, instead of all others of the same runs."""
    theirs = f"session IN ({', '.join(map(quote, replays))})"
    return (
        f"(SELECT * REPLACE (CASE WHEN {theirs} THEN 'run' ELSE purpose END AS purpose) FROM {executions} "
        f"WHERE {theirs} OR run NOT IN (SELECT run FROM {executions} WHERE {theirs}))"
    )


NAMED = regex(r'(?:\b(?:from|join|describe|summarize|table|show)\b|[,(])\s*(?:"((?:[^"]|"")+)"|([^\W\d]\w*))', re.IGNORECASE)
ALL = regex(r"\b(?:show\s+(?:all\s+)?tables|information_schema|duckdb_\w+|pragma\w*)\b", re.IGNORECASE)
LISTS = regex(r"\b(?:show|describe\s*(?:$|[^\s\w\"(]))|\b(?:pg|sqlite)_\w", re.IGNORECASE | re.DOTALL)
"""Further ways to list tables or databases: only those that exist on the connection."""


def tables_of(text: str) -> set[str] | None:
    """Return the names in a statement that may be tables, in lower case; None if the statement may use all tables."""
    if ALL.search(text):
        return None
    return {(quoted.replace('""', '"') or plain).lower() for quoted, plain in NAMED.findall(text)}


def lists_tables(text: str) -> bool:
    """Return whether a statement may list tables."""
    return tables_of(text) is None or LISTS.search(text) is not None

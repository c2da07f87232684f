"""The store as SQL sees it: views over the segments' files, made only for the tables that a statement names."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

from sierra.errors import Damaged
from sierra.store.columns import Relation, relation
from sierra.store.errors import first_line
from sierra.store.names import column_names, identifier, quote
from sierra.store.order import STAMPED, TIMES
from sierra.store.scans import read_parquet
from sierra.store.schema import DERIVED, LATER, RECORDED
from sierra.store.segments import Segment, is_first_part

NEEDS = {
    "judged": ("findings", "judgements"),
    "executions": ("judged",),
    "artifacts": ("judged",),
    "judged_artifacts": ("artifacts",),
    "counting": ("members", "sessions", "judged"),
    "nondeterminism": ("executions", "verdicts"),
    "points": ("members", "experiments", "batches"),
    "runs": ("members", "experiments", "batches", "executions", "counting"),
}
ONCE = {
    "batches": ("batch",),
    "experiments": ("batch", "ordinal"),
    "recipes": ("recipe",),
    "environments": ("environment",),
    "sources": ("source",),
    "programs": ("programs", "name", "path"),
    "objects": ("sha256", "part"),
    "blobs": ("blob",),
    "images": ("image",),
    "isolations": ("isolation",),
    "readings": ("reading",),
    "findings": ("execution",),
}
"""Records that two writers may both have made: what makes them the same."""

FIRST = {"batches": "lamport", "findings": "lamport"}


def outputs(segments: Iterable[Segment]) -> list[str]:
    """The names of the tables that runs wrote."""
    return sorted({name for segment in segments for name, _ in segment.outputs()})


class Views:
    """Makes views on one connection; each once."""

    def __init__(self, connection: Any, segments: Sequence[Segment], within: str | None = None) -> None:
        self._sql = connection
        self._within = within
        self._files: dict[str, list[str]] = {}
        self._outputs: dict[str, list[str]] = {}
        spelled: dict[str, str] = {}
        for segment in segments:
            for name, path in segment.files.items():
                self._files.setdefault(name, []).append(path)
            for name, path in segment.outputs():
                self._outputs.setdefault(spelled.setdefault(name.lower(), name), []).append(path)
        self._own = [segment for segment in segments if within is not None and segment.batch == within[:12]]
        self._segments = segments
        self.called: dict[str, dict[str, str]] = {}
        """By output (in lower case) whose view is made, what its columns are called there."""
        self.told: list[str] = []
        """What must be known of columns that are not of one type."""
        self._made: set[str] = set()
        self._there: list[str] = []

    def _execute(self, statement: str, parameters: Mapping[str, Any] | None = None) -> Any:
        """A statement of these views, with whatever is wrong in the store's files turned into Damaged."""
        import duckdb

        try:
            return self._sql.execute(statement, parameters or {})
        except duckdb.Error as error:
            raise Damaged(f"the store cannot be read: {first_line(error)}") from error

    def make(self, names: Iterable[str] | None = None) -> None:
        """Views of these tables and of what they need; of all where no names are given."""
        wanted = None if names is None else {name.lower() for name in names}
        for name in (*RECORDED, *DERIVED, *sorted(self._outputs)):
            if wanted is None or name.lower() in wanted:
                self._make(name)

    def made(self) -> list[str]:
        """The views that are there, as SQL names them."""
        return self._there

    def axes(self) -> list[str]:
        """The independent variables as columns: those of all batches, as in `experiments`; of one batch, in its order."""
        if self._within is not None:
            self._make("batches")
            rows = self._execute("SELECT unnest(axes) FROM batches WHERE batch = $batch", {"batch": self._within})
            return [row[0] for row in rows.fetchall()]
        self._make("experiments")
        fixed = {column.name for column in RECORDED["experiments"].columns}
        rows = self._execute("DESCRIBE experiments").fetchall()
        return [row[0] for row in rows if row[0] not in fixed]

    def _make(self, name: str) -> None:
        if name in self._made:
            return
        self._made.add(name)
        for needed in NEEDS.get(name, ()):
            self._make(needed)
        if name == "runs":
            body = self._runs()
        elif name == "points":
            body = self._points()
        elif name in DEFINED:
            body = DEFINED[name]
        elif name in RECORDED or name in ("judged", "judged_artifacts"):
            self._make_recorded(name)
            return
        elif name in self._outputs:
            body = self._output(name)
        else:
            return
        self._execute(f"CREATE VIEW {identifier(name)} AS {body}")
        self._there.append(identifier(name))

    def _make_recorded(self, name: str) -> None:
        """Make a view of records; where none of the files has the later columns, in the way that takes longer to prepare."""
        import duckdb

        view = f"CREATE VIEW {identifier(name)} AS "
        bodies = {"judged": self._judged, "judged_artifacts": self._judged_artifacts}
        body = bodies.get(name, partial(self._recorded, name))
        try:
            self._sql.execute(view + body())
        except duckdb.Error:
            self._execute(view + body(older=True))
        self._there.append(identifier(name))

    def _recorded(self, name: str, *, older: bool = False) -> str:
        files = self._files.get(name)
        if files is None:
            columns = ", ".join(f"NULL::{c.type} AS {identifier(c.name)}" for c in RECORDED[name].columns)
            return f"SELECT {columns} WHERE false"
        source = self._experiments(files) if name == "experiments" else self._records(name, files, older=older)
        if name in ONCE:
            keys = ONCE[name]
            others = [c for c in self._columns(name, source) if c not in keys]
            picked = "".join(f", {_pick(c, FIRST.get(name))} AS {identifier(c)}" for c in others)
            return f"SELECT {', '.join(keys)}{picked} FROM {source} GROUP BY {', '.join(keys)}"
        if name == "executions":
            return self._executions(source)
        if name == "artifacts" and self._anew:
            return f"SELECT a.* REPLACE (l.execution AS execution) FROM {source} a JOIN ({LAST}) l ON a.execution = l.judgement"
        if name == "members" and self._within is not None:
            return f"SELECT * FROM {source} WHERE batch = {quote(self._within)}"
        return f"SELECT * FROM {source}"

    def _records(self, name: str, files: list[str], *, older: bool) -> str:
        """Records as they stand in files; `older`: of which none has the later columns."""
        source = records(name, files) if older else read_parquet(files, union=name in LATER)
        if name not in LATER:
            return source
        values = {"lamport": STAMPED.format(time=TIMES.get(name))}  # DuckDB refuses those that no file has
        later = ", ".join(f"{values.get(column, column)} AS {column}" for column in LATER[name])
        return f"(SELECT * REPLACE ({later}) FROM {source})"

    def _experiments(self, files: list[str]) -> str:
        """The values of axes: those of one batch as they are, those of all with numbers apart from texts."""
        own = [segment.files["experiments"] for segment in self._own if "experiments" in segment.files]
        found = relation(self._fetch, own or files)
        self._tell("experiments", found, {name: name for name in found.types})
        return found.sql if self._within is None else f"(SELECT * FROM {found.sql} WHERE batch = {quote(self._within)})"

    def _fetch(self, statement: str) -> list[tuple[Any, ...]]:
        rows: list[tuple[Any, ...]] = self._execute(statement).fetchall()
        return rows

    def _tell(self, table: str, found: Relation, called: Mapping[str, str]) -> None:
        """Note which columns have another one beside them."""
        for name, text in found.texts.items():
            column, beside = f"column {called[name]!r} of {table}", repr(called[text])
            holds = "numbers in some runs, and other things in others: these are"
            if name in found.rounded:
                holds = "fractions in some runs, and whole numbers too great for them in others: all digits are"
            self.told.append(f"{column} holds {holds} in {beside}")

    @property
    def _anew(self) -> bool:
        """Whether anything was judged anew."""
        return "judgements" in self._files

    def _executions(self, source: str) -> str:
        if not self._anew:
            return "SELECT * EXCLUDE (judgement, judged, place) FROM judged"
        said = "l.status AS status, l.reason AS reason, l.reading AS reading"
        return f"SELECT e.* REPLACE ({said}) FROM {source} e JOIN ({LAST}) l USING (execution)"

    def _judged(self, *, older: bool = False) -> str:
        """Every judgement, the first of each execution and those made anew, with what was found out about it since."""
        files = self._files.get("executions")
        if files is None:
            columns = ", ".join(f"NULL::{c.type} AS {identifier(c.name)}" for c in DERIVED["judged"].columns)
            return f"SELECT {columns} WHERE false"
        source = self._records("executions", files, older=older)
        first = f"SELECT execution AS judgement, ended AS judged, lamport AS place, * FROM {source}"
        if self._anew:
            theirs = ", ".join(f"j.{name} AS {name}" for name in ("batch", "status", "reason", "reading"))
            anew = (
                f"SELECT j.judgement, j.judged, j.lamport AS place, e.* REPLACE ({theirs}) "
                f"FROM judgements j JOIN {source} e USING (execution)"
            )
            first = f"{first} UNION ALL BY NAME {anew}"
        if "findings" not in self._files:
            return first
        return (
            "SELECT e.* REPLACE (coalesce(f.status, e.status) AS status, coalesce(f.reason, e.reason) AS reason) "
            f"FROM ({first}) e LEFT JOIN findings f ON f.execution = e.judgement"
        )

    def _judged_artifacts(self, *, older: bool = False) -> str:
        files = self._files.get("artifacts")
        return "FROM artifacts" if files is None else f"SELECT * FROM {self._records('artifacts', files, older=older)}"

    def _columns(self, name: str, source: str) -> list[str]:
        if name != "experiments":
            return [column.name for column in RECORDED[name].columns]
        return [row[0] for row in self._execute(f"DESCRIBE SELECT * FROM {source}").fetchall()]

    def _runs(self) -> str:
        axes = "".join(f"{_only(_value(axis))} AS {identifier(axis)}, " for axis in self.axes())
        return (
            "WITH state AS (SELECT run, count(*) AS executions, arg_max(status, lamport) AS last FROM executions "
            "GROUP BY run), "
            f"counted AS ({COUNTED}) "
            f"SELECT m.run, {axes}any_value(m.seed) AS seed, min(m.number) AS number, any_value(m.input) AS input, "
            "any_value(m.recipe) AS recipe, CASE WHEN any_value(c.execution) IS NOT NULL THEN 'ok' "
            "WHEN any_value(s.last) = 'ok' THEN 'stale' ELSE coalesce(any_value(s.last), 'missing') END AS status, "
            "any_value(c.execution) AS execution, coalesce(any_value(s.executions), 0) AS executions "
            "FROM members m JOIN experiments x USING (batch, ordinal) LEFT JOIN batches b USING (batch) "
            "LEFT JOIN state s USING (run) "
            "LEFT JOIN counted c USING (run) GROUP BY m.run"
        )

    def _points(self) -> str:
        axes = [identifier(axis) for axis in self.axes()]
        seen = "".join(f", {_value(axis)} AS {identifier(axis)}" for axis in self.axes())
        merged = "".join(f", max({axis}) AS {axis}" for axis in axes)
        alike = " AND ".join(f"min({axis}) IS NOT DISTINCT FROM max({axis})" for axis in axes) or "true"
        return (
            f"WITH seen AS (SELECT DISTINCT m.run, m.number{seen} FROM members m JOIN experiments x USING (batch, ordinal) "
            "LEFT JOIN batches b USING (batch)), "
            f"alike AS (SELECT run, {alike} AS alike FROM seen GROUP BY run) "
            f"SELECT run, min(number) AS number{merged} FROM seen JOIN alike USING (run) WHERE alike GROUP BY run UNION ALL "
            f"SELECT run, min(number) AS number{''.join(f', {axis}' for axis in axes)} FROM seen JOIN alike USING (run) "
            "WHERE NOT alike GROUP BY ALL"
        )

    def _output(self, name: str) -> str:
        self._make("counting")
        self._make("points")
        files = self._holding(self._outputs[name])
        found = relation(self._fetch, files, f"execution IN (SELECT execution FROM ({COUNTED}))", rows=True)
        axes = self.axes()
        theirs = list(found.types)
        free = column_names(theirs, taken=axes)
        renamed = ", ".join(f"{identifier(c)} AS {identifier(n)}" for c, n in zip(theirs, free, strict=True) if c != n)
        rename = f" RENAME ({renamed})" if renamed else ""
        *_, row = column_names(["row"], taken=(*axes, *free))
        self.called[name.lower()] = dict(zip(theirs, free, strict=True))
        self._tell(name, found, self.called[name.lower()])
        ours = "".join(f"p.{identifier(axis)}, " for axis in axes)
        return (
            f"SELECT {ours}p.number, o.file_row_number AS {identifier(row)}, "
            f"o.* EXCLUDE (file_row_number, filename) REPLACE (c.execution AS execution){rename} "
            f"FROM {found.sql} o JOIN points p ON o.run = p.run "
            f"JOIN ({COUNTED}) c ON o.execution = c.judgement"
        )

    def _holding(self, files: list[str]) -> list[str]:
        """Of an output whose columns may differ, the files with an execution that counts; what others have, nobody sees."""
        if self._within is not None:
            mine = self._of_batch(files)
            files = [file for file in files if file in mine] or files
        elif all(map(is_first_part, files)) and "findings" not in self._files and not self._anew:
            return files
        found = {row[0] for row in self._execute(files_with(files, f"SELECT judgement FROM ({COUNTED})")).fetchall()}
        return [file for file in files if file in found] or files

    def _of_batch(self, files: Sequence[str]) -> set[str]:
        """Of these files, those of batches that recorded an execution that counts."""
        batches = {
            row[0][:12] for row in self._fetch(f"SELECT DISTINCT batch FROM judged SEMI JOIN ({COUNTED}) USING (judgement)")
        }
        return {path for segment in self._segments if segment.batch in batches for path in segment.files.values()} & set(files)


LATEST = """
WITH asked AS (
    SELECT batch, programs, reading, ended, lamport FROM sessions WHERE reading IS NOT NULL
    UNION ALL
    SELECT batch, programs, reading, judged, place FROM judged WHERE purpose = 'run'
),
latest AS (
    SELECT batch, arg_max(programs, lamport) AS programs, arg_max(reading, lamport) AS reading,
           arg_max(ended, lamport) AS asked, max(lamport) AS lamport
    FROM asked GROUP BY batch
)
"""
"""The programs and the rules of each batch's last asking, as the relation `latest`."""

COUNTS = "e.status = 'ok' AND e.purpose = 'run' AND e.programs = l.programs AND e.reading = l.reading"
"""Whether a judgement e may count in a batch of which l is `latest`; of those that may, the last execution's last one does."""

ORDER = "(e.lamport, e.place, e.judgement)"
"""The order of judgements e: that of their executions, then their own."""

COUNTING = f"""{LATEST}
SELECT batch, ordinal, run, c.execution AS execution, c.judgement AS judgement, asked, lamport
FROM (
    SELECT m.batch, m.ordinal, m.run, any_value(l.asked) AS asked, any_value(l.lamport) AS lamport,
           arg_max({{'execution': e.execution, 'judgement': e.judgement}}, {ORDER}) AS c
    FROM members m
    JOIN latest l ON m.batch = l.batch
    JOIN judged e ON e.run = m.run AND {COUNTS}
    GROUP BY m.batch, m.ordinal, m.run
)
"""

LAST = """
SELECT execution, l.judgement AS judgement, l.status AS status, l.reason AS reason, l.reading AS reading
FROM (
    SELECT e.execution, arg_max({'judgement': e.judgement, 'status': e.status, 'reason': e.reason, 'reading': e.reading},
           (e.place, e.judgement)) AS l
    FROM judged e GROUP BY e.execution
)
"""
"""The last judgement of each execution."""


NONDETERMINISM = """
WITH several AS (
    SELECT run, programs, count(*) AS executions, count(DISTINCT result) AS results
    FROM executions WHERE status = 'ok' GROUP BY run, programs HAVING min(result) < max(result)
),
judged AS (
    SELECT e.run, e.programs, max(CASE v.verdict WHEN 'identical' THEN 0 WHEN 'equal' THEN 1 WHEN 'within tolerance' THEN 2
        ELSE 3 END) AS worst
    FROM verdicts v JOIN executions e ON e.execution = v.execution GROUP BY e.run, e.programs
)
SELECT s.*, CASE j.worst WHEN 0 THEN 'identical' WHEN 1 THEN 'equal' WHEN 2 THEN 'within tolerance' WHEN 3 THEN 'different'
    END AS verdict
FROM several s LEFT JOIN judged j USING (run, programs)
"""
DEFINED = {"counting": COUNTING, "nondeterminism": NONDETERMINISM}


COUNTED = """
SELECT run, c.execution AS execution, c.judgement AS judgement
FROM (SELECT run, arg_max({'execution': execution, 'judgement': judgement}, lamport) AS c FROM counting GROUP BY run)
"""
"""A run's execution that counts for the batch last asked for, and the judgement of it."""


def _value(axis: str) -> str:
    """An axis's value in an experiment; a controller or a scenario may be that of the whole batch."""
    return f"coalesce(x.{axis}, b.{axis})" if axis in ("controller", "scenario") else f"x.{identifier(axis)}"


def _only(column: str) -> str:
    """The one value that a column has in a group, or NULL where it has several."""
    return f"CASE WHEN min({column}) = max({column}) THEN max({column}) END"


def _pick(column: str, first: str | None) -> str:
    """One of several records of the same: the first, where that can be told. What is not asked for is not read."""
    name = identifier(column)
    return f"any_value({name})" if first is None else f"min({name})" if column == first else f"arg_min({name}, {first})"


def files_with(files: Sequence[str], judgements: str, column: str = "execution") -> str:
    """The statement for which of these files have a row of one of the judgements that a query gives."""
    return f"SELECT DISTINCT filename FROM {read_parquet(files, filename=True)} WHERE {column} IN ({judgements})"


def recording(run: Callable[[str], list[tuple[Any, ...]]], segments: Sequence[Segment], judgements: str) -> list[Segment]:
    """Return the segments in which judgements are recorded that a query gives: with their executions, or made anew."""
    found: set[str] = set()
    for name, column in (("executions", "execution"), ("judgements", "judgement")):
        files = {segment.files[name]: segment.name for segment in segments if name in segment.files}
        if files:
            found |= {files[row[0]] for row in run(files_with(list(files), judgements, column))}
    return [segment for segment in segments if segment.name in found]


def records(name: str, files: Sequence[str], *, filename: bool = False) -> str:
    """Return the relation of files of records, whatever columns they have; what older ones do not have is NULL.

    DuckDB takes twice as long to prepare it as without a schema.
    """
    schema = {column.name: column.type for column in RECORDED[name].columns} if name in LATER else None
    return read_parquet(files, union=name == "experiments", schema=schema, filename=filename)


NAMED = re.compile(
    r'(?:\b(?:from|join|describe|summarize|table|show)\b|[,(])\s*(?:"((?:[^"]|"")+)"|([^\W\d]\w*))', re.IGNORECASE
)
ALL = re.compile(r"\b(?:show\s+(?:all\s+)?tables|information_schema|duckdb_\w+|pragma\w*)\b", re.IGNORECASE)


def tables_of(text: str) -> set[str] | None:
    """What a statement may name as tables, in lower case (some of it is none); None where it may be all."""
    if ALL.search(text):
        return None
    return {(quoted.replace('""', '"') or plain).lower() for quoted, plain in NAMED.findall(text)}

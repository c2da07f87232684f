"""The schema of the store's tables: each column with its type, its unit and its description.

`sierra schema` prints this schema, `schemas/store.sql` is generated from it, and every segment is written with it.
The tables of the runs' own outputs are not here: the runs define their columns.
"""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime
from enum import Enum
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple, get_args

from sierra.store import row_types
from sierra.store.row_mapper import without_facts
from sierra.store.row_types import ROWS, Of, Redaction
from sierra.util.lazy_definitions import dataclass

if TYPE_CHECKING:
    import pyarrow as pa


@dataclass(frozen=True, slots=True)
class Column:
    name: str
    type: str
    meaning: str
    unit: str = ""
    facts: tuple[Enum, ...] = ()
    """The further facts: see `sierra.store.row_types`."""

    @property
    def redaction(self) -> Redaction | None:
        """The way in which anonymous packages show its values; None for a column of texts without a decision."""
        default = {TEXT: None, "VARCHAR[]": None, TIME: Redaction.TIME}.get(self.type, Redaction.KEEP)
        return next((fact for fact in self.facts if isinstance(fact, Redaction)), default)


@dataclass(frozen=True, slots=True)
class Table:
    name: str
    meaning: str
    columns: tuple[Column, ...]


ID, TEXT, INT, TIME = "VARCHAR", "VARCHAR", "BIGINT", "TIMESTAMP WITH TIME ZONE"
TYPES = {str: TEXT, int: INT, float: "DOUBLE", bool: "BOOLEAN", datetime: TIME, list[str]: "VARCHAR[]", bytes: "BLOB"}
"""The SQL type of a column by the Python type of its values."""


def _table(name: str, meaning: str, *columns: tuple[str, str, str] | tuple[str, str, str, str]) -> Table:
    return Table(name, meaning, tuple(Column(*column) for column in columns))


def _recorded(name: str, row: type[NamedTuple]) -> Table:
    columns = []
    for column, hint in row.__annotations__.items():
        plain = without_facts(hint)
        kind = next(each for each in (plain, *get_args(plain)) if each in TYPES)
        said = list(_said(hint))
        texts = [fact for fact in said if isinstance(fact, str)]
        facts = tuple(fact for fact in said if isinstance(fact, Enum))
        columns.append(Column(column, TYPES[kind], texts[0], " ".join(texts[1:]), facts))
    return Table(name, " ".join(str(row.__doc__).split()), tuple(columns))


def _said(hint: Any) -> Iterator[object]:
    """Yield all that an annotation says beside the type, also within it."""
    for inner in get_args(hint):
        yield from (inner,) if isinstance(inner, str | Enum) else _said(inner)


RECORDED = {name: _recorded(name, row) for name, row in ROWS.items()}
"""The tables that are written, by name."""

LATER: dict[str, tuple[str, ...]] = {
    name: later
    for name, table in RECORDED.items()
    if (later := tuple(column.name for column in table.columns if row_types.LATER in column.facts))
}
"""By table, the last columns that were added within this format: older files lack them, and their values are NULL there."""
STAMPED = tuple(name for name, table in RECORDED.items() if any(column.name == "lamport" for column in table.columns))
"""The tables whose records have a position in the logical order."""
OUTPUTS = "output"
"""The name that stands for all tables that runs wrote. Their rows belong to judgements, in the column `execution`."""


def columns_with(*facts: Enum) -> dict[str, tuple[str, ...]]:
    """Return the columns with any of these facts, by table."""
    found: dict[str, tuple[str, ...]] = {OUTPUTS: ("execution",)} if Of.JUDGEMENT in facts else {}
    for name, table in RECORDED.items():
        if columns := tuple(column.name for column in table.columns if not set(facts).isdisjoint(column.facts)):
            found[name] = columns
    return found


PACKAGES = ("packages", "VARCHAR[]", "packages in which the execution came, as in imported_sessions; NULL if it was made here")

DERIVED = {
    table.name: table
    for table in (
        _table(
            "runs",
            "Runs, one row each; the independent variables are further columns.",
            ("run", ID, "the run's id"),
            ("seed", INT, "its seed"),
            ("number", INT, "its number in its experiment, from 0; the smallest number if it belongs to several experiments"),
            ("input", ID, "SHA-256 of its first input file; the file itself is in objects"),
            ("spec", ID, "the specification that it shares with other runs"),
            (
                "status",
                TEXT,
                "ok or accepted if it has an effective execution; otherwise the status of its last execution (stale if that is "
                "ok or accepted); missing if there is none",
            ),
            (
                "outcome",
                TEXT,
                "success, or the end that [success] accept names, such as exit 3; NULL without an effective execution",
            ),
            (
                "execution",
                ID,
                "its effective execution in the batch that was submitted last; batches that were executed here come first",
            ),
            ("executions", INT, "number of its executions, without captures", "1"),
        ),
        _table(
            "effective",
            "The effective execution of each run in each batch: the last one with a result by the programs and rules of the "
            "batch's last session. Statistics, figures and outputs use no other execution. If a batch was executed here, only "
            "executions that were made here count in it; otherwise only those of the package that was imported first.",
            ("batch", ID, "the batch"),
            ("ordinal", INT, "the experiment's position in the batch, from 0"),
            ("run", ID, "the run"),
            ("execution", ID, "the execution"),
            ("judgement", ID, "the effective judgement of that execution, as in all_judgements"),
            ("submitted", TIME, "when the batch was last submitted"),
            ("lamport", INT, "position of that session in the logical order, as in sessions"),
            ("outcome", TEXT, "success, or the end that [success] accept names, such as exit 3"),
        ),
        _table(
            "ended",
            "The execution of each run in each batch that a replay repeats: the effective one or, if there is none, the last "
            "one with the programs and rules of the batch's last session whose program has ended with an error.",
            ("batch", ID, "the batch"),
            ("ordinal", INT, "the experiment's position in the batch, from 0"),
            ("run", ID, "the run"),
            ("execution", ID, "the execution"),
            ("judgement", ID, "the judgement of that execution, as in all_judgements"),
            ("status", TEXT, "its status by this judgement"),
        ),
        _table(
            "all_judgements",
            "All judgements of executions: the first, made when the execution was recorded, and later ones by changed rules.",
            ("judgement", ID, "the judgement; the first one has the id of its execution"),
            ("judged_at", TIME, "when it was evaluated"),
            ("place", INT, "its position in the logical order; the first judgement has the position of its execution"),
            *(
                (column.name, column.type, f"{column.meaning}; by this judgement", column.unit)
                if column.name in ("status", "reason", "ingest_rules")
                else (column.name, column.type, column.meaning, column.unit)
                for column in RECORDED["executions"].columns
            ),
            PACKAGES,
        ),
        _table(
            "all_candidates",
            "All judgements of executions, by the run that they may count for: their own run, and each run for which a session "
            "reused them.",
            ("reusing", ID, "the session that reused the execution (see reused_executions); NULL for its own run"),
            ("judgement", ID, "the judgement, as in all_judgements"),
            ("judged_at", TIME, "when it was evaluated"),
            ("place", INT, "its position in the logical order, as in all_judgements"),
            *(
                (column.name, column.type, "the run that it may count for" if column.name == "run" else column.meaning)
                for column in RECORDED["executions"].columns
            ),
            PACKAGES,
        ),
        _table(
            "all_sessions",
            "All sessions, those included that stand beside others: sessions that came in packages, of batches that were also "
            "executed here or came in an earlier package. The table sessions does not have these.",
            *((column.name, column.type, column.meaning, column.unit) for column in RECORDED["sessions"].columns),
        ),
        _table(
            "all_trials",
            "All remarks on supervised executions, also those that later ones replace. The table trials has the last ones.",
            *((column.name, column.type, column.meaning, column.unit) for column in RECORDED["trials"].columns),
        ),
        _table(
            "origins",
            "Batches with imported sessions, and the origin that counts in each: this store, or a package.",
            ("batch", ID, "the batch"),
            ("packages", "VARCHAR[]", "packages as in imported_sessions; NULL if executions that were made here count"),
        ),
        _table(
            "all_artifacts",
            "Artifacts by each judgement; the table artifacts has only those by the last judgement.",
            ("execution", ID, "the judgement"),
            *((column.name, column.type, column.meaning, column.unit) for column in RECORDED["artifacts"].columns[1:]),
        ),
        _table(
            "nondeterminism",
            "Runs whose output changed between successful executions with the same programs, replays included and imported "
            "executions not.",
            ("run", ID, "the run"),
            ("programs", ID, "fingerprint of the programs"),
            ("executions", INT, "successful executions with these programs", "1"),
            ("results", INT, "number of different results", "1"),
            (
                "verdict",
                TEXT,
                "the worst verdict of a replay (equal, within tolerance: by the declared rules); NULL if only bytes are known",
            ),
        ),
        _table(
            "robot_clocks",
            "Clocks of robots. A robot's stamp (ns since 1970-01-01 UTC) becomes one of the submitting host: "
            "stamp - offset_ns - round(drift * (stamp - clock_ns))::BIGINT",
            ("execution", ID, "the execution"),
            ("place", INT, "the robot's place in the run, as in robots"),
            ("clock_ns", INT, "its clock when the first offset was measured", "ns"),
            ("offset_ns", INT, "its clock minus the clock of the submitting host at that time", "ns"),
            (
                "drift",
                "DOUBLE",
                "how much the offset grows per second of its clock; NULL without a second measurement, and with a remark",
                "s/s",
            ),
            (
                "uncertainty_ns",
                "DOUBLE",
                "largest error of converted stamps: half of the round-trip time of the measurements, and how unevenly both "
                "clocks have moved between them; NULL if there is only one measurement",
                "ns",
            ),
            ("remark", TEXT, "why stamps cannot be converted: a clock was set during the run; NULL if they can"),
        ),
        _table(
            "points",
            "Runs with the values of the independent variables, which are further columns. A run that belongs to experiments "
            "with different values of one variable has a row for each value.",
            ("run", ID, "the run"),
            ("number", INT, "its smallest number in its experiments, from 0"),
        ),
    )
}

WITHOUT_AXES = ("origins", "robot_clocks")
"""Tables that are read together with those that have the axes, so that their columns may have the names of axes."""

RESERVED = frozenset(
    (
        "batch",
        "experiment",
        "run",
        "number",
        "seed",
        "execution",
        "row",
        "file",
        "session",
        "ordinal",
        "runs",
        "succeeded",
        "failed",
    )
) | {
    column.name
    for table in DERIVED.values()
    if not table.name.startswith("all_") and table.name not in WITHOUT_AXES
    for column in table.columns
}
"""Names that are not allowed for axes, because a column of the store has them."""

BESIDE_OUTPUTS = frozenset(("run", "execution", "file", "number", "filename", "file_row_number"))
"""Names that output columns cannot have in the store; such a column gets a trailing underscore."""

TABLE_NAMES = frozenset(RECORDED) | frozenset(DERIVED)


def check_name(name: str) -> bool:
    """Check that an output may have this name: it must not hide a table of the store; case is ignored."""
    return name.lower() not in TABLE_NAMES


@cache
def arrow_schema(name: str) -> pa.Schema:
    """Return a recorded table's schema."""
    import pyarrow as pa

    types = {
        "VARCHAR": pa.string(),
        "BIGINT": pa.int64(),
        "DOUBLE": pa.float64(),
        "BOOLEAN": pa.bool_(),
        "TIMESTAMP WITH TIME ZONE": pa.timestamp("us", tz="UTC"),
        "VARCHAR[]": pa.list_(pa.string()),
        "BLOB": pa.large_binary(),
    }
    return pa.schema([(column.name, types[column.type]) for column in RECORDED[name].columns])


def sql_types(name: str) -> dict[str, str]:
    """Return the columns of a recorded table with their SQL types."""
    return {column.name: column.type for column in RECORDED[name].columns}


def is_table(name: str, schema: pa.Schema) -> bool:
    """Check if a file with this Arrow schema holds the columns of a recorded table: all of them, or an older version's."""
    found = [(field.name, _sql_type(field.type)) for field in schema]
    whole = [*sql_types(name).items()]
    older = len(whole) - len(LATER.get(name, ()))
    return any(found == whole[:end] for end in range(older, len(whole) + 1))


def _sql_type(kind: pa.DataType) -> str:
    """Return DuckDB's name of an Arrow type. DuckDB and pyarrow write the same column with different Arrow types."""
    from pyarrow import types

    if types.is_list(kind):
        return f"{_sql_type(kind.value_type)}[]"
    if types.is_timestamp(kind):
        return TIME if kind.tz == "UTC" and kind.unit == "us" else str(kind)
    names = {"string": TEXT, "int64": INT, "double": "DOUBLE", "bool": "BOOLEAN", "binary": "BLOB", "large_binary": "BLOB"}
    return names.get(str(kind), str(kind))


def sql() -> str:
    """Return the whole schema as SQL with comments: the content of `schemas/store.sql`."""
    parts = []
    for table in (*RECORDED.values(), *DERIVED.values()):
        lines = [f"-- {table.meaning}", f"CREATE TABLE {table.name} ("]
        for column in table.columns:
            unit = f" [{column.unit}]" if column.unit else ""
            comma = "" if column is table.columns[-1] else ","
            lines.append(f'    "{column.name}" {column.type}{comma}  -- {column.meaning}{unit}')
        parts.append("\n".join([*lines, ");"]))
    return "\n\n".join(parts) + "\n"

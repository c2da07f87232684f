"""Find the tables, functions and samples that an SQL statement uses, by DuckDB's own parser: nothing is guessed."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from sierra.errors import SqlError
from sierra.store.sql_names import identifier
from sierra.store.statement_worker import kind
from sierra.util.json_types import Json
from sierra.util.lazy_definitions import dataclass, field
from sierra.util.text import half_character

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

MAKING_ROWS = frozenset(("range", "generate_series", "unnest", "repeat", "repeat_row", "json_each", "json_tree"))
"""The table functions that use nothing but their arguments."""
DESCRIBING = ("duckdb_", "pragma_", "parquet_", "read_parquet", "icu_", "pg_", "summary", "test_")
"""The beginnings of the names of table functions that describe the connection, or read the store's files."""
MISLABELLED = frozenset((("current_localtime", 0), ("current_localtimestamp", 0), ("age", 1)))
"""Functions of the current time that DuckDB's catalogue calls consistent, with their numbers of arguments."""
HARMLESS = frozenset(("error", "make_timestamptz", "timezone"))
"""Functions that DuckDB's catalogue calls volatile, but that have no result, or depend on the time zone only, which is UTC."""
ZONED = ("TIMESTAMP WITH TIME ZONE", "TIMESTAMPTZ_NS")
"""Types of arguments with which functions, such as `+`, depend on the time zone, so that the catalogue calls them volatile."""


@dataclass(slots=True)
class Used:
    """The tables and functions that one statement uses. Names are in lower case, without schemas."""

    tables: dict[str, str] = field(default_factory=dict)
    """Tables after FROM, except those that the statement itself defines (WITH), as they are spelled."""
    schemas: list[str] = field(default_factory=list)
    """Names of tables that are written with a schema, as they are spelled."""
    calls: set[tuple[str, int]] = field(default_factory=set)
    """Functions with their numbers of arguments."""
    table_functions: dict[str, None] = field(default_factory=dict)
    names: set[str] = field(default_factory=set)
    """Names without a dot where columns may be; some are functions, such as `current_timestamp`."""
    sampled: bool = False
    """True if a sample has no seed."""
    ordered: bool = False
    """True if the statement itself orders its rows."""


def used(connection: DuckDBPyConnection, text: str) -> Used:
    """Return what one SELECT statement uses. Raises SqlError for text that is no such statement."""
    answer = _json(connection, "json_serialize_sql", text)
    if answer.get("error"):
        raise SqlError(_problem(connection, text, answer))
    statements = answer["statements"]
    if not isinstance(statements, list) or len(statements) != 1:
        raise SqlError(f"use one statement; this is {len(statements) if isinstance(statements, list) else 0}")
    used_parts = Used()
    whole = statements[0]
    node = whole.get("node") if isinstance(whole, dict) else None
    modifiers = node.get("modifiers") if isinstance(node, dict) else None
    used_parts.ordered = any(
        isinstance(modifier, dict) and modifier.get("type") == "ORDER_MODIFIER"
        for modifier in (modifiers if isinstance(modifiers, list) else ())
    )
    _walk(node, frozenset(), used_parts)
    return used_parts


def kinds(connection: DuckDBPyConnection, text: str) -> list[str]:
    """Return the names of the types of the statements in a text. Raises SqlError."""
    return [kind(statement) for statement in connection.extract_statements(checked(text))]


def checked(text: str) -> str:
    """Return a text that DuckDB can have. Raises SqlError for half of a character, as UTF-16 and names of files have it."""
    if found := half_character(text):
        raise SqlError(f"the text has {found!r}, which is no character of UTF-8")
    return text


def check_describes(connection: DuckDBPyConnection, text: str) -> None:
    """Check that a statement calls no table function that acts: writes logs, executes other statements. Raises SqlError."""
    for name in used(connection, text).table_functions:
        if name not in MAKING_ROWS and not name.startswith(DESCRIBING):
            raise SqlError(f"the function {name}() is not allowed here; statements can only read the store's tables")


def check_repeatable(connection: DuckDBPyConnection, found: Used) -> None:
    """Check that a statement gives the same rows each time, and reads nothing but tables. Raises SqlError."""
    for name in found.table_functions:
        if name not in MAKING_ROWS:
            raise SqlError(f"the function {name}() is not allowed here; read tables of the store, not files or settings")
    if found.sampled:
        raise SqlError("a sample without a seed gives other rows each time; add REPEATABLE (1) to it")
    if (function := _volatile(connection, found)) is not None:
        raise SqlError(f"{function} gives another value each time; use columns of the store's tables instead")


def check_condition(connection: DuckDBPyConnection, text: str) -> None:
    """Check that a condition on columns uses no table, and has the same result each time. Raises SqlError."""
    whole = f"SELECT 1 WHERE (\n{text}\n)"
    answer = _json(connection, "json_serialize_sql", whole)
    if answer.get("error") or not _is_condition(answer):
        raise SqlError(f"it is no SQL condition: {answer.get('error_message', 'there is more than a condition')}")
    found = used(connection, whole)
    if named := [*found.tables.values(), *found.schemas]:
        raise SqlError(f"a condition uses columns only, not the table {named[0]!r}; use a derived table")
    check_repeatable(connection, found)


def _is_condition(answer: Mapping[str, Json]) -> bool:
    """Return whether a parsed statement has nothing but a condition: a text with brackets could add parts of its own."""
    match answer.get("statements"):
        case [{"node": {"type": "SELECT_NODE", "modifiers": [], **rest}}]:
            return not any(rest.get(part) for part in ("group_expressions", "having", "qualify", "sample"))
    return False


def _json(connection: DuckDBPyConnection, function: str, text: str) -> Mapping[str, Json]:
    options = ", optimize := false" if function == "json_serialize_plan" else ""
    rows = connection.execute(f"SELECT {function}($text{options})", {"text": checked(text)}).fetchall()
    try:
        found: Mapping[str, Json] = json.loads(rows[0][0])
    except RecursionError as error:
        raise SqlError("the statement has too many levels of nesting") from error
    return found


def _problem(connection: DuckDBPyConnection, text: str, answer: Mapping[str, Json]) -> str:
    """Return why DuckDB cannot parse a statement, with the place; or that it is no SELECT statement."""
    position = answer.get("position")
    if isinstance(position, str) and position.isdecimal():
        before = text[: int(position)]
        line, column = before.count("\n") + 1, len(before) - (before.rfind("\n") + 1) + 1
        return f"{answer.get('error_message')} (line {line}, column {column})"
    if answer.get("error_type") == "not implemented":
        named = kinds(connection, text)
        return (
            "a PIVOT needs IN with its values" if named == ["MULTI"] else f"{named[0]} statements are not allowed; use SELECT"
        )
    return " ".join(str(answer.get("error_message")).split())


def _walk(node: Json, defined: frozenset[str], used_parts: Used) -> None:
    """Add what a part of the parsed statement uses. `defined`: the names that WITH defines around it."""
    if isinstance(node, list):
        for part in node:
            _walk(part, defined, used_parts)
    if not isinstance(node, dict):
        return
    inside = defined
    for name, query in _definitions(node):
        own = inside | {name} if isinstance(query, dict) and query.get("type") == "RECURSIVE_CTE_NODE" else inside
        _walk(query, own, used_parts)
        inside = inside | {name}
    _note(node, inside, used_parts)
    for key, part in node.items():
        if key != "cte_map":
            _walk(part, inside, used_parts)


def _definitions(node: Mapping[str, Json]) -> Iterator[tuple[str, Json]]:
    """Yield the names that WITH defines here, in lower case, with their queries."""
    within = node.get("cte_map")
    entries = within.get("map") if isinstance(within, dict) else None
    for entry in entries if isinstance(entries, list) else ():
        if isinstance(entry, dict) and isinstance(value := entry.get("value"), dict):
            yield str(entry.get("key")).lower(), value.get("query_node")


def _note(node: Mapping[str, Json], defined: frozenset[str], used_parts: Used) -> None:
    """Add what one part uses itself, without its own parts."""
    sample = node.get("sample")
    if isinstance(sample, dict) and not sample.get("repeatable"):
        used_parts.sampled = True
    match node.get("type"):
        case "BASE_TABLE":
            name = str(node.get("table_name"))
            if node.get("schema_name") or node.get("catalog_name"):
                used_parts.schemas.append(".".join(map(str, filter(None, (node.get("schema_name"), name)))))
            elif name.lower() not in defined:
                used_parts.tables.setdefault(name.lower(), name)
        case "TABLE_FUNCTION" if isinstance(called := node.get("function"), dict):
            used_parts.table_functions.setdefault(_name(called))
        case "FUNCTION":
            arguments = node.get("arguments", node.get("children"))
            used_parts.calls.add((_name(node), len(arguments) if isinstance(arguments, list) else 0))
        case "COLUMN_REF" if isinstance(names := node.get("column_names"), list) and len(names) == 1:
            used_parts.names.add(str(names[0]).lower())


def _name(called: Mapping[str, Json]) -> str:
    return str(called.get("function_name")).lower()


def _volatile(connection: DuckDBPyConnection, used_parts: Used) -> str | None:
    """Return a function whose result differs between executions; None if there is none.

    DuckDB's catalogue says which functions these are. A macro is volatile if its definition is.
    """
    volatile, macros = _catalogue(connection)
    queue = sorted(_all_calls(connection, used_parts))
    seen = set(queue)
    while queue:
        name, arguments = queue.pop(0)
        if name in volatile or (name, arguments) in MISLABELLED:
            return f"{name}()"
        for definition in macros.get(name, ()):
            more = _all_calls(connection, used(connection, f"SELECT {definition}")) - seen
            queue += sorted(more)
            seen |= more
    return None


def _all_calls(connection: DuckDBPyConnection, found: Used) -> set[tuple[str, int]]:
    """Return the functions that a statement calls, with or without parentheses."""
    return found.calls | {(function, 0) for name in found.names if (function := _value_function(connection, name))}


_kept: list[tuple[frozenset[str], Mapping[str, Sequence[str]]]] = []
"""The answer of `_catalogue`, which is the same for all connections; reading the catalogue takes longer than most queries."""


def _catalogue(connection: DuckDBPyConnection) -> tuple[frozenset[str], Mapping[str, Sequence[str]]]:
    """Return the names of the functions that are volatile by DuckDB's catalogue, and the definitions of macros by name."""
    if not _kept:
        rows = connection.execute(
            "SELECT function_name, bool_or(stability <> 'CONSISTENT' AND NOT list_has_any(parameter_types, $zoned)), "
            "list(DISTINCT macro_definition) FILTER (function_type = 'macro') FROM duckdb_functions() "
            "WHERE stability <> 'CONSISTENT' OR function_type = 'macro' GROUP BY function_name",
            {"zoned": ZONED},
        ).fetchall()
        volatile = frozenset(name for name, is_volatile, _ in rows if is_volatile) - HARMLESS
        _kept.append((volatile, {name: definitions for name, _, definitions in rows if definitions}))
    return _kept[0]


def _value_function(connection: DuckDBPyConnection, name: str) -> str | None:
    """Return the function that a name without parentheses calls if there is no such column; None if it calls none."""
    answer = _json(connection, "json_serialize_plan", f"SELECT {identifier(name)}")
    if answer.get("error"):
        return None
    return next(_functions_of_plan(answer.get("plans")), None)


def _functions_of_plan(node: Json) -> Iterator[str]:
    """Yield the names of the functions in a plan."""
    if isinstance(node, list):
        for part in node:
            yield from _functions_of_plan(part)
    elif isinstance(node, dict):
        name = node.get("qname")
        if isinstance(name, dict) and isinstance(path := name.get("path"), list) and path:
            yield str(path[-1]).lower()
        for part in node.values():
            yield from _functions_of_plan(part)

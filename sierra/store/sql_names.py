"""SQL literals, SQL identifiers, and column names of outputs."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence

from sierra.store.schema import BESIDE_OUTPUTS

LOWER = "_lower"
UPPER = "_upper"
"""The ends of the names of columns that differ only in upper and lower case."""


def quote(text: str) -> str:
    """Return a text as an SQL literal."""
    return "'" + text.replace("'", "''") + "'"


def identifier(name: str) -> str:
    """Return a name as an SQL identifier."""
    return '"' + name.replace('"', '""') + '"'


def column_names(names: Sequence[str], taken: Iterable[str] = BESIDE_OUTPUTS) -> tuple[str, ...]:
    """Return the names of an output's columns in the store; they are unique without regard to case."""
    seen = {name.lower() for name in taken}
    kept = []
    for number, name in enumerate(names):
        free = name or f"column{number}"
        while free.lower() in seen:
            free += "_"
        seen.add(free.lower())
        kept.append(free)
    return tuple(kept)


def stored_names(names: Sequence[str], taken: Iterable[str] = BESIDE_OUTPUTS) -> tuple[str, ...]:
    """Return the names in the store of the columns of a file.

    Names that differ only in upper and lower case get suffixes that tell them apart in whatever order they are: `t` and `T` are
    `t_lower` and `T_upper`.
    """
    doubled = {lower for spelled in differing_by_case(names) for lower in map(str.lower, spelled)}
    return column_names([name + _case(name) if name.lower() in doubled else name for name in names], taken)


def differing_by_case(names: Iterable[str]) -> list[list[str]]:
    """Return the names that differ from others only in upper and lower case, those that are alike together."""
    spelled: dict[str, dict[str, None]] = {}
    for name in names:
        spelled.setdefault(name.lower(), {})[name] = None
    return [list(alike) for alike in spelled.values() if len(alike) > 1]


def stored_name(name: str, stored: Collection[str]) -> str:
    """Return the name in the store of the column that a file calls `name`, among those of its table; else `name` itself."""
    if name in stored:
        return name
    called = (one for bare in dict.fromkeys((name, unmarked(name))) for one in (bare + _case(bare), bare))
    return next((one for one in called if one in stored), name)


def _case(name: str) -> str:
    """Return the suffix that tells a name from others that differ only in upper and lower case."""
    if name == name.lower():
        return LOWER
    places = "_".join(str(place) for place, letter in enumerate(name, 1) if letter != letter.lower())
    return UPPER if name == name.upper() else f"{UPPER}_{places}"


def unmarked(name: str) -> str:
    """Return a name without the mark of a comment before it: `# t` and `%t` are `t`; `# of cars` and `#` stay.

    Programs mark the line of column names as a comment, for example `numpy.savetxt`.
    """
    bare = name.lstrip("#%").lstrip()
    return bare if bare and bare != name and not bare.lower().startswith("of ") else name


def row_name(taken: Iterable[str]) -> str:
    """Return the name of the column with the number of the row; another one if an output or a variable has the usual name."""
    names = tuple(taken)
    usual, other = column_names(("row", "row_number"), names)
    return usual if usual == "row" else other


def unnested(columns: Mapping[str, str]) -> str:
    """Return the query whose parameters are the values of each column, as lists. `columns`: their SQL types by name."""
    names = (f"unnest(${place}::{kind}[]) AS {identifier(name)}" for place, (name, kind) in enumerate(columns.items(), 1))
    return f"SELECT {', '.join(names)}"


def node_name(name: str) -> str:
    """Return the SQL of the name of a network's node in a column: a whole number without `.0`, and no name for NaN."""
    column = identifier(name)
    number = f"CASE WHEN isfinite(TRY_CAST({column} AS DOUBLE)) THEN regexp_replace({column}::VARCHAR, '\\.0$', '') END"
    return f"CASE WHEN typeof({column}) IN ('DOUBLE', 'FLOAT') THEN {number} ELSE {column}::VARCHAR END"

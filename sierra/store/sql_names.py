"""SQL literals, SQL identifiers, and column names of outputs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from sierra.store.schema import BESIDE_OUTPUTS


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


def row_name(taken: Iterable[str]) -> str:
    """Return the name of the column with the number of the row; another one if an output or a variable has the usual name."""
    names = tuple(taken)
    usual, other = column_names(("row", "row_number"), names)
    return usual if usual == "row" else other


def unnested(columns: Mapping[str, str]) -> str:
    """Return the query whose parameters are the values of each column, as lists. `columns`: their SQL types by name."""
    names = (f"unnest(${place}::{kind}[]) AS {identifier(name)}" for place, (name, kind) in enumerate(columns.items(), 1))
    return f"SELECT {', '.join(names)}"

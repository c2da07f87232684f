"""Names in SQL: texts and identifiers as statements hold them, and what columns of outputs are called."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from sierra.store.schema import BESIDE_OUTPUTS


def quote(text: str) -> str:
    """A text as an SQL literal."""
    return "'" + text.replace("'", "''") + "'"


def identifier(name: str) -> str:
    """A name as an SQL identifier."""
    return '"' + name.replace('"', '""') + '"'


def column_names(names: Sequence[str], taken: Iterable[str] = BESIDE_OUTPUTS) -> tuple[str, ...]:
    """The names that the columns of a run's output have in the store, where case makes no difference."""
    seen = {name.lower() for name in taken}
    kept = []
    for number, name in enumerate(names):
        free = name or f"column{number}"
        while free.lower() in seen:
            free += "_"
        seen.add(free.lower())
        kept.append(free)
    return tuple(kept)

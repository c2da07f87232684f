"""The list of objects in a JSON document that probably has its rows, and the keys of `[outputs.NAME]` that read it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from sierra.ingest.base import UnreadableError
from sierra.ingest.json_rows import DOT, parsed
from sierra.util.text import toml_value

DEEPEST = 6
"""The largest number of keys that lead to a list."""
LOOKED_AT = 20
"""The number of objects of a list that are looked at for lists within them."""


def keys_of(content: bytes) -> Mapping[str, str] | None:
    """Return `rows` and `unnest` for the longest list of objects in a document; None if it has no such list."""
    try:
        document = parsed(content)
    except UnreadableError:
        return None
    lists = sorted(_lists(document, ()), key=lambda pair: -len(pair[1]))
    if not lists:
        return None
    path, items = lists[0]
    rows = {"rows": DOT.join(path)} if path else {}
    within = [".".join(inner) for inner, _ in _lists(items[0], ()) if all(_has_list(item, inner) for item in items[:LOOKED_AT])]
    return rows | ({"unnest": within[0]} if len(within) == 1 else {})


def in_words(keys: Mapping[str, object]) -> str:
    """Return keys as they are written in `sierra.toml`."""
    return ", ".join(f"{name} = {toml_value(value)}" for name, value in keys.items())


def _lists(value: object, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], list[object]]]:
    """Yield the lists of objects in objects, each with the keys that lead to it; no list in a list."""
    if isinstance(value, list) and value and all(isinstance(item, dict) for item in value):
        yield path, value
    elif isinstance(value, dict) and len(path) < DEEPEST:
        for key, inner in value.items():
            if DOT not in key:  # it could not be told from two keys
                yield from _lists(inner, (*path, key))


def _has_list(item: object, path: tuple[str, ...]) -> bool:
    for key in path:
        item = item.get(key) if isinstance(item, dict) else None
    return isinstance(item, list)

"""Types of the columns of many files, so that files of the same types are read together."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence

from sierra.ingest.model import Found, Written
from sierra.store.type_inference import AS_TEXT, EMPTY, is_whole, kind_of


def alike(files: Sequence[Written], kept: Found, apart: Collection[str] = ()) -> list[list[Written]]:
    """Return the files grouped by the kinds of their columns; a column without values joins the most frequent kind.

    `apart`: the columns in which whole numbers are kept separate from fractions, because DOUBLE cannot hold them.
    """

    def sort(name: str, kind: str) -> str:
        return "whole" if name in apart and is_whole(kind) else kind_of(kind)

    kinds = {name: {path: sort(name, kind) for path, kind in seen.items() if kind} for name, seen in kept.items()}
    mixed = {name: Counter(seen.values()) for name, seen in kinds.items() if len(set(seen.values())) > 1}
    most = {name: counts.most_common(1)[0][0] for name, counts in mixed.items()}
    sorts: dict[tuple[str, ...], list[Written]] = {}
    for file in files:
        sorts.setdefault(tuple(kinds[name].get(file.path, most[name]) for name in mixed), []).append(file)
    return sorted(sorts.values(), key=lambda some: -len(some))


def kinds_of(files: Sequence[Written], types: Mapping[str, str], found: Found, kept: Found) -> dict[str, dict[str, str]]:
    """Return the kind of each column in each file, marked if it is kept as text."""
    by_file = {}
    same: dict[tuple[str, ...], dict[str, str]] = {}
    for file in files:
        mine = {}
        for name in types:
            kind = found[name].get(file.path)
            as_text = kind not in (None, "VARCHAR") and kept[name].get(file.path) == "VARCHAR"
            mine[name] = kind_of(kind or EMPTY) + AS_TEXT * as_text
        by_file[file.path] = same.setdefault(tuple(mine.values()), mine)
    return by_file

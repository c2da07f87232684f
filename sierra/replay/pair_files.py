"""Pairs of files that are compared, if the names of an output's files are left open by a pattern such as `log_*.csv`.

The files of two executions are paired by the order of their names, because a name may have the time of the run in it. If a
pattern has names in braces, the numbers in their place say which files belong together. If the numbers of files differ, files
with the same name are paired first, and the files that are left over are missing or new.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from sierra.config.output_tables import Output
from sierra.ingest.match_outputs import claims
from sierra.store.row_types import ArtifactRow
from sierra.util.text import natural

Key = tuple[str, tuple[int, ...] | None]
"""An output, and the numbers in the name of one of its files."""
Artifacts = Mapping[str, ArtifactRow]


class Pairs(NamedTuple):
    """The files of a new execution by the keys of the recorded ones, and the reasons why some of both have no other."""

    found: Artifacts
    unpaired: Mapping[str, str]


def pair(recorded: Artifacts, replayed: Artifacts, declared: Mapping[str, Output]) -> Pairs:
    """Return the files in `found` with the keys of those in `recorded` that they are compared with."""
    if recorded.keys() == replayed.keys():
        return Pairs(replayed, {})
    groups, others = (_grouped(files, declared) for files in (recorded, replayed))
    keys: dict[str, str] = {}
    unpaired: dict[str, str] = {}
    for (name, numbers), old in groups.items():
        new = others.get((name, numbers), [])
        keys.update({theirs: ours for ours, theirs in paired(old, new)})
        if len(old) != len(new):
            file = declared[name].file
            reason = f"{len(old)} of the files {file!r} {'was' if len(old) == 1 else 'were'} recorded, {len(new)} found"
            unpaired |= dict.fromkeys((*old, *new), reason)
    return Pairs({keys.get(key, key): row for key, row in replayed.items()}, unpaired)


def paired(recorded: Sequence[str], found: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield the names that belong together, of files that match one pattern: by their order."""
    same = set(recorded) & set(found) if len(recorded) != len(found) else set()
    yield from ((name, name) for name in same)
    rest = (sorted((name for name in names if name not in same), key=natural) for names in (recorded, found))
    yield from zip(*rest, strict=False)


def _grouped(files: Artifacts, declared: Mapping[str, Output]) -> dict[Key, list[str]]:
    """Return the keys of the files whose names a pattern leaves open, by what the names say."""
    groups: dict[Key, list[str]] = {}
    for key, row in files.items():
        name = row.output if row.output in declared else next(iter(claims(declared, row.name)), None)
        if name is not None and has_open_names(declared[name]):
            numbers = declared[name].ticks_of(row.name) if declared[name].ticks else None
            groups.setdefault((name, numbers), []).append(key)
    return groups


def has_open_names(output: Output) -> bool:
    """Return whether an output's `file` is a pattern, so that its files have names of which nobody knows more."""
    return bool(output.ticks) or output.rotated or any(character in output.file for character in "*?[")

"""The segments of a store at one moment: those that an index names, which are not looked at, and all others."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

from sierra.store.segments import Segment, is_whole, listed, marked, names_in, out_of_date, sound


class Facts(NamedTuple):
    """The segments that an index names."""

    numbers: Mapping[str, int]
    """Their numbers in the index, by name."""
    ignored: frozenset[str]
    """The segments that were ignored when the index was built: it has none of their rows."""
    replacing: frozenset[str]
    """The segments that replace others."""
    replaced: frozenset[str]
    """The segments that these replace."""
    after: frozenset[str]
    """The segments that some of them wait for."""
    tables: Mapping[str, int]
    """The tables of records that have rows in the index, each with their number."""
    stored: frozenset[str]
    """The tables of results that the index holds (see `sierra.store.index_builder`)."""
    spellings: Mapping[str, str]
    """The tables that runs wrote, each with the names of the first segment that has it and of the file."""

    def are_sure(self, present: AbstractSet[str]) -> bool:
        """Return whether these existing segments, and no others, show which of the index's segments are current."""
        return present >= self.after and not any(name in self.replacing for name in self.numbers.keys() - present)


class Listing:
    """The current segments in some folders. `rest` are those that the index does not name; `facts` is None without an index."""

    def __init__(self, folders: Sequence[Path], facts: Facts | None = None, segments: Sequence[Segment] | None = None) -> None:
        """Look at the folders; with `facts`, there is one. `segments`: those to read, in place of the current ones.

        An index that cannot tell which of its segments are current is not used.

        Raises Damaged if a damaged or lost file may hide a segment, or a part of one.
        """
        self.folders = folders
        given = [segment.name for segment in segments or ()]
        self.names = given or [name for folder in folders for name in names_in(folder)]
        """The names of all existing segments, ignored or not."""
        self.without: frozenset[int] = frozenset()
        """The numbers of segments in the index that are not current any more."""
        self.facts = facts if facts is not None and facts.are_sure(set(self.names)) else None
        if segments is not None:
            self.rest = list(segments)
        elif self.facts is not None:
            self.rest, self.without = self._beside(self.facts, folders[0])
        else:
            self.rest = [segment for folder in folders for segment in listed(folder) if is_whole(segment, folder)]

    @cached_property
    def rewritten(self) -> bool:
        """True if some segments replace others."""
        return bool(self.facts and self.facts.replacing) or any(segment.replaces for segment in self.rest)

    def _beside(self, facts: Facts, folder: Path) -> tuple[list[Segment], frozenset[int]]:
        """Return the segments that the index does not name, and the numbers of its own that are not current any more."""
        present = set(self.names)
        gone = facts.numbers.keys() - present
        found = marked(folder, (name for name in self.names if name not in facts.numbers))
        hidden = out_of_date(found, present & facts.numbers.keys()) | (facts.replaced & present)
        rest = sound([segment for segment in found if segment.name not in hidden], folder)
        without = frozenset(facts.numbers[name] for name in (gone | (hidden & facts.numbers.keys())) - facts.ignored)
        return [segment for segment in rest if is_whole(segment, folder)], without

    @cached_property
    def segments(self) -> list[Segment]:
        """All current segments, in the order of their names. Raises Damaged."""
        if self.facts is None:
            return self.rest
        return self.named(self.names)

    def of_batches(self, batches: Iterable[str]) -> list[Segment]:
        """Return the current segments of batches, which the first 12 digits of their ids name. Raises Damaged."""
        wanted = set(batches)
        return self.named(name for name in self.names if name[:12] in wanted)

    def named(self, names: Iterable[str]) -> list[Segment]:
        """Return the current ones of the segments with these names, in the order of their names. Raises Damaged."""
        wanted = set(names)
        rest = [segment for segment in self.rest if segment.name in wanted]
        if self.facts is None:
            return rest
        numbers = self.facts.numbers
        indexed = sorted(name for name in wanted & numbers.keys() if self._is_current(name, numbers[name]))
        return sorted(rest + self._read(indexed), key=lambda segment: segment.name) if indexed else rest

    def _is_current(self, name: str, number: int) -> bool:
        return self.facts is not None and number not in self.without and name not in self.facts.ignored

    def _read(self, names: Iterable[str]) -> list[Segment]:
        folder = self.folders[0]
        return [segment for segment in sound(marked(folder, names), folder) if is_whole(segment, folder)]

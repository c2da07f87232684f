"""Tables of pairs: each two groups in each experiment, of which a claim that a test decides names some.

Two claims are on one table if the batches, the variable of the groups, and the value of each run are the same: output, column,
measure, threshold, and rows that count. The experiments, the groups and the method of a claim do not matter: they choose pairs
and a test from the table, and the correction of p values is for such choices. If a comparison of `sierra.toml` has the batches
of a claim among others, its table is that of the claim.
"""

from __future__ import annotations

import contextlib
import shlex
from collections.abc import Iterable, Iterator, Mapping
from math import comb
from typing import TypeAlias

from sierra.config.deliverable_tables import Comparison
from sierra.config.project_file import LoadedProject
from sierra.deliverables.claims.by_test import Asked, Family, cells_in_order, comparison_of
from sierra.deliverables.comparison import cells_of, runs_of_groups
from sierra.deliverables.run_statistics import RunTable
from sierra.errors import NotFound, QueryError, UsageError
from sierra.execution.batches_of_queries import BatchesOfQueries
from sierra.stats.comparison.model import Cell
from sierra.store.store import Store
from sierra.util.hashing import short
from sierra.util.lazy_definitions import dataclass

Key: TypeAlias = tuple[object, ...]
"""The parts that claims on one table have in common."""
PairId: TypeAlias = tuple[frozenset[tuple[str, object]], frozenset[str]]
"""A pair: the values of the variables that are not compared, and the two groups or batches."""
VALUES = ("table", "column", "measure", "threshold", "where")
"""The keys of a claim that say what the value of a run is."""


@dataclass(frozen=True, slots=True)
class Prepared:
    """A claim that can be tested: its runs, its cells, and its table of pairs."""

    asked: Asked
    runs: Mapping[str, RunTable]
    """The runs of each batch by its label."""
    cells: list[Cell]
    """The cells of the claim, with its groups in their order."""
    key: Key
    pairs: int
    """The number of pairs of its table."""
    named: frozenset[PairId]
    """The pairs that it names."""
    command: str
    """The command that compares all pairs of its table."""


class PairTables:
    """The tables of pairs of a project's claims. The runs of each are read once."""

    def __init__(self, project: LoadedProject, store: Store) -> None:
        self._project, self._store = project, store
        self._queries = BatchesOfQueries(project, store)
        self._runs: dict[Key, dict[str, RunTable]] = {}

    def prepared(self, asked: Asked, batches: Mapping[str, str]) -> Prepared:
        """Return a claim with its runs and its table; `batches` are those of the claim by label. Raises SierraError."""
        runs = self._runs_of(comparison_of(asked), batches)
        cells = cells_in_order(asked, runs)
        first = next(iter(runs.values()))
        name, every = self._declared(asked, batches, first)
        whole = comparison_of(asked).model_copy(update={"groups": (), "experiments": ""})
        try:
            _, all_cells, _, _ = cells_of(self._runs_of(whole, every), whole)
        except (NotFound, UsageError):  # the declared comparison is not possible
            name, every = "", dict(batches)
            _, all_cells, _, _ = cells_of(runs, whole)
        groups = {} if asked.by else batches
        key = (frozenset(every.values()), asked.by, first.output, first.column, first.measure, first.threshold, asked.where)
        pairs = sum(comb(len(cell.samples), 2) for cell in all_cells)
        named = frozenset(_pairs(cells, groups))
        return Prepared(asked, runs, cells, key, pairs, named, self._command(name, asked, every, first))

    def _runs_of(self, asked: Comparison, batches: Mapping[str, str]) -> dict[str, RunTable]:
        """Return the runs of all experiments of batches, by their labels."""
        runs: dict[str, RunTable] = {}
        for label, batch in batches.items():
            key = (batch, *(getattr(asked, name) for name in VALUES))
            if key not in self._runs:
                self._runs[key] = runs_of_groups(self._project, {"": self._store}, {"": batch}, asked)
            runs[label] = self._runs[key][""]
        return runs

    def _declared(self, asked: Asked, batches: Mapping[str, str], runs: RunTable) -> tuple[str, dict[str, str]]:
        """Return the name of the comparison in `sierra.toml` that has the pairs of a claim, "" if none has, and its batches."""
        own = set(batches.values())
        for name, declared in self._project.config.comparisons.items():
            if not _same_values(declared, runs, asked):
                continue
            if asked.by:
                by = declared.by or (() if declared.groups else runs.axes)
                chosen = not declared.groups or {*asked.groups} <= {*declared.groups}
                if by == (asked.by,) and chosen and (not declared.query or self._batches(declared.query) == own):
                    return name, dict(batches)
            elif declared.groups and not declared.by and own <= (others := self._batches(declared.groups)):
                labels = {batch: label for label, batch in batches.items()}
                return name, {labels.get(batch, batch): batch for batch in sorted(others)}
        return "", dict(batches)

    def _batches(self, words: Iterable[str]) -> set[str]:
        """Return the batches that words of a comparison name; none for a query that was not run."""
        batches: set[str] = set()
        for word in words:
            name = word.rpartition("=")[2]
            with contextlib.suppress(NotFound, QueryError):
                known = name in self._project.config.queries
                batches.add(self._queries.last(name) if known else self._store.batch_id(name))
        return batches

    def _command(self, name: str, asked: Asked, batches: Mapping[str, str], runs: RunTable) -> str:
        """Return the command that compares all pairs of a table; "" if only a comparison in `sierra.toml` could do it."""
        ids = [short(batch) for batch in batches.values()]
        if name:
            bound = self._project.config.comparisons[name].query or not asked.by
            return shlex.join(["sierra", "compare", name, *([] if bound else ids)])
        if asked.where:
            return ""
        options = ["--by", asked.by] if asked.by else []
        options += ["--table", runs.output, "--column", runs.column]
        options += ["--measure", asked.measure] if asked.measure else []
        options += ["--threshold", f"{asked.threshold:g}"] if asked.threshold is not None else []
        return shlex.join(["sierra", "compare", *ids, *options])


def _same_values(declared: Comparison, runs: RunTable, asked: Asked) -> bool:
    """Return whether a comparison is about the same value of each run as a claim."""
    return (
        declared.table in ("", runs.output)
        and declared.column in ("", runs.column)
        and declared.measure in (asked.measure, runs.measure)
        and (declared.threshold, declared.where) == (asked.threshold, asked.where)
        and declared.experiments in ("", asked.experiments)
        and not declared.over_time
    )


def _pairs(cells: Iterable[Cell], batches: Mapping[str, str]) -> Iterator[PairId]:
    """Yield each two neighbouring groups of cells; of batches, by their ids."""
    for cell in cells:
        names = [batches.get(sample.group, sample.group) for sample in cell.samples]
        for index in range(len(names) - 1):
            yield frozenset(cell.point.items()), frozenset(names[index : index + 2])


def families(prepared: Mapping[str, Prepared]) -> Iterator[tuple[Family, dict[str, Prepared]]]:
    """Yield each family of claims on one table of pairs, with these claims by name."""
    by_table: dict[Key, dict[str, Prepared]] = {}
    for name, claim in prepared.items():
        by_table.setdefault(claim.key, {})[name] = claim
    for members in by_table.values():
        first = next(iter(members.values()))
        claimed = frozenset[PairId]().union(*(claim.named for claim in members.values()))
        yield Family(len(members), first.pairs, len(claimed), first.command), members

"""Comparison of two batches, experiments, runs or executions; differences that are likely to affect results come first.

Everything comes from the record: the query, the parts that runs were made from, the environment of executions and, last, the
results. If a record cannot be read any more, a note reports that, and the comparison continues.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TypeAlias

from sierra.config.project_file import LoadedProject
from sierra.errors import Damaged, NotFound, SqlError
from sierra.execution import targets
from sierra.execution.plan import Plan
from sierra.explain.diff import code, environment, images, query, run_inputs, used_files
from sierra.explain.diff.load_sides import AFTER, BEFORE, ComparedRuns, check, gather, of_batch, of_plan, pair, pair_runs
from sierra.explain.diff.model import KINDS, Difference, Note, changed
from sierra.store.store import ResolvedId, Snapshot, Store
from sierra.util.lazy_definitions import dataclass


@dataclass(frozen=True, slots=True)
class Comparison:
    """Result of a comparison: its two sides, and their differences."""

    before: ResolvedId
    after: ResolvedId
    differences: tuple[Difference, ...]
    """Differences by rank."""
    same: tuple[str, ...]
    """Kinds that were compared completely and do not differ."""
    notes: tuple[str, ...]
    """Notes about kinds that could not be compared completely, and other notes."""


def compare(project: LoadedProject, store: Store, before: str, after: str, *, results_too: bool = True) -> Comparison:
    """Compare the objects of two id prefixes; `results_too` compares their results too.

    Raises NotFound, and UsageError for two kinds of objects that cannot be compared.
    """
    old, new = store.resolve(before), store.resolve(after)
    check(old, new)
    if old == new:
        return Comparison(old, new, (), KINDS, (f"both are the same {old.kind}",))
    differing: list[Difference] = []
    notes = [Note(text) for text in targets.notes(project, store, new.batch or new.id)]
    project = targets.of_batch(project, store, new.batch or new.id)
    compared: set[str] = set()
    for kinds, differences in _parts(project, store, old, new, notes, results_too=results_too):
        try:
            differing += differences
            compared |= set(kinds)
        except (Damaged, NotFound, SqlError) as error:
            notes.append(Note(f"{kinds[0]} cannot be compared: {error}", kinds[0]))
    compared -= {difference.kind for difference in differing} | {note.kind for note in notes if note.kind}
    return Comparison(
        before=old,
        after=new,
        differences=tuple(sorted(differing, key=lambda difference: difference.rank)),
        same=tuple(kind for kind in KINDS if kind in compared),
        notes=tuple(dict.fromkeys(note.text for note in notes)),
    )


MADE = frozenset(("query", "platform", "command", "image", "variables", "source", "template", "inputs", "seed"))
"""Kinds of differences that lead to different runs."""
FOLLOWING = ("as asked", "the seed")
"""Names of differences in inputs that other kinds report already."""


def made_other(project: LoadedProject, store: Store, before: str, after: str) -> tuple[Difference, ...]:
    """Return the differences that make the runs of two batches different. Both arguments are batch ids."""
    compared = compare(project, store, before, after, results_too=False)
    return tuple(
        difference for difference in compared.differences if difference.kind in MADE and difference.name not in FOLLOWING
    )


OTHER_SETTINGS = Difference(
    "inputs", "settings", "sierra.toml makes other inputs (variables, changes, controllers, scenarios, seed, platforms)"
)


def other_plan(plan: Plan, store: Store, batch: str) -> tuple[Difference, ...]:
    """Return the differences that make the runs of a plan different from those of a recorded batch."""
    with store.snapshot() as snapshot:
        before, after = of_batch(snapshot, batch), of_plan(plan)
        parts = made_from(snapshot, store, plan.project.root, before, after, pair(before, after))
        differing = [
            *chain.from_iterable(differences for _, differences in parts),
            *query.base_seed(before, after),
            *changed("inputs", "names", list(before.names), list(after.names), called="names of the input files"),
            *code.exclusions(store, before, after),
        ]
    return tuple(sorted(differing, key=lambda difference: difference.rank)) or (OTHER_SETTINGS,)


Part: TypeAlias = tuple[tuple[str, ...], Iterable[Difference]]
"""Kinds that are compared, and their differences, which are computed when they are read."""


def made_from(
    snapshot: Snapshot, store: Store, root: Path, before: ComparedRuns, after: ComparedRuns, pairs: Sequence[tuple[int, int]]
) -> Iterator[Part]:
    """Yield the differences of everything that the runs of recorded batches and plans are made from, except their inputs.

    `pairs` are the experiments that both sides have.
    """
    yield ("query",), query.query(before, after, pairs)
    yield ("platform", "command", "variables"), query.spec(before, after)
    if before.spec.shared_files != after.spec.shared_files:
        yield ("inputs",), query.files_beside(snapshot, before, after)
    yield ("image",), images.image(snapshot, store, before, after, root)
    yield ("source",), code.source(store, root, before, after)


AROUND = (
    ("environment", "environment", environment.environments),
    ("rules", "ingest_rules", environment.rules),
)
"""Kinds, the columns of `executions` that identify them, and the functions that compare them."""
NOT_EXECUTED = "{kind}: not compared, because no run was executed"


def _parts(
    project: LoadedProject, store: Store, old: ResolvedId, new: ResolvedId, notes: list[Note], *, results_too: bool
) -> Iterator[Part]:
    with store.snapshot() as snapshot:
        snapshot.run("SET threads = 1")
        before, after = gather(snapshot, old, BEFORE), gather(snapshot, new, AFTER)
        pairs = pair(before, after)
        pair_runs(snapshot, before, after, pairs)
        yield from made_from(snapshot, store, project.root, before, after, pairs)
        if code.has_commits(before, after):
            yield ("commit",), code.commit(project.root, before, after)
        used = ("programs", "programs", partial(environment.programs, root=project.root))
        for kind, what, compared in (used, *AROUND):
            if all(environment.known(snapshot, side, what) for side in (before, after)):
                yield (kind,), compared(snapshot, before, after)
            else:
                notes.append(Note(NOT_EXECUTED.format(kind=kind), kind))
        if all(used_files.is_known(snapshot, side) for side in (before, after)):
            yield ("files",), used_files.files(snapshot, store, before, after)
        if any(side.spec.image for side in (before, after)):
            if all(environment.executed(snapshot, side) for side in (before, after)):
                yield ("isolation",), environment.isolations(snapshot, before, after)
            else:
                notes.append(Note(NOT_EXECUTED.format(kind="isolation"), "isolation"))
        if pairs:
            yield ("seed",), chain(query.base_seed(before, after), query.seeds(snapshot, before))
            yield ("inputs",), run_inputs.inputs(snapshot, before, after, notes)
        else:
            notes.append(Note("no experiment is in both; inputs, seeds and results are not compared", "results"))
        if not results_too:
            return
        from sierra.explain.diff import results  # imports the statistics, which `sierra why` and `sierra run` do not need

        if before.is_one:
            yield ("status", "results"), results.of_one(snapshot, store, project, before, after, notes)
            return
        yield ("status",), results.good(snapshot, before, after)
        yield ("results",), results.of_shared(snapshot, store, project, notes)
        yield ("results",), results.of_places(snapshot)
        others = results.others(snapshot, pairs)
        rows = results.rows(snapshot) if others else 0
    if others:
        yield ("results",), results.means(store, project, before, after, others, rows, notes)


__all__ = ["Comparison", "Difference", "compare", "made_other"]

"""The section about comparisons: what `sierra compare` says about a batch, and about batches beside each other."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator, Sequence
from functools import partial

from sierra.config.deliverable_tables import Comparison
from sierra.config.project_file import LoadedProject
from sierra.deliverables import comparison, comparison_figure
from sierra.deliverables.comparison import Compared
from sierra.deliverables.comparison_text import paper_table
from sierra.deliverables.report.parts import Place, Section, auto, code, details, note, picture
from sierra.deliverables.report.results import paper_table as as_element
from sierra.errors import DamagedFile, Missing, SierraError, UsageError
from sierra.store.row_types import DeliverableRow
from sierra.store.store import Store
from sierra.util.hashing import short
from sierra.util.html_elements import Markup, element, joined
from sierra.util.lazy_definitions import dataclass

RECORDED = """
SELECT * FROM deliverables WHERE kind = 'comparison' AND list_has_any(batches, $batches)
QUALIFY row_number() OVER (PARTITION BY name, batches ORDER BY lamport DESC, made DESC) = 1 ORDER BY name, batches
"""
"""The last record of each comparison that someone has drawn."""


@dataclass(frozen=True, slots=True)
class Comparisons:
    """The comparisons that a report shows, and why others could not be made."""

    shown: Sequence[Compared]
    notes: Sequence[str]

    def within(self, batch: str) -> list[Compared]:
        """Return the comparisons of groups within one batch."""
        return [compared for compared in self.shown if list(compared.batches.values()) == [batch]]

    def between(self) -> list[Compared]:
        """Return the comparisons of several batches."""
        return [compared for compared in self.shown if len(compared.batches) > 1]


def find(
    project: LoadedProject, store: Store, batches: Sequence[str], declared_between: Callable[[str], Compared] | None
) -> Comparisons:
    """Return the declared and the recorded comparisons of these batches.

    `declared_between` makes a declared comparison of several batches; None if the queries that it names cannot be resolved.
    """
    by_batches: dict[tuple[str, tuple[str, ...]], Compared] = {}
    notes = []
    for name, make in _possible(project, store, batches, declared_between):
        try:
            compared = make()
        except (DamagedFile, Missing):
            raise
        except SierraError as error:
            notes.append(f"comparison {name} could not be made: {error}")
            continue
        if set(batches).intersection(compared.batches.values()):
            by_batches.setdefault((compared.name, tuple(compared.batches.values())), compared)
    if declared_between is None and (
        left := [name for name, declared in project.config.comparisons.items() if not _is_within(declared)]
    ):
        notes.append(f"comparisons of several batches are not made from the declarations of a package: {', '.join(left)}")
    return Comparisons(list(by_batches.values()), notes)


def _possible(
    project: LoadedProject, store: Store, batches: Sequence[str], declared_between: Callable[[str], Compared] | None
) -> Iterator[tuple[str, Callable[[], Compared]]]:
    """Yield the name of each comparison, and a function that makes it."""
    for name, asked in project.config.comparisons.items():
        if _is_within(asked):
            for batch in batches:
                yield f"{name} of batch {short(batch)}", partial(_of_batch, project, store, name, asked, batch)
        elif declared_between is not None:
            yield name, partial(declared_between, name)
    for row in store.select(DeliverableRow, RECORDED, batches=list(batches)):
        yield row.name, partial(comparison.again, project, store, row)


def _is_within(asked: Comparison) -> bool:
    return bool(asked.by) or not asked.groups


def _of_batch(project: LoadedProject, store: Store, name: str, asked: Comparison, batch: str) -> Compared:
    return comparison.compare(project, store, name, {short(batch): batch}, asked)


def section(comparisons: Sequence[Compared], notes: Sequence[str], headings: Place) -> Section | None:
    """Return the section about comparisons; None if there is nothing to say."""
    lines = [_compared(compared, headings) for compared in comparisons] + list(map(note, notes))
    return Section("comparisons", "Comparisons", joined(lines)) if lines else None


def _compared(compared: Compared, headings: Place) -> Markup:
    shown = paper_table(compared)
    return element(
        "article",
        element(headings.inner, auto(compared.name)),
        element("p", compared.text, dir="auto"),
        *_picture(compared),
        as_element(shown),
        *map(note, compared.notes),
        details("How to make this again", code(again(compared), "the comparison")),
        class_="comparison",
    )


def _picture(compared: Compared) -> Iterator[Markup]:
    try:
        svg = comparison_figure.svg(compared)
    except UsageError as error:
        yield note(f"There is no figure: {error}")
        return
    yield picture(svg, f"Differences between groups. {compared.text}")


def again(compared: Compared) -> str:
    """Return the command that makes a comparison again; its keys in `sierra.toml` if the command has no options for them."""
    if compared.asked.where or compared.asked.experiments or compared.asked.groups:
        return compared.asked.model_dump_json(exclude_unset=True, indent=1)
    groups = [f"{group}={batch}" if len(compared.batches) > 1 else batch for group, batch in compared.batches.items()]
    options = {
        "--by": ",".join(compared.asked.by),
        "--table": compared.table,
        "--column": compared.column,
        "--measure": "" if compared.asked.over_time else compared.measure,
        "--threshold": "" if compared.asked.threshold is None else f"{compared.asked.threshold!r}",
        "--method": "" if compared.asked.method == Comparison().method else compared.asked.method,
        "--paired": {"auto": "", True: "yes", False: "no"}[compared.asked.paired],
        "--against": compared.asked.against or "",
        "--margin": "" if compared.asked.margin is None else f"{compared.asked.margin!r}",
        "--alpha": "" if compared.asked.alpha == Comparison().alpha else f"{compared.asked.alpha!r}",
    }
    words = [*groups, *(word for name, value in options.items() if value for word in (name, value))]
    words += ["--over-time"] if compared.asked.over_time else []
    return shlex.join(["sierra", "compare", *words])

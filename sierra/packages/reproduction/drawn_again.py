"""The figures, tables, comparisons and numbers of a package, made from the recorded and from the reproduced runs.

Each is made twice in the same way, so that a difference is one of the runs. If the package has a picture that the author drew,
this one is shown instead of one that is drawn from the recorded runs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from sierra.config.deliverable_tables import Figure, TableForPaper
from sierra.config.project_file import LoadedProject
from sierra.deliverables import bound, comparison, comparison_figure, declared_tables, default_figures
from sierra.deliverables.comparison import Compared
from sierra.deliverables.figures import drawing as figures
from sierra.deliverables.figures.drawing import Drawing
from sierra.deliverables.gallery import Gallery
from sierra.deliverables.paper import bound_files, numbers
from sierra.deliverables.paper_tables import PaperTable
from sierra.deliverables.report import comparisons as declared_comparisons
from sierra.errors import DamagedFile, Missing, SierraError, UsageError
from sierra.execution.batches_of_queries import BatchesOfQueries
from sierra.packages.layout import drawn as member_of
from sierra.packages.reading import received
from sierra.store import deliverable_records
from sierra.store.batch_data import BatchData
from sierra.store.store import Store
from sierra.util.hashing import sha256, short
from sierra.util.lazy_definitions import dataclass, field, replace
from sierra.util.regular_files import read_regular
from sierra.util.text import one_line

if TYPE_CHECKING:
    import pyarrow as pa

PICTURES = {".svg": "image/svg+xml", ".png": "image/png"}
"""The endings of pictures that a browser shows, the better one first, with their media types."""
LARGEST = 8 << 20
"""The largest picture of a package that a page shows, in bytes."""


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture for a browser."""

    content: bytes
    media_type: str = PICTURES[".svg"]
    packed: str = ""
    """The member of the package; "" if it was drawn now."""


@dataclass(frozen=True, slots=True)
class Rendering:
    """A deliverable as it follows from some runs."""

    data: str
    """The hash of the values that it shows, or the values as text."""
    values: Mapping[str, Sequence[float | None]]
    """All numbers that it shows, by their column and table."""
    picture: Picture | None = None
    table: PaperTable | None = None
    text: str = ""


@dataclass(frozen=True, slots=True)
class DrawnAgain:
    """A deliverable, made from the recorded and from the reproduced runs."""

    kind: str
    name: str
    batches: tuple[str, ...]
    table: str = ""
    """The output or derived table that it shows, for its tolerance."""
    recorded: Rendering | None = None
    reproduced: Rendering | None = None
    problem: str = ""
    """Why it could not be made from one of them."""

    @property
    def same(self) -> bool:
        """True if both show the same values, to the last bit."""
        return bool(self.recorded and self.reproduced and self.recorded.data == self.reproduced.data)

    @property
    def is_lost(self) -> bool:
        """True if it follows from the recorded runs, but could not be made from the reproduced ones."""
        return self.recorded is not None and self.reproduced is None

    @property
    def difference(self) -> str:
        """The greatest difference of its numbers, in words; "" if there is none."""
        if self.same or self.recorded is None or self.reproduced is None:
            return ""
        return _greatest(self.recorded.values, self.reproduced.values)


@dataclass(slots=True)
class Sides:
    """The same package, read with its recorded runs, and with the reproduced ones in their place."""

    project: LoadedProject
    recorded: Store
    reproduced: Store
    package: Path
    """The folder of the verified copy."""
    notes: list[str] = field(default_factory=list)

    def of(self, is_new: bool) -> Store:
        return self.reproduced if is_new else self.recorded


def make(sides: Sides, batches: Sequence[str]) -> list[DrawnAgain]:
    """Return all deliverables that show only these batches, of which all runs were executed again. Raises Damaged, Missing."""
    deliverables: list[DrawnAgain] = []
    config, queries = sides.project.config, BatchesOfQueries(sides.project, sides.recorded)
    for batch in batches:
        deliverables += _figures_of(sides, batch)
        tables, _ = bound.of_batch(config.paper_tables, queries, batch)
        deliverables += (_table(sides, name, tables[name], {short(batch): batch}) for name in tables)
    deliverables += _of_several(sides, queries, batches)
    deliverables += _comparisons(sides, queries, batches)
    return deliverables


def _both(kind: str, name: str, batches: Sequence[str], make_from: Callable[[bool], Rendering], table: str = "") -> DrawnAgain:
    """Make a deliverable from both sides; `make_from` receives True for the reproduced one."""
    renderings: list[Rendering | None] = [None, None]
    problem = ""
    for is_new in (False, True):
        try:
            renderings[is_new] = make_from(is_new)
        except (DamagedFile, Missing):
            raise
        except SierraError as error:
            problem = problem or f"{'the reproduced' if is_new else 'the recorded'} runs: {one_line(str(error))}"
    recorded, reproduced = renderings
    return DrawnAgain(kind, name, tuple(batches), table, recorded, reproduced, problem)


# Figures


def _figures_of(sides: Sides, batch: str) -> Iterator[DrawnAgain]:
    """Yield the figures of a batch, as its report shows them."""
    with BatchData(sides.recorded, batch) as recorded, BatchData(sides.reproduced, batch) as reproduced:
        galleries = Gallery(sides.project, sides.recorded, recorded), Gallery(sides.project, sides.reproduced, reproduced)
        wanted, notes = default_figures.wanted(galleries[0], None)
        sides.notes += notes
        packed = _Packed(sides, batch)
        for name, figure in wanted.items():
            yield _both("figure", name, [batch], partial(_figure, galleries, packed, name, figure), figure.table)


def _figure(galleries: Sequence[Gallery], packed: _Packed, name: str, figure: Figure, is_new: bool) -> Rendering:
    return _of_drawing(galleries[is_new].drawing(name, figure), None if is_new else packed)


def _of_several(sides: Sides, queries: BatchesOfQueries, batches: Sequence[str]) -> Iterator[DrawnAgain]:
    """Yield the figures and tables that are bound to several queries."""
    config = sides.project.config
    for name, figure in config.figures.items():
        if len(figure.query) > 1 and (known := _known(sides, queries, figure.query, batches, f"figure {name}")):
            yield _both("figure", name, list(known.values()), partial(_overlaid, sides, known, name, figure), figure.table)
    for name, table in config.paper_tables.items():
        if len(table.query) > 1 and (known := _known(sides, queries, table.query, batches, f"table {name}")):
            yield _table(sides, name, table, known)


def _overlaid(sides: Sides, batches: Mapping[str, str], name: str, figure: Figure, is_new: bool) -> Rendering:
    with bound_files.Galleries(sides.project, sides.of(is_new)) as galleries:
        packed = None if is_new else _Packed(sides, next(iter(batches.values())))
        return _of_drawing(bound_files.drawing_of(name, figure, batches, galleries), packed)


def _known(
    sides: Sides, queries: BatchesOfQueries, words: Sequence[str], batches: Sequence[str], what: str
) -> dict[str, str] | None:
    """Return the batches of queries by label; None, and a note, if not all of their runs were executed again."""
    try:
        known = comparison.of_queries(queries, words)
    except DamagedFile:
        raise
    except SierraError as error:
        sides.notes.append(f"{what}: {one_line(str(error))}")
        return None
    if not set(known.values()) <= set(batches):
        sides.notes.append(f"{what}: not all runs of its batches were executed again")
        return None
    return known


def _of_drawing(drawing: Drawing, packed: _Packed | None) -> Rendering:
    figures.check(drawing)
    picture = packed.picture("figure", drawing.name, drawing.data) if packed else None
    if picture is None:
        [(_, svg)] = figures.rendered(replace(drawing, formats=("svg",)))
        picture = Picture(svg)
    values = {f"{name} of {table}": column for table, content in drawing.tables.items() for name, column in _numbers(content)}
    return Rendering(drawing.shown, values, picture)


class _Packed:
    """The pictures of a batch in the package, as its author drew them."""

    def __init__(self, sides: Sides, batch: str) -> None:
        self._folder = sides.package
        self._rows = deliverable_records.latest(sides.recorded, batch)

    def picture(self, kind: str, name: str, data: str) -> Picture | None:
        """Return the picture of a deliverable that shows these data; None if the package has none that a browser shows."""
        for ending, media_type in PICTURES.items():
            for row in self._rows:
                for file, digest in zip(row.files, row.sha256s, strict=True):
                    path = self._folder / member_of(file)
                    if (row.kind, row.name, row.data) != (kind, name, data) or not file.endswith(ending) or not path.is_file():
                        continue
                    if path.stat().st_size <= LARGEST and sha256(content := read_regular(path)) == digest:
                        return Picture(content, media_type, member_of(file))
        return None


# Tables, comparisons, numbers


def _table(sides: Sides, name: str, declared: TableForPaper, batches: Mapping[str, str]) -> DrawnAgain:
    def made(is_new: bool) -> Rendering:
        found = declared_tables.make(sides.project, sides.of(is_new), name, declared, batches)
        return Rendering(found.content().data, dict(_numbers(found.data)), table=found.table)

    return _both("table", name, list(batches.values()), made, declared.table)


def _comparisons(sides: Sides, queries: BatchesOfQueries, batches: Sequence[str]) -> Iterator[DrawnAgain]:
    """Yield the comparisons within each batch, and those that are bound to queries."""
    project = sides.project
    for batch in batches:
        stores = (sides.recorded, sides.reproduced)
        within = (declared_comparisons.find(project, store, [batch], None).within(batch) for store in stores)
        both = [{compared.name: compared for compared in comparisons} for comparisons in within]
        for name, compared in both[0].items():
            yield _both("comparison", name, [batch], partial(_compared, both, name), compared.table)
    for name, words in bound_files.comparisons(project.config).items():
        if len(words) > 1 and (known := _known(sides, queries, words, batches, f"comparison {name}")):
            yield _both("comparison", name, list(known.values()), partial(_of_queries, sides, name, known))


def _compared(found: Sequence[Mapping[str, Compared]], name: str, is_new: bool) -> Rendering:
    if name not in found[is_new]:
        raise UsageError("the comparison cannot be made")
    return _of_comparison(found[is_new][name])


def _of_queries(sides: Sides, name: str, batches: Mapping[str, str], is_new: bool) -> Rendering:
    asked = sides.project.config.comparisons[name].model_copy(update={"groups": ()})
    return _of_comparison(comparison.compare(sides.project, sides.of(is_new), name, batches, asked))


def _of_comparison(compared: Compared) -> Rendering:
    content = comparison_figure.content_of(compared)
    values: dict[str, list[float | None]] = {"difference": [], "p": []}
    for pair in compared.pairs:
        values["difference"].append(pair.difference)
        values["p"].append(pair.p_adjusted)
    try:
        picture = Picture(comparison_figure.svg(compared))
    except UsageError:  # there is nothing to draw
        picture = None
    return Rendering(f"{content.data} {compared.text}", values, picture, text=compared.text)


def numbers_of(sides: Sides, batches: Sequence[str]) -> tuple[dict[str, tuple[str, str]], str]:
    """Return the numbers of the paper's text, `[numbers.NAME]`, by both kinds of runs; and why they could not be computed.

    `batches` are those of which all runs were executed again; numbers that rest on others are left out, with a note.
    """
    if not sides.project.config.numbers:
        return {}, ""
    try:
        before, now = (_texts(sides, store, batches) for store in (sides.recorded, sides.reproduced))
    except (DamagedFile, Missing):
        raise
    except SierraError as error:
        return {}, one_line(str(error))
    return {name: (before.get(name, ""), now.get(name, "")) for name in dict.fromkeys((*before, *now))}, ""


def _texts(sides: Sides, store: Store, batches: Sequence[str]) -> dict[str, str]:
    project, queries = sides.project, BatchesOfQueries(sides.project, store)
    claims = numbers.claims_of(queries, among=received.batches(store))
    compared = dict(bound_files.compared_by(queries))
    texts = {}
    for name, number in project.config.numbers.items():
        with bound_files.named("number", name):
            own = compared[number.comparison].batches if number.comparison else comparison.of_queries(queries, number.query)
            value = numbers.computed(queries, number, compared, claims)
            if not {*own.values(), *value.batches} <= set(batches):
                sides.notes.append(f"number {name}: not all runs of its batches were executed again")
                continue
            texts[name] = numbers.text(number, value, siunitx=False).replace("$", "")
    return texts


# Differences


def _numbers(table: pa.Table) -> Iterator[tuple[str, list[float | None]]]:
    """Yield the columns of numbers of a table."""
    import pyarrow.types as kinds

    for name in table.column_names:
        column = table.column(name)
        if kinds.is_floating(column.type) or kinds.is_integer(column.type):
            yield name, [None if value is None else float(value) for value in column.to_pylist()]


def _greatest(before: Mapping[str, Sequence[float | None]], now: Mapping[str, Sequence[float | None]]) -> str:
    """Return the greatest difference between numbers in words, relative to the greatest number of the same kind."""
    worst: tuple[float, str] | None = None
    for name in before:
        old, new = before[name], now.get(name, ())
        if len(old) != len(new) or any((a is None) != (b is None) for a, b in zip(old, new, strict=True)):
            return (
                f"{name}: {len(old)} values before, and {len(new)} now"
                if len(old) != len(new)
                else f"{name}: others are missing"
            )
        pairs = [(a, b) for a, b in zip(old, new, strict=True) if a is not None and b is not None and a != b]
        if not pairs:
            continue
        scale = max((abs(a) for a in old if a is not None), default=0.0)
        largest = max(abs(a - b) for a, b in pairs)
        part = largest / scale if scale else 0.0
        said = f"{name}: at most {largest:.3g}" + (f" ({100 * part:.2g} %)" if scale else "")
        worst = max(worst, (part, said)) if worst else (part, said)
    return worst[1] if worst else "values that are not numbers differ"

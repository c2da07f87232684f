"""Make reports: gather what the store knows about batches, and put it into a page."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

from sierra.config import extensions
from sierra.config.project_file import LoadedProject, Project
from sierra.deliverables.comparison import Compared
from sierra.deliverables.report import (
    batch_state,
    claims,
    comparisons,
    design,
    environment,
    failures,
    moving_pictures,
    page,
    question,
    reproduce,
    results,
)
from sierra.deliverables.report.batch_state import BatchState
from sierra.deliverables.report.claims import Claims
from sierra.deliverables.report.comparisons import Comparisons
from sierra.deliverables.report.moving_pictures import Films
from sierra.deliverables.report.page import Chapter
from sierra.deliverables.report.parts import Place, Section, filled_table, note
from sierra.deliverables.report.reproduce import Received
from sierra.deliverables.report.results import Figures
from sierra.execution import list_batches
from sierra.execution.list_batches import ListedBatch
from sierra.store.store import Store
from sierra.util.hashing import short
from sierra.util.html_elements import Markup, Node, element, joined
from sierra.util.lazy_definitions import dataclass, replace

AT_MOST = 50
"""The largest number of batches that a report of all batches shows in full; of more, it only has the list."""
MOST = 1000
"""The largest number of batches that are listed: a page with more becomes slow."""


@dataclass(frozen=True, slots=True)
class ReportSource:
    """The source of a report: a store with its project, or a received package."""

    project: LoadedProject
    store: Store
    declared_between: Callable[[str], Compared] | None = None
    """Makes a declared comparison of several batches; None in a package, whose queries are not resolved."""
    received: Received | None = None
    """The package; None for the user's own project."""
    read: moving_pictures.Read | None = None
    """Reads files of videos; None to read them from the project."""

    def films(self) -> Films:
        """Return the videos of a new page."""
        return Films(self.read or moving_pictures.from_project(self.project.root))


@dataclass(frozen=True, slots=True)
class Report:
    """A page, and notes on what it lacks."""

    page: bytes
    batches: Sequence[str]
    notes: Sequence[str]
    title: str = ""
    """The title of a report of all batches."""
    sql: Sequence[str] = ()
    """The statements behind its figures."""
    libraries: Sequence[str] = ()
    """The libraries that made its figures, as name==version."""
    complete: bool = True
    """False if it only has the list of too many batches."""


@dataclass(frozen=True, slots=True)
class _Parts:
    """The sections about one batch."""

    sections: Sequence[Section]
    notes: Sequence[str]
    figures: Figures


def received(source: ReportSource) -> ReportSource:
    """Return the source without what would execute programs of a package: models by commands."""
    if source.received is None:
        return source
    project = source.project
    left = [name for name, model in project.config.models.items() if model.command]
    note = f"Models are left out, because commands of the package would have to be executed: {', '.join(left)}."
    about = replace(source.received, notes=(*source.received.notes, *([note] if left else [])))
    harmless = replace(
        project, config=_without_commands(project.config), declared=project.declared and _without_commands(project.declared)
    )
    return replace(source, project=harmless, received=about)


def _without_commands(config: Project) -> Project:
    return config.model_copy(update={"models": {name: model for name, model in config.models.items() if not model.command}})


def of_batches(
    source: ReportSource, batches: Sequence[str], tell: Callable[[str], None] = lambda text: None, every: str = ""
) -> Report:
    """Return the report of batches: of one, or of several with a list at the beginning.

    `every` is the title of a report of all batches; of more than `AT_MOST`, it only has the list. `tell` receives the progress.
    """
    if every and len(batches) > AT_MOST:
        return _list(source, every)
    source = received(source)
    states = [batch_state.read(source.project, source.store, batch) for batch in batches]
    tell("claims")
    shown_claims = claims.find(source.project, source.store, batches, batches if source.received else None, every=bool(every))
    tell("comparisons")
    compared = comparisons.find(source.project, source.store, batches, source.declared_between)
    if len(states) == 1:
        return replace(_single(source, states[0], shown_claims, compared, tell), title=every)
    return replace(_several(source, states, shown_claims, compared, tell, every or f"{len(states)} batches"), title=every)


def _list(source: ReportSource, title: str) -> Report:
    """Return the report of too many batches: the list of them, the last one first."""
    listed = list_batches.batches(source.store)[::-1]
    remedy = "name some, as in: sierra report HASH HASH" if source.received is None else "see: sierra open FILE.zip explore"
    data = page.of_batches(title, [index_section(listed, (), remedy)], [], Claims(()), source.received)
    note = f"{len(listed):,} batches are too many for one page, so it only has their list; {remedy}"
    return Report(data, [batch.batch for batch in listed], (note,), complete=False)


def _single(
    source: ReportSource, state: BatchState, shown_claims: Claims, compared: Comparisons, tell: Callable[[str], None]
) -> Report:
    headings = Place()
    of_claims = claims.section(source.project, shown_claims, headings)
    of_groups = comparisons.section(compared.shown, compared.notes, headings)
    parts = _parts(source, state, headings, (of_groups, of_claims), source.films(), tell)
    data = page.of_batch(state, parts.sections, shown_claims, source.received)
    return _made(data, [state], [parts], (*parts.notes, *compared.notes))


def _several(
    source: ReportSource,
    states: Sequence[BatchState],
    shown_claims: Claims,
    compared: Comparisons,
    tell: Callable[[str], None],
    title: str,
) -> Report:
    ids = [state.id for state in states]
    listed = sorted(
        (batch for batch in list_batches.batches(source.store) if batch.batch in ids), key=lambda batch: ids.index(batch.batch)
    )
    of_claims = claims.section(source.project, shown_claims, Place())
    of_groups = comparisons.section(compared.between(), compared.notes, Place())
    every, films = [], source.films()
    for number, state in enumerate(states, 1):
        headings = Chapter(state, ()).place
        within = comparisons.section(compared.within(state.id), (), headings)
        every.append(_parts(source, state, headings, (within,), films, _within(tell, f"batch {number} of {len(states)}")))
    chapters = [Chapter(state, parts.sections) for state, parts in zip(states, every, strict=True)]
    first = [index_section(listed, ids), *filter(None, (of_claims, of_groups))]
    data = page.of_batches(title, first, chapters, shown_claims, source.received)
    return _made(data, states, every, (*compared.notes, *dict.fromkeys(note for parts in every for note in parts.notes)))


def _within(tell: Callable[[str], None], prefix: str) -> Callable[[str], None]:
    return lambda text: tell(f"{prefix}, {text}")


def _made(data: bytes, states: Sequence[BatchState], every: Sequence[_Parts], notes: Sequence[str]) -> Report:
    figures = [parts.figures for parts in every]
    sql = dict.fromkeys(content.sql for drawn in figures for content in drawn.contents if content.sql)
    libraries = sorted({name for drawn in figures for name in drawn.libraries})
    return Report(data, [state.id for state in states], notes, sql=[*sql], libraries=libraries)


def _parts(
    source: ReportSource,
    state: BatchState,
    headings: Place,
    between: Sequence[Section | None],
    films: Films,
    tell: Callable[[str], None],
) -> _Parts:
    """Return the sections about a batch, with some after its results."""
    figures = results.figures(state, tell)
    tell("tables and facts")
    tables, failed = results.table_section(state, headings)
    sections = [
        question.section(state),
        design.section(state),
        results.figure_section(figures, headings),
        *filter(None, (tables, results.other_section(state, films))),
        *filter(None, between),
        failures.section(state, headings),
        *extensions.called("report_sections", state),
        environment.section(state, headings),
        reproduce.section(state, source.received, headings),
    ]
    return _Parts(sections, (*figures.notes, *failed), figures)


def index_section(listed: Sequence[ListedBatch], shown: Collection[str], remedy: str = "") -> Section:
    """Return the list of batches in this order. Those in `shown` have a part of their own in the page.

    `remedy` says how to see the others if none has.
    """
    headers = ("batch", "query", "controller", "scenario", "experiments", "runs", "failed", "not executed", "first submitted")
    rows = [_row(batch, batch.batch in shown) for batch in listed[:MOST]]
    inner: list[Node] = [filled_table(headers, rows, numbers=(4, 5, 6, 7, 8))]
    if len(listed) > MOST:
        inner.append(note(f"The first {MOST:,} of {len(listed):,} batches are listed; sierra ls lists all."))
    if not shown:
        inner.append(note(f"These are too many batches for one page; {remedy}"))
    return Section("batches", "Batches", joined(inner))


def _row(batch: ListedBatch, shown: bool) -> tuple[Node, ...]:
    identity: Markup = element("code", short(batch.batch))
    return (
        element("a", identity, href=f"#b{short(batch.batch)}") if shown else identity,
        batch.query,
        batch.controller,
        batch.scenario,
        f"{batch.experiments:,}",
        f"{batch.runs:,}",
        "?" if batch.failed is None else f"{batch.failed:,}",
        "?" if batch.missing is None else f"{batch.missing:,}",
        f"{batch.created:%Y-%m-%d %H:%M}",
    )

"""The files of a paper: figures, captions, tables and paragraphs of the deliverables that are bound to queries.

    figures/NAME.pdf     figures and those of comparisons, in the formats that they declare, or else as PDF
    captions/NAME.tex    the captions of figures
    tables/NAME.tex      tables for papers and those of comparisons, with booktabs
    texts/NAME.tex       the paragraphs of comparisons
    sql/NAME.sql         the SQL of a table
    videos/NAME.mp4      videos, and what other extensions make: see `sierra.deliverables.kinds`
    numbers.tex          the numbers in the text: see `sierra.deliverables.paper.numbers`

The same runs give the same bytes on every machine with the same versions of SIERRA and the libraries that draw.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial

from sierra.config.deliverable_tables import Comparison, Figure, Format
from sierra.config.project_file import LoadedProject, Project
from sierra.deliverables import comparison, comparison_figure, comparison_text, declared_tables, kinds, overlay, paper_tables
from sierra.deliverables.claims import rests_on
from sierra.deliverables.comparison import Compared
from sierra.deliverables.figures.captions import ended
from sierra.deliverables.figures.drawing import Drawing, check, rendered
from sierra.deliverables.gallery import Gallery
from sierra.deliverables.kinds import InPaper
from sierra.deliverables.paper import numbers
from sierra.deliverables.record import Deliverable, origin_of
from sierra.design.query.query_request import QueryRequest
from sierra.errors import DamagedFile, SierraError, UsageError
from sierra.execution.batches_of_queries import BatchesOfQueries, labelled
from sierra.store.batch_data import BatchData
from sierra.store.store import Store
from sierra.util.fs import fitting
from sierra.util.hashing import digest
from sierra.util.json_types import JsonView
from sierra.util.lazy_definitions import dataclass
from sierra.util.text import like
from sierra.util.version import __version__

NUMBERS = "numbers"
"""The kind and the name of the deliverable with the numbers in the text."""
FIGURES, CAPTIONS, TABLES, TEXTS, SQL = "figures", "captions", "tables", "texts", "sql"
TEX: Format = "tex"


@dataclass(frozen=True, slots=True)
class PaperItem:
    """One deliverable of a paper."""

    name: str
    content: Deliverable
    data: str
    """The hash of the values that it shows."""
    paths: tuple[str, ...]
    """Its files, relative to the folder of the paper."""
    files: Callable[[], Mapping[str, bytes]]
    """Makes its files, by their paths."""
    same_bytes: bool = True
    """False if the same data may give other bytes, as encoders of videos do."""


def queries(config: Project) -> list[str]:
    """Return the queries that deliverables are bound to, as they are declared; each once."""
    words = [word for figure in config.figures.values() for word in figure.query]
    words += [word for table in config.paper_tables.values() for word in table.query]
    words += [word for deliverable in kinds.bound(config) for word in deliverable.query]
    words += [word for some in comparisons(config).values() for word in some]
    words += [word for number in config.numbers.values() for word in number.query]
    return list(dict.fromkeys(words))


def requests(config: Project) -> list[QueryRequest]:
    """Return the requests of all queries of a paper, also of the claims whose numbers it has; each once."""
    requested = [labelled(config, word)[1] for word in queries(config)]
    for number in config.numbers.values():
        if claim := config.claims.get(number.claim):
            requested += rests_on.requests(claim, config)
    return list(dict.fromkeys(requested))


def comparisons(config: Project) -> dict[str, tuple[str, ...]]:
    """Return the queries of the comparisons that are bound to any, by their names. Raises UsageError, as `_words` does."""
    words = {name: _words(name, declared, config) for name, declared in config.comparisons.items()}
    return {name: some for name, some in words.items() if some}


def _words(name: str, declared: Comparison, config: Project) -> tuple[str, ...]:
    """Return the queries of a comparison: its `query`, or its groups, if they are names of queries.

    Raises UsageError for groups of which only some are.
    """
    if declared.query or declared.by or not declared.groups:
        return declared.query
    others = [word for word in declared.groups if word.rpartition("=")[2] not in config.queries]
    if others and len(others) < len(declared.groups):
        known = like(others[0].rpartition("=")[2], list(config.queries), "there are")
        raise UsageError(f"[comparisons.{name}] groups: {others[0]!r} is not the name of a query, but others are; {known}")
    return () if others else declared.groups


def items(query_batches: BatchesOfQueries, package: str, words: Mapping[str, str]) -> Iterator[PaperItem]:
    """Yield the deliverables of a paper, each computed from the last batches of its queries.

    `package` is the id of its package; `words` has by the name of a claim whether it was planned or exploratory.

    Raises NotFound for a query that was not run, and SierraError for a deliverable that cannot be made.
    """
    project, store, config = query_batches.project, query_batches.store, query_batches.project.config
    compared: dict[str, Compared] = {}
    with Galleries(project, store) as galleries:
        for name, figure in config.figures.items():
            if figure.query:
                with named("figure", name):
                    claims = _claims(config, words, figure=name)
                    yield _figure(name, figure, comparison.of_queries(query_batches, figure.query), galleries, claims)
        for name, table in config.paper_tables.items():
            if table.query:
                with named("table", name):
                    computed = declared_tables.make(
                        project, store, name, table, comparison.of_queries(query_batches, table.query)
                    )
                    content, claims = computed.content(), _claims(config, words, table=name)
                    paths = f"{TABLES}/{fitting(name)}.tex", f"{SQL}/{fitting(name)}.sql"
                    yield PaperItem(name, content, _with(content.data, claims), paths, partial(_table, computed, claims))
        for deliverable in kinds.bound(config):
            with named(deliverable.kind, deliverable.name):
                yield _added(deliverable, comparison.of_queries(query_batches, deliverable.query), galleries)
        for name, comparison_result in compared_by(query_batches):
            compared[name] = comparison_result
            with named("comparison", name):
                content, make_files = comparison_figure.content_of(comparison_result), partial(_comparison, comparison_result)
                yield PaperItem(name, content, content.data, _paths_of(comparison_result), make_files)
    if config.numbers or config.paper.package:
        yield _numbers(query_batches, compared, package)


def compared_by(query_batches: BatchesOfQueries) -> Iterator[tuple[str, Compared]]:
    """Yield the comparisons that are bound to queries, by their names, each made from the last batches of its queries."""
    for name, words in comparisons(query_batches.project.config).items():
        declared = query_batches.project.config.comparisons[name]
        with named("comparison", name):
            asked = declared if declared.by or declared.query else declared.model_copy(update={"groups": ()})
            yield (
                name,
                comparison.compare(
                    query_batches.project, query_batches.store, name, comparison.of_queries(query_batches, words), asked
                ),
            )


def _claims(config: Project, words: Mapping[str, str], *, figure: str = "", table: str = "") -> str:
    """Return the claims that name a figure or a table as what shows them, each with its word; "" if there are none."""
    shown = ((name, claim) for name, claim in config.claims.items() if name in words)
    own = {name: claim.says for name, claim in shown if figure == claim.figure != "" or table == claim.table != ""}
    return " ".join(ended(f"Claim ({words[name]}): {says}") for name, says in own.items())


def _with(data: str, more: str) -> str:
    """Return the hash of values and of what a paper shows with them, which records do not have."""
    return digest("with", {"data": data, "more": more}) if more else data


@contextmanager
def named(kind: str, name: str) -> Iterator[None]:
    """Name the deliverable in the errors of what follows."""
    try:
        yield
    except DamagedFile:
        raise
    except SierraError as error:
        raise type(error)(f"{kind} {name}: {error}") from error


class Galleries:
    """The data of batches, each opened once."""

    def __init__(self, project: LoadedProject, store: Store) -> None:
        self._project = project
        self._store = store
        self._frames = ExitStack()
        self._known: dict[str, Gallery] = {}

    def __enter__(self) -> Galleries:
        return self

    def __exit__(self, *_: object) -> None:
        self._frames.close()

    def of(self, batch: str) -> Gallery:
        if batch not in self._known:
            frame = self._frames.enter_context(BatchData(self._store, batch))
            self._known[batch] = Gallery(self._project, self._store, frame)
        return self._known[batch]


def drawing_of(name: str, figure: Figure, batches: Mapping[str, str], galleries: Galleries) -> Drawing:
    """Return a figure of batches, by label. Raises SierraError if it cannot be drawn."""
    if len(batches) == 1:
        [batch] = batches.values()
        return galleries.of(batch).drawing(name, figure)
    fitted, own = overlay.fitting(figure, declared=True), overlay.name_of(name, batches)
    drawings = {label: galleries.of(batch).drawing(own, fitted) for label, batch in batches.items()}
    return overlay.merged(drawings, overlay.BATCH)


def _figure(name: str, figure: Figure, batches: Mapping[str, str], galleries: Galleries, claims: str) -> PaperItem:
    drawing = replace(drawing_of(name, figure, batches, galleries), formats=figure.formats or ("pdf",), claims=claims)
    check(drawing)
    paths = tuple(_path(name, ending) for ending in _with_caption(drawing.formats))
    return PaperItem(name, drawing.content(), _with(drawing.shown, claims), paths, partial(_drawn, name, drawing))


def _drawn(name: str, drawing: Drawing) -> dict[str, bytes]:
    """Return the files of a figure: its formats, and its caption."""
    return _placed(name, rendered(replace(drawing, name=name, formats=_with_caption(drawing.formats))))


def _with_caption(formats: Sequence[Format]) -> tuple[Format, ...]:
    return tuple(dict.fromkeys((*formats, TEX)))


def _path(name: str, ending: Format) -> str:
    """Return the path of a figure in a format, or of its caption."""
    return f"{CAPTIONS if ending in ('tex', 'txt') else FIGURES}/{fitting(name)}.{ending}"


def _placed(name: str, files: Iterable[tuple[Format, bytes]]) -> dict[str, bytes]:
    """Return the files of a figure by their paths."""
    return {_path(name, ending): data for ending, data in files}


def _added(deliverable: InPaper, batches: Mapping[str, str], galleries: Galleries) -> PaperItem:
    """Return the files of a deliverable that an extension makes, in a folder with the name of its table in `sierra.toml`."""
    data = {label if len(batches) > 1 else "": galleries.of(batch) for label, batch in batches.items()}
    content, names, make = deliverable.files(data)

    def files() -> dict[str, bytes]:
        return {f"{deliverable.table}/{name}": file_bytes for name, file_bytes in make().items()}

    return PaperItem(
        deliverable.name, content, content.data, tuple(f"{deliverable.table}/{name}" for name in names), files, same_bytes=False
    )


def _table(computed: declared_tables.ComputedTable, claims: str) -> dict[str, bytes]:
    """Return the files of a table for papers: its LaTeX, with claims in its caption or else below it, and its SQL."""
    content, name = computed.content(), fitting(computed.name)
    table = computed.table
    above = table.caption or table.note
    text = f"{ended(above)} {claims}" if above and claims else above or claims
    table = replace(table, caption=text) if table.caption else replace(table, note=text)
    origin = origin_of(content.batches[0], content.data, *content.batches[1:])
    head = f"% {origin}; SQL: {SQL}/{name}.sql\n\n"
    return {
        f"{TABLES}/{name}.tex": (head + paper_tables.FORMATS["latex"](table)).encode(),
        f"{SQL}/{name}.sql": f"-- {origin}\n{computed.sql}\n".encode(),
    }


def _numbers(query_batches: BatchesOfQueries, compared: Mapping[str, Compared], package: str) -> PaperItem:
    """Return the numbers in the text. Raises SierraError for one that cannot be computed.

    Records do not have the package's id: whoever checks them may not have the package.
    """
    config = query_batches.project.config
    claims = numbers.claims_of(query_batches)
    shown: dict[str, tuple[str, str]] = {}
    batches = [query_batches.last(word) for word in queries(config)]
    for name, number in config.numbers.items():
        with named("number", name):
            value = numbers.computed(query_batches, number, compared, claims)
            shown[name] = numbers.text(number, value, siunitx=config.paper.siunitx), value.origin
            batches += value.batches
    batches = list(dict.fromkeys(batches))
    every = {name: (text, "") for name, text in numbers.built_in(query_batches.store, batches).items()} | shown
    definition: dict[str, JsonView] = {
        "numbers": {name: number.model_dump(mode="json", exclude_defaults=True) for name, number in config.numbers.items()},
        "paper": config.paper.model_dump(mode="json", include={"prefix", "siunitx"}),
    }
    data = digest("numbers", {name: text for name, (text, _) in every.items()})
    sql = "\n\n".join(f"-- {name}\n{number.sql}" for name, number in config.numbers.items() if number.sql)
    content = Deliverable(NUMBERS, NUMBERS, tuple(batches), definition, sql, data, (f"sierra-experiments=={__version__}",))
    paths = (f"{NUMBERS}.tex", *([f"{SQL}/{NUMBERS}.sql"] if sql else []))
    if package:
        every["package"] = package, ""
    return PaperItem(NUMBERS, content, _with(data, package), paths, partial(_macros, content, every, config.paper.prefix))


def _macros(content: Deliverable, shown: Mapping[str, tuple[str, str]], prefix: str) -> dict[str, bytes]:
    """Return two files: one with a macro for each number, one with their SQL."""
    origin = origin_of(content.batches[0], content.data, *content.batches[1:])
    lines = [rf"\newcommand{{\{prefix}{name}}}{{{text}}}{f' % {why}' if why else ''}" for name, (text, why) in shown.items()]
    files = {f"{NUMBERS}.tex": "\n".join([f"% {origin}", "", *lines, ""]).encode()}
    return files | ({f"{SQL}/{NUMBERS}.sql": f"-- {origin}\n{content.sql}\n".encode()} if content.sql else {})


def _paths_of(compared: Compared) -> tuple[str, ...]:
    """Return the files of a comparison."""
    formats: tuple[Format, ...] = ("pdf", TEX) if compared.pairs or compared.effects else ()
    name = fitting(compared.name)
    return (*(_path(compared.name, ending) for ending in formats), f"{TABLES}/{name}.tex", f"{TEXTS}/{name}.tex")


def _comparison(compared: Compared) -> dict[str, bytes]:
    """Return the files of a comparison: its figure with a caption, its table and its paragraph."""
    content, name = comparison_figure.content_of(compared), fitting(compared.name)
    head = f"% {origin_of(content.batches[0], content.data, *content.batches[1:])}\n\n"
    table = paper_tables.FORMATS["latex"](comparison_text.paper_table(compared))
    paragraph = comparison_text.PARAGRAPHS["latex"](compared.text)
    drawn = {}
    if compared.pairs or compared.effects:
        drawn = _placed(compared.name, comparison_figure.rendered(compared, ("pdf", TEX)))
    return {**drawn, f"{TABLES}/{name}.tex": (head + table).encode(), f"{TEXTS}/{name}.tex": (head + paragraph).encode()}

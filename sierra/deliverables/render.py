"""Render figures from the store: the figures that `sierra.toml` declares, or else the default figures that fit; and its tables.

Figures are drawn from aggregates that SQL computes; the project adds labels and units. A figure or table that cannot be
made (no such column in this batch, no finite value in it) is reported, and the others are still made.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path

from sierra.config.deliverable_tables import Figure, Format, TableForPaper
from sierra.config.project_file import LoadedProject
from sierra.config.validate import options
from sierra.deliverables import bound, declared_tables, default_figures, overlay
from sierra.deliverables.figures.drawing import Drawing, draw
from sierra.deliverables.gallery import Gallery
from sierra.deliverables.record import Deliverable, Recorder, marked_folder, parsing
from sierra.errors import DamagedFile, Missing, NotInstalled, SierraError
from sierra.execution.batches_of_queries import BatchesOfQueries
from sierra.store.batch_data import AllFailed, BatchData
from sierra.store.layout import ProjectPaths
from sierra.store.row_types import DeliverableRow
from sierra.store.store import Store
from sierra.util.hashing import short

KIND = "figure"
"""The kind of the records of figures, among deliverables."""


def figures(
    project: LoadedProject,
    store: Store,
    batch: str,
    name: str | None = None,
    *,
    again: bool = True,
    formats: tuple[Format, ...] = (),
) -> tuple[list[Path], list[str]]:
    """Draw a batch's figures and tables, or the one called `name`; return the files, and what could not be drawn and why.

    Without `again`, those that were drawn from the same data in the same way are left as they are. `formats` are those of the
    figures; by default, those that `sierra.toml` declares. Raises NotFound if none has that name, SierraError if it cannot be
    drawn, or is drawn without one of its models.
    """
    drawn: list[Path] = []
    notes: list[str] = []
    galleries: list[Gallery] = []
    with BatchData(store, batch) as frame:
        drawer = _Drawer(project, store, frame, again=again, formats=formats)
        if name not in project.config.paper_tables:
            gallery = Gallery(project, store, frame, name=name)
            wanted, notes = default_figures.wanted(gallery, name)
            drawn, failed = _draw_each(drawer, wanted, gallery.drawing, strict=name is not None)
            notes += (*failed, *gallery.declared_notes, *gallery.time_notes.values())
            notes += gallery.models.notes([] if name else [*wanted])
            galleries.append(gallery)
        declared, invalid = project.config.paper_tables, list[str]()
        if name is None and declared:
            declared, invalid = bound.of_batch(declared, BatchesOfQueries(project, store), batch)
            declared = {called: table for called, table in declared.items() if not _is_of_others(table, frame, project, store)}
        written, failed = _write_tables(drawer, project, store, {short(batch): batch}, name, declared)
        notes += [f"table {note}" for note in invalid]
    notes += (*(problem for problem in failed if problem not in notes), *drawer.close())
    _check_models(name, *galleries)
    return [*drawn, *written], notes


def _is_of_others(table: TableForPaper, frame: BatchData, project: LoadedProject, store: Store) -> bool:
    """Check if a table for papers is about a variable or an output that only other batches have."""
    variables = () if table.sql or table.across not in project.config.variables else (table.across,)
    return not table.query and bound.is_of_others(variables, table.table, project.config, store, frame)


def _write_tables(
    drawer: _Drawer,
    project: LoadedProject,
    store: Store,
    batches: Mapping[str, str],
    name: str | None,
    tables: Mapping[str, TableForPaper],
) -> tuple[list[Path], list[str]]:
    """Write these tables, or the one called `name`; return the files, and why others could not be written."""
    written: list[Path] = []
    failed = []
    for called, declared in tables.items():
        if name not in (None, called):
            continue
        try:
            own = called if len(batches) == 1 else overlay.name_of(called, batches)
            table = declared_tables.make(project, store, own, declared, batches)
            written += drawer.keep(table.content(), table.write)
        except (DamagedFile, Missing):
            raise
        except SierraError as error:
            if name is not None:
                raise
            failed.append(str(error) if isinstance(error, AllFailed) else f"table {called}: {error}")
    return written, failed


def _check_models(name: str | None, *galleries: Gallery) -> None:
    """Raise SierraError if the figure that was requested by its name was drawn without a model."""
    for model, reason in ((model, reason) for gallery in galleries for model, reason in gallery.models.failed.items()):
        if name is not None:
            raise SierraError(f"figure {name} was drawn without model {model}: {reason}")


def _draw_each(
    drawer: _Drawer, wanted: Mapping[str, Figure], drawing: Callable[[str, Figure], Drawing], *, strict: bool
) -> tuple[list[Path], list[str]]:
    """Draw figures; return the files, and why others could not be drawn. With `strict`, that is an error."""
    drawn: list[Path] = []
    failed = []
    for name, figure in wanted.items():
        try:
            drawn += drawer.draw(drawing(name, figure))
        except SierraError as error:
            if strict or isinstance(error, DamagedFile) or (isinstance(error, Missing) and not isinstance(error, NotInstalled)):
                raise
            failed.append(f"figure {name}: {error}")
    return drawn, failed


def content(
    project: LoadedProject, store: Store, row: DeliverableRow, shared: Callable[[], Gallery] | None = None
) -> Deliverable:
    """Return the content of a recorded figure by its definition and the data that the store has now.

    `shared` returns the data of the batch if they serve several figures; by default, only those of this figure are read.
    """
    with parsing(row.name):
        definition = json.loads(row.definition)
        figure = options(Figure, definition["figure"], f"figure {row.name}, as it was recorded")
    if together := overlay.together_in(definition):
        word, names = together
        with ExitStack() as frames:
            batches = dict(zip(names, row.batches, strict=True))
            fitting = overlay.fitting(figure, declared=True)
            return _overlay(_galleries(project, store, batches, frames, word), row.name, fitting, word).content()
    if shared:
        return shared().drawing(row.name, figure).content()
    with BatchData(store, row.batch) as frame:
        only = {figure.table} if figure.table or figure.sql else None
        return Gallery(project, store, frame, only=only).drawing(row.name, figure).content()


def overlaid(
    project: LoadedProject,
    store: Store,
    batches: Mapping[str, str],
    name: str | None = None,
    word: overlay.Word = overlay.TARGET,
    *,
    formats: tuple[Format, ...] = (),
) -> tuple[list[Path], list[str]]:
    """Draw the figures and tables of several batches together; return the files, and what could not be drawn and why.

    `batches` are by target, or by label if `word` is `batch`. Raises NotFound if no figure or table has that name, SierraError
    if it cannot be drawn, or is drawn without a model.
    """
    with ExitStack() as frames:
        galleries = _galleries(project, store, batches, frames, word)
        first, *others = galleries.values()
        added = [gallery.frame.batch for gallery in others]
        drawer = _Drawer(project, store, first.frame, *added, again=True, formats=formats)
        declared = project.config.paper_tables
        tables, failed = _write_tables(drawer, project, store, batches, name, declared if name else bound.unbound(declared))
        if name in project.config.paper_tables:
            return tables, drawer.close()
        wanted, notes = default_figures.wanted(first, name, together=True)

        def drawing(called: str, original: Figure) -> Drawing:
            figure = overlay.fitting(original, declared=bool(project.config.figures))
            fitted = called.replace("_heatmap", "_summary") if figure is not original else called
            return _overlay(galleries, overlay.name_of(fitted, galleries), figure, word)

        drawn, undrawn = _draw_each(drawer, wanted, drawing, strict=name is not None)
        notes += (*undrawn, *failed)
        every = [note for gallery in (first, *others) for note in (*gallery.time_notes.values(), *gallery.models.notes())]
        notes += dict.fromkeys(every)
    notes += drawer.close()
    _check_models(name, first, *others)
    return [*drawn, *tables], notes


def _galleries(
    project: LoadedProject, store: Store, batches: Mapping[str, str], frames: ExitStack, word: overlay.Word
) -> dict[str, Gallery]:
    opened = {name: frames.enter_context(BatchData(store, batch)) for name, batch in batches.items()}
    if word == overlay.TARGET:
        return {name: Gallery(project.for_target(name), store, frame, name) for name, frame in opened.items()}
    return {name: Gallery(project, store, frame) for name, frame in opened.items()}


def _overlay(galleries: Mapping[str, Gallery], name: str, figure: Figure, word: overlay.Word) -> Drawing:
    return overlay.merged({label: gallery.drawing(name, figure) for label, gallery in galleries.items()}, word)


class _Drawer:
    """The writer of figures' files, which records them. Without `again`, it skips figures that it would only write again."""

    def __init__(
        self, project: LoadedProject, store: Store, frame: BatchData, *others: str, again: bool, formats: tuple[Format, ...]
    ) -> None:
        """`others`: further batches that the figures show. `formats`: empty for those that are declared."""
        self._recorder = Recorder(store, project.root, frame.batch, frame)
        self._mark = ProjectPaths(project.root).drawn("-".join(map(short, (frame.batch, *others))))
        self._again = again
        self._formats = formats
        self._declared = project.config.figure_formats

    def draw(self, drawing: Drawing) -> tuple[Path, ...]:
        """Return the figure's files, drawn now or before."""
        drawing = replace(drawing, formats=self._formats or drawing.figure.formats or self._declared)
        return self.keep(drawing.content(), partial(draw, drawing))

    def keep(self, content: Deliverable, write: Callable[[Path], tuple[Path, ...]]) -> tuple[Path, ...]:
        """Return the files of a deliverable, which `write` writes to a folder unless they are there already."""
        files = None if self._again else self._recorder.made(content)
        if files is None:
            files = write(marked_folder(self._mark, "Figures drawn by SIERRA: see the table deliverables."))
            self._recorder.add(content, files)
        return files

    def close(self) -> list[str]:
        """Record what was drawn. Return a note if that is not possible."""
        try:
            self._recorder.close()
        except Missing as error:
            return [f"the figures are drawn, but not recorded: {error}"]
        return []

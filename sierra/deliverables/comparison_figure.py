"""The figure of a comparison: drawn, recorded, and made again from its record."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from sierra.config import plugin_registry
from sierra.config.deliverable_tables import PRINTED, Figure, Format
from sierra.config.project_file import LoadedProject
from sierra.deliverables import comparison
from sierra.deliverables.comparison import KIND, Compared
from sierra.deliverables.record import Deliverable, Recorder, marked_folder
from sierra.errors import UsageError
from sierra.store.layout import COMPARISONS, ProjectPaths
from sierra.store.row_types import DeliverableRow
from sierra.store.store import Store
from sierra.util.json_types import JsonView
from sierra.util.text import n_of

if TYPE_CHECKING:
    import matplotlib.figure

    from sierra.deliverables.figures.drawing import Drawing


def draw(compared: Compared, store: Store, paths: ProjectPaths, formats: tuple[Format, ...] = PRINTED) -> list[Path]:
    """Draw the figure of a comparison in these formats, and record it; return the files.

    A comparison with a package is not drawn, because its data could not be computed again from the store.
    Raises UsageError if there is nothing to draw, Missing if the store cannot be written.
    """
    from sierra.deliverables.figures import drawing

    if compared.packaged:
        raise UsageError(f"the runs of {', '.join(compared.packaged)} are not in the store, so the data could not be checked")
    drawn = replace(drawing_of(compared), formats=formats)
    folder = marked_folder(paths.drawn(COMPARISONS), "Figures of comparisons, drawn by SIERRA.")
    files = drawing.save(rendered(compared, formats), drawn, folder)
    recorder = Recorder(store, paths.root, drawn.batch)
    recorder.add(_content(compared, drawn), files)
    recorder.close()
    return list(files)


def rendered(compared: Compared, formats: tuple[Format, ...]) -> list[tuple[Format, bytes]]:
    """Return the content of the figure's files, by format. Raises UsageError if there is nothing to draw."""
    from sierra.deliverables.figures import drawing, style

    drawn = replace(drawing_of(compared), formats=formats)
    with style.applied(drawn.figure):
        figure, drawn = painted(compared, drawn)
        return drawing.files_of(figure, drawn, drawn.data)


def painted(compared: Compared, drawn: Drawing) -> tuple[matplotlib.figure.Figure, Drawing]:
    """Return the complete figure, and its content with all of its small print. To be called under `style.applied`."""
    from sierra.deliverables.figures import style
    from sierra.deliverables.figures.forest import forest

    letters = style.choose_fonts(f"{compared.arrow().to_pydict()}{compared.asked.labels}{drawn.note}{compared.unit}")
    drawn = replace(drawn, note="; ".join((drawn.note, *letters)))
    figure = forest(compared)
    style.settle(figure, drawn)
    return figure, drawn


def svg(compared: Compared) -> bytes:
    """Return the figure of a comparison as an SVG file. Raises UsageError if there is nothing to draw."""
    [(_, data)] = rendered(compared, ("svg",))
    return data


def content(project: LoadedProject, store: Store, row: DeliverableRow) -> Deliverable:
    """Return the content of a recorded comparison by its definition and the data that the store has now."""
    return content_of(comparison.again(project, store, row))


def content_of(compared: Compared) -> Deliverable:
    """Return everything that the files of a comparison depend on."""
    return _content(compared, drawing_of(compared))


def _content(compared: Compared, drawn: Drawing) -> Deliverable:
    definition: dict[str, JsonView] = {
        "version": compared.analysis.version,
        "comparison": compared.asked.model_dump(mode="json"),
        "groups": list(compared.batches),
        "note": drawn.note,
        "formats": drawn.formats,
    }
    content = drawn.content()
    made_by = (*content.made_by, *plugin_registry.COMPARISONS.recorded(compared.analysis.method))
    return replace(content, kind=KIND, batches=tuple(compared.batches.values()), definition=definition, made_by=made_by)


def drawing_of(compared: Compared) -> Drawing:
    """Return the data and the small print of the figure of a comparison."""
    import pyarrow as pa

    from sierra.deliverables.figures.drawing import Drawing

    bands = [{name: getattr(band, name) for name in ("times", "mean", "low", "high")} for band in compared.bands]
    return Drawing(
        name=compared.name,
        figure=Figure() if compared.asked.size is None else Figure(size=compared.asked.size),
        axes=(),
        cells={},
        tables={"": compared.arrow()},
        rows={str(number): pa.table(band) for number, band in enumerate(bands)},
        note=caption_of(compared),
        sql=f"-- comparison of {', '.join(compared.batches.values())}",
        batch=next(iter(compared.batches.values())),
    )


def caption_of(compared: Compared) -> str:
    """Return the small print of the figure."""
    analysis = compared.analysis
    if compared.bands:
        return f"mean difference, {100 * (1 - analysis.question.alpha):.4g} % CI at each time (no test), {_runs(compared)}"
    margin = "; shaded: the margin" if analysis.question.margin is not None else ""
    return estimates_of(compared) + (f"; filled: different (Holm){margin}" if compared.pairs else "")


def estimates_of(compared: Compared) -> str:
    """Return what the differences and their intervals are, and the numbers of runs."""
    analysis = compared.analysis
    if compared.effects:
        return f"{analysis.title}; {analysis.pairing.reason}"
    known = any(pair.low is not None for pair in compared.pairs)
    each = "each" if len(compared.pairs) == 1 else f"each alone (not corrected for {len(compared.pairs)} pairs)"
    interval = analysis.estimates + (f", {100 * (1 - analysis.question.alpha):.4g} % CI of {each}" if known else "")
    return f"{interval}, {_runs(compared)}"


def _runs(compared: Compared) -> str:
    runs = n_of(n for pair in compared.pairs for n in (pair.n_first, pair.n_second))
    return f"{runs} pairs" if compared.analysis.pairing.paired else runs

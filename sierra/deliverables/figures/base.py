"""The contract of kinds of figures: what data a kind needs, and how it is drawn.

A kind is a plug-in: a class under a name, as an entry point of the group `sierra.figures` or in
`sierra/config/plugin_registry.py`. SIERRA computes what the kind needs in SQL. The kind gets a `Drawing`, which holds all data
and labels of one figure, and returns a matplotlib figure. SIERRA then adds title, legend space and small print, and writes the
files.

A kind's module must not import matplotlib, seaborn or pandas when it is imported, because its options are read for every
command. It imports them in `draw`; a `DrawnKind` imports the functions that draw it in `drawn_by`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache
from typing import TYPE_CHECKING, ClassVar, Generic, Protocol, TypeVar, runtime_checkable

from pydantic import Field

from sierra.config.deliverable_tables import Figure
from sierra.config.field_types import Table
from sierra.config.plugin_registry import FIGURES, NoOptions
from sierra.model import Axis
from sierra.stats.needs import Needs
from sierra.util.lazy_definitions import dataclass

if TYPE_CHECKING:
    import matplotlib.figure

    from sierra.deliverables.figures.drawing import Drawing
    from sierra.deliverables.html import Chart

CENTER = frozenset({"center", "band", "quantiles"})
"""The keys of kinds that draw centers with intervals."""
PLOT = frozenset({"log_x", "log_y", "xlim", "ylim", "palette", "labels"})
"""The keys of kinds that have an x axis, a y axis and categories."""
STATISTICAL = ("seaborn", "pandas")
"""The libraries that draw the kinds in `seaborn_plots`; they come with the extra `figures`."""
RUN = Field(description="number of the run that is shown, the same for all experiments")
ROWS = Field(description="count rows instead of runs")
"""Options that several kinds have."""
MODELS = "models"
"""The word in `uses` of kinds that draw `Drawing.models`."""


@dataclass(frozen=True, slots=True)
class Request:
    """A figure that is to be drawn of one batch."""

    figure: Figure
    """The keys of `[figures.NAME]` that all kinds share."""
    axes: tuple[Axis, ...]
    """The independent variables, in the order in which the figure uses them."""
    experiments: int
    rows: int
    """The number of rows of the longest run."""
    columns: tuple[str, ...] = ()


class FigureKind(Protocol):
    """One kind of figure. Objects may be used several times, and must not change.

    `draw` must give the same figure for the same data: no time, no unseeded random numbers, no order of a set. It works under
    SIERRA's settings of matplotlib (see `style`), and must not use `pyplot`. All that it leaves out must be in `notes`.
    A kind may also have `libraries`: the names of the packages besides matplotlib that draw it. Their versions are recorded.
    """

    Options: ClassVar[type[Table]]
    """The model of the keys of `[figures.NAME]` that only this kind has."""
    uses: ClassVar[frozenset[str]]
    """The keys of `sierra.config.deliverable_tables.CHOSEN` that have an effect; others are errors. Also `MODELS`."""

    def __init__(self, options: Table) -> None: ...

    def needs(self, request: Request) -> Needs:
        """Return what SQL must compute. Raises UsageError, in one line, if the batch does not suit the kind."""

    def notes(self, drawing: Drawing) -> Sequence[str]:
        """Return what the reader must know of this drawing, for the small print: for example values that are left out."""

    def draw(self, drawing: Drawing) -> matplotlib.figure.Figure:
        """Draw the data. Raises UsageError, in one line, if they do not suit the kind."""


@runtime_checkable
class Explorable(Protocol):
    """A kind whose data can be explored in a page of HTML. Of other kinds, the page shows the figure as it is printed."""

    def charts(self, drawing: Drawing) -> Sequence[Chart]:
        """Return the same data as charts, one for each panel. Raises UsageError if `draw` would."""


@dataclass(frozen=True, slots=True)
class DrawnBy:
    """The functions that draw a kind of figure, and that return notes for its small print."""

    draw: Callable[[Drawing], matplotlib.figure.Figure]
    notes: tuple[Callable[[Drawing], Sequence[str]], ...] = ()


Own = TypeVar("Own", bound=Table)


class DrawnKind(Generic[Own]):
    """A kind that is drawn by functions of other modules, with options of the type `Own`."""

    contract = 1
    Options: ClassVar[type[Table]] = NoOptions

    def __init__(self, options: Own) -> None:
        self.options = options

    def drawn_by(self) -> DrawnBy:
        """Import and return the functions that draw this kind."""
        raise NotImplementedError

    def notes(self, drawing: Drawing) -> Sequence[str]:
        return [note for notes in self.drawn_by().notes for note in notes(drawing)]

    def draw(self, drawing: Drawing) -> matplotlib.figure.Figure:
        return self.drawn_by().draw(drawing)


def made_by(kind: str) -> tuple[str, ...]:
    """Return the libraries that draw a kind of figure, as name==version; those that are not installed are not in it."""
    libraries = ("matplotlib", *getattr(FIGURES.load(kind), "libraries", ()))
    return (*(f"{name}=={version}" for name in libraries if (version := _version(name))), *FIGURES.recorded(kind))


@cache
def _version(library: str) -> str | None:
    """Return the version of a library; None if it is not installed."""
    from importlib.metadata import PackageNotFoundError, version

    with suppress(PackageNotFoundError):
        return version(library)
    return None


def kind_of(figure: Figure) -> FigureKind:
    """Return the kind of a figure, made with its options. Raises ConfigError, PluginError."""
    kind: FigureKind = FIGURES.make(figure.kind, {figure.kind: figure.own})
    return kind

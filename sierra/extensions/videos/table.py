"""The tables `[videos.NAME]` of `sierra.toml`: what a video shows of a batch, and in which files."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import AfterValidator, Field, NonNegativeInt, model_validator

from sierra.config.deliverable_tables import (
    FORMERLY_POSES,
    Bound,
    Layout,
    LimitsOfAxis,
    LimitsOfX,
    LimitsOfY,
    RowsOf,
    Title,
)
from sierra.config.field_types import Experiments, Finite, ListOfWords, Name, OfTable, Positive, Table

if TYPE_CHECKING:
    from sierra.config.project_file import Project

Kind = Literal["matrix", "grid", "trajectories", "network", "pictures", "capture"]
Format = Literal["mp4", "webm", "gif", "png"]
COLUMNS = {
    "matrix": (3, 3),
    "grid": (0, 100_000),
    "trajectories": (2, 3),
    "network": (2, 3),
    "pictures": (0, 0),
    "capture": (0, 0),
}
"""The smallest and the largest number of columns of each kind."""
NUMERIC = ("matrix", "grid")
"""The kinds whose states are numbers, which have means and differences."""
OF_KINDS = {
    "fill": ("matrix",),
    "palette": (*NUMERIC, "network"),
    "limits": (*NUMERIC, "network"),
    "label": (*NUMERIC, "network"),
    "robot": ("trajectories",),
    "xlim": ("trajectories", "network"),
    "ylim": ("trajectories", "network"),
    "place": ("network",),
    "layout": ("network",),
    "directed": ("network",),
    "node_value": ("network",),
}
"""The keys that only some kinds have."""
FASTEST_GIF = 50
"""The most frames per second of a GIF: its times are in 1/100 s, and browsers show frames of 1/100 s for 1/10 s."""
FASTEST, USUAL = 60.0, 25.0
SHORTEST, LONGEST = 5.0, 20.0
"""The seconds that a video lasts at least and at most if nothing says how fast it is."""
Pixels = Annotated[int, Field(ge=160, le=4096)]


def _once(formats: tuple[Format, ...]) -> tuple[Format, ...]:
    if twice := next((name for name in formats if formats.count(name) > 1), None):
        raise ValueError(f"{twice!r} is named twice")
    return formats


class Video(Table):
    """One video of each experiment of a batch, or of several runs or experiments side by side, for `sierra video`."""

    kind: Annotated[Kind, FORMERLY_POSES] = Field(
        "matrix",
        description="`matrix`: three columns (number of the row, number of the column, value), a row for each cell; `grid`: "
        "each row of the table is a row of the matrix, and `columns` are its columns; `trajectories`, formerly `poses`: x, y "
        "and perhaps the heading in radians, a row for each robot; `network`: source, target and perhaps a weight, a row for "
        "each edge; `pictures`: images or videos that runs leave, in the files of the output that `table` names; `capture`: "
        "the frames that `sierra video --capture` has recorded",
    )
    query: Bound = ()
    table: OfTable = ""
    sql: RowsOf = ""
    columns: ListOfWords = Field(
        (), alias="column", description="the columns that the kind needs; default for `grid`: all numeric ones but the time"
    )
    show: Literal["run", "mean", "tiles", "difference"] = Field(
        "run",
        description="`run`: a video of one run of each experiment; `mean`: a video of the mean over the runs of each "
        "experiment; `tiles`: all runs of an experiment side by side; `difference`: A, B and A − B of two experiments",
    )
    run: NonNegativeInt | None = Field(
        None, description="number of the run that is shown; default: 0, and the mean over all runs in a difference"
    )
    experiments: Experiments = ""
    groups: ListOfWords = Field(
        (), description="for `difference`: two conditions as in `experiments`, A and B, that choose one experiment each"
    )
    step: Positive | None = Field(
        None,
        description="time between frames, in the unit of the time that is shown; a frame shows the last values until its "
        "time; default: a frame for each time that a run wrote",
    )
    fill: Finite | None = Field(
        None,
        description="value of cells that have no row, also of whole rows between others; default: such a matrix is an error",
    )
    limits: LimitsOfAxis | None = Field(
        None, description="values at the ends of the colours; default: the smallest and the largest value of all frames"
    )
    palette: Literal["viridis", "cividis", "magma", "grey", "coolwarm"] = Field("viridis", description="scale of colours")
    robot: str = Field(
        "",
        description="column that tells robots apart, for their colours, numbers and trails; a robot has one row at a time; "
        "default: all look the same, and this is not checked",
    )
    xlim: LimitsOfX = None
    ylim: LimitsOfY = None
    place: ListOfWords = Field(
        (), description="columns of x and y of the source of a row at its time; default: a layout that is the same at all times"
    )
    layout: Layout = "spring"
    directed: bool = Field(False, description="draw arrows, and do not merge the two directions of an edge")
    node_value: str = Field("", description="column that gives the source of a row its colour; default: one colour")
    title: Title = ""
    label: str = Field("", description="label of the values; default: the name of their column and its unit")
    size: tuple[Pixels, Pixels] = Field((640, 480), description="width and height in pixels; odd sizes are increased by one")
    fps: Annotated[float, Field(ge=0.1, le=120)] | None = Field(
        None,
        description="frames per second; a `gif` has at most 50; default: 25, or what makes the video last 5 to 20 s, but at "
        "most 60, or 50 in a `gif`",
    )
    formats: Annotated[
        tuple[Format, ...], Field(min_length=1, json_schema_extra={"uniqueItems": True}), AfterValidator(_once)
    ] = Field(("mp4",), description="formats of the files: `mp4` (H.264), `webm` (VP9), `gif`; `png`: a file for each frame")

    @model_validator(mode="after")
    def _fitting(self) -> Video:
        if self.table and self.sql:
            raise ValueError('give either "table" or "sql"')
        for key, kinds in OF_KINDS.items():
            if key in self.model_fields_set and self.kind not in kinds:
                raise ValueError(f'"{key}" needs kind {" or ".join(map(repr, kinds))}, not {self.kind!r}')
        if self.kind == "pictures" and not self.table:
            raise ValueError("kind 'pictures' needs \"table\": the name of the output with their files")
        if self.kind == "capture" and (self.table or self.sql):
            raise ValueError('kind \'capture\' shows the frames that sierra video --capture records; remove "table" and "sql"')
        if len(self.place) not in (0, 2):
            raise ValueError('"place" should name the two columns of x and y')
        if self.kind == "network" and not self.place and {"xlim", "ylim"} & self.model_fields_set:
            raise ValueError('"xlim" and "ylim" of a network need "place"')
        if self.kind == "network" and not self.node_value and {"palette", "limits", "label"} & self.model_fields_set:
            raise ValueError('"palette", "limits" and "label" of a network need "node_value"')
        if "gif" in self.formats and (self.fps or 0) > FASTEST_GIF:
            raise ValueError(f"a gif has at most {FASTEST_GIF} frames per second; browsers show faster ones slowly")
        least, most = COLUMNS[self.kind]
        if not least <= len(self.columns) <= most:
            wanted = str(least) if least == most else f"{least} to {most}"
            raise ValueError(f"kind {self.kind!r} needs {wanted} columns, not {len(self.columns)}")
        return self

    @model_validator(mode="after")
    def _shows(self) -> Video:
        if (self.show == "difference") != bool(self.groups) or len(self.groups) not in (0, 2):
            raise ValueError('show = "difference" and two "groups", such as ["noise=0", "noise=0.4"], belong together')
        if self.show in ("mean", "difference") and self.kind not in NUMERIC:
            raise ValueError(f'show = "{self.show}" needs numbers: kind "matrix" or "grid", not {self.kind!r}')
        if self.show in ("mean", "tiles") and self.run is not None:
            raise ValueError(f'show = "{self.show}" shows all runs, so it cannot be used with "run"')
        if self.show == "difference" and self.experiments:
            raise ValueError('the experiments of a difference are its "groups"')
        return self

    def rate(self, frames: int, format: Format) -> float:
        """Return the frames per second of a file with this number of frames."""
        fitting = max(frames / LONGEST, min(USUAL, frames / SHORTEST))
        return self.fps or min(fitting, FASTEST_GIF if format == "gif" else FASTEST)


TABLE: tuple[object, object] = (
    Mapping[Name, Video],
    Field(default_factory=dict, description="videos, by name, for `sierra video`"),
)
"""The key `videos` of `sierra.toml`."""


def declared(config: Project) -> Mapping[str, Video]:
    """Return the declared videos of a project, by name."""
    found: Mapping[str, Video] = config.added("videos", {})
    return found

"""The kinds of what videos show: the tracks of the runs of a film, and the painter of their states."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Protocol, cast

from sierra.config.deliverable_tables import Figure
from sierra.config.output_tables import PLACEHOLDER
from sierra.config.video_table import Video
from sierra.deliverables.gallery import Gallery
from sierra.deliverables.videos.films import Film
from sierra.deliverables.videos.pictures import pictures
from sierra.deliverables.videos.poses import Poses
from sierra.deliverables.videos.sql_tracks import Grids, Matrices, Source, shown_files
from sierra.deliverables.videos.survey import Range, Survey
from sierra.errors import SierraError, UsageError
from sierra.util.text import counted

if TYPE_CHECKING:
    from sierra.deliverables.videos.pictures import PictureTrack
    from sierra.deliverables.videos.scene import Painter, Scale
    from sierra.deliverables.videos.tracks import Track


class Subject(Protocol):
    """The subject of one film."""

    @property
    def tracks(self) -> Sequence[Track]:
        """One for each run of the film."""

    time: str
    """The name of the time."""
    unit: str
    """The unit of the time; "" if there is none."""
    layout: Mapping[str, Sequence[float]]
    """The numbers of the rows and columns of matrices, by their names; others have none."""
    sql: str
    """The SQL that the states are computed from."""

    def notes(self, survey: Survey) -> Sequence[str]:
        """Return what the viewer must know of the states."""

    def painter(self, film: Film, survey: Survey, tracks: Sequence[Track]) -> Painter:
        """Return the painter; `survey` has the ranges of all films of the video, `tracks` are those of the film's runs."""


def subjects(video: Video, gallery: Gallery) -> Callable[[Film], Subject]:
    """Return the function that makes what a film shows. It raises SierraError for a table or column that does not suit."""
    if video.kind == "pictures":
        return partial(_Pictures, video, gallery)
    kind = _Robots if video.kind == "poses" else _Cells
    return partial(kind, video, gallery, source_of(video, gallery))


def source_of(video: Video, gallery: Gallery) -> Source:
    """Return the table that a video shows. Raises NotFound, or UsageError for a table without a time."""
    output = gallery.output(Figure.model_construct(table=video.table, sql=video.sql, columns=video.columns))
    time = gallery.time(output)
    if not time:
        raise UsageError(f'output {output.name!r} has no time column; set time = "COLUMN" in [outputs.{output.name}]')
    return Source(gallery.frame, output, time, gallery.ticks_per_second(output.name))


class _Timed:
    """The time of a table, as frames show it."""

    def __init__(self, source: Source, gallery: Gallery) -> None:
        self.source = source
        self.time = source.time
        self.unit = "s" if source.per_second else gallery.unit(source.output, source.time)


class _Cells(_Timed):
    """Matrices as colours."""

    def __init__(self, video: Video, gallery: Gallery, source: Source, film: Film) -> None:
        super().__init__(source, gallery)
        self._video = video
        self._grid = (Matrices if video.kind == "matrix" else Grids)(self.source, video, film.runs)
        self.tracks = self._grid.tracks
        self._names = self._grid.columns[:2] if video.kind == "matrix" else ("row", "column")
        self.layout: Mapping[str, Sequence[float]] = dict(
            zip(self._names, (self._grid.up.tolist(), self._grid.across.tolist()), strict=True)
        )
        self.sql = self.source.shown(self._grid.columns, film.runs)
        value = self._grid.columns[-1] if video.kind == "matrix" else self.source.output.name
        self._value = _labelled(video.label or value, gallery.unit(self.source.output, self._grid.columns[-1]))

    def notes(self, survey: Survey) -> Sequence[str]:
        timeless = sum(rows.timeless for rows in self._grid.rows)
        limits, found = self._video.limits, survey.values
        beyond = limits is not None and found.found and (found.low < limits[0] or found.high > limits[1])
        return [
            *([f"{counted(timeless, 'row')} without a time left out"] if timeless else []),
            *([f"cells without a row count as {self._video.fill:g}"] if self._video.fill is not None else []),
            *(["grey: cells without a finite value"] if survey.empty else []),
            *(["values beyond the scale have the colours of its ends"] if beyond else []),
        ]

    def painter(self, film: Film, survey: Survey, tracks: Sequence[Track]) -> Painter:
        from sierra.deliverables.videos.scene import MatrixPainter

        del tracks
        labels = (self._names[0].replace("_", " "), self._names[1].replace("_", " "))
        return MatrixPainter(self._grid.up, self._grid.across, labels, self._scales(film, survey))

    def _scales(self, film: Film, survey: Survey) -> list[Scale]:
        from sierra.deliverables.videos.scene import Scale

        shown = tuple(k for k, panel in enumerate(film.panels) if not panel.minus)
        apart = tuple(k for k, panel in enumerate(film.panels) if panel.minus)
        low, high = self._video.limits or _ends(survey.values)
        beyond = (survey.values.low < low, survey.values.high > high)
        scales = [
            Scale(low, high, "gray" if self._video.palette == "grey" else self._video.palette, self._value, shown, beyond)
        ]
        if apart:
            most = max(map(abs, _ends(survey.differences)))
            scales.append(Scale(-most, most, "coolwarm", f"difference of {self._value}", apart))
        return scales


class _Robots(_Timed):
    """Poses of robots."""

    def __init__(self, video: Video, gallery: Gallery, source: Source, film: Film) -> None:
        super().__init__(source, gallery)
        self._video = video
        self._poses = Poses(source, video, film.runs)
        self.layout: Mapping[str, Sequence[float]] = {}
        self.tracks = self._poses.tracks
        self.sql = source.shown((*filter(None, (video.robot,)), *video.columns), film.runs)
        x, y = (_labelled(name, gallery.unit(source.output, name)) for name in video.columns[:2])
        self._labels = x, y

    def notes(self, survey: Survey) -> Sequence[str]:
        timeless = sum(rows.timeless for rows in self._poses.rows)
        cut = self._video.xlim is not None or self._video.ylim is not None
        return [
            *([f"{counted(timeless, 'row')} without a time left out"] if timeless else []),
            *([f"{survey.empty} missing values: robots without a place are not shown"] if survey.empty else []),
            *(["robots beyond the limits are not shown"] if cut else []),
        ]

    def painter(self, film: Film, survey: Survey, tracks: Sequence[Track]) -> Painter:
        from sierra.deliverables.videos.pose_painter import PosePainter

        del film, tracks
        return PosePainter(self._limits(0, self._video.xlim, survey), self._limits(1, self._video.ylim, survey), self._labels)

    def _limits(self, place: int, given: tuple[float, float] | None, survey: Survey) -> tuple[float, float]:
        """Return the limits of an axis: the given ones, or those of all films with a margin."""
        if given:
            return given
        low, high = _ends(survey.columns[place] if place < len(survey.columns) else Range())
        margin = 0.05 * (high - low)
        return low - margin, high + margin


class _Pictures:
    """Pictures that runs left in files."""

    def __init__(self, video: Video, gallery: Gallery, film: Film) -> None:
        output = gallery.declared_output(video.table)
        per_second = gallery.ticks_per_second(video.table)
        self.tracks = [
            pictures(gallery.frame, video.table, output, run, per_second.get(run.experiment, 1.0)) for run in film.runs
        ]
        self.time = output.ticks[0] if output.ticks else "time"
        self.unit = "s" if per_second or not output.ticks else output.units.get(self.time, "")
        self.layout: Mapping[str, Sequence[float]] = {}
        self.sql = shown_files(PLACEHOLDER.sub("*", output.file.removeprefix("./")), film.runs)

    def notes(self, survey: Survey) -> Sequence[str]:
        del survey
        return [track.missing for track in self.tracks if track.missing]

    def painter(self, film: Film, survey: Survey, tracks: Sequence[Track]) -> Painter:
        from sierra.deliverables.videos.picture_painter import PicturePainter

        del survey
        return PicturePainter([cast("PictureTrack", tracks[panel.plus[0]]) for panel in film.panels])


def _labelled(name: str, unit: str) -> str:
    return f"{name.replace('_', ' ')} [{unit}]" if unit else name.replace("_", " ")


def _ends(values: Range) -> tuple[float, float]:
    """Return the ends of a scale, which are different numbers. Raises SierraError if there is no value."""
    if not values.found:
        raise SierraError("there is no finite value to show")
    if values.low < values.high:
        return values.low, values.high
    around = abs(values.low) * 0.1 + 1e-12
    return values.low - around, values.high + around

"""The kinds of subjects: matrices, robots, networks and pictures.

Each has the tracks of the runs of a film, the notes for the viewer, and the painter of its states.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, TypeAlias, cast

from sierra.deliverables.figures.drawing import check_magnitude
from sierra.deliverables.gallery import Gallery
from sierra.errors import SierraError
from sierra.extensions.videos.films import Film
from sierra.extensions.videos.networks import Networks
from sierra.extensions.videos.pictures import pictures
from sierra.extensions.videos.poses import Poses
from sierra.extensions.videos.sql_tracks import Grids, Matrices, Rows, TrackSource, shown_files
from sierra.extensions.videos.survey import Range, Survey
from sierra.extensions.videos.table import Video
from sierra.extensions.videos.tracks import uneven
from sierra.util.text import counted, few

if TYPE_CHECKING:
    from sierra.extensions.videos.painting.scene import Painter, Scale
    from sierra.extensions.videos.pictures import PictureTrack
    from sierra.extensions.videos.tracks import Track

Layout: TypeAlias = Mapping[str, Sequence[float] | Sequence[str]]
"""The numbers of rows and columns, or the nodes, by their names."""


class Timed:
    """The time of a table, as frames show it, and the units of the columns with `values`."""

    def __init__(self, source: TrackSource, gallery: Gallery, values: Sequence[str]) -> None:
        self.source = source
        self.time = source.time
        self.unit = "s" if source.per_second else gallery.unit(source.output, source.time)
        self.units: Mapping[str, str] = {name: gallery.unit(source.output, name) for name in values}


def _left_out(rows: Sequence[Rows]) -> list[str]:
    """Return notes on rows without a time, and on runs without a row."""
    timeless = sum(one.timeless for one in rows)
    empty = [f"run {one.run.number} of experiment {one.run.experiment}" for one in rows if not len(one.times)]
    return [
        *([f"{counted(timeless, 'row')} without a time left out"] if timeless else []),
        *([f"without a row: {few(empty, 8)}"] if empty else []),
    ]


class CellSubject(Timed):
    """Matrices as colours."""

    def __init__(self, video: Video, gallery: Gallery, source: TrackSource, film: Film) -> None:
        self._grid = (Matrices if video.kind == "matrix" else Grids)(source, video, film.runs)
        super().__init__(source, gallery, self._grid.columns[2:] if video.kind == "matrix" else self._grid.columns)
        self._video = video
        self.tracks = self._grid.tracks
        self._names = self._grid.columns[:2] if video.kind == "matrix" else ("row", "column")
        of_axes = [gallery.unit(source.output, name) if video.kind == "matrix" else "" for name in self._names]
        up, across = map(_labelled, self._names, of_axes)
        self._labels = up, across
        self.layout: Layout = dict(zip(self._names, (self._grid.up.tolist(), self._grid.across.tolist()), strict=True))
        self.sql = self.source.shown(self._grid.columns, film.runs)
        value = self._grid.columns[-1] if video.kind == "matrix" else self.source.output.name
        units = set(self.units.values())
        self._value = _labelled(video.label or value, units.pop() if len(units) == 1 else "")

    def left_out(self) -> Sequence[str]:
        return _left_out(self._grid.rows)

    def notes(self, survey: Survey) -> Sequence[str]:
        limits, found = self._video.limits, survey.values
        beyond = limits is not None and found.found and (found.low < limits[0] or found.high > limits[1])
        return [
            *(f"numbers of {name} are uneven: {names} between neighbours" for name, names in self._uneven()),
            *([f"cells without a row count as {self._video.fill:g}"] if self._video.fill is not None else []),
            *(["grey: cells without a finite value"] if survey.empty else []),
            *(["values beyond the scale have the colours of its ends"] if beyond else []),
        ]

    def _uneven(self) -> Iterator[tuple[str, str]]:
        """Yield the names of rows or columns whose numbers have different distances, but not in the picture."""
        for name, numbers in zip(self._names, (self._grid.up, self._grid.across), strict=True):
            if steps := uneven(numbers):
                yield name.replace("_", " "), "{:g} to {:g}".format(*steps)

    def painter(self, film: Film, survey: Survey, tracks: Sequence[Track]) -> Painter:
        from sierra.extensions.videos.painting.scene import MatrixPainter

        del tracks
        return MatrixPainter(self._grid.up, self._grid.across, self._labels, self._scales(film, survey))

    def _scales(self, film: Film, survey: Survey) -> list[Scale]:
        from sierra.extensions.videos.painting.scene import Scale

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


class RobotSubject(Timed):
    """Poses of robots."""

    def __init__(self, video: Video, gallery: Gallery, source: TrackSource, film: Film) -> None:
        super().__init__(source, gallery, video.columns)
        self._video = video
        self._poses = Poses(source, video, film.runs)
        self.layout: Layout = {"robots": self._poses.robots}
        self.tracks = self._poses.tracks
        self.sql = source.shown((*filter(None, (video.robot,)), *video.columns), film.runs)
        x, y = (_labelled(name, self.units[name]) for name in video.columns[:2])
        self._labels = x, y

    def left_out(self) -> Sequence[str]:
        return _left_out(self._poses.rows)

    def notes(self, survey: Survey) -> Sequence[str]:
        cut = self._video.xlim is not None or self._video.ylim is not None
        return [
            *([f"{survey.empty} missing values: robots without a place are not shown"] if survey.empty else []),
            *(["robots beyond the limits are not shown"] if cut else []),
            *self._legend(),
        ]

    def _legend(self) -> Iterator[str]:
        """Yield what the numbers of robots stand for, unless they are the names."""
        from sierra.extensions.videos.painting.pose_painter import marks

        robots = self._poses.robots
        if (shown := marks(robots)) and shown != robots:
            yield f"numbers: {few([f'{mark} {name}' for mark, name in zip(shown, robots, strict=True)], 12)}"

    def painter(self, film: Film, survey: Survey, tracks: Sequence[Track]) -> Painter:
        from sierra.extensions.videos.painting.pose_painter import PosePainter

        del film, tracks
        x, y, *_ = survey.columns or (Range(), Range())
        wide, high = (ends[1] - ends[0] for ends in (_ends(x), _ends(y)))
        room = MARGIN * max(wide, high)
        limits = _margin(x, self._video.xlim, room), _margin(y, self._video.ylim, room)
        return PosePainter(*limits, self._labels, self._poses.robots)


class NetworkSubject(Timed):
    """Nodes and edges."""

    def __init__(self, video: Video, gallery: Gallery, source: TrackSource, film: Film) -> None:
        super().__init__(source, gallery, (*video.columns[2:], *video.place, video.node_value))
        self._video = video
        self._network = Networks(source, video, film.runs)
        self.tracks = self._network.tracks
        self.layout: Layout = {"nodes": self._network.nodes}
        self.sql = source.shown((*video.columns, *video.place, *filter(None, (video.node_value,))), film.runs)
        self._labels = tuple(_labelled(name, self.units[name]) for name in video.place)
        self._value = _labelled(video.label or video.node_value, self.units[video.node_value])
        self._notes = [
            *([] if video.node_value else ["hollow: no edge"]),
            *(["grey: nodes without a value"] if video.node_value else []),
            *([f"width: {video.columns[2].replace('_', ' ')}"] if video.columns[2:] else []),
            "nodes without a row at a time are not shown" if video.place else "places: a layout of the edges of all times",
        ]

    def left_out(self) -> Sequence[str]:
        return [*_left_out(self._network.rows), *self._network.notes()]

    def notes(self, survey: Survey) -> Sequence[str]:
        del survey
        cut = self._video.xlim is not None or self._video.ylim is not None
        return [*self._notes, *(["nodes beyond the limits are not shown"] if cut else [])]

    def painter(self, film: Film, survey: Survey, tracks: Sequence[Track]) -> Painter:
        from sierra.extensions.videos.painting.network_painter import Look, NetworkPainter
        from sierra.extensions.videos.painting.scene import Scale

        del tracks
        video = self._video
        x, y, value, _, _, _, weight = survey.columns
        scale = None
        if video.node_value:
            low, high = video.limits or _ends(value)
            palette = "gray" if video.palette == "grey" else video.palette
            panels = tuple(range(len(film.panels)))
            scale = Scale(low, high, palette, self._value, panels, (value.low < low, value.high > high))
        places = None if video.place else self._network.places()
        limits = LAYOUT if places is not None else (_margin(x, video.xlim), _margin(y, video.ylim))
        widest = max(map(abs, (weight.low, weight.high))) if weight.found and video.columns[2:] else 0.0
        labels = (self._labels[0], self._labels[1]) if video.place else None
        return NetworkPainter(Look(self._network.nodes, places, limits, labels, video.directed, widest, scale))


LAYOUT = ((-1.25, 1.25), (-1.25, 1.25))
"""The limits of computed layouts, whose nodes are between -1 and 1."""


MARGIN = 0.06
"""The part of the longer axis that is left beside robots: they and their headings fit into it."""


def _margin(values: Range, given: tuple[float, float] | None, margin: float | None = None) -> tuple[float, float]:
    """Return the limits of an axis: the given ones, or those of the values with a margin."""
    if given:
        return given
    low, high = _ends(values)
    margin = 0.05 * (high - low) if margin is None else margin
    return low - margin, high + margin


class PictureSubject:
    """Pictures that runs left in files."""

    def __init__(self, video: Video, gallery: Gallery, film: Film) -> None:
        output = gallery.declared_output(video.table)
        per_second = gallery.ticks_per_second(video.table)
        self.tracks = [
            pictures(gallery.frame, video.table, output, run, per_second.get(run.experiment, 1.0)) for run in film.runs
        ]
        self.time = output.ticks[0] if output.ticks else "time"
        self.unit = "s" if per_second or not output.ticks else output.units.get(self.time, "")
        self.units: Mapping[str, str] = {}
        self.layout: Layout = {}
        self.sql = shown_files(output, gallery.frame.batch, film.runs)

    def left_out(self) -> Sequence[str]:
        return [track.missing for track in self.tracks if track.missing]

    def notes(self, survey: Survey) -> Sequence[str]:
        del survey
        return []

    def painter(self, film: Film, survey: Survey, tracks: Sequence[Track]) -> Painter:
        from sierra.extensions.videos.painting.picture_painter import PicturePainter

        del survey
        return PicturePainter([cast("PictureTrack", tracks[panel.plus[0]]) for panel in film.panels])


def _labelled(name: str, unit: str) -> str:
    return f"{name.replace('_', ' ')} [{unit}]" if unit else name.replace("_", " ")


def _ends(values: Range) -> tuple[float, float]:
    """Return the ends of a scale, which are different numbers. Raises SierraError if there is no value, or one too large."""
    if not values.found:
        raise SierraError("there is no finite value to show")
    check_magnitude(max(abs(values.low), abs(values.high)))
    if values.low < values.high:
        return values.low, values.high
    around = abs(values.low) * 0.1 + 1e-12
    return values.low - around, values.high + around

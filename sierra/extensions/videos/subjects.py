"""Subjects: what a film shows, as the tracks of its runs and the painter of their states."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Protocol

from sierra.config.deliverable_tables import Figure
from sierra.deliverables.gallery import Gallery
from sierra.errors import UsageError
from sierra.extensions.videos.captured import CapturedSubject
from sierra.extensions.videos.films import Film
from sierra.extensions.videos.sql_tracks import TrackSource
from sierra.extensions.videos.subject_kinds import CellSubject, Layout, NetworkSubject, PictureSubject, RobotSubject
from sierra.extensions.videos.survey import Survey
from sierra.extensions.videos.table import Video

if TYPE_CHECKING:
    from sierra.extensions.videos.painting.scene import Painter
    from sierra.extensions.videos.tracks import Track


class Subject(Protocol):
    """The subject of one film."""

    @property
    def tracks(self) -> Sequence[Track]:
        """One for each run of the film."""

    time: str
    """The name of the time."""
    unit: str
    """The unit of the time; "" if there is none."""
    units: Mapping[str, str]
    """The units of the values that are shown, by their columns; those without one are "" or not there."""
    layout: Layout
    """The numbers of the rows and columns of matrices, by their names; the nodes of networks; others have none."""
    sql: str
    """The SQL that the states are computed from."""

    def left_out(self) -> Sequence[str]:
        """Return notes on data that are not shown, which the user is told, too."""

    def notes(self, survey: Survey) -> Sequence[str]:
        """Return what else the viewer must know of the states."""

    def painter(self, film: Film, survey: Survey, tracks: Sequence[Track]) -> Painter:
        """Return the painter; `survey` has the ranges of all films of the video, `tracks` are those of the film's runs."""


def subjects(video: Video, gallery: Gallery) -> Callable[[Film], Subject]:
    """Return the function that makes what a film shows. It raises SierraError for a table or column that does not suit."""
    if video.kind == "capture":
        return partial(CapturedSubject, gallery.frame)
    if video.kind == "pictures":
        return partial(PictureSubject, video, gallery)
    source = source_of(video, gallery)
    match video.kind:
        case "trajectories":
            return partial(RobotSubject, video, gallery, source)
        case "network":
            return partial(NetworkSubject, video, gallery, source)
        case _:
            return partial(CellSubject, video, gallery, source)


def source_of(video: Video, gallery: Gallery) -> TrackSource:
    """Return the table that a video shows. Raises NotFound, or UsageError for a table without a time."""
    output = gallery.output(Figure.model_construct(table=video.table, sql=video.sql, columns=video.columns))
    time = gallery.time(output)
    if not time:
        raise UsageError(f'output {output.name!r} has no time column; set time = "COLUMN" in [outputs.{output.name}]')
    return TrackSource(gallery.frame, output, time, gallery.ticks_per_second(output.name))

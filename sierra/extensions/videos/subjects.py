"""Subjects: what a film shows, as the tracks of its runs and the painter of their states.

Also: frames that `sierra video --capture` recorded, as the subject of a video. The frames say if they show what was measured.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Protocol

from sierra.config.deliverable_tables import Figure
from sierra.config.output_tables import FILE_FORMAT, Output
from sierra.config.validate import options
from sierra.deliverables.gallery import Gallery
from sierra.errors import NotFound, UsageError
from sierra.extensions.videos.films import Film
from sierra.extensions.videos.pictures import Pictures, VideoFile, pictures
from sierra.extensions.videos.sql_tracks import TrackSource
from sierra.extensions.videos.subject_kinds import CellSubject, Layout, NetworkSubject, PictureSubject, RobotSubject
from sierra.extensions.videos.survey import Survey
from sierra.extensions.videos.table import Video
from sierra.store.batch_data import BatchData, ChosenRun
from sierra.store.row_types import CaptureRow
from sierra.store.sql_names import quote
from sierra.util.text import few

if TYPE_CHECKING:
    from sierra.extensions.videos.painting.scene import Painter
    from sierra.extensions.videos.tracks import Track


AS_MEASURED = ("identical", "equal", "within tolerance")
"""The verdicts of captures that show what was measured."""


class CapturedSubject(PictureSubject):
    """Pictures of executions with rendering, for the runs of a film."""

    def __init__(self, frame: BatchData, film: Film) -> None:
        """Raises NotFound if no frames of a run are recorded, and the errors of damaged pictures."""
        captures = frame.captures(film.runs)
        if lacking := [run for run in film.runs if run.judgement not in captures]:
            names = few([f"run {run.number} of experiment {run.experiment}" for run in lacking], 3)
            wanted = f"sierra video --capture --runs {max(run.number for run in lacking) + 1}"
            raise NotFound(f"there are no captured frames of {names}; {wanted} makes them")
        self._rows = [(run, captures[str(run.judgement)]) for run in film.runs]
        self.tracks = [_track(frame, run, row) for run, row in self._rows]
        in_seconds = all(row.ticks_per_second for _, row in self._rows)
        self.time, self.unit = ("time", "s") if in_seconds else ("tick", "")
        self.units: Mapping[str, str] = {}
        self.layout: Layout = {}
        ids = ", ".join(quote(row.execution) for _, row in self._rows)
        self.sql = f"SELECT execution, path, sha256 FROM artifacts WHERE execution IN ({ids}) ORDER BY ALL"

    def left_out(self) -> Sequence[str]:
        """Return the differences from the measured executions."""
        return [
            f"NOT what was measured: run {run.number} differs when it is rendered ({row.reason})"
            for run, row in self._rows
            if row.verdict not in AS_MEASURED
        ]

    def notes(self, survey: Survey) -> Sequence[str]:
        del survey
        return [] if self.left_out() else ["rendered apart from the measured runs, with the same results"]


def _track(frame: BatchData, run: ChosenRun, row: CaptureRow) -> Pictures | VideoFile:
    """Return the frames of one run, which belong to the execution for capture."""
    output = options(Output, {"file": row.files, "format": FILE_FORMAT}, "captured files")
    return pictures(frame, "capture", output, replace(run, judgement=row.execution), row.ticks_per_second or 1.0)


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

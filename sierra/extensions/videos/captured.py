"""Frames that `sierra video --capture` recorded, as the subject of a video. The frames say if they show what was measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from sierra.config.output_tables import FILE_FORMAT, Output
from sierra.config.validate import options
from sierra.errors import NotFound
from sierra.extensions.videos.films import Film
from sierra.extensions.videos.pictures import Pictures, VideoFile, pictures
from sierra.extensions.videos.subject_kinds import Layout, PictureSubject
from sierra.extensions.videos.survey import Survey
from sierra.store.batch_data import BatchData, ChosenRun
from sierra.store.row_types import CaptureRow
from sierra.store.sql_names import quote
from sierra.util.text import few

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

"""Render the videos of a batch that `sierra.toml` declares, and record them like figures."""

from __future__ import annotations

import json
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir

from sierra.config.project_file import LoadedProject
from sierra.config.validate import options
from sierra.deliverables import bound
from sierra.deliverables.gallery import Gallery
from sierra.deliverables.kinds import FilesOfPaper
from sierra.deliverables.record import Deliverable, Recorder, marked_folder, parsing
from sierra.errors import DamagedFile, Missing, NotFound, NotInstalled, SierraError
from sierra.execution import targets
from sierra.execution.batches_of_queries import BatchesOfQueries
from sierra.extensions.videos import encode
from sierra.extensions.videos.draw import write
from sierra.extensions.videos.prepare import Prepared, prepare
from sierra.extensions.videos.progress import Progress, no_progress
from sierra.extensions.videos.table import Video, declared
from sierra.store.batch_data import BatchData
from sierra.store.layout import ProjectPaths
from sierra.store.row_types import DeliverableRow
from sierra.store.segments import disk_errors
from sierra.store.store import Store
from sierra.util.fs import fitting
from sierra.util.hashing import short
from sierra.util.lazy_definitions import dataclass
from sierra.util.text import like

MARK = "Figures drawn by SIERRA: see the table deliverables."


@dataclass(frozen=True, slots=True)
class RenderedVideos:
    """The videos that were made, and notes."""

    files: list[Path]
    notes: list[str]
    complete: bool
    """False if a video, or the file of an experiment, could not be made; notes say why."""


def joined(made: Sequence[RenderedVideos]) -> RenderedVideos:
    """Return all files and notes, each note once."""
    notes = dict.fromkeys(note for part in made for note in part.notes)
    return RenderedVideos([file for part in made for file in part.files], [*notes], all(part.complete for part in made))


def videos(
    project: LoadedProject,
    store: Store,
    batches: Mapping[str, str],
    names: Sequence[str] = (),
    *,
    jobs: int = 1,
    progress: Progress = no_progress,
) -> RenderedVideos:
    """Make the videos of a batch, or of two, all or those with these names.

    `batches` are by label. `jobs` is the number of files that are made at a time. Notes say what could not be shown and why.
    Raises NotFound if none has that name, NotInstalled without the encoders, SierraError if a video that is named cannot be
    made.
    """
    config = targets.of_batch(project, store, next(iter(batches.values()))).config
    wanted, invalid = _wanted(declared(config), names), list[str]()
    if not names and len(batches) == 1:
        wanted, invalid = bound.of_batch(wanted, BatchesOfQueries(project, store), *batches.values())
    elif not names:
        wanted = bound.unbound(wanted)
    encode.check({format for video in wanted.values() for format in video.formats})
    written: list[Path] = []
    complete = True
    with ExitStack() as frames:
        galleries = _galleries(project, store, batches, _tables(wanted), frames)
        first = next(iter(galleries.values()))
        recorder = Recorder(store, project.root, first.frame.batch, first.frame)
        notes = [*(f"video {note}" for note in invalid), *_once(galleries, lambda gallery: gallery.declared_notes)]
        folder = marked_folder(ProjectPaths(project.root).drawn("-".join(map(short, batches.values()))), MARK)
        try:
            for name, video in wanted.items():
                try:
                    prepared = prepare(name, video, galleries, progress)
                    files = write(prepared, folder, jobs, progress)
                except SierraError as error:
                    if isinstance(error, DamagedFile | Missing) and not isinstance(error, NotInstalled):
                        raise
                    if names:
                        raise type(error)(f"video {name}: {error}") from error
                    notes.append(f"video {name}: {error}")
                    complete = False
                    continue
                recorder.add(prepared.content(), files)
                written += files
                notes += prepared.notes
                complete &= prepared.complete
        finally:
            notes += _recorded(recorder)
        notes += _once(galleries, lambda gallery: gallery.time_notes.values())
    return RenderedVideos(written, notes, complete)


def _galleries(
    project: LoadedProject, store: Store, batches: Mapping[str, str], tables: Container[str] | None, frames: ExitStack
) -> dict[str, Gallery]:
    opened = {label: frames.enter_context(BatchData(store, batch)) for label, batch in batches.items()}
    return {label: Gallery(project, store, frame, only=tables) for label, frame in opened.items()}


def _once(galleries: Mapping[str, Gallery], notes: Callable[[Gallery], Iterable[str]]) -> list[str]:
    """Return the notes of all galleries, each once."""
    return list(dict.fromkeys(note for one in galleries.values() for note in notes(one)))


def _recorded(recorder: Recorder) -> list[str]:
    """Record the videos that were made; return a note if that is not possible."""
    try:
        recorder.close()
    except Missing as error:
        return [f"the videos are made, but not recorded: {error}"]
    return []


def _wanted(known: Mapping[str, Video], names: Sequence[str]) -> dict[str, Video]:
    """Return the videos with these names; all if there are no names. Raises NotFound."""
    if not known:
        raise NotFound("sierra.toml declares no [videos.NAME]")
    for name in names:
        if name not in known:
            raise NotFound(f"there is no [videos.{name}]; {like(name, list(known), 'there are')}")
    return {name: video for name, video in known.items() if not names or name in names}


def _tables(wanted: Mapping[str, Video]) -> set[str] | None:
    """Return the tables that videos need; None if it may be any table."""
    known = all(video.table or video.sql or video.kind == "capture" for video in wanted.values())
    return {video.table for video in wanted.values()} if known else None


def content(project: LoadedProject, store: Store, row: DeliverableRow) -> Deliverable:
    """Return the content of a recorded video by its definition and the data that the store has now."""
    with parsing(row.name):
        definition = json.loads(row.definition)
        video = options(Video, definition["video"], f"video {row.name}, as it was recorded")
        batches = dict(zip(definition.get("batches", [""]), row.batches, strict=True))
        name = str(definition.get("name", row.name))
    with ExitStack() as frames:
        galleries = _galleries(project, store, batches, _tables({name: video}), frames)
        return prepare(name, video, galleries).content()


def of_paper(name: str, video: Video, galleries: Mapping[str, Gallery]) -> FilesOfPaper:
    """Return the files of a video for a paper. Raises SierraError if a file cannot be made."""
    prepared = prepare(name, video, galleries)
    if not prepared.complete:
        raise SierraError("; ".join(prepared.notes))
    names = tuple(f"{fitting(one.film.name)}.{format}" for one in prepared.films for format in video.formats)
    return FilesOfPaper(prepared.content(), names, partial(_written, prepared))


def _written(prepared: Prepared) -> dict[str, bytes]:
    encode.check({*prepared.video.formats})
    with disk_errors(Path(gettempdir())), TemporaryDirectory(prefix="sierra-video-") as folder:
        return {path.name: path.read_bytes() for path in write(prepared, Path(folder), 1, no_progress)}

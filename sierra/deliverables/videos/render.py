"""Render the videos of a batch that `sierra.toml` declares, and record them like figures."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING

from sierra.config.project_file import LoadedProject
from sierra.config.validate import options
from sierra.config.video_table import Format, Video
from sierra.deliverables import overlay
from sierra.deliverables.gallery import Gallery
from sierra.deliverables.record import Content, Recorder, marked_folder, origin_of, parsing
from sierra.deliverables.videos import encode
from sierra.deliverables.videos.films import Film, Members, films
from sierra.deliverables.videos.subjects import Subject, subjects
from sierra.deliverables.videos.survey import Survey, survey
from sierra.deliverables.videos.tracks import aligned, digits, frame_times, uneven
from sierra.deliverables.videos.two_batches import films_of_two
from sierra.errors import Missing, NotFound, NotInstalled, SierraError
from sierra.execution import targets
from sierra.store.layout import ProjectPaths
from sierra.store.row_types import DeliverableRow
from sierra.store.samples import Frame
from sierra.store.store import Store
from sierra.util.hashing import digest, short
from sierra.util.json_types import JsonView
from sierra.util.text import like
from sierra.version import __version__

if TYPE_CHECKING:
    from sierra.deliverables.videos.encode import Image
    from sierra.deliverables.videos.tracks import Floats

KIND = "video"
"""The kind of the records of videos, among deliverables."""
MARK = "Figures drawn by SIERRA: see the table deliverables."
Progress = Callable[[int, int, str], None]
"""A function that receives the number of frames that are done, and of all frames; and what is done: `READ`, or `DRAWN`."""
READ, DRAWN = "frames read", "frames drawn"


def no_progress(done: int, frames: int, what: str) -> None:
    """Show no progress."""


@dataclass(frozen=True)
class Ready:
    """One film with everything that its frames need."""

    film: Film
    subject: Subject
    times: Floats
    found: Survey


@dataclass(frozen=True)
class Prepared:
    """One declared video of a batch: its films with the ranges of values that they share."""

    name: str
    video: Video
    batches: Mapping[str, str]
    """The batches that are shown, by label; the label of a single one is empty."""
    films: tuple[Ready, ...]
    whole: Survey
    """The ranges of all films together."""
    notes: tuple[str, ...]

    @property
    def frames(self) -> int:
        """The number of frames of all files."""
        return sum(len(one.times) for one in self.films) * len(self.video.formats)

    def content(self) -> Content:
        """Return everything that the files depend on."""
        shown: dict[str, JsonView] = {
            one.film.name: {
                "title": one.film.title,
                "panels": [panel.label for panel in one.film.panels],
                "notes": list(_small_print(self, one)),
                "time": one.subject.time,
                "unit": one.subject.unit,
            }
            for one in self.films
        }
        definition: dict[str, JsonView] = {
            "video": self.video.model_dump(mode="json", exclude_unset=True, by_alias=True),
            "files": shown,
            **({"name": self.name, "batches": list(self.batches)} if len(self.batches) > 1 else {}),
        }
        sql = "\n\n".join(dict.fromkeys(one.subject.sql for one in self.films))
        own = self.name if len(self.batches) == 1 else overlay.name_of(self.name, self.batches)
        return Content(KIND, own, tuple(self.batches.values()), definition, sql, self.data, _made_by())

    @property
    def data(self) -> str:
        """The hash of all states that the files show."""
        return digest("video data", {one.film.name: one.found.data for one in self.films})


def videos(
    project: LoadedProject,
    store: Store,
    batches: Mapping[str, str],
    names: Sequence[str] = (),
    *,
    jobs: int = 1,
    progress: Progress = no_progress,
) -> tuple[list[Path], list[str]]:
    """Make the videos of a batch, or of two, all or those with these names; return the files, and notes.

    `batches` are by label. `jobs` is the number of files that are made at a time. Notes say what could not be shown and why.
    Raises NotFound if none has that name, NotInstalled without the encoders, SierraError if a video that is named cannot be
    made.
    """
    config = targets.of_batch(project, store, next(iter(batches.values()))).config
    wanted = _wanted(config.videos, names)
    encode.check({format for video in wanted.values() for format in video.formats})
    made: list[Path] = []
    with ExitStack() as frames:
        galleries = _galleries(project, store, batches, _tables(wanted), frames)
        first = next(iter(galleries.values()))
        recorder = Recorder(store, project.root, first.frame.batch, first.frame)
        notes = _once(galleries, lambda one: one.declared_notes)
        folder = marked_folder(ProjectPaths(project.root).drawn("-".join(map(short, batches.values()))), MARK)
        try:
            for name, video in wanted.items():
                try:
                    prepared = prepare(name, video, galleries, progress)
                    files = write(prepared, folder, jobs, progress)
                except SierraError as error:
                    if names or (isinstance(error, Missing) and not isinstance(error, NotInstalled)):
                        raise
                    notes.append(f"video {name}: {error}")
                    continue
                recorder.add(prepared.content(), files)
                made += files
                notes += prepared.notes
        finally:
            notes += _recorded(recorder)
        notes += _once(galleries, lambda one: one.time_notes.values())
    return made, notes


def _galleries(
    project: LoadedProject, store: Store, batches: Mapping[str, str], tables: Container[str] | None, frames: ExitStack
) -> dict[str, Gallery]:
    opened = {label: frames.enter_context(Frame(store, batch)) for label, batch in batches.items()}
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


def _made_by() -> tuple[str, ...]:
    """Return SIERRA and the libraries that make videos, as name==version; those that are not installed are not in it."""
    found = [f"sierra-experiments=={__version__}"]
    for name in ("av", "matplotlib", "networkx", "numpy", "pillow"):
        with suppress(PackageNotFoundError):
            found.append(f"{name}=={version(name)}")
    return tuple(found)


def _wanted(declared: Mapping[str, Video], names: Sequence[str]) -> dict[str, Video]:
    """Return the videos with these names; all if there are no names. Raises NotFound."""
    if not declared:
        raise NotFound("sierra.toml declares no [videos.NAME]")
    for name in names:
        if name not in declared:
            raise NotFound(f"there is no [videos.{name}]; {like(name, list(declared), 'there are')}")
    return {name: video for name, video in declared.items() if not names or name in names}


def _tables(wanted: Mapping[str, Video]) -> set[str] | None:
    """Return the tables that videos need; None if it may be any table."""
    known = all(video.table or video.sql or video.kind == "capture" for video in wanted.values())
    return {video.table for video in wanted.values()} if known else None


def prepare(name: str, video: Video, galleries: Mapping[str, Gallery], progress: Progress = no_progress) -> Prepared:
    """Return a video of the batches of one or two galleries, by label, with the facts about its states.

    Raises SierraError if there is nothing that can be shown.
    """
    notes: list[str] = []
    shown = []
    for film, subject in _subjects(name, video, galleries, notes):
        shown.append((film, subject, frame_times(subject.tracks, video.step)))
    told = _Counter(sum(len(times) for *_, times in shown), progress, READ)
    ready, whole = [], Survey()
    for film, subject, times in shown:
        found = survey(film, subject.tracks, times, carry=video.step is not None, seen=told.add)
        ready.append(Ready(film, subject, times, found))
        whole = whole.joined(found)
    batches = {label: gallery.frame.batch for label, gallery in galleries.items()}
    prepared = Prepared(name, video, batches, tuple(ready), whole, tuple(notes))
    said = (f"video {one.film.name}: {note}" for one in ready for note in _told(prepared, one))
    return replace(prepared, notes=(*notes, *said))


def _subjects(name: str, video: Video, galleries: Mapping[str, Gallery], notes: list[str]) -> Iterator[tuple[Film, Subject]]:
    """Yield the films of a video with their subjects; add notes on what is not shown."""
    if len(galleries) > 1:
        yield from films_of_two(name, video, galleries, notes)
        return
    (gallery,) = galleries.values()
    chosen, found = films(name, video, Members(gallery.axes, gallery.cells, tuple(gallery.frame.runs())))
    notes += found
    subject = subjects(video, gallery)
    for film in chosen:
        yield film, subject(film)


def write(prepared: Prepared, folder: Path, jobs: int, progress: Progress) -> tuple[Path, ...]:
    """Write all files of a video into a folder, `jobs` at a time; return their paths. Raises SierraError."""
    from sierra.deliverables.videos.scene import settings

    work = [(one, format) for one in prepared.films for format in prepared.video.formats]
    told = _Counter(prepared.frames, progress, DRAWN)
    first, *others = prepared.batches.values()
    origin = origin_of(first, prepared.data, *others)

    def make(one: Ready, format: Format) -> Path:
        path = folder / f"{one.film.name}.{format}"
        encode.encode(path, told.each(frames(prepared, one)), prepared.video.fps, format, origin)
        return path

    with settings(), ThreadPoolExecutor(max(1, min(jobs, len(work)))) as pool:
        try:
            return tuple(pool.map(make, *zip(*work, strict=True)))
        except BaseException:
            told.stop = True
            raise


class _Counter:
    """The count of frames of all threads; it stops them if one has failed."""

    def __init__(self, frames: int, progress: Progress, what: str) -> None:
        self.stop = False
        self._done, self._frames, self._progress, self._what, self._lock = 0, frames, progress, what, threading.Lock()

    def add(self) -> None:
        with self._lock:
            self._done += 1
            self._progress(self._done, self._frames, self._what)

    def each(self, images: Iterator[Image]) -> Iterator[Image]:
        for image in images:
            if self.stop:
                raise SierraError("stopped")
            yield image
            self.add()


def frames(prepared: Prepared, one: Ready) -> Iterator[Image]:
    """Yield the frames of one film."""
    from sierra.deliverables.figures import style
    from sierra.deliverables.videos.scene import Scene, Words

    video, film = prepared.video, one.film
    title = ", ".join(filter(None, (video.title, film.title)))
    words = Words(title, [panel.label for panel in film.panels], "; ".join(_small_print(prepared, one)))
    width, height = (side + side % 2 for side in video.size)
    scene = Scene((width, height), words, one.subject.painter(film, prepared.whole, one.subject.tracks))
    unit, precision = one.subject.unit and f" {one.subject.unit}", digits(one.times)
    for time, states in zip(
        one.times.tolist(), aligned(one.subject.tracks, one.times, carry=video.step is not None), strict=True
    ):
        shown, numbers = zip(*(panel.state(states) for panel in film.panels), strict=True)
        text = f"{one.subject.time.replace('_', ' ')} = {style.number(time, precision)}{unit}{_count(film, numbers)}"
        yield scene.frame(text, shown)


def _count(film: Film, numbers: Sequence[tuple[int, ...]]) -> str:
    """Return the number of runs behind a frame, if it shows a mean; of a difference, of both groups."""
    if all(len(panel.plus) <= 1 and len(panel.minus) <= 1 for panel in film.panels):
        return ""
    return f", n = {', '.join(map(str, max((len(group), group) for group in numbers)[1]))}"


def _small_print(prepared: Prepared, one: Ready) -> list[str]:
    """Return what the viewer must know, for the bottom of the frames."""
    return [*_told(prepared, one), *one.subject.notes(prepared.whole)]


def _told(prepared: Prepared, one: Ready) -> list[str]:
    """Return what the user is told, too."""
    return [*one.film.notes, *_on_times(prepared, one), *one.subject.left_out()]


def _on_times(prepared: Prepared, one: Ready) -> list[str]:
    """Return notes on times that frames do not show as they are."""
    from sierra.deliverables.figures import style

    notes = [f"{one.found.gaps} of {len(one.times)} frames lack data of a panel"] if one.found.gaps else []
    if prepared.video.step is not None:
        return [
            f"a frame each {prepared.video.step:g}{one.subject.unit and f' {one.subject.unit}'}, with the last values",
            *notes,
        ]
    if steps := uneven(one.times):
        low, high = map(style.number, steps)
        return [f"times are uneven: {low} to {high} between frames (step makes them even)", *notes]
    return notes


def content(project: LoadedProject, store: Store, row: DeliverableRow) -> Content:
    """Return the content of a recorded video by its definition and the data that the store has now."""
    with parsing(row.name):
        definition = json.loads(row.definition)
        video = options(Video, definition["video"], f"video {row.name}, as it was recorded")
        batches = dict(zip(definition.get("batches", [""]), row.batches, strict=True))
        name = str(definition.get("name", row.name))
    with ExitStack() as frames:
        galleries = _galleries(project, store, batches, _tables({name: video}), frames)
        return prepare(name, video, galleries).content()

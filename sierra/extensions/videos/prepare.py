"""Prepare a declared video: find its films, read their states once, and say what the viewer must know of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING

from sierra.deliverables import overlay
from sierra.deliverables.gallery import Gallery
from sierra.deliverables.record import Deliverable
from sierra.extensions.videos.films import Film, Members, films
from sierra.extensions.videos.progress import READ, Counter, Progress, no_progress
from sierra.extensions.videos.subjects import Subject, subjects
from sierra.extensions.videos.survey import Survey, survey
from sierra.extensions.videos.table import Video
from sierra.extensions.videos.tracks import frame_times, uneven
from sierra.extensions.videos.two_batches import films_of_two
from sierra.store.batch_data import AllFailed
from sierra.util.hashing import digest
from sierra.util.json_types import JsonView
from sierra.util.version import __version__

if TYPE_CHECKING:
    from sierra.extensions.videos.tracks import Floats

KIND = "video"
"""The kind of the records of videos, among deliverables."""
VERSION = 2
"""The version of how videos are made. Those of version 1 had other names of files, and robots without numbers and trails."""


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
    complete: bool
    """False if the file of an experiment cannot be made; notes say why."""

    @property
    def frames(self) -> int:
        """The number of frames of all files."""
        return sum(len(one.times) for one in self.films) * len(self.video.formats)

    def content(self) -> Deliverable:
        """Return everything that the files depend on."""
        shown: dict[str, JsonView] = {
            film.film.name: {
                "title": film.film.title,
                "panels": [panel.label for panel in film.film.panels],
                "notes": list(small_print(self, film)),
                "time": film.subject.time,
                "unit": film.subject.unit,
            }
            for film in self.films
        }
        definition: dict[str, JsonView] = {
            "version": VERSION,
            "video": self.video.model_dump(mode="json", exclude_unset=True, by_alias=True),
            "files": shown,
            **({"name": self.name, "batches": list(self.batches)} if len(self.batches) > 1 else {}),
        }
        sql = "\n\n".join(dict.fromkeys(film.subject.sql for film in self.films))
        own = self.name if len(self.batches) == 1 else overlay.name_of(self.name, self.batches)
        return Deliverable(KIND, own, tuple(self.batches.values()), definition, sql, self.data, _made_by())

    @property
    def data(self) -> str:
        """The hash of all states that the files show."""
        return digest("video data", {one.film.name: one.found.data for one in self.films})


def _made_by() -> tuple[str, ...]:
    """Return SIERRA and the libraries that make videos, as name==version; those that are not installed are not in it."""
    found = [f"sierra-experiments=={__version__}"]
    for name in ("av", "matplotlib", "networkx", "numpy", "pillow"):
        with suppress(PackageNotFoundError):
            found.append(f"{name}=={version(name)}")
    return tuple(found)


def prepare(name: str, video: Video, galleries: Mapping[str, Gallery], progress: Progress = no_progress) -> Prepared:
    """Return a video of the batches of one or two galleries, by label, with the facts about its states.

    Raises SierraError if there is nothing that can be shown.
    """
    notes: list[str] = []
    failed: list[str] = []
    shown = []
    for film, subject in _subjects(name, video, galleries, notes, failed):
        shown.append((film, subject, frame_times(subject.tracks, video.step)))
    told = Counter(sum(len(times) for *_, times in shown), progress, READ)
    ready, whole = [], Survey()
    for film, subject, times in shown:
        facts = survey(film, subject.tracks, times, carry=video.step is not None, seen=told.add)
        ready.append(Ready(film, subject, times, facts))
        whole = whole.joined(facts)
    batches = {label: gallery.frame.batch for label, gallery in galleries.items()}
    prepared = Prepared(name, video, batches, tuple(ready), whole, (), not failed)
    said = (f"video {ready_film.film.name}: {note}" for ready_film in ready for note in _told(prepared, ready_film))
    return replace(prepared, notes=(*notes, *failed, *said))


def _subjects(
    name: str, video: Video, galleries: Mapping[str, Gallery], notes: list[str], failed: list[str]
) -> Iterator[tuple[Film, Subject]]:
    """Yield the films of a video with their subjects; add notes, and the reasons why films cannot be made to `failed`."""
    if len(galleries) > 1:
        yield from films_of_two(name, video, galleries, notes, failed)
        return
    (gallery,) = galleries.values()
    if why := gallery.frame.failure():
        raise AllFailed(why)
    chosen, lost = films(name, video, Members(gallery.axes, gallery.cells, gallery.frame.cells(), tuple(gallery.frame.runs())))
    failed += lost
    subject = subjects(video, gallery)
    for film in chosen:
        yield film, subject(film)


def small_print(prepared: Prepared, one: Ready) -> list[str]:
    """Return what the viewer must know, for the bottom of the frames."""
    return [*_told(prepared, one), *one.subject.notes(prepared.whole)]


def _told(prepared: Prepared, one: Ready) -> list[str]:
    """Return what the user is told, too."""
    return [*one.film.notes, *_on_times(prepared, one), *one.subject.left_out()]


def _on_times(prepared: Prepared, ready: Ready) -> list[str]:
    """Return notes on times that frames do not show as they are."""
    from sierra.deliverables.figures import style

    notes = [f"{ready.found.gaps} of {len(ready.times)} frames lack data of a panel"] if ready.found.gaps else []
    if prepared.video.step is not None:
        return [
            f"a frame each {prepared.video.step:g}{ready.subject.unit and f' {ready.subject.unit}'}, with the last values",
            *notes,
        ]
    if steps := uneven(ready.times):
        low, high = map(style.number, steps)
        return [f"times are uneven: {low} to {high} between frames (step makes them even)", *notes]
    return notes

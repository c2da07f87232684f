"""Draw a prepared video: paint its frames and encode them, several files at a time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

from sierra.deliverables.record import origin_of
from sierra.extensions.videos import encode
from sierra.extensions.videos.films import UNFIT, Film
from sierra.extensions.videos.prepare import Prepared, Ready, small_print
from sierra.extensions.videos.progress import DRAWN, Counter, Progress
from sierra.extensions.videos.table import Format
from sierra.extensions.videos.tracks import aligned, digits
from sierra.util.fs import fitting

if TYPE_CHECKING:
    from sierra.extensions.videos.encode import Image


def write(prepared: Prepared, folder: Path, jobs: int, progress: Progress) -> tuple[Path, ...]:
    """Write all files of a video into a folder, `jobs` at a time; return their paths. Raises SierraError."""
    from sierra.extensions.videos.painting.scene import settings

    work = [(ready, format) for ready in prepared.films for format in prepared.video.formats]
    told = Counter(prepared.frames, progress, DRAWN)
    first, *others = prepared.batches.values()
    origin = origin_of(first, prepared.data, *others)

    def make(ready: Ready, format: Format) -> Sequence[Path]:
        if format == "png":
            return encode.stills(_of_times(ready, folder), told.each(frames(prepared, ready)), origin)
        path = folder / f"{fitting(ready.film.name)}.{format}"
        encode.encode(path, told.each(frames(prepared, ready)), prepared.video.rate(len(ready.times), format), format, origin)
        return [path]

    with settings(), ThreadPoolExecutor(max(1, min(jobs, len(work)))) as pool:
        try:
            return tuple(path for paths in pool.map(make, *zip(*work, strict=True)) for path in paths)
        except BaseException:
            told.stop = True
            raise


def _of_times(one: Ready, folder: Path) -> list[Path]:
    """Return a path for each frame of a film, with its time: `heat-population_size=8-tick=20.png`."""
    precision, time = digits(one.times), UNFIT.sub("_", one.subject.time)
    return [folder / f"{fitting(f'{one.film.name}-{time}={t:.{precision}g}')}.png" for t in one.times.tolist()]


def frames(prepared: Prepared, ready: Ready) -> Iterator[Image]:
    """Yield the frames of one film."""
    from sierra.deliverables.figures import style
    from sierra.extensions.videos.painting.scene import Scene, Words

    video, film = prepared.video, ready.film
    title = ", ".join(filter(None, (video.title, film.title)))
    words = Words(title, [panel.label for panel in film.panels], "; ".join(small_print(prepared, ready)))
    width, height = (side + side % 2 for side in video.size)
    scene = Scene((width, height), words, ready.subject.painter(film, prepared.whole, ready.subject.tracks))
    unit, precision = ready.subject.unit and f" {ready.subject.unit}", digits(ready.times)
    for time, states in zip(
        ready.times.tolist(), aligned(ready.subject.tracks, ready.times, carry=video.step is not None), strict=True
    ):
        shown, numbers = zip(*(panel.state(states) for panel in film.panels), strict=True)
        text = f"{ready.subject.time.replace('_', ' ')} = {style.number(time, precision)}{unit}{_count(film, numbers)}"
        yield scene.frame(text, shown)


def _count(film: Film, numbers: Sequence[tuple[int, ...]]) -> str:
    """Return the number of runs behind a frame, if it shows a mean; of a difference, of both groups."""
    if all(len(panel.plus) <= 1 and len(panel.minus) <= 1 for panel in film.panels):
        return ""
    return f", n = {', '.join(map(str, max((len(group), group) for group in numbers)[1]))}"

"""Images and video files that runs leave, as tracks: the pictures of each run over time.

A state is the hash of a file and the place of a picture in its video; the picture itself is decoded when it is painted. The
recorded files are written to a temporary folder first, because decoders need files. They come from the runs, so nothing in
them is trusted: only formats that are known by the name of the file are decoded, no file leads to another one, and pictures
that are too large are refused before they are decoded.

Pictures are shown as viewers show them: upright, as their orientation says, and in their proportions, also if their pixels are
no squares.
"""

from __future__ import annotations

import struct
import warnings
import zlib
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, Protocol

from sierra.config import extensions
from sierra.config.output_tables import Output
from sierra.errors import SierraError, UsageError
from sierra.extensions.videos.encode import library
from sierra.ingest.base import UnreadableError
from sierra.store.batch_data import BatchData, ChosenRun
from sierra.util.lazy_definitions import dataclass
from sierra.util.text import like

if TYPE_CHECKING:
    from sierra.extensions.videos.encode import Image
    from sierra.extensions.videos.tracks import Floats, State
    from sierra.store.recorded_files import Recorded

IMAGES = {
    **{"png": "PNG", "jpg": "JPEG", "jpeg": "JPEG", "ppm": "PPM", "pgm": "PPM", "pbm": "PPM", "pnm": "PPM"},
    **{"gif": "GIF", "webp": "WEBP", "bmp": "BMP", "tif": "TIFF", "tiff": "TIFF"},
}
"""The formats of images by the ending of their files, with their names in Pillow."""
FORMATS = tuple(dict.fromkeys(IMAGES.values()))
VIDEOS = {"mp4": "mov", "m4v": "mov", "mov": "mov", "avi": "avi", "webm": "matroska", "mkv": "matroska"}
"""The formats of videos by the ending of their files, with the names of their demuxers in FFmpeg."""
MOST_PIXELS = 50_000_000
"""The largest number of pixels of a picture: 150 MB."""
DEEP = ("I", "F", "I;16", "I;16B", "I;16L", "I;16N")
"""Pillow's modes of greys with more than 8 bits, which it would cut off."""
UNREADABLE = (OSError, SyntaxError, ValueError, TypeError, IndexError, KeyError, EOFError, zlib.error, struct.error)
"""The errors that Pillow raises for damaged files."""
ORIENTATION, ACROSS = 0x0112, (5, 6, 7, 8)
"""The tag of Exif that says how an image is shown, and its values that make rows of columns. Pillow turns TIFF itself."""


class Reader(Protocol):
    """Reads the pictures of one run."""

    def read(self, place: int) -> Image:
        """Return a picture. Places ascend, or stay the same. Raises SierraError if it cannot be decoded."""


class PictureTrack(Protocol):
    """The pictures of one run, all of the same size."""

    times: Floats
    size: tuple[int, int]
    """Width and height in pixels, or in the same proportion if pixels are no squares."""

    def states(self) -> Iterator[State]: ...

    def reader(self) -> Reader:
        """Return a reader of its own for each video that is drawn."""


def pictures(frame: BatchData, name: str, output: Output, run: ChosenRun, per_second: float) -> Pictures | VideoFile:
    """Return the pictures that a run left in the files of an output. Raises UsageError or SierraError, naming run and file."""
    where = f"run {run.number} of experiment {run.experiment}"
    matching = [file for file in frame.files_of_run(run) if output.matches(_path(file))]
    if not matching:
        raise UsageError(f"{where}: no file {output.file!r} (output {name!r})")
    ending = PurePosixPath(output.file).suffix[1:].lower()
    if output.kind in extensions.added("pictures") and not output.archive:
        return PicturesWithin(frame, where, name, output, matching)
    if ending in IMAGES:
        return ImageFiles(frame, where, output, matching, per_second)
    if ending not in VIDEOS:
        raise UsageError(
            f"output {name!r}: {output.file!r} is no image or video file; {like(ending, [*IMAGES, *VIDEOS], 'endings are')}"
        )
    if len(matching) > 1:
        raise UsageError(f"{where}: {len(matching)} files {output.file!r}; a run needs one video file (output {name!r})")
    return VideoFile(frame, where, matching[0])


def _path(file: Recorded) -> str:
    return file.path.partition("/")[2]


@dataclass(frozen=True, slots=True)
class _Extracted:
    """A recorded file, and where it is."""

    where: str
    """The run and the path, for messages."""
    sha256: str
    path: Path


def _extracted(frame: BatchData, where: str, files: Sequence[Recorded]) -> list[_Extracted]:
    paths = frame.extracted(files)
    named = [(f"{where}: {_path(file)}", file.sha256 or "") for file in files]
    return [_Extracted(*name, path) for name, path in zip(named, paths, strict=True)]


def _state(file: _Extracted, place: int) -> State:
    import numpy as np

    return np.frombuffer(bytes.fromhex(file.sha256), np.uint8), np.array([place], np.int64)


class Pictures:
    """A file for each time."""

    missing = ""
    """A note on times without a file; "" if there are none."""

    def __init__(self, files: Sequence[_Extracted], times: Floats) -> None:
        """Check that all pictures have the same size. Raises UsageError, SierraError."""
        self._files, self.times = files, times
        self.size = _checked(files[0])
        for one in files[1:]:
            if (size := _checked(one)) != self.size:
                raise UsageError(
                    f"{one.where}: {size[0]} × {size[1]} pixels, but the first picture has {self.size[0]} × {self.size[1]}"
                )

    def states(self) -> Iterator[State]:
        for place, file in enumerate(self._files):
            yield _state(file, place)

    def reader(self) -> Reader:
        return _ImageReader(self._files, self.size)


class ImageFiles(Pictures):
    """A recorded file for each time; the time is in its name."""

    def __init__(self, frame: BatchData, where: str, output: Output, files: Sequence[Recorded], per_second: float) -> None:
        import numpy as np

        if len(output.ticks) != 1:
            raise UsageError(f"{output.file!r} names no time; write the number in it as {{tick}}, such as frame-{{tick}}.png")
        by_tick: dict[int, Recorded] = {}
        for file in files:
            ((tick,), path) = (output.ticks_of(_path(file)) or (0,), _path(file))
            if tick in by_tick:
                raise UsageError(f"{where}: {_path(by_tick[tick])} and {path} have the same {output.ticks[0]}")
            by_tick[tick] = file
        ticks = sorted(by_tick)
        times: Floats = np.array(ticks, np.float64) / per_second
        if len(np.unique(times)) < len(ticks):
            raise UsageError(f"{where}: numbers in {output.file} are too large to be told apart as times")
        super().__init__(_extracted(frame, where, [by_tick[tick] for tick in ticks]), times)
        self.missing = _missing(where, output, ticks)


class PicturesWithin(Pictures):
    """Pictures in one file of a format of an extension, such as those of a camera in a bag; times are since the first."""

    def __init__(self, frame: BatchData, where: str, name: str, output: Output, files: Sequence[Recorded]) -> None:
        import numpy as np

        own = {file.path: file for file in files}
        if len(own) > 1:
            raise UsageError(f"{where}: {len(own)} files {output.file!r}; a video needs one (output {name!r})")
        (file,) = _extracted(frame, where, [*own.values()])
        try:
            images = extensions.load("pictures", output.kind)(file.path, _path(files[0]), output)
        except UnreadableError as error:
            raise UsageError(f"{file.where}: {error} (output {name!r})") from error
        if not images:
            raise UsageError(f"{file.where}: has no picture (output {name!r})")
        shown = [_Extracted(f"{file.where}, picture {k}", picture.sha256, picture.path) for k, picture in enumerate(images)]
        super().__init__(shown, np.array([picture.time - images[0].time for picture in images], np.float64) / 1e9)


def _missing(where: str, output: Output, ticks: Sequence[int]) -> str:
    """Return a note if some files seem to be missing: all distances of ticks are multiples of the smallest one."""
    steps = [after - before for before, after in pairwise(ticks)]
    step = min(steps, default=0)
    if not step or any(one % step for one in steps) or all(one == step for one in steps):
        return ""
    first = ticks[next(k for k, one in enumerate(steps) if one > step)] + step
    lost = sum(one // step - 1 for one in steps)
    name = f"{output.ticks[0]} {first}"
    return f"{where}: {lost} of {len(ticks) + lost} files {output.file} missing, first {name}"


def _checked(file: _Extracted) -> tuple[int, int]:
    """Return the width and the height of an upright image, by its header. Raises SierraError if it is damaged or too large."""
    from PIL import Image as Pillow

    with warnings.catch_warnings():
        warnings.simplefilter("error", Pillow.DecompressionBombWarning)
        try:
            with Pillow.open(file.path, formats=FORMATS) as image:
                size, mode, several = image.size, image.mode, getattr(image, "n_frames", 1) > 1
                _check_size(file, *size)
                across = image.format != "TIFF" and Pillow.Image.getexif(image).get(ORIENTATION) in ACROSS
                image.verify()
        except (Pillow.DecompressionBombWarning, Pillow.DecompressionBombError) as error:
            raise SierraError(f"{file.where}: more than {MOST_PIXELS} pixels") from error
        except UNREADABLE as error:
            raise _damaged(file, error) from error
    if mode in DEEP:
        raise SierraError(f"{file.where}: greys of more than 8 bits would be cut off; write 8 bits")
    if several:
        raise SierraError(f"{file.where}: an image that moves; write a file for each time, or a video")
    return size[::-1] if across else size


def _check_size(file: _Extracted, width: int, height: int) -> None:
    if width * height > MOST_PIXELS:
        raise SierraError(f"{file.where}: {width} × {height} pixels are too many; at most {MOST_PIXELS} are possible")


def _damaged(file: _Extracted, error: Exception) -> SierraError:
    from PIL import UnidentifiedImageError

    if isinstance(error, UnidentifiedImageError):
        return SierraError(f"{file.where}: cannot be decoded: its beginning is not that of a {_either(FORMATS)} image")
    text = (getattr(error, "strerror", None) or str(error)).replace(str(file.path), "it").splitlines() or [type(error).__name__]
    return SierraError(f"{file.where}: cannot be decoded: {text[0]}")


def _either(names: Sequence[str]) -> str:
    return f"{', '.join(names[:-1])} or {names[-1]}"


class _ImageReader:
    def __init__(self, files: Sequence[_Extracted], size: tuple[int, int]) -> None:
        self._files, self._size = files, size

    def read(self, index: int) -> Image:
        import numpy as np
        from PIL import Image as Pillow
        from PIL import ImageOps

        file = self._files[index]
        try:
            with Pillow.open(file.path, formats=FORMATS) as stored:
                image = ImageOps.exif_transpose(stored)
                if image.size != self._size:
                    raise SierraError(f"{file.where}: its orientation comes after its pixels; write it before them")
                clear = image.has_transparency_data
                behind = Pillow.new("RGBA", image.size, "white")
                shown = Pillow.alpha_composite(behind, image.convert("RGBA")) if clear else image
                return np.asarray(shown.convert("RGB"))
        except UNREADABLE as error:
            raise _damaged(file, error) from error


class VideoFile:
    """A video file, whose pictures have the times that it says."""

    missing = ""

    def __init__(self, frame: BatchData, where: str, file: Recorded) -> None:
        import numpy as np

        (self._file,) = _extracted(frame, where, [file])
        av = library()
        try:
            with _opened(self._file) as video:
                stream = video.streams.video[0]
                _check_size(self._file, stream.width, stream.height)
                stamps = [packet.pts for packet in video.demux(stream) if packet.size and not packet.is_discard]
                unit, rate, said = stream.time_base, stream.average_rate, stream.frames
            self.size = _size_shown(self._file)
        except (av.error.FFmpegError, OSError, ValueError) as error:
            raise _damaged(self._file, error) from error
        if said and said != len(stamps):
            raise SierraError(f"{self._file.where}: has {len(stamps)} pictures, but says {said}")
        if None in stamps or len(set(stamps)) < len(stamps):
            if not rate:
                raise SierraError(f"{self._file.where}: its pictures have no times")
            self.times: Floats = np.arange(len(stamps)) / float(rate)
        else:
            self.times = np.array(sorted(stamps), np.float64) * float(unit)

    def states(self) -> Iterator[State]:
        for place in range(len(self.times)):
            yield _state(self._file, place)

    def reader(self) -> Reader:
        return _VideoReader(self._file, len(self.times))


def _opened(file: _Extracted) -> Any:
    """Return an open video, whose format is that of its name, and which can lead to no other file. Raises SierraError."""
    av = library()
    video = av.open(str(file.path), format=VIDEOS[file.path.suffix[1:]], options={"protocol_whitelist": "file"})
    if not video.streams.video:
        video.close()
        raise SierraError(f"{file.where}: has no pictures")
    video.streams.video[0].codec_context.options = {"err_detect": "explode"}
    return video


def _size_shown(file: _Extracted) -> tuple[int, int]:
    """Return the width and the height of the first picture, upright and as if its pixels were squares."""
    with _opened(file) as video:
        aspect = video.streams.video[0].sample_aspect_ratio or 1
        picture = next(video.decode(video=0), None)
        if picture is None:
            raise SierraError(f"{file.where}: has no pictures")
        wide, high = round(picture.width * max(aspect, 1)), round(picture.height / min(aspect, 1))
        return (wide, high) if _turn(file, picture)[0] else (high, wide)


def _turn(file: _Extracted, picture: Any) -> tuple[int, int, int, int]:
    """Return the signs a, b, c and d of the matrix by which a picture is shown: x' = ax + cy, y' = bx + dy.

    Raises SierraError for an angle that is not a right one.
    """
    import numpy as np

    data = picture.side_data.get("DISPLAYMATRIX")
    if data is None:
        return 1, 0, 0, 1
    a, b, _, c, d, *_ = np.sign(np.frombuffer(data, np.int32)).tolist()
    if (bool(a), bool(b)) != (bool(d), bool(c)) or bool(a) == bool(b):
        raise SierraError(f"{file.where}: is turned by an angle that is no multiple of 90°; write it upright")
    return a, b, c, d


def _upright(image: Image, turn: tuple[int, int, int, int]) -> Image:
    import numpy as np

    a, b, c, d = turn
    return np.ascontiguousarray((image if a else image.swapaxes(0, 1))[:: b or d, :: a or c])


class _VideoReader:
    """Decodes a video from its beginning; only one picture is in memory."""

    def __init__(self, file: _Extracted, count: int) -> None:
        self._file, self._count = file, count
        self._pictures = self._decoded()
        self._last: tuple[int, Image] | None = None

    def read(self, place: int) -> Image:
        while self._last is None or self._last[0] < place:
            image = next(self._pictures, None)
            if image is None:
                raise SierraError(f"{self._file.where}: ends before picture {place} of {self._count}")
            self._last = (0 if self._last is None else self._last[0] + 1, image)
        if place == self._count - 1 and next(self._pictures, None) is not None:
            raise SierraError(f"{self._file.where}: has more than its {self._count} pictures")
        return self._last[1]

    def _decoded(self) -> Iterator[Image]:
        av, first = library(), None
        try:
            with _opened(self._file) as video:
                for number, picture in enumerate(video.decode(video=0)):
                    look = (picture.width, picture.height, _turn(self._file, picture))
                    first = first or look
                    if look[:2] != first[:2]:
                        sizes = "{} × {} pixels, but the first one {} × {}".format(*look[:2], *first[:2])
                        raise SierraError(f"{self._file.where}: picture {number} has {sizes}")
                    if look != first:
                        raise SierraError(f"{self._file.where}: picture {number} is turned otherwise than the first one")
                    if picture.is_corrupt:
                        raise SierraError(f"{self._file.where}: picture {number} is damaged")
                    yield _upright(picture.to_ndarray(format="rgb24"), look[2])
        except (av.error.FFmpegError, OSError, ValueError) as error:
            raise _damaged(self._file, error) from error

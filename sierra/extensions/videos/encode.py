"""Encode frames as a video file that appears whole or not at all.

Frames are encoded one by one, so that memory does not grow with their number. Each format has one encoder with fixed settings
and a fixed number of threads: then the same frames give the same bytes, whatever the number of cores. Other versions of the
encoder give other bytes.

A video is written in a folder beside its target, and renamed when it is complete. If the process is killed, the target is as
before, and the next video removes the folder.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from sierra.errors import Missing, NotInstalled, SierraError, UsageError
from sierra.extensions.videos.table import Format
from sierra.store.segments import disk_errors
from sierra.util.fs import write_whole
from sierra.util.lazy_definitions import dataclass, field
from sierra.util.scratch import scratch

if TYPE_CHECKING:
    import av
    import numpy as np
    import numpy.typing as npt

    Image: TypeAlias = npt.NDArray[np.uint8]
    """A frame: height × width × 3 (red, green, blue)."""

UNFINISHED = ".video-"
"""The beginning of the names of folders with unfinished videos."""
MOST = 1000
"""The largest number of PNG files of one video."""
EXTRA = "pip install 'sierra-experiments[video]'"


@dataclass(frozen=True, slots=True)
class Encoder:
    """The encoder of one format, and its settings."""

    name: str
    pixels: str
    """The layout of pixels, by its name in FFmpeg."""
    options: Mapping[str, str]
    container_options: Mapping[str, str] = field(default_factory=dict)


ENCODERS: Mapping[Format, Encoder] = {
    "mp4": Encoder("libx264", "yuv420p", {"threads": "2", "crf": "18", "preset": "superfast"}, {"movflags": "faststart"}),
    "webm": Encoder("libvpx-vp9", "yuv420p", {"threads": "1", "crf": "24", "b": "0", "deadline": "realtime", "cpu-used": "8"}),
    "gif": Encoder("gif", "pal8", {"threads": "1"}),
}


def library() -> Any:
    """Return PyAV. Raises NotInstalled."""
    try:
        import av
    except ImportError as error:
        raise NotInstalled(f"videos need PyAV; {EXTRA}") from error
    av.logging.set_level(av.logging.PANIC)  # what fails is raised; the rest would go to standard error
    return av


def check(formats: Iterable[Format]) -> None:
    """Raise NotInstalled if PyAV, or its encoder for one of the formats, is missing. PNG files do not need it."""
    for format in set(formats) - {"png"}:
        av, name = library(), ENCODERS[format].name
        if name not in av.codecs_available:
            raise NotInstalled(f"this PyAV {av.__version__} has no encoder {name} for {format}; {EXTRA} has all")


def encode(path: Path, frames: Iterable[Image], fps: float, format: Format, comment: str = "") -> None:
    """Write frames, all of one size, as a video; replace an existing file only when the video is complete.

    `fps` is in frames per second. Raises SierraError if there is no frame or the video cannot be encoded, Missing if the file
    cannot be written. Errors of `frames` leave the target as it was.
    """
    with _errors(ENCODERS[format], path), scratch(path.parent, UNFINISHED) as folder:
        unfinished = folder / path.name
        _write(unfinished, frames, Fraction(fps).limit_denominator(1000), format, comment)
        unfinished.replace(path)


def stills(paths: Sequence[Path], frames: Iterable[Image], comment: str) -> Sequence[Path]:
    """Write each frame as a PNG file, which appears whole or not at all; return the paths. Raises SierraError, Missing."""
    from PIL import Image as Pillow
    from PIL.PngImagePlugin import PngInfo

    if len(paths) > MOST:
        raise UsageError(f"png: {len(paths)} frames are too many files; at most {MOST} are possible (use a larger step)")
    info = PngInfo()
    info.add_text("Comment", comment)
    for path, image in zip(paths, frames, strict=True):
        data = io.BytesIO()
        Pillow.fromarray(image).save(data, "PNG", pnginfo=info)
        with disk_errors(path):
            write_whole(path, data.getvalue())
    return paths


def _write(path: Path, frames: Iterable[Image], rate: Fraction, format: Format, comment: str) -> None:
    av, encoder, images = library(), ENCODERS[format], iter(frames)
    first = next(images, None)
    if first is None:
        raise SierraError("there is no frame to show")
    first = _even(first)
    with av.open(str(path), "w", format=format, options={"fflags": "+bitexact", **encoder.container_options}) as out:
        out.metadata["comment"] = comment
        stream = out.add_stream(encoder.name, rate=rate, options=dict(encoder.options))
        stream.height, stream.width, stream.pix_fmt = *first.shape[:2], encoder.pixels
        stream.codec_context.flags |= av.codec.context.Flags.bitexact
        convert = _Palette(av, first.shape, rate) if encoder.pixels == "pal8" else _plain
        for number, image in enumerate(_all(first, images)):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts, frame.time_base = number, 1 / rate
            out.mux(stream.encode(convert(frame)))
        out.mux(stream.encode(None))


def _all(first: Image, others: Iterable[Image]) -> Iterator[Image]:
    yield first
    yield from map(_even, others)


def _even(image: Image) -> Image:
    """Return an image with an even number of rows and of columns, which encoders need: the last one is repeated."""
    import numpy as np

    high, wide = image.shape[0] % 2, image.shape[1] % 2
    return np.ascontiguousarray(np.pad(image, ((0, high), (0, wide), (0, 0)), mode="edge") if high or wide else image)


def _plain(frame: av.VideoFrame) -> av.VideoFrame:
    return frame


class _Palette:
    """The conversion of frames to 256 colours each, which are the best for each frame."""

    def __init__(self, av: Any, shape: tuple[int, ...], rate: Fraction) -> None:
        graph = self._graph = av.filter.Graph()
        source = graph.add_buffer(width=shape[1], height=shape[0], format="rgb24", time_base=1 / rate)
        copies = graph.add("split")
        palette = graph.add("palettegen", "stats_mode=single:reserve_transparent=0")
        used = graph.add("paletteuse", "new=1:dither=none")
        source.link_to(copies)
        copies.link_to(palette, 0, 0)
        copies.link_to(used, 1, 0)
        palette.link_to(used, 0, 1)
        used.link_to(graph.add("buffersink"))
        graph.configure()

    def __call__(self, frame: av.VideoFrame) -> av.VideoFrame:
        self._graph.push(frame)
        found: av.VideoFrame = self._graph.pull()
        return found


@contextlib.contextmanager
def _errors(encoder: Encoder, path: Path) -> Iterator[None]:
    """Raise the errors of FFmpeg and of the disk as SierraError, in one line."""
    import av.error

    try:
        yield
    except OSError as error:  # FFmpeg's errors of files are also OSErrors
        raise Missing(f"{path}: cannot write the video: {error.strerror or error}") from error
    except av.error.FFmpegError as error:
        raise SierraError(f"{path.name}: the encoder {encoder.name} failed: {error.strerror or error}") from error

"""Pictures of runs are shown as they are; damaged, unfitting and hostile files are refused in one line with run and file."""

from __future__ import annotations

import io
import json
import shutil
import struct
import zlib
from collections.abc import Callable, Mapping
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import numpy as np
import pytest
from PIL import Image as Pillow

from sierra.config.output_tables import Output
from sierra.errors import SierraError
from sierra.extensions.videos.painting.picture_painter import PicturePainter
from sierra.extensions.videos.painting.scene import Scene, Words, settings
from sierra.extensions.videos.pictures import VideoFile, pictures
from sierra.store.batch_data import ChosenRun
from sierra.util.hashing import sha256
from tests import projects, stores
from tests.extensions.videos import video_files

RUN = ChosenRun(1, 0, "r", "j")
FRAMES = Output(file="frame-{tick}.png", format="file", time="tick")


class Left:
    """A frame of a batch whose run left these files."""

    def __init__(self, folder: Path, files: Mapping[str, bytes]) -> None:
        self._folder, self._files = folder, files

    def files_of_run(self, run: ChosenRun) -> list[Any]:
        del run
        return [SimpleNamespace(path=f"output/{name}", sha256=sha256(data)) for name, data in self._files.items()]

    def extracted(self, files: list[Any]) -> list[Path]:
        paths = [self._folder / f"{place}{Path(file.path).suffix}" for place, file in enumerate(files)]
        for file, path in zip(files, paths, strict=True):
            path.write_bytes(self._files[file.path.removeprefix("output/")])
        return paths


def image(
    size: tuple[int, int] = (30, 20), colour: Any = (200, 30, 60), mode: str = "RGB", format: str = "png", **more: Any
) -> bytes:
    file = io.BytesIO()
    Pillow.new(mode, size, colour).save(file, format, **more)
    return file.getvalue()


def video(
    count: int = 5,
    *,
    format: str = "mp4",
    codec: str = "libx264",
    size: tuple[int, int] = (64, 48),
    change: Callable[[Any], object] = lambda stream: None,
) -> bytes:
    """Return a video whose pictures become brighter; their left upper corner is white. `change` is made to its stream."""
    file = io.BytesIO()
    with av.open(file, "w", format=format) as out:
        stream = out.add_stream(codec, rate=10)
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        change(stream)
        for number in range(count):
            grey = np.full((size[1], size[0], 3), 40 * number % 256, np.uint8)
            grey[:8, :8] = 255
            out.mux(stream.encode(av.VideoFrame.from_ndarray(grey, format="rgb24")))
        out.mux(stream.encode(None))
    return file.getvalue()


def left(folder: Path, files: Mapping[str, bytes], output: Output = FRAMES) -> Any:
    return pictures(Left(folder, files), "camera", output, RUN, 10.0)  # type: ignore[arg-type]


def read(track: Any) -> list[np.ndarray]:
    reader = track.reader()
    return [reader.read(place) for place in range(len(track.times))]


def test_images_are_in_the_order_of_their_ticks(tmp_path: Path) -> None:
    files = {f"frame-{tick}.png": image(colour=(tick, 0, 0)) for tick in (100, 20, 3)}
    track = left(tmp_path, files | {"other.png": b"?"})
    assert (track.times.tolist(), track.size) == ([0.3, 2, 10], (30, 20))
    assert [picture[0, 0].tolist() for picture in read(track)] == [[3, 0, 0], [20, 0, 0], [100, 0, 0]]
    assert [bytes(state[0]).hex() for state in track.states()] == [sha256(files[f"frame-{tick}.png"]) for tick in (3, 20, 100)]


def test_all_kinds_of_images_have_their_colours(tmp_path: Path) -> None:
    clear = image(colour=(255, 0, 0, 0), mode="RGBA")
    assert read(left(tmp_path, {"frame-1.png": clear}))[0][0, 0].tolist() == [255, 255, 255], "transparent is white"
    for mode, colour, wanted in (("L", 70, 70), ("1", 1, 255), ("P", 0, 0)):
        assert read(left(tmp_path, {"frame-1.png": image(mode=mode, colour=colour)}))[0][0, 0].tolist() == [wanted] * 3
    kinds = {"ppm": "PPM", "jpg": "JPEG", "jpeg": "JPEG", "pnm": "PPM", "gif": "GIF", "webp": "WEBP", "bmp": "BMP"}
    for ending, format in (kinds | {"tif": "TIFF", "tiff": "TIFF"}).items():
        (found,) = read(left(tmp_path, {f"frame-1.{ending}": image(format=format)}, Output(file=f"frame-{{tick}}.{ending}")))
        assert np.abs(found[0, 0].astype(int) - (200, 30, 60)).max() < 8, ending
    for ending, mode, colour, wanted in (("pgm", "L", 70, 70), ("pbm", "1", 1, 255)):
        plain = image(format="PPM", mode=mode, colour=colour)
        (found,) = read(left(tmp_path, {f"frame-1.{ending}": plain}, Output(file=f"frame-{{tick}}.{ending}")))
        assert found[0, 0].tolist() == [wanted] * 3


CONTAINERS = {
    "mp4": ("mp4", "libx264"),
    "m4v": ("mp4", "libx264"),
    "mov": ("mov", "libx264"),
    "avi": ("avi", "mpeg4"),
    "webm": ("webm", "libvpx-vp9"),
    "mkv": ("matroska", "libx264"),
}


@pytest.mark.parametrize("ending", CONTAINERS)
def test_videos_have_all_pictures_at_their_times(tmp_path: Path, ending: str) -> None:
    format, codec = CONTAINERS[ending]
    track = left(tmp_path, {f"a.{ending}": video(format=format, codec=codec)}, Output(file=f"a.{ending}"))
    assert isinstance(track, VideoFile)
    assert track.times.tolist() == pytest.approx([0, 0.1, 0.2, 0.3, 0.4])
    assert [float(picture[8:].mean()) for picture in read(track)] == pytest.approx([0, 40, 80, 120, 160], abs=4)


CORNERS = {1: (0, 0), 2: (0, -1), 3: (-1, -1), 4: (-1, 0), 5: (0, 0), 6: (0, -1), 7: (-1, -1), 8: (-1, 0)}
"""The row and the column of the corner in which a white left upper corner is shown, by the orientation in Exif."""


@pytest.mark.parametrize("ending", ["jpg", "png", "tiff", "webp"])
def test_images_are_upright_as_their_orientation_says(tmp_path: Path, ending: str) -> None:
    for orientation, corner in CORNERS.items():
        shown = Pillow.new("RGB", (64, 48))
        shown.paste("white", (0, 0, 16, 16))
        exif, file = Pillow.Exif(), io.BytesIO()
        exif[0x0112] = orientation
        shown.save(file, {"jpg": "JPEG", "tiff": "TIFF"}.get(ending, ending), exif=exif)
        track = left(tmp_path, {f"frame-1.{ending}": file.getvalue()}, Output(file=f"frame-{{tick}}.{ending}"))
        (found,) = read(track)
        assert track.size == ((64, 48) if orientation < 5 else (48, 64)), orientation
        assert found.shape[1::-1] == track.size
        assert [place for place in ((0, 0), (0, -1), (-1, 0), (-1, -1)) if found[place].min() > 200] == [corner], orientation


def turned(degrees: int = 0, sides: Fraction = Fraction(1), **flips: bool) -> Callable[[Any], None]:
    def change(stream: Any) -> None:
        stream.codec_context.sample_aspect_ratio = sides
        stream.set_display_rotation(degrees, **flips)

    return change


@pytest.mark.parametrize(
    ("change", "size", "corner"),
    [
        (turned(90, Fraction(2)), (48, 128), (-1, 0)),
        (turned(0, Fraction(2)), (128, 48), (0, 0)),
        (turned(0, Fraction(1, 2)), (64, 96), (0, 0)),
        (turned(90), (48, 64), (-1, 0)),
        (turned(180), (64, 48), (-1, -1)),
        (turned(-90), (48, 64), (0, -1)),
        (turned(0, hflip=True), (64, 48), (0, -1)),
        (turned(90, hflip=True), (48, 64), (-1, -1)),
    ],
)
def test_films_are_upright_and_keep_their_proportions(
    tmp_path: Path, change: Callable[[Any], None], size: tuple[int, int], corner: tuple[int, int]
) -> None:
    track = left(tmp_path, {"a.mp4": video(change=change)}, Output(file="a.mp4"))
    assert track.size == size
    found = read(track)[0]
    assert [place for place in ((0, 0), (0, -1), (-1, 0), (-1, -1)) if found[place].min() > 200] == [corner]
    with settings():
        scene = Scene((400, 300), Words("", [""], ""), PicturePainter([track]))
    (box,) = scene.boxes()
    assert (box.right - box.left) / (box.bottom - box.top) == pytest.approx(size[0] / size[1], rel=0.03)


def flipped(data: bytes, place: int = -30) -> bytes:
    return data[:place] + bytes([data[place] ^ 0x55]) + data[place + 1 :]


def header(width: int, height: int) -> bytes:
    """Return a PNG whose header claims another size, with the right checksum."""
    chunk = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    whole = image()
    return whole[:12] + chunk + struct.pack(">I", zlib.crc32(chunk)) + whole[33:]


def noise() -> bytes:
    file = io.BytesIO()
    Pillow.fromarray(np.random.default_rng(1).integers(0, 255, (40, 40, 3), np.uint8)).save(file, "png")
    return file.getvalue()


PLAYLIST = b"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nhttp://127.0.0.1:9/a.ts\n#EXT-X-ENDLIST\n"


@pytest.mark.parametrize(
    ("files", "output", "message"),
    [
        (lambda: {"frame-1.png": flipped(noise())}, FRAMES, "run 0 of experiment 1: frame-1.png: cannot be decoded"),
        (lambda: {"frame-1.png": noise()[:-900]}, FRAMES, "frame-1.png: cannot be decoded"),
        (
            lambda: {"frame-1.png": b"GIF90a"},
            FRAMES,
            "frame-1.png: cannot be decoded: its beginning is not that of a PNG, JPEG, PPM, GIF, WEBP, BMP or TIFF image",
        ),
        (lambda: {"frame-1.png": b""}, FRAMES, "frame-1.png: cannot be decoded"),
        (
            lambda: {"frame-1.png": image(), "frame-2.png": image((30, 21))},
            FRAMES,
            "run 0 of experiment 1: frame-2.png: 30 × 21 pixels, but the first picture has 30 × 20",
        ),
        (lambda: {"frame-1.png": image(), "frame-01.png": image()}, FRAMES, "frame-1.png and frame-01.png have the same tick"),
        (lambda: {"frame-1.png": header(9000, 9000)}, FRAMES, "frame-1.png: 9000 × 9000 pixels are too many"),
        (lambda: {"frame-1.png": header(60000, 60000)}, FRAMES, "frame-1.png: more than 50000000 pixels"),
        (lambda: {"frame-1.png": image(mode="I;16", colour=9)}, FRAMES, "frame-1.png: greys of more than 8 bits"),
        (
            lambda: {"frame-1.png": image(save_all=True, append_images=[Pillow.new("RGB", (30, 20))])},
            FRAMES,
            "frame-1.png: an image that moves",
        ),
        (
            lambda: {f"frame-{10**17 + k}.png": image() for k in (1, 2)},
            FRAMES,
            "numbers in frame-{tick}.png are too large to be told apart",
        ),
        (dict, FRAMES, "run 0 of experiment 1: no file 'frame-{tick}.png' (output 'camera')"),
        (lambda: {"a.png": image()}, Output(file="a.png"), "'a.png' names no time; write the number in it as {tick}"),
        (lambda: {"a.csv": b""}, Output(file="a.csv"), "'a.csv' is no image or video file"),
        (lambda: {"a.mp4": PLAYLIST}, Output(file="a.mp4"), "run 0 of experiment 1: a.mp4: cannot be decoded"),
        (lambda: {"a.mp4": video()[:700]}, Output(file="a.mp4"), "a.mp4: cannot be decoded"),
        (lambda: {"a.avi": video(format="avi", codec="mpeg4")[:-900]}, Output(file="a.avi"), "a.avi: "),
        (lambda: {"a.mp4": flipped(video(40), 850)}, Output(file="a.mp4"), "a.mp4: "),
        (
            lambda: {"a.mp4": video(change=turned(30))},
            Output(file="a.mp4"),
            "run 0 of experiment 1: a.mp4: is turned by an angle that is no multiple of 90°",
        ),
        (lambda: {"a.mp4": b"", "b.mp4": b""}, Output(file="*.mp4"), "2 files '*.mp4'; a run needs one video file"),
    ],
)
def test_files_that_cannot_be_shown_are_refused(
    tmp_path: Path, files: Callable[[], dict[str, bytes]], output: Output, message: str
) -> None:
    with pytest.raises(SierraError) as caught:
        read(left(tmp_path, files(), output))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert str(tmp_path) not in str(caught.value)


def test_missing_files_are_noted_with_the_first_one(tmp_path: Path) -> None:
    track = left(tmp_path, {f"frame-{tick}.png": image() for tick in (0, 10, 40, 50)})
    assert track.missing == "run 0 of experiment 1: 2 of 6 files frame-{tick}.png missing, first tick 20"
    assert left(tmp_path, {f"frame-{tick}.png": image() for tick in (0, 10, 20)}).missing == ""


def test_pictures_fill_their_panels_without_distortion(tmp_path: Path) -> None:
    wide = left(tmp_path, {"frame-1.png": image((300, 101))})
    with settings():
        scene = Scene((400, 300), Words("", [""], ""), PicturePainter([wide]))
        frame = scene.frame("t = 0", list(wide.states()))
    (box,) = scene.boxes()
    assert (box.right - box.left) / (box.bottom - box.top) == pytest.approx(300 / 101, rel=0.03)
    assert np.abs(frame[box.pixels].astype(int) - (200, 30, 60)).max() < 3
    thin = left(tmp_path, {"frame-1.png": image((1, 4000))})
    with settings(), pytest.raises(SierraError, match="do not fit into 400 × 300 pixels"):
        Scene((400, 300), Words("", [""], ""), PicturePainter([thin]))


SIMULATOR = """\
import os, shutil, sys
number = int(open(sys.argv[1]).read().split('run="')[1].split('"')[0])
for tick in (0, 5, 10):
    with open(f"Frame {tick}.ppm", "wb") as file:
        file.write(b"P6 6 4 255 " + bytes((250 if number else 10, 0, 20 * tick)) * 24)
shutil.copy(sys.argv[2], "cam[1].mp4")
tried = f"{sys.argv[3]}-{number}"
if not os.path.exists(tried):
    sys.exit(open(tried, "x").close() or 3)
"""
CONFIG = """\
template = "arena.xml"
command = "python3 sim.py {input} {project}/cam.mp4 TRIED"
seed = "//random/@seed"
runs = 2
observe = "none"
run_changes = [{ set = "/arena/@run", value = "{run}" }]
[variables]
population_size = "//swarm/@count"
[outputs.frames]
file = "Frame {tick}.ppm"
time = "tick"
ticks_per_second = 10
[outputs.cam]
file = "cam[1].mp4"
[videos.tiles]
kind = "pictures"
table = "frames"
show = "tiles"
size = [400, 300]
[videos.cam]
kind = "pictures"
table = "cam"
size = [200, 160]
"""


@pytest.mark.integration
def test_recorded_files_become_videos_and_tiles(tmp_path: Path) -> None:
    template = projects.TEMPLATE.replace("<arena ", '<arena run="0" ')
    config = CONFIG.replace("TRIED", str(tmp_path / "tried"))
    root = projects.make(tmp_path / "p", config, simulator=SIMULATOR, template=template)
    (root / "cam.mp4").write_bytes(video())
    for _ in range(2):  # the first executions fail, and leave the same files
        stores.ask(root, "population_size=1")
    done = projects.quick(root, "video", "--json")
    assert done.returncode == 0, done.stderr
    tiles, cam = map(Path, json.loads(done.stdout)["files"])
    first, *_, last = video_files.decoded(tiles)
    assert first[150, 100].tolist() == pytest.approx([10, 0, 0], abs=8)
    assert last[150, 300].tolist() == pytest.approx([250, 0, 200], abs=8)
    assert len(video_files.decoded(cam)) == 5
    assert list((root / ".sierra/extracted").iterdir()) == []
    assert "cam: follows from the store" in projects.quick(root, "figures", "--check").stdout
    assert projects.quick(root, "fsck").returncode == 0
    of_cam, of_tiles = (row["sql"] for row in projects.sql(root, "SELECT sql FROM deliverables ORDER BY name"))
    assert len(projects.sql(root, of_tiles)) == 6
    assert [row["path"] for row in projects.sql(root, of_cam)] == ["cam[1].mp4"]
    shutil.rmtree(root / ".sierra/extracted")
    (root / "sierra.toml").write_text(config.replace('"frames"\nshow', '"frame"\nshow'))
    wrong = projects.quick(root, "video", "tiles")
    assert (wrong.returncode, "sierra.toml has no [outputs.frame]" in wrong.stderr) == (2, True), wrong.stderr

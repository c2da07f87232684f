"""Images in bags are shown in videos as they are; others than those that are read are refused in one line."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image as Pillow

from sierra.config.output_tables import Output
from sierra.errors import SierraError
from sierra.extensions.videos.pictures import pictures
from sierra.store.batch_data import ChosenRun
from tests import projects
from tests.extensions.videos.test_pictures import Left
from tests.projects import quick

pytest.importorskip("rosbags")

from tests.extensions.ros import bags
from tests.extensions.ros.bags import KINDS, NS, Recorded

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
RED_GREEN = [[200, 30, 60], [0, 255, 1]]
"""The pixels of a picture: 2 rows of 1 pixel."""
ENCODED: Mapping[str, list[list[int]]] = {
    "rgb8": RED_GREEN,
    "bgr8": [pixel[::-1] for pixel in RED_GREEN],
    "rgba8": [[*pixel, 255] for pixel in RED_GREEN],
    "bgra8": [[*pixel[::-1], 255] for pixel in RED_GREEN],
    "mono8": [[70], [80]],
}


def image(time: float, encoding: str = "rgb8", padding: int = 0, topic: str = "/camera", **other: Any) -> Recorded:
    data = [byte for pixel in ENCODED.get(encoding, RED_GREEN) for byte in (*pixel, *[9] * padding)]
    step = len(data) // 2
    found = {"width": 1, "height": 2, "step": step, "encoding": encoding, "data": data, "header.stamp.sec": int(time)}
    return Recorded(topic, IMAGE, int(time * NS) + 7, found | {"header.stamp.nanosec": int(time % 1 * NS)} | other)


def compressed(time: int, format: str, kind: str, data: bytes = b"") -> Recorded:
    file = io.BytesIO()
    Pillow.new("RGB", (16, 8), (200, 30, 60)).save(file, kind)
    values = {"header.stamp.sec": time, "format": format, "data": list(data or file.getvalue())}
    return Recorded("/camera", COMPRESSED, time * NS, values)


def shown(folder: Path, messages: list[Recorded], kind: str = "mcap", **keys: Any) -> tuple[list[float], list[np.ndarray]]:
    bag = bags.record(folder / "bag", kind, messages)
    output = Output.model_validate({"file": bag.name, "format": "bag", "topics": ("/camera",), **keys})
    track = pictures(Left(folder, {bag.name: bag.read_bytes()}), "camera", output, ChosenRun(1, 0, "r", "j"), 1.0)  # type: ignore[arg-type]
    reader = track.reader()
    assert len({bytes(state[0]) for state in track.states()}) == len({repr(one.values) for one in messages})
    return track.times.tolist(), [reader.read(place) for place in range(len(track.times))]


@pytest.mark.parametrize("kind", KINDS)
def test_pixels_are_those_of_the_messages_in_the_order_of_their_stamps(tmp_path: Path, kind: str) -> None:
    messages = [image(10 + place / 2, encoding, padding=place) for place, encoding in enumerate(ENCODED)]
    times, frames = shown(tmp_path, [*messages[2:], *messages[:2]], kind)
    assert times == [0, 0.5, 1, 1.5, 2]
    for frame in frames[:4]:
        assert frame[:, 0].tolist() == RED_GREEN
    assert frames[4][:, 0].tolist() == [[70] * 3, [80] * 3]


def test_compressed_pictures_and_times_of_receipt(tmp_path: Path) -> None:
    formats = [("jpeg", "JPEG"), ("rgb8; jpeg compressed bgr8", "JPEG"), ("rgb8; png compressed bgr8", "PNG")]
    times, frames = shown(tmp_path, [compressed(time, *one) for time, one in enumerate(formats, 5)])
    assert times == [0, 1, 2]
    for frame in frames:
        assert np.abs(frame[0, 0].astype(int) - (200, 30, 60)).max() < 8
    same = [image(0)._replace(received=3 * NS), image(0)._replace(received=5 * NS)]
    assert shown(tmp_path / "a", same, time="received_ns")[0] == [0, 2]


@pytest.mark.parametrize(
    ("messages", "keys", "why"),
    [
        (
            [image(1, "yuv422")],
            {},
            "picture 0 of '/camera': the encoding 'yuv422' is not read; rgb8, bgr8, mono8, rgba8, bgra8 are",
        ),
        (
            [image(1), image(2, step=2)],
            {},
            "picture 1 of '/camera': 6 bytes in 2 rows of 2 (step), but a row of 1 pixels in rgb8 has 3",
        ),
        ([image(1, height=3)], {}, "6 bytes in 3 rows of 3 (step)"),
        ([image(1, width=0)], {}, "0 × 2 pixels; 1 to 50000000 are possible"),
        ([image(1, width=1 << 31, height=1 << 31)], {}, "pixels; 1 to 50000000"),
        ([image(1), image(2, height=1, data=[1, 2, 3])], {}, "picture 1: 1 × 1 pixels, but the first picture has 1 × 2"),
        ([image(1), image(1)], {}, 'the same header_stamp_ns, 1000000000; set time = "received_ns" in the output'),
        ([image(1)], {"time": "height"}, "pictures have their time in header_stamp_ns or received_ns, not in time = 'height'"),
        ([image(1), image(1, topic="/b")], {"topics": ("/*",)}, "a video shows one topic, and topics names /b, /camera"),
        ([image(1)], {"topics": ("/b",)}, "has no topic '/b'; it has /camera"),
        (
            [compressed(1, "16UC1; compressedDepth png", "PNG", b"\0" * 40)],
            {},
            "its format '16UC1; compressedDepth png' is not read",
        ),
        ([compressed(1, "png", "PNG", b"\x89PNG\r\n\x1a\n" + b"\0" * 9)], {}, "picture 0: cannot be decoded"),
        (
            [Recorded("/camera", "std_msgs/msg/Float64", 1)],
            {},
            "has messages of std_msgs/msg/Float64, not of sensor_msgs/msg/Image",
        ),
    ],
)
def test_what_is_no_picture_is_refused_in_one_line(
    tmp_path: Path, messages: list[Recorded], keys: dict[str, Any], why: str
) -> None:
    with pytest.raises(SierraError) as refused:
        shown(tmp_path, messages, **keys)
    assert str(refused.value).startswith("run 0 of experiment 1: run.mcap")
    assert why in str(refused.value)
    assert "\n" not in str(refused.value)


SIMULATOR = 'import shutil\nshutil.copy({bag!r}, "run.db3")\n'
CAMERA = """
[outputs.camera]
file = "run.db3"
format = "bag"
topics = ["/camera"]

[videos.camera]
kind = "pictures"
table = "camera"
formats = ["png"]
show = "tiles"
"""


@pytest.mark.integration
def test_images_of_a_camera_become_a_video(tmp_path: Path) -> None:
    bag = bags.record(tmp_path / "bags", "db3", [image(10), image(10.5), image(12)])
    here = projects.make(tmp_path / "p", projects.CONFIG + CAMERA, simulator=SIMULATOR.format(bag=str(bag)))
    projects.run(here, "population_size=1")
    made = quick(here, "video", "--json")
    assert made.returncode == 0, made.stderr
    assert sorted(Path(one).name for one in json.loads(made.stdout)["files"]) == [
        f"camera-time={time}.png" for time in (0.5, 0, 2)
    ]
    checked = quick(here, "figures", "--check")
    assert checked.returncode == 0, checked.stdout + checked.stderr

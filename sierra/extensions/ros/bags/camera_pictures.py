"""Images in bags as files of pictures, for videos: messages of `sensor_msgs/Image` and `sensor_msgs/CompressedImage`.

Each message becomes a file: an image with raw pixels as PNG, without a loss; a compressed one as it is. Videos decode these
files with the same limits as those that runs write. The time of a picture is the stamp in its header, or with
`time = "received_ns"` when it was received.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from sierra.config.output_tables import Output
from sierra.extensions.ros.bags.bag_topics import NAMED, RECEIVED, STAMP, Keys, TopicTable, opened
from sierra.extensions.ros.bags.containers import NS, damage
from sierra.ingest.base import UnreadableError
from sierra.ingest.model import Written
from sierra.ingest.rewriting import OriginalFile
from sierra.util.hashing import sha256
from sierra.util.text import few

ENCODINGS = {
    "rgb8": ("RGB", "RGB"),
    "bgr8": ("RGB", "BGR"),
    "mono8": ("L", "L"),
    "rgba8": ("RGBA", "RGBA"),
    "bgra8": ("RGBA", "BGRA"),
}
"""The encodings of pixels, with Pillow's mode, and its name of their order in memory."""
MAGIC = {b"\xff\xd8\xff": ".jpg", b"\x89PNG\r\n\x1a\n": ".png"}
"""The first bytes of compressed pictures, with the endings of files."""
PIXELS = 50_000_000
"""The limit on the pixels of a picture, as for those in files."""


class Picture(NamedTuple):
    """A picture: its time in ns, its file, and the hash of its message."""

    time: int
    path: Path
    sha256: str


def pictures(bag: Path, name: str, output: Output) -> list[Picture]:
    """Write the pictures of the only topic of an output beside the bag; return them in the order of their times.

    `name` is the path of the bag in the output folder of its run. Raises UnreadableError.
    """
    if output.time not in ("", STAMP, RECEIVED):
        raise UnreadableError(f"pictures have their time in {STAMP} or {RECEIVED}, not in time = {output.time!r}")
    source = OriginalFile(Written(str(bag), "", "", name, "", 0, True, bag.stat().st_size))
    with opened(source) as content:
        index = content.index()
        table = TopicTable(index, Keys(**dict(output.own_keys)))
        topic, *others = sorted({channel.topic for channel in table.channels})
        if others:
            raise UnreadableError(f"a video shows one topic, and topics names {topic}, {few(others, NAMED)}")
        written: list[Picture] = []
        for channel, received, data in content.scan(table.channels.__contains__):
            what = f"picture {len(written)} of {topic!r}"
            with damage(what):
                kind = table.type_of(channel)
                if kind.name not in WRITERS:
                    raise UnreadableError(f"the topic {topic!r} has messages of {kind.name}, not of {' or '.join(WRITERS)}")
                message: Any = kind.message(data)
                stamp = message.header.stamp
                time = received if output.time == RECEIVED else int(stamp.sec) * NS + int(stamp.nanosec)
                path = WRITERS[kind.name](message, bag.with_name(f"{bag.stem}-{len(written)}"), what)
                written.append(Picture(time, path, sha256(data)))
        if len(written) != sum(index[channel] for channel in table.channels):
            raise UnreadableError(f"has {len(written)} pictures of {topic!r}, but its index says another number")
    written.sort()
    for before, after in pairwise(written):
        if before.time == after.time:
            cure = "" if output.time == RECEIVED else f'; set time = "{RECEIVED}" in the output'
            raise UnreadableError(f"has two pictures of {topic!r} with the same {output.time or STAMP}, {after.time}{cure}")
    return written


def _raw(message: Any, path: Path, what: str) -> Path:
    """Write raw pixels as PNG; return the path."""
    from PIL import Image as Pillow

    encoding, width, height, step = str(message.encoding), int(message.width), int(message.height), int(message.step)
    if encoding not in ENCODINGS:
        raise UnreadableError(f"{what}: the encoding {encoding!r} is not read; {', '.join(ENCODINGS)} are")
    mode, order = ENCODINGS[encoding]
    least, data = width * len(order), message.data.tobytes()
    if not 0 < width * height <= PIXELS:
        raise UnreadableError(f"{what}: {width} × {height} pixels; 1 to {PIXELS} are possible")
    if step < least or len(data) != step * height:
        size = f"{len(data)} bytes in {height} rows of {step} (step)"
        raise UnreadableError(f"{what}: {size}, but a row of {width} pixels in {encoding} has {least}")
    target = path.with_name(f"{path.name}.png")
    Pillow.frombytes(mode, (width, height), data, "raw", order, step).save(target, compress_level=1)
    return target


def _compressed(message: Any, path: Path, what: str) -> Path:
    """Write a compressed picture as it is; return the path."""
    data = message.data.tobytes()
    ending = next((ending for magic, ending in MAGIC.items() if data.startswith(magic)), None)
    if ending is None:
        raise UnreadableError(f"{what}: its format {str(message.format)[:80]!r} is not read; jpeg and png are")
    target = path.with_name(f"{path.name}{ending}")
    target.write_bytes(data)
    return target


WRITERS = {"sensor_msgs/msg/Image": _raw, "sensor_msgs/msg/CompressedImage": _compressed}
"""The functions that write messages, by type."""

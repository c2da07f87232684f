"""A video file appears whole or not at all, and the same frames give the same bytes."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import av
import numpy as np
import numpy.typing as npt
import pytest

from sierra.errors import Missing, NotInstalled, SierraError
from sierra.extensions.videos.encode import check, encode
from sierra.extensions.videos.table import Format
from tests.extensions.videos.video_files import decoded

Image = npt.NDArray[np.uint8]
RED, BLUE = (200, 30, 30), (30, 30, 200)


def images(count: int = 6, size: tuple[int, int] = (64, 96)) -> Iterator[Image]:
    """Yield images whose left part is red, more of it with each image, and whose right part is blue."""
    for number in range(count):
        image = np.full((*size, 3), BLUE, np.uint8)
        image[:, : 8 * (number + 1)] = RED
        yield image


@pytest.mark.parametrize("format", ["mp4", "webm", "gif"])
def test_frames_come_back_and_the_same_frames_give_the_same_bytes(tmp_path: Path, format: Format) -> None:
    first, second = tmp_path / f"a.{format}", tmp_path / f"b.{format}"
    for path in (first, second):
        encode(path, images(size=(63, 95)), 10, format, 'made by <script> & "me"')
    assert first.read_bytes() == second.read_bytes()
    found = decoded(first)
    assert [image.shape for image in found] == [(64, 96, 3)] * 6, "odd sizes are padded"
    for image, expected in zip(found, images(), strict=True):
        assert np.abs(image[8:-8, 2:6].astype(int) - expected[8:-8, 2:6]).max() < 30
        assert np.abs(image[8:-8, 60:90].astype(int) - expected[8:-8, 60:90]).max() < 30
    if format == "mp4":
        with av.open(str(first)) as video:
            assert video.metadata["comment"] == 'made by <script> & "me"'
            stream = video.streams.video[0]
            assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")


def test_a_failing_frame_leaves_the_file_as_it_was(tmp_path: Path) -> None:
    def failing() -> Iterator[Image]:
        yield from images(3)
        raise SierraError("no more")

    path = tmp_path / "a.mp4"
    path.write_bytes(b"before")
    with pytest.raises(SierraError, match="no more"):
        encode(path, failing(), 10, "mp4")
    assert [one.name for one in tmp_path.iterdir()] == ["a.mp4"]
    assert path.read_bytes() == b"before"
    with pytest.raises(SierraError, match="no frame"):
        encode(path, iter(()), 10, "mp4")
    with pytest.raises(Missing, match="cannot write the video"):
        encode(tmp_path / "none" / "a.mp4", images(), 10, "mp4")


def test_a_missing_encoder_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(av, "codecs_available", av.codecs_available - {"libx264"})
    check(["gif"])
    with pytest.raises(NotInstalled, match="has no encoder libx264 for mp4"):
        check(["gif", "mp4"])
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(NotInstalled, match="videos need PyAV; pip install"):
        check(["gif"])

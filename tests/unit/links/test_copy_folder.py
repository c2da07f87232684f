"""A folder is received from a host only as it was sent, and never outside its target, whatever the host sends."""

from __future__ import annotations

import hashlib
import json
import os
import sys
from pathlib import Path
from subprocess import PIPE, Popen
from typing import Any, cast

import pytest

from sierra.errors import Missing
from sierra.links import copy_folder, remote_folder
from sierra.links.commands import Exchange

EMPTY = hashlib.sha256(b"").hexdigest()


class Answers:
    """The exchange with a host that sends certain bytes."""

    name = "rb1"

    def __init__(self, data: bytes) -> None:
        self._data = [data]

    def send(self, data: bytes, timeout: float) -> None:
        pass

    def read(self, timeout: float) -> tuple[int, bytes] | None:
        return (1, self._data.pop()) if self._data else None


def pull(target: Path, entries: Any, contents: bytes = b"") -> Any:
    line = json.dumps({"entries": entries, "left_out": []}).encode() + b"\n"
    return copy_folder.pull(cast(Exchange, Answers(line + contents)), "data", target, 1)


@pytest.mark.parametrize(
    "entries",
    [
        [["file", "../out", EMPTY, 0, False]],
        [["file", "/out", EMPTY, 0, False]],
        [["file", "a/../../out", EMPTY, 0, False]],
        [["folder", ".."]],
        [["folder", "a"], ["folder", "a/.."]],
        [["file", "", EMPTY, 0, False]],
        [["file", "a\0b", EMPTY, 0, False]],
        [["file", "a", EMPTY, 0, False], ["file", "a", EMPTY, 0, False]],
        [["link", "a", "b"], ["file", "a/out", EMPTY, 0, False]],
        [["link", "a", "/etc"]],
        [["link", "a", "../out"]],
        [["folder", "a"], ["link", "a/b", "../../out"]],
        [["link", "a", "."]],
        [["folder", "d"], ["link", "d/up", "../s/.."]],
        [["link", "a", "b/../../out"]],
        [["file", "a", EMPTY, -1, False]],
        [["file", "a", "no hash", 0, False]],
        [["device", "a"]],
        "entries",
        [7],
    ],
)
def test_entries_that_lead_outside_are_refused(tmp_path: Path, entries: Any) -> None:
    with pytest.raises(Missing, match="rb1: sends") as raised:
        pull(tmp_path / "here" / "target", entries)
    assert len(str(raised.value).splitlines()) == 1
    assert not (tmp_path / "here").exists()


def test_contents_that_differ_from_their_hash_or_end_early_leave_nothing(tmp_path: Path) -> None:
    digest = hashlib.sha256(b"right").hexdigest()
    for contents, reason in ((b"wrong", "changed while it was copied"), (b"rig", "python3 ended")):
        with pytest.raises(Missing, match=reason):
            pull(tmp_path / "target", [["folder", "a"], ["file", "a/b", digest, 5, False]], contents)
    assert list(tmp_path.iterdir()) == []
    assert pull(tmp_path / "target", [["file", "b", digest, 5, True]], b"right").files == {"b": digest}
    assert os.access(tmp_path / "target" / "b", os.X_OK)


def test_lists_and_reasons_of_a_host_are_bounded_and_on_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(copy_folder, "LONGEST", 1000)
    for data, reason in (
        (b"x" * 2000, "list of more than"),
        (b'{"error": "a\\nb\\u001b[31m"}\n', r"a\\nb\\x1b\[31m"),
        (b"no json\n", "sends no answer"),
        (b"[]\n", "sends no answer"),
        (b"{}\n", "sends no answer"),
    ):
        with pytest.raises(Missing, match=reason) as raised:
            copy_folder.pull(cast(Exchange, Answers(data)), "data", tmp_path / "target", 1)
        assert str(raised.value).isprintable()


def test_the_part_on_the_host_removes_what_it_wrote_when_it_is_cut_off(tmp_path: Path) -> None:
    home = tmp_path / "home"
    home.mkdir()
    (home / ".sierra-unfinished-of-another").mkdir()
    source = json.dumps(Path(remote_folder.__file__).read_text())
    entry = ["file", "a", hashlib.sha256(b"all").hexdigest(), 3, False]
    for sent in (b"al", b""):
        argv = [sys.executable, *copy_folder.program("push")[1:]]
        with Popen(argv, stdin=PIPE, stdout=PIPE, env={"HOME": str(home)}) as process:
            out, _ = process.communicate(f"{source}\n{json.dumps(['deep/target', [entry]])}\n".encode() + sent, timeout=20)
        assert b"the connection ended" in out
        assert list((home / "deep").iterdir()) == []

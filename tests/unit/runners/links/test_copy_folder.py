"""A folder is received from a host only as it was sent, and never outside its target, whatever the host sends."""

from __future__ import annotations

import hashlib
import io
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from subprocess import PIPE, Popen
from typing import Any, cast

import pytest

from sierra.errors import Missing
from sierra.runners.links import copy_folder
from sierra.runners.links.commands import Exchange
from sierra.worker import remote_folder
from tests.waiting import PATIENCE_S


class Answers:
    """The exchange with a host that sends certain bytes."""

    name = "rb1"

    def __init__(self, data: bytes) -> None:
        self._data = [data]

    def send(self, data: bytes, timeout: float) -> None:
        pass

    def read(self, timeout: float) -> tuple[int, bytes] | None:
        return (1, self._data.pop()) if self._data else None


def pull(target: Path, entries: Any, contents: bytes = b"", *digests: str) -> Any:
    line = json.dumps({"entries": entries, "left_out": []}).encode() + b"\n"
    end = json.dumps({"state": "done", "digests": digests}).encode() + b"\n"
    return copy_folder.pull(cast(Exchange, Answers(line + contents + (end if digests else b""))), "data", target, 1)


@pytest.mark.parametrize(
    "entries",
    [
        [["file", "../out", None, 0, False]],
        [["file", "/out", None, 0, False]],
        [["file", "a/../../out", None, 0, False]],
        [["folder", ".."]],
        [["folder", "a"], ["folder", "a/.."]],
        [["file", "", None, 0, False]],
        [["file", "a\0b", None, 0, False]],
        [["folder", "\ud800"]],
        [["link", "a", "\ud800"]],
        [["file", "a", None, 0, False], ["file", "a", None, 0, False]],
        [["link", "a", "b"], ["file", "a/out", None, 0, False]],
        [["link", "a", "/etc"]],
        [["link", "a", "../out"]],
        [["folder", "a"], ["link", "a/b", "../../out"]],
        [["link", "a", "."]],
        [["folder", "d"], ["link", "d/up", "../s/.."]],
        [["link", "a", "b/../../out"]],
        [["file", "a", None, -1, False]],
        [["file", "a", "0" * 64, 0, False]],
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
    for contents, digests, reason in (
        (b"wrong", [digest], "a/b changed while it was copied"),
        (b"rig", [], "Python ended"),
        (b"right", [], "Python ended"),
        (b"right", [digest, digest], "no list of hashes"),
    ):
        with pytest.raises(Missing, match=reason):
            pull(tmp_path / "target", [["folder", "a"], ["file", "a/b", None, 5, False]], contents, *digests)
    assert list(tmp_path.iterdir()) == []
    assert pull(tmp_path / "target", [["file", "b", None, 5, True]], b"right", digest).files == {"b": digest}
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
        argv = copy_folder.program("push", sys.executable)
        with Popen(argv, stdin=PIPE, stdout=PIPE, env={"HOME": str(home)}) as process:
            out, _ = process.communicate(
                f"{source}\n{json.dumps(['deep/target', [entry]])}\n".encode() + sent, timeout=PATIENCE_S
            )
        assert b"the connection ended" in out
        assert list((home / "deep").iterdir()) == []


def asked(home: Path, *words: str) -> bytes:
    """Return what the part on a host answers to a request to pull."""
    argv = copy_folder.program("pull", sys.executable)
    source = json.dumps(Path(remote_folder.__file__).read_text())
    with Popen(argv, stdin=PIPE, stdout=PIPE, env={"HOME": str(home)}) as process:
        return process.communicate(f"{source}\n{json.dumps(words)}\n".encode(), timeout=PATIENCE_S)[0]


def test_a_host_reads_files_once_unless_they_are_young_and_says_which_it_cannot_send(tmp_path: Path) -> None:
    digests = [hashlib.sha256(text).hexdigest() for text in (b"old", b"new")]
    for name, text in (("a", b"old"), ("b", b"new")):
        (tmp_path / name).write_bytes(text)
    os.utime(tmp_path / "a", (0, 0))
    (tmp_path / "c").symlink_to("b")
    listed = [["file", "a", None, 3, False], ["file", "b", None, 3, False], ["link", "c", "b"]]
    first, _, rest = asked(tmp_path, "", "copy").partition(b"\n")
    assert json.loads(first) == {"entries": listed, "left_out": []}
    assert rest == b"oldnew" + json.dumps({"state": "done", "digests": digests}).encode() + b"\n"
    compared = json.loads(asked(tmp_path, "", "compare"))["entries"]
    assert [entry[2] for entry in compared] == [*digests, "b"]


def test_a_file_that_changes_while_it_is_sent_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remote_folder, "YOUNG_S", PATIENCE_S)
    file = tmp_path / "file"
    file.write_bytes(b"before")

    class Output(io.BytesIO):
        def __init__(self, change: Callable[[], object] = lambda: None) -> None:
            super().__init__()
            self._change = change

        def write(self, data: Any) -> int:
            self._change()
            return super().write(data)

    for change, reason in (
        (lambda: file.write_bytes(b"after!"), "changed while it was copied"),
        (lambda: file.write_bytes(b"longer than before"), "changed while it was copied"),
        (lambda: None, "just before"),
        (lambda: os.utime(file, (0, 0)), "changed while it was copied"),
        (lambda: None, ""),
    ):
        size = file.stat().st_size
        sent = Output(change)
        assert reason in remote_folder.send(os.fsencode(file), size, sent)[1]
        assert len(sent.getvalue()) == size
    sent = Output()
    assert "No such file" in remote_folder.send(os.fsencode(tmp_path / "gone"), 7, sent)[1]
    assert sent.getvalue() == bytes(7)

"""The record of the end of a run, and what it has left: whatever a folder contains, it is checked before it is used."""

from __future__ import annotations

import json
import os
import socket
import time
from pathlib import Path
from typing import Any

import pytest

from sierra.extensions.collect.folder import Refused, files_left, read_ended

RECORD: dict[str, Any] = {
    "format": 1,
    "run": "a" * 64,
    "status": 0,
    "started": 1700000000.25,
    "ended": 1700000001.5,
    "host": "node1",
    "system": "Linux",
    "release": "6.1",
    "machine": "x86_64",
    "cores": 4,
}


def written(folder: Path, data: bytes) -> Path:
    (folder / "run").mkdir()
    (folder / "run" / "ended.json").write_bytes(data)
    return folder


def test_a_record_has_status_times_and_machine(tmp_path: Path) -> None:
    record = read_ended(written(tmp_path, json.dumps(RECORD).encode()), "run")
    assert (record.run, record.status, record.started, record.ended) == ("a" * 64, 0, 1700000000.25, 1700000001.5)
    assert (record.facts["host"], record.facts["release"], record.cores) == ("node1", "6.1", 4)


def test_facts_about_the_machine_may_be_unknown(tmp_path: Path) -> None:
    few = {name: RECORD[name] for name in ("format", "run", "status", "started", "ended")}
    record = read_ended(written(tmp_path, json.dumps(few | {"cores": None}).encode()), "run")
    assert (set(record.facts.values()), record.cores) == ({""}, 0)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"format": 2}, 'needs "format": 1'),
        ({"run": 5}, 'needs "run"'),
        ({"status": None}, 'needs "status"'),
        ({"status": True}, 'needs "status"'),
        ({"status": 256}, 'needs "status"'),
        ({"status": -9}, 'needs "status"'),
        ({"started": None}, 'needs "started"'),
        ({"started": -1}, 'needs "started"'),
        ({"ended": float("nan")}, 'needs "ended"'),
        ({"ended": float("inf")}, 'needs "ended"'),
        ({"ended": 10**400}, 'needs "ended"'),
        ({"ended": 1600000000}, '"ended" is before "started"'),
        ({"ended": time.time() + 1e6}, '"ended" is in the future'),
        ({"host": "a\nb"}, '"host" should be a text'),
        ({"host": "a" * 300}, '"host" should be a text'),
        ({"machine": ["x86_64"]}, '"machine" should be a text'),
    ],
)
def test_a_record_that_cannot_be_right_is_refused(changes: dict[str, object], reason: str, tmp_path: Path) -> None:
    with pytest.raises(Refused, match=reason):
        read_ended(written(tmp_path, json.dumps({**RECORD, **changes}).encode()), "run")


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (json.dumps(RECORD).encode()[:50], "damaged or incomplete"),
        (b"", "damaged or incomplete"),
        (b"[" * 60000, "damaged or incomplete"),
        (b"\xff\xfe", "damaged or incomplete"),
        (b"[1]", 'needs "format": 1'),
        (b" " * 70000, "is larger than 65536 bytes"),
    ],
)
def test_damaged_and_huge_records_are_refused(data: bytes, reason: str, tmp_path: Path) -> None:
    with pytest.raises(Refused, match=reason):
        read_ended(written(tmp_path, data), "run")


@pytest.mark.parametrize("where", ["ended.json", "run"])
def test_links_are_not_followed(where: str, tmp_path: Path) -> None:
    real = tmp_path / "real"
    real.mkdir()
    (real / "ended.json").write_text(json.dumps(RECORD))
    if where == "run":
        (tmp_path / "run").symlink_to(real)
    else:
        (tmp_path / "run").mkdir()
        (tmp_path / "run" / "ended.json").symlink_to(real / "ended.json")
    with pytest.raises(Refused, match=r"ended\.json cannot be read"):
        read_ended(tmp_path, "run")


def test_a_pipe_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    os.mkfifo(tmp_path / "run" / "ended.json")
    with pytest.raises(Refused, match="not a regular file"):
        read_ended(tmp_path, "run")


@pytest.mark.parametrize(
    ("status", "statuses", "outcome"),
    [
        (0, (0,), (0, None)),
        (3, (0,), (3, None)),
        (127, (0,), (127, None)),
        (137, (0,), (None, 9)),
        (137, (0, 137), (137, None)),
        (255, (0,), (255, None)),
    ],
)
def test_a_status_above_128_is_a_signal_unless_the_project_gives_it_a_meaning(
    status: int, statuses: tuple[int, ...], outcome: tuple[int | None, int | None], tmp_path: Path
) -> None:
    record = read_ended(written(tmp_path, json.dumps({**RECORD, "status": status}).encode()), "run")
    assert record.outcome(statuses) == outcome


def test_files_are_read_in_folders_of_any_name(tmp_path: Path) -> None:
    output = tmp_path / "run" / "output"
    names = ["a'; echo foo", "b\nc/d", "-rf", "\udcff"]
    for name in names:
        (output / name).parent.mkdir(parents=True, exist_ok=True)
        (output / name).write_text(name, "utf-8", "surrogateescape")
    left = {name: file.read() for name, file in files_left(tmp_path, "run") if file}
    assert left == {name: name.encode("utf-8", "surrogateescape") for name in names}


def test_links_sockets_and_pipes_are_named_and_not_read(tmp_path: Path) -> None:
    output = tmp_path / "run" / "output"
    (output / "inner").mkdir(parents=True)
    (tmp_path / "secret").write_text("secret")
    (output / "file").symlink_to(tmp_path / "secret")
    (output / "inner" / "folder").symlink_to(tmp_path)
    os.mkfifo(output / "pipe")
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(output / "socket"))
        assert dict(files_left(tmp_path, "run")) == dict.fromkeys(("file", "inner/folder", "pipe", "socket"))


def test_outputs_behind_a_link_are_refused(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "output").symlink_to(tmp_path)
    with pytest.raises(Refused, match="its outputs cannot be read"):
        list(files_left(tmp_path, "run"))

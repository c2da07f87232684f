"""The program with which a driver talks on a host, as a process."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from sierra.extensions.lab import agent
from sierra.extensions.lab.agent import front, keeper
from sierra.util import worker_zip
from tests.pythons import python_of

HELLO = {"do": "hello", "slots": 1, "lease": 60, "gpus": None, "cores": 1, "have": {}}


class Host:
    """A front of a session's folder."""

    def __init__(self, root: Path, python: str) -> None:
        self.folder = root / "sessions" / "ab-1" / "pc1"
        programs = root / "worker.pyz"
        programs.write_bytes(worker_zip.packed(Path(agent.__file__).parent))
        self.argv = (python, "-I", "-S", "-B", str(programs))
        self.process = subprocess.Popen(
            (*self.argv, front.__name__, str(self.folder)), stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0
        )

    def send(self, content: bytes = b"", **request: Any) -> None:
        assert self.process.stdin is not None
        size = {"size": len(content)} if content else {}
        self.process.stdin.write(json.dumps({**request, **size}).encode() + b"\n" + content)

    def until(self, event: str) -> tuple[dict[str, Any], bytes]:
        """Return the next event of this kind, with its content."""
        assert self.process.stdout is not None
        while line := self.process.stdout.readline():
            record = json.loads(line)
            content = b""
            while len(content) < record.get("size", 0):
                content += self.process.stdout.read(record["size"] - len(content))
            if record["event"] == event:
                return record, content
        raise AssertionError(f"no {event}")

    def close(self) -> int:
        assert self.process.stdin and self.process.stdout  # noqa: PT018
        self.process.stdin.close()
        self.process.stdout.close()
        return self.process.wait(30)


@pytest.fixture
def host(tmp_path: Path) -> Iterator[Host]:
    host = Host(tmp_path, sys.executable)
    yield host
    host.close()


def test_the_oldest_supported_python_is_enough_on_a_host(tmp_path: Path, require: Callable[..., str]) -> None:
    oldest = python_of("3.8")
    require("Python 3.8", there=oldest is not None)
    assert oldest is not None
    host = Host(tmp_path, oldest)
    host.send(**HELLO)
    assert host.until("hello")[0]["python"].startswith("3.8.")
    host.send(do="queue", entry="1.0", task="1_0", job="1-1", host="pc1", clock="0")
    state = host.until("state")[0]
    while not state["ended"]:  # there are no jobs, so that it cannot execute them
        state = host.until("state")[0]
    assert state["ended"]["1.0"][0] == 3
    host.close()
    assert subprocess.run((*host.argv, keeper.__name__, str(host.folder), "1", "0", "1"), check=False).returncode == 0


def test_a_result_log_is_sent_from_where_the_driver_has_it(host: Host) -> None:
    log = host.folder / "results" / "0.a.pack"
    log.parent.mkdir(parents=True)
    log.write_bytes(b"0123456789")
    host.send(**{**HELLO, "have": {"0.a.pack": 4}})
    assert host.until("log") == ({"event": "log", "name": "0.a.pack", "at": 4, "size": 6}, b"456789")
    log.write_bytes(b"012")
    assert host.until("cut")[0]["at"] == 3
    with log.open("ab") as file:
        file.write(b"abc")
    assert host.until("log") == ({"event": "log", "name": "0.a.pack", "at": 3, "size": 3}, b"abc")


def test_a_task_that_is_not_there_is_withdrawn(host: Host) -> None:
    host.send(**HELLO)
    host.send(do="withdraw", entry="7.3")
    assert host.until("withdrawn")[0]["entry"] == "7.3"


@pytest.mark.parametrize("name", ["../escaped", "elements/../../escaped", "/tmp/escaped", "lease"])
def test_a_driver_writes_only_its_own_files(host: Host, name: str) -> None:
    host.send(**HELLO)
    host.send(b"content", do="file", name=name)
    host.send(b"{}", do="file", name="element.json")
    host.send(do="clock")
    host.until("clock")
    assert (host.folder / "element.json").read_bytes() == b"{}"
    assert not list(host.folder.parents[2].rglob("escaped"))


def test_the_name_of_no_task_is_refused(host: Host) -> None:
    host.send(**HELLO)
    host.send(do="queue", entry="../../1", task="", job="", host="", clock="")
    assert "is the name of no task" in host.until("trouble")[0]["reason"]


def test_a_folder_that_cannot_be_made_is_reported(tmp_path: Path) -> None:
    (tmp_path / "sessions").write_text("a file")
    host = Host(tmp_path, sys.executable)
    host.send(**HELLO)
    assert "sessions" in host.until("trouble")[0]["reason"]
    host.close()


def test_a_host_forgets_a_session(host: Host) -> None:
    host.send(**HELLO)
    host.send(do="remove")
    host.until("removed")
    assert not host.folder.parent.exists()

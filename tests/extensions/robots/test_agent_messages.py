"""Tests of the messages of agents: whatever a robot sends, nothing else than the protocol gets into results and tables."""

from __future__ import annotations

import json
import queue
from typing import Any

import pytest

from sierra.extensions.robots import agent_messages
from sierra.extensions.robots.agent_link import AgentLink
from sierra.worker import machine
from sierra.worker.journal import End, OutputFile
from tests.support.local_link import LocalLink
from tests.waiting import PATIENCE_S

FILE = {"path": "a\udcff.csv", "sha256": "0" * 64, "bytes": 1, "lines": 1, "ended": True, "head": "t", "quotes": None}
END = {
    **{"event": "end", "run": "r", "execution": "e", "directory": "/d", "host": "tb1", "slot": 0},
    **{"started": 1e9, "ended": 1e9, "exit_code": 0, "signal": None, "stopped": None, "error": None},
    **{"user_s": 0, "system_s": 0.5, "max_rss_bytes": 1, "outputs": [FILE]},
}
ENDED = {"event": "ended", "attempt": "1", "started": True, "why": None, "end": END, "problems": []}


def with_end(**changes: Any) -> dict[str, Any]:
    return {**ENDED, "end": {**END, **changes}}


def test_everything_is_known_that_robots_report_of_themselves_and_of_ends():
    assert agent_messages.Facts.model_fields.keys() == machine.facts().keys()
    assert agent_messages.OutputFile.model_fields.keys() == OutputFile.__annotations__.keys()
    without_robots = {"event", "elsewhere", "spare", "resumed", "gpus", "gpu_limit", "gpu_s", "gpu_memory_bytes"}
    assert agent_messages.End.model_fields.keys() == End.__annotations__.keys() - without_robots


def test_a_report_is_passed_on_without_what_nobody_knows():
    found = agent_messages.read(json.dumps({**with_end(error="\udcff: not found"), "environment": "another"}))
    assert "environment" not in found
    assert found["end"]["error"] == "\\udcff: not found"
    assert found["end"]["outputs"][0]["path"] == "a\udcff.csv"  # a name of bytes that are no text
    assert "left_out" not in found["end"]
    report = {name: value for name, value in ENDED.items() if name != "event"}
    assert agent_messages.as_report(report)
    assert agent_messages.as_report({"why": 7}) is None


@pytest.mark.parametrize(
    "sent",
    [
        [],
        {},
        {"event": []},
        {"event": "reboot"},
        {"event": "clock", "id": "1", "wall": 1},
        {"event": "clock", "wall": 1 << 64},
        {"event": "clock", "wall": 1.5},
        {"event": "checked", "battery": float("nan"), "disk": 1, "failed": []},
        {"event": "checked", "battery": None, "disk": "much", "failed": []},
        {"event": "refused"},
        {"event": "ended", "attempt": "1"},
        {**ENDED, "end": None},
        {"event": "watched", "uneven": -1, "moved": 0},
        {"event": "watched", "uneven": 1, "moved": 1.5},
        {"event": "watched", "uneven": 1 << 60, "moved": 0},
        with_end(started=float("nan")),
        with_end(ended=1e30),
        with_end(exit_code="0"),
        with_end(exit_code=True),
        with_end(stopped="weird"),
        with_end(max_rss_bytes=1 << 70),
        with_end(outputs=[{"path": "a"}]),
    ],
)
def test_other_messages_are_refused(sent: Any):
    with pytest.raises(ValueError, match=r"a message|validation error"):
        agent_messages.read(json.dumps(sent))


class Channel:
    """The channel of an agent that sends some lines, and ends."""

    def __init__(self, *lines: str) -> None:
        self._lines = list(lines)

    def send(self, line: str) -> None:
        pass

    def receive(self, timeout: float) -> str | None:
        return self._lines.pop(0) if self._lines else None

    def status(self) -> int | None:
        return 0

    def errors(self) -> str:
        return ""

    def close(self) -> None:
        pass


@pytest.mark.parametrize("line", ["no json", "[" * 100_000, '{"event": "clock", "wall": null}'])
def test_an_agent_that_sends_something_else_is_given_up(line: str, monkeypatch: pytest.MonkeyPatch):
    events: queue.SimpleQueue[tuple[str, dict[str, Any]]] = queue.SimpleQueue()
    monkeypatch.setattr(LocalLink, "channel", lambda self, argv: Channel('{"event": "beat"}', line))
    agent = AgentLink("ada", LocalLink.__new__(LocalLink), 1.0, events)
    agent.start(("agent",))
    assert events.get(timeout=PATIENCE_S) == ("ada", {"event": "lost", "reason": "its agent sends what is not in the protocol"})
    agent.close()

"""Commands on hosts end with an error of one line, whatever the host sends."""

from __future__ import annotations

import pytest

from sierra.runners.links import commands
from sierra.runners.links.base import Unreachable
from sierra.runners.links.commands import Exchange, Lines


class Sends:
    """The stream of a host that sends certain bytes again and again."""

    def __init__(self, *pieces: bytes) -> None:
        self._pieces = list(pieces)

    def read(self, timeout: float) -> tuple[int, bytes] | None:
        return 1, self._pieces.pop(0) if len(self._pieces) > 1 else self._pieces[0]

    def send(self, data: bytes, timeout: float) -> None:
        pass

    def end_input(self) -> None:
        pass

    def close(self, *, ended: bool = False) -> None:
        pass

    def problem(self) -> str:
        return ""


def test_a_host_that_sends_endless_lines_or_false_ends_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(commands, "LONGEST_LINE", 1000)
    for pieces, said in (
        ((b"m:", b"x" * 100), "rb1: sends a line of more than 0 MiB"),
        ((b"m:", b"m.zero\n"), "rb1: the end of a command comes without its exit status"),
    ):
        lines = Lines(Exchange("rb1", Sends(*pieces), "m", lambda one: None), 1.0)
        with pytest.raises(Unreachable) as raised:
            lines.receive(5.0)
        assert str(raised.value) == said

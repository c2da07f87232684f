"""A note on successful runs that wrote no file: they are no failures, because a program may only be timed."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from sierra.util.text import one_line

LINES = 3
"""The number of lines at the end of standard error that are shown."""
SHOWN = 300


class SilentRuns:
    """The number of runs that wrote no file, with the last lines that one of them printed on standard error."""

    def __init__(self) -> None:
        self._runs = 0
        self._said = ""

    def add(self, stderr: Callable[[], bytes]) -> None:
        """Count one run; `stderr` reads the end of its standard error."""
        self._runs += 1
        if not self._said:
            lines = [line.strip() for line in stderr().decode("utf-8", "replace").splitlines()]
            self._said = " / ".join([one_line(line) for line in lines if line][-LINES:])[-SHOWN:]

    def notes(self) -> Iterator[str]:
        if self._runs:
            one = self._runs == 1
            who, whose = ("1 run", "its program") if one else (f"{self._runs} runs", "their programs")
            said = f"said on stderr: {self._said}" if self._said else "said nothing on stderr"
            yield f"{who} wrote no file; {whose} {said}"

"""The supervisor at a terminal: prompts before and after each trial, and any key stops it.

Prompts are lines that end with Enter, so that they work in every terminal. Keys that were pressed before a prompt appeared do
not answer it, except those that a person types ahead while the files of a trial are collected. Only while a trial runs or is
about to begin, single keys are read; then Ctrl-C works as always.
"""

from __future__ import annotations

import contextlib
import getpass
import math
import os
import select
import sys
import termios
import time
import tty
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, TextIO, cast

from sierra.cli.output import Safe, raw, safe
from sierra.extensions.trials.supervisor import Agreeing, Attendant, Start, Supervisor, Verdict
from sierra.extensions.trials.table import Trials
from sierra.model import Status

if TYPE_CHECKING:
    from sierra.extensions.trials.supervisor import Ended, Trial
    from sierra.runners.base import Beat

DRAWN_S, PRINTED_S = 0.2, 10.0
"""Seconds between two states of the line that shows a trial, and between two such lines in a terminal that cannot redraw."""
DECISIONS = {
    **dict.fromkeys(("", "g", "go"), Start.GO),
    **dict.fromkeys(("s", "skip"), Start.SKIP),
    **dict.fromkeys(("a", "abort"), Start.ABORT),
}
PLACE, GO = "place the robots; ", "Enter: go, s: skip, a: abort > "
AGAIN = "Enter: try again, s: skip, a: abort > "


def supervisor(trials: Trials, *, operator: str | None, agreed: bool) -> Supervisor | None:
    """Return the supervisor of trials; None if there is neither a terminal nor an agreement to all of them."""
    if agreed:
        return Agreeing(operator)
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        return None
    return Person(trials, operator)


class Person:
    """A person at a terminal who supervises trials."""

    def __init__(self, trials: Trials, operator: str | None) -> None:
        self._trials = trials
        self._operator = operator
        self._terminal = _Terminal()

    def begin(self, trials: int) -> str | None:
        if self._operator is None:
            login = _login()
            self._operator = self._terminal.ask(f"operator ({f'Enter: {login}' if login else 'Enter: none'}) > ") or login
        return self._operator

    @contextlib.contextmanager
    def attending(self, trial: Trial) -> Iterator[Attendant]:
        self._terminal.show("", *_heading(trial))
        with self._terminal.restored(), self._terminal.with_notes():
            person = PersonAttending(self._terminal, trial, self._trials.countdown)
            try:
                yield person
            finally:
                person.leave()

    def unready(self, reason: str) -> Start | None:
        self._terminal.show(f"not ready: {reason}")
        while True:
            if decision := DECISIONS.get(self._terminal.ask(AGAIN).lower()):
                return decision

    def verdict(self, trial: Trial, ended: Ended) -> Verdict:
        self._terminal.show(_ending(ended))
        if not self._is_valid(good=ended.status.is_result):
            return Verdict(valid=False, reason=self._reason(), note=self._note())
        return Verdict(valid=True, note=self._note())

    def _is_valid(self, *, good: bool) -> bool:
        """Return the answer. A line that was typed ahead and is no answer may be chance; those after it are forgotten then."""
        prompt = "valid? Enter or v: yes, i: no > " if good else "v: it stays as it is, Enter or i: not valid, repeat it > "
        ahead = True
        while True:
            match self._terminal.ask(prompt, ahead=ahead).lower():
                case "v" | "valid" | "y" | "yes":
                    return True
                case "i" | "invalid" | "n" | "no":
                    return False
                case "":
                    return good
                case _:
                    ahead = False

    def _reason(self) -> str:
        listed = [f"{number}: {reason}" for number, reason in enumerate(self._trials.reasons, 1)]
        while True:
            given = self._terminal.ask(f"reason ({', '.join(listed)}, or text) > ", ahead=True)
            if given.isdecimal() and 1 <= int(given) <= len(listed):
                return self._trials.reasons[int(given) - 1]
            if given and not given.isdecimal():
                return given

    def _note(self) -> str | None:
        return self._terminal.ask("note (Enter: none) > ", ahead=True) or None


class PersonAttending:
    """A person at a terminal who decides on one trial: a prompt, a countdown that any key ends, and any key stops the trial."""

    def __init__(self, terminal: _Terminal, trial: Trial, countdown: float) -> None:
        self._terminal = terminal
        self._prompt = (PLACE if trial.poses else "") + GO
        self._countdown = countdown
        self._allowed = time.monotonic() + trial.wait_s
        self._goes = False
        """True between the word go and the start."""
        self._start: float | None = None
        """The end of the countdown by the monotonic clock; None if there is none yet."""
        self._line_is_open = True
        """False after the Enter that answers the prompt for good."""
        terminal.prompt(self._prompt)

    def decide(self, *, ready: bool) -> Start | None:
        return self._counted_down(ready=ready) if self._goes else self._answered()

    def _answered(self) -> Start | None:
        line = self._terminal.typed()
        if line is None:
            return None
        if (decision := DECISIONS.get(line.lower())) in (Start.SKIP, Start.ABORT):
            self._line_is_open = False
            return decision
        if decision is Start.GO:
            self._goes, self._start = True, None
            self._terminal.begin_keys()
        else:
            self._terminal.prompt(self._prompt)
        return None

    def _counted_down(self, *, ready: bool) -> Start | None:
        """Count down as soon as the robots are ready; a key leads back to the prompt."""
        now = time.monotonic()
        if self._start is None and ready:
            self._start = max(now + self._countdown, self._allowed)
        if self._start is not None and now >= self._start:
            self._terminal.end_line("go")
            return Start.GO
        state = "the trial is being prepared" if self._start is None else f"starts in {math.ceil(self._start - now)} s"
        self._terminal.redraw(f"{state}; any key: back")
        if self._terminal.pressed():
            self._terminal.end_line("not started")
            self._goes = False
            self._terminal.prompt(self._prompt)
        return None

    def watch(self, seconds: float, beats: Sequence[Beat]) -> bool:
        self._terminal.redraw(_live(f"{seconds:.0f} s; any key: stop", beats))
        if not self._terminal.pressed():
            return False
        self._terminal.end_line("stopping")
        return True

    def ending(self, beats: Sequence[Beat], collecting_s: float | None) -> None:
        if collecting_s is not None:
            self._terminal.keep_keys()
        self._terminal.redraw(_live("stopping" if collecting_s is None else f"collecting files, {collecting_s:.0f} s", beats))

    def leave(self) -> None:
        """End the line of the prompt, or that of the running trial."""
        if self._line_is_open:
            with contextlib.suppress(KeyboardInterrupt):  # of a terminal that is gone
                self._terminal.end_line() if self._goes else self._terminal.show("")


def _heading(trial: Trial) -> Iterator[str]:
    """Yield the lines that present a trial."""
    values = ", ".join(f"{name}={value}" for name, value in trial.values.items())
    again = f", try {trial.attempt + 1}" if trial.attempt else ""
    block = f" (block {trial.block + 1} of {trial.blocks})" if trial.blocks > 1 else ""
    yield f"trial {trial.position} of {trial.total}{block}: {values}{', ' if values else ''}run {trial.number}{again}"
    for robot, pose in enumerate(trial.poses, 1):
        heading = "" if pose.heading is None else f", heading {pose.heading:g} degrees"
        yield f"  {_numbered(robot, trial.robots)}: x {pose.x:g} m, y {pose.y:g} m{heading}"
    if others := [robot for robot in sorted(trial.robots) if not 0 < robot <= len(trial.poses)]:
        named = ", ".join(_numbered(robot, trial.robots) for robot in others)
        yield f"{'without a pose' if trial.poses else 'robots'}: {named}"
    for name, text in trial.facts.items():
        yield f"{name}: {text}"


def _numbered(place: int, robots: Mapping[int, str]) -> str:
    """Return the place of a robot in its run with its name, if that is known."""
    return f"{place} ({robots[place]})" if place in robots else str(place)


def _live(state: str, beats: Sequence[Beat]) -> str:
    """Return the line that shows a trial from its start to its record."""
    robots = (
        f"{one.name} {one.age_s:.1f} s{'' if one.battery is None else f' {one.battery:.0f} %'}"
        for one in sorted(beats, key=lambda one: one.name)
    )
    return "  ".join([state, *robots])


def _ending(ended: Ended) -> str:
    how = "stopped" if ended.stopped else "ended"
    state = "" if ended.status is Status.OK else f"; {ended.status}: {ended.reason}"
    return f"{how} after {ended.seconds:.1f} s{state}"


def _login() -> str | None:
    try:
        return getpass.getuser()
    except (OSError, KeyError, ImportError):
        return None


class _Terminal:
    """Standard input and standard error, if both are a terminal."""

    def __init__(self) -> None:
        self._keyboard = sys.stdin.fileno()
        self._screen = raw(sys.stderr)
        self._redraws = os.environ.get("TERM", "dumb") != "dumb"
        self._drawn, self._width, self._is_open = 0.0, 0, False
        self._typed = b""
        self._kept: bytes | None = None
        """Keys that were pressed while the files of a trial were collected; None if none are kept."""
        self._ahead: list[str] = []
        """Lines that these keys have typed, for the prompts that follow. The last one may lack its end."""
        with _if_lost():
            self._lines = termios.tcgetattr(self._keyboard)

    def show(self, *lines: str) -> None:
        for line in lines:
            self._write(f"{line}\n")

    def ask(self, prompt: str, *, ahead: bool = False) -> str:
        """Return the line that the person types, without blanks around it. Raises KeyboardInterrupt if the terminal is gone.

        `ahead`: see `prompt`.
        """
        self.prompt(prompt, ahead=ahead)
        while (line := self.typed(None)) is None:
            pass
        return line

    def prompt(self, prompt: str, *, ahead: bool = False) -> None:
        """Show a prompt for a line. Keys that were pressed before are forgotten; with `ahead`, kept ones answer it."""
        if not ahead:
            self._ahead = []
        elif self._kept is not None:
            self._ahead = _lines(self._kept + self._keys())
        self._kept = None
        with _if_lost():
            termios.tcsetattr(self._keyboard, termios.TCSANOW, self._lines)
            termios.tcflush(self._keyboard, termios.TCIFLUSH)
        line = self._ahead.pop(0) if self._ahead else ""
        self._typed = line.encode()
        self._write(prompt + line)

    def typed(self, seconds: float | None = 0.0) -> str | None:
        """Return the line that was typed at the prompt, without blanks around it; None if there is none.

        `seconds` is how long it is waited for; None: until something is there.
        """
        if not self._typed.endswith(b"\n"):
            with _if_lost():
                if not select.select([self._keyboard], [], [], seconds)[0]:
                    return None
                more = os.read(self._keyboard, 1024)
            if not more:
                raise KeyboardInterrupt
            self._typed += more
        return self._typed.decode("utf-8", "replace").strip() if self._typed.endswith(b"\n") else None

    def begin_keys(self) -> None:
        """Read single keys from now on. Keys that were pressed before are forgotten."""
        with _if_lost():
            termios.tcflush(self._keyboard, termios.TCIFLUSH)
        self.pressed()

    def keep_keys(self) -> None:
        """Keep the keys that are pressed from now on for the prompts that follow. Keys that were pressed before are forgotten.

        The line that is redrawn says so at once.
        """
        if self._kept is None:
            with _if_lost():
                termios.tcflush(self._keyboard, termios.TCIFLUSH)
            self._kept, self._drawn = b"", 0.0
        self._kept += self._keys()

    def pressed(self) -> bool:
        """Return whether a key was pressed."""
        return bool(self._keys())

    def _keys(self) -> bytes:
        """Return the keys that were pressed.

        If the process was stopped and goes on, the shell may have changed the terminal; so each call sets it again.
        """
        with _if_lost():
            if termios.tcgetattr(self._keyboard)[3] & (termios.ICANON | termios.ECHO):
                tty.setcbreak(self._keyboard, termios.TCSANOW)
            return os.read(self._keyboard, 1024) if select.select([self._keyboard], [], [], 0)[0] else b""

    @contextlib.contextmanager
    def restored(self) -> Iterator[None]:
        """Let lines be typed as before when the block ends, whatever happens."""
        try:
            yield
        finally:
            with contextlib.suppress(termios.error, OSError):
                termios.tcsetattr(self._keyboard, termios.TCSADRAIN, self._lines)

    @contextlib.contextmanager
    def with_notes(self) -> Iterator[None]:
        """Show what others write to standard error beneath the line that is redrawn, not within it."""
        before = sys.stderr
        sys.stderr = cast("TextIO", _Beneath(self._screen, self))
        try:
            yield
        finally:
            sys.stderr = before

    def end_open_line(self) -> None:
        """End the line that is redrawn, if there is one."""
        if self._is_open:
            self.end_line()

    def redraw(self, line: str) -> None:
        """Show a line in the place of the last one, now and then."""
        now = time.monotonic()
        if now - self._drawn < (DRAWN_S if self._redraws else PRINTED_S):
            return
        self._drawn = now
        self._write(f"\r{safe(line).ljust(self._width)}" if self._redraws else f"{line}\n", steering=True)
        self._width, self._is_open = len(line), self._redraws

    def end_line(self, text: str = "") -> None:
        """End the line that is redrawn; a text takes its place."""
        if self._redraws:
            self._write(f"\r{text.ljust(self._width)}\n" if text else "\n", steering=True)
        elif text:
            self._write(f"{text}\n")
        self._drawn, self._width, self._is_open = 0.0, 0, False

    def _write(self, text: str, *, steering: bool = False) -> None:
        with _if_lost():
            self._screen.write(text if steering else safe(text))
            self._screen.flush()


class _Beneath(Safe):
    """A stream to a terminal, whose line that is redrawn ends before anything else is written."""

    def __init__(self, stream: TextIO, terminal: _Terminal) -> None:
        super().__init__(stream)
        self._terminal = terminal

    def write(self, text: str) -> int:
        self._terminal.end_open_line()
        return super().write(text)


def _lines(keys: bytes) -> list[str]:
    """Return the lines that keys type; the last one may lack its end.

    Enter before any text is left out: it may have been meant to stop the trial, and an answer by default needs a question.
    """
    text = ""
    for key in keys.decode("utf-8", "replace"):
        if key in "\b\x7f":
            text = text if text.endswith("\n") else text[:-1]
        elif key == "\x15":  # Ctrl-U
            text = text[: text.rfind("\n") + 1]
        elif key in "\r\n":
            text += "\n"
        elif key.isprintable():
            text += key
    return text.lstrip().splitlines(keepends=True)


@contextlib.contextmanager
def _if_lost() -> Iterator[None]:
    """Turn the error of a terminal that is gone into the interruption that it means."""
    try:
        yield
    except (OSError, termios.error, ValueError) as error:
        raise KeyboardInterrupt from error

"""Progress of a session: a bar on a terminal, occasional lines elsewhere."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import typer

from sierra.cli import ask_detach
from sierra.cli.output import note, raw, safe
from sierra.errors import UsageError
from sierra.execution.observer import Observer, Progress
from sierra.execution.progress_display import text
from sierra.util import terminal
from sierra.util.text import counted

if TYPE_CHECKING:
    from rich.progress import TaskID

FIRST_S, LAST_S = 10.0, 300.0
"""Seconds between two lines. The interval grows, so that the log of days stays short."""
DRAW_S = 0.1
"""Seconds between two pictures of a bar."""
MANY = 200_000
"""The number of runs above which the user must confirm."""
SHARE = 0.2
"""The time until the next line, as a share of the time since the beginning."""


class Display(Observer):
    """An observer that prints notices and asks the user questions; this base class shows no progress."""

    def notice(self, text: str) -> None:
        note(text)

    def leave(self) -> bool:
        """Return whether cluster jobs continue when the user interrupts: see `sierra.cli.ask_detach`."""
        return ask_detach.wants_detach()


@contextlib.contextmanager
def watching(*, quiet: bool) -> Iterator[Display]:
    """Yield a receiver of progress, which shows it on standard error unless `quiet`."""
    if quiet:
        yield Display()
    elif sys.stderr.isatty():
        with _Bar() as bar:
            yield bar
    else:
        yield _Lines()


@contextlib.contextmanager
def telling(*, quiet: bool) -> Iterator[Callable[[str], None]]:
    """Yield a receiver of the part that is being made, unless `quiet`: a terminal shows it meanwhile, a log now and then."""
    if quiet or not sys.stderr.isatty():
        yield (lambda text: None) if quiet else _lines()
        return
    from rich.console import Console
    from rich.text import Text

    with Console(file=raw(sys.stderr)).status("") as status:
        yield lambda text: status.update(Text(safe(text)))


@contextlib.contextmanager
def counting(*, quiet: bool) -> Iterator[Callable[[int, int, str], None]]:
    """Yield a function that shows how many of all things are done, and the text, unless `quiet`.

    It shows a bar on a terminal, and lines elsewhere.
    """
    if quiet:
        yield lambda done, every, things: None
    elif sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
        from rich.progress import Progress as Bars

        shown = (BarColumn(bar_width=24), MofNCompleteColumn(), TextColumn("{task.description}"), TimeRemainingColumn())
        with Bars(*shown, console=Console(file=raw(sys.stderr)), transient=True) as bars:
            tasks: dict[str, TaskID] = {}

            def show(done: int, every: int, things: str) -> None:
                if things not in tasks:
                    tasks[things] = bars.add_task(things, total=None)
                bars.update(tasks[things], completed=done, total=every)

            yield show
    else:
        tell = _lines()
        yield lambda done, every, things: tell(f"{done} of {every} {things}")


def _lines() -> Callable[[str], None]:
    """Return a function that prints a text if the last one is `FIRST_S` ago."""
    said = time.monotonic()

    def tell(text: str) -> None:
        nonlocal said
        if time.monotonic() - said >= FIRST_S:
            said = time.monotonic()
            print(safe(text), file=sys.stderr, flush=True)

    return tell


class Planning(Observer):
    """Prints the progress of planning to standard error, unless `quiet`.

    It asks the user to confirm a large number of runs, unless `agreed`. It raises UsageError without a terminal to ask on,
    typer.Exit if the user declines.
    """

    def __init__(self, *, agreed: bool, quiet: bool) -> None:
        self._printed = time.monotonic()
        self._sure = agreed
        self._quiet = quiet

    def planning(self, done: int, experiments: int, runs: int) -> None:
        if runs > MANY and not self._sure:
            _ask(experiments, runs)
            self._sure = True
        now = time.monotonic()
        if not self._quiet and now - self._printed >= FIRST_S:
            self._printed = now
            print(f"planning: {done} of {counted(experiments, 'experiment')}", file=sys.stderr, flush=True)


def _ask(experiments: int, runs: int) -> None:
    """Ask the user to confirm a large number of runs."""
    message = f"{counted(experiments, 'experiment')} are {counted(runs, 'run')}"
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        raise UsageError(f"{message}, which take long to plan; use --yes to confirm")
    print(f"{message}, which take long to plan; continue? [y/N] ", end="", file=sys.stderr, flush=True)
    if not sys.stdin.readline().strip().lower().startswith("y"):
        raise typer.Exit(2)


class _Lines(Display):
    """Progress as plain lines, for logs."""

    def __init__(self) -> None:
        self._began = self._said = time.monotonic()
        self._last = ""

    def progress(self, progress: Progress) -> None:
        now = time.monotonic()
        if now - self._said >= min(max(FIRST_S, SHARE * (now - self._began)), LAST_S):
            line = safe(text(progress, now - self._began))
            if line != self._last:
                print(line, file=sys.stderr, flush=True)
            self._said, self._last = now, line


class _Bar(Display):
    """Progress as a bar that is drawn again and again in one line, but not while a program asks the user something."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, TextColumn
        from rich.progress import Progress as Bars

        self._began = time.monotonic()
        self._bars = Bars(
            BarColumn(bar_width=24),
            TextColumn("{task.description}"),
            console=Console(file=raw(sys.stderr)),
            transient=True,
            auto_refresh=False,
        )
        self._drawn = 0.0
        self._task = self._bars.add_task("", total=None)

    def __enter__(self) -> _Bar:
        self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bars.stop()

    def leave(self) -> bool:
        self._bars.stop()
        try:
            return ask_detach.wants_detach()
        finally:
            self._bars.start()

    def progress(self, progress: Progress) -> None:
        self._bars.update(
            self._task,
            total=progress.total,
            completed=progress.reused + progress.done,
            description=safe(text(progress, time.monotonic() - self._began)),
        )
        if time.monotonic() - self._drawn >= DRAW_S and terminal.is_free():
            self._bars.refresh()
            self._drawn = time.monotonic()

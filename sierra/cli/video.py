"""`sierra video`: make the videos of a batch."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Annotated

import typer

from sierra.cli import complete
from sierra.cli.arguments import AsJsonList, Jobs
from sierra.cli.figures import PREFIX, from_here
from sierra.cli.output import note, print_json, raw

if TYPE_CHECKING:
    from sierra.api import Project

EACH_S = 10.0
"""Seconds between two lines of progress, where no terminal shows a bar."""


def video(
    words: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[HASH] [NAME]...",
            autocompletion=complete.batches_and_figures,
            help="Batch id or prefix, or the name of a query (default: the last batch); then names of videos (default: all).",
        ),
    ] = None,
    jobs: Jobs = None,
    quiet: Annotated[bool, typer.Option("-q", "--quiet", help="Show no progress.")] = False,
    as_json: AsJsonList = False,
) -> None:
    """Make the videos that sierra.toml declares for a batch.

    They are made from recorded results; nothing is executed. Each file appears whole or not at all, in the folder of the
    batch's figures. `sierra figures --check` tells whether they still follow from the store.

    \b
    Examples:
      sierra video
      sierra video 3f9a1c heat
    """
    from sierra.cli.open_project import project

    opened = project()
    prefix, names = _split(opened, words or [])
    with _progress(quiet=quiet) as progress:
        paths, notes = opened.videos(prefix, *names, jobs=jobs, progress=progress)
    for text in notes:
        note(text)
    if as_json:
        print_json([str(path) for path in paths])
    else:
        for path in paths:
            print(from_here(path))


def _split(opened: Project, words: list[str]) -> tuple[str | None, list[str]]:
    """Return the batch, if the first word is one, and the names of videos."""
    if words and words[0] not in opened.config.videos and (words[0] in opened.config.queries or PREFIX.fullmatch(words[0])):
        return words[0], words[1:]
    return None, words


@contextlib.contextmanager
def _progress(*, quiet: bool) -> Iterator[Callable[[int, int], None]]:
    """Yield a function that shows the number of frames on standard error: as a bar, or as lines where there is no terminal."""
    if quiet:
        yield lambda done, frames: None
    elif sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        shown = (BarColumn(bar_width=24), MofNCompleteColumn(), TextColumn("frames"), TimeRemainingColumn())
        with Progress(*shown, console=Console(file=raw(sys.stderr)), transient=True) as bars:
            task = bars.add_task("", total=None)
            yield lambda done, frames: bars.update(task, completed=done, total=frames)
    else:
        yield _lines()


def _lines() -> Callable[[int, int], None]:
    said = time.monotonic()

    def tell(done: int, frames: int) -> None:
        nonlocal said
        if time.monotonic() - said >= EACH_S:
            said = time.monotonic()
            print(f"{done} of {frames} frames", file=sys.stderr, flush=True)

    return tell

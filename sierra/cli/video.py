"""`sierra video`: make the videos of a batch."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from sierra.cli import complete
from sierra.cli.arguments import AsJsonList, Jobs
from sierra.cli.figures import PREFIX, print_files

if TYPE_CHECKING:
    from sierra.api import Project


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
    from sierra.cli.progress import counting

    opened = project()
    prefix, names = _split(opened, words or [])
    with counting("frames", quiet=quiet) as progress:
        paths, notes = opened.videos(prefix, *names, jobs=jobs, progress=progress)
    print_files(paths, notes, as_json=as_json)


def _split(opened: Project, words: list[str]) -> tuple[str | None, list[str]]:
    """Return the batch, if the first word is one, and the names of videos."""
    if words and words[0] not in opened.config.videos and (words[0] in opened.config.queries or PREFIX.fullmatch(words[0])):
        return words[0], words[1:]
    return None, words

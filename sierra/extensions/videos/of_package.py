"""`sierra open FILE.zip video`: list or write the videos of a package."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sierra.cli.arguments import AsJsonList
from sierra.cli.open_results import show


def video(
    context: typer.Context,
    names: Annotated[list[str] | None, typer.Argument(metavar="NAME", help="Videos (default: all).")] = None,
    to: Annotated[Path | None, typer.Option("--to", metavar="FOLDER", help="Write their files to this folder.")] = None,
    as_json: AsJsonList = False,
) -> None:
    """List the videos of a package, as they were made.

    Nothing is made. With --to, their files are written.

    \b
    Examples:
      sierra open results.zip video
      sierra open results.zip video heat --to videos
    """
    show(context, names, to, kind="video", as_json=as_json)

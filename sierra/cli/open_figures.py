"""`sierra open FILE.zip figures`: list or write the figures of a package, and other deliverables."""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from typing import Annotated

import typer

from sierra.cli.arguments import AsJsonList
from sierra.cli.output import note, print_json, readable, table


def figures(
    context: typer.Context,
    names: Annotated[list[str] | None, typer.Argument(metavar="NAME", help="Figures and tables (default: all).")] = None,
    to: Annotated[Path | None, typer.Option("--to", metavar="FOLDER", help="Write their files to this folder.")] = None,
    as_json: AsJsonList = False,
) -> None:
    """List the figures, tables and videos of a package, as they were made.

    Nothing is drawn. With --to, their files are written. Files that no record of the package knows are listed as not recorded.

    \b
    Examples:
      sierra open results.zip figures
      sierra open results.zip figures coverage --to figures
    """
    show(context, names, to, as_json=as_json)


def show(context: typer.Context, names: list[str] | None, to: Path | None, *, kind: str = "", as_json: bool) -> None:
    """List the deliverables of the package in the context: of one kind, by default all; with `to`, write their files there."""
    from sierra.packages.reading import drawn

    found = drawn.find(context.obj, names or (), kind)
    paths = drawn.write(context.obj, found, to) if to is not None else []
    if as_json:
        print_json(found)
    elif to is not None:
        print("".join(f"{readable(str(path))}\n" for path in paths), end="")
    elif found:
        rows = [(readable(one.name), one.kind, one.batch[:10], _formats(one.files)) for one in found]
        table(("name", "kind", "batch", "formats"), rows)
    else:
        note(f"the package has no {kind or 'figure'}s")


def _formats(files: tuple[str, ...]) -> str:
    return readable(", ".join(PurePosixPath(file).suffix[1:] for file in files))

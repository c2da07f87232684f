"""`sierra package --cite`: the file by which archives and people cite a project."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated

import typer

from sierra.cli.output import print_json

if TYPE_CHECKING:
    from sierra.packages.parts.metadata import Metadata


def _lines(found: Metadata) -> Iterator[str]:
    yield from (f"{name}: written" for name in found.written)
    yield from (f"{name}: agrees with [package]" for name in found.equal)
    yield from (f"{name}: does not exist; sierra package --cite writes it" for name in found.absent)
    yield from found.differences


def cite(
    write: Annotated[
        bool, typer.Option("--write", help="Write the file if the project does not have it; never replace it.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text.")] = False,
) -> None:
    """Make or check CITATION.cff, by which others cite the project.

    It is compared with [package] in sierra.toml. Zenodo, GitHub and reference managers read it.

    Exits with 1 if the file says something else than [package].

    \b
    Examples:
      sierra package --cite
    """
    from sierra.cli.open_project import project

    metadata = project().packages.metadata(write=write)
    if as_json:
        print_json(metadata)
    else:
        print("\n".join(_lines(metadata)))
    raise typer.Exit(1 if metadata.differences else 0)

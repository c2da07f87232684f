"""`sierra package`: write a reproduction package."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from sierra.cli import complete
from sierra.cli.arguments import AsJson, Yes
from sierra.cli.output import print_json
from sierra.errors import UsageError
from sierra.util.text import size

if TYPE_CHECKING:
    from sierra.packages.pack import Preview


def package(
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE.zip", help="The file to write.")],
    batches: Annotated[
        list[str] | None,
        typer.Argument(metavar="BATCH", autocompletion=complete.ids, help="Ids of batches; prefixes are enough."),
    ] = None,
    claims: Annotated[bool, typer.Option("--claims", help="Also pack the batches that the claims rest on.")] = False,
    image: Annotated[
        Literal["oci", "sif", "both", "none"],
        typer.Option(
            "--image",
            help="Pack the container images of the runs: oci (for podman and docker), sif (for apptainer), both or none "
            "(ids and recipes only).",
        ),
    ] = "none",
    wheels: Annotated[
        bool, typer.Option("--wheels", help="Pack SIERRA and the project's Python packages, to install them without a network.")
    ] = False,
    pythons: Annotated[
        str,
        typer.Option("--python", metavar="VERSION[,VERSION...]", help="Versions of Python for --wheels (default: this one)."),
    ] = "",
    machines: Annotated[
        str,
        typer.Option("--arch", metavar="NAME[,NAME...]", help="Processors for --wheels, as x86_64 (default: this one)."),
    ] = "",
    yes: Yes = False,
    as_json: AsJson = False,
) -> None:
    """Write batches with their code and results to one file.

    The file contains the records and outputs of the batches, their source, sierra.toml with the files that it names, and
    metadata made from [package] in sierra.toml. Things that are left out are listed first, and must be confirmed.

    \b
    Examples:
      sierra package 3f2a -o results.zip
      sierra package --claims -o results.zip
      sierra package 3f2a -o results.zip --image both
      sierra package 3f2a -o results.zip --wheels --python 3.12,3.13
    """
    from sierra.cli.confirm import agreed
    from sierra.cli.open_project import project

    def agree(preview: Preview) -> bool:
        print("" if as_json else "".join(f"{fact}\n" for fact in preview.facts), end="")
        lines = [f"{output}: {preview.members:,} files, {size(preview.bytes)}", *preview.notes]
        return not preview.notes or agreed(lines, yes, as_json, "to be packed")

    if (pythons or machines) and not wheels:
        raise UsageError("--python and --arch choose wheels; add --wheels")
    chosen = {"pythons": _listed(pythons), "machines": _listed(machines)}
    packed = project().package(*(batches or ()), path=output, claims=claims, agree=agree, image=image, wheels=wheels, **chosen)
    if packed is None:
        print("nothing was written")
        raise typer.Exit(1)
    if as_json:
        print_json(packed)
    else:
        print(f"{packed.path}: package {packed.id[:10]}, {packed.preview.members:,} files")


def _listed(text: str) -> list[str]:
    """Return the words of a list with commas."""
    return [one.strip() for one in text.split(",") if one.strip()]

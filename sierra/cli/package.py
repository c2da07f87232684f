"""`sierra package`: write a reproduction package."""

from __future__ import annotations

import sys
from collections.abc import Iterator
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

SHOWN = 200
"""The number of places with names that are listed."""


def package(
    batches: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="BATCH",
            autocompletion=complete.ids,
            help="Ids of batches, or names of queries; prefixes are enough (default: the last batch, unless with --claims).",
        ),
    ] = None,
    output: Annotated[Path | None, typer.Option("--output", "-o", metavar="FILE.zip", help="The file to write.")] = None,
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
        bool,
        typer.Option("--wheels", help="Pack all Python packages that SIERRA and the project need, for use without a network."),
    ] = False,
    pythons: Annotated[
        str,
        typer.Option("--python", metavar="VERSION[,VERSION...]", help="Versions of Python for --wheels (default: this one)."),
    ] = "",
    machines: Annotated[
        str,
        typer.Option("--arch", metavar="NAME[,NAME...]", help="Processors for --wheels, as x86_64 (default: this one)."),
    ] = "",
    no_report: Annotated[bool, typer.Option("--no-report", help="Leave out the report, which takes some seconds.")] = False,
    anonymous: Annotated[
        bool, typer.Option("--anonymous", help="For double-blind review: no names, hosts, folders, commits and dates.")
    ] = False,
    allow: Annotated[
        list[str] | None,
        typer.Option("--allow", metavar="TEXT", help="With --anonymous: a text that may contain a name. Repeatable."),
    ] = None,
    yes: Yes = False,
    as_json: AsJson = False,
    cite: Annotated[
        bool,
        typer.Option(
            "--cite", help="Only make CITATION.cff from [package], by which others cite the project, or compare it with that."
        ),
    ] = False,
) -> None:
    """Write batches with their code and results to one file.

    The file contains the records and outputs of the batches, their source, sierra.toml with the files that it names, the
    figures and other files that were made, a report, and metadata made from [package] in sierra.toml. Things that are left
    out are listed first, and must be confirmed.

    With --cite, a CITATION.cff is written if the project has none; one that is there is never replaced. The exit code is 1 if
    it says something else than [package].

    With --anonymous, records are rewritten, and all files are searched for names. If one is found, nothing is written, and
    the exit code is 2.

    \b
    Examples:
      sierra package -o results.zip
      sierra package 9e1c -o results.zip
      sierra package --claims -o results.zip
      sierra package 9e1c -o results.zip --image both
      sierra package 9e1c -o results.zip --wheels --python 3.12,3.13
      sierra package 9e1c -o review.zip --anonymous
      sierra package --cite
    """
    from sierra.cli.confirm import agreed
    from sierra.cli.open_project import given_or_last, project
    from sierra.config.extensions import given
    from sierra.errors import Identifying

    def agree(preview: Preview) -> bool:
        print("" if as_json else "".join(f"{fact}\n" for fact in preview.facts), end="")
        lines = [f"{output}: {preview.members:,} files, {size(preview.bytes)}", *preview.notes]
        return not preview.notes or agreed(lines, yes, as_json, "to be packed")

    if cite:
        others = (
            output,
            batches,
            claims,
            image != "none",
            wheels,
            pythons,
            machines,
            no_report,
            anonymous,
            allow,
            yes,
            given(str),
        )
        if any(others):
            raise UsageError("--cite packs nothing; leave out batches and other options")
        from sierra.cli.cite import cite as make

        make(True, as_json)
        return
    if output is None:
        raise UsageError("name the file to write, as in: sierra package 9e1c -o results.zip")
    if (pythons or machines) and not wheels:
        raise UsageError("--python and --arch choose wheels; add --wheels")
    chosen = {"pythons": _listed(pythons), "machines": _listed(machines)}
    opened = project()
    packed_batches = batches or ([] if claims else [given_or_last(None, opened)])
    try:
        packed = opened.packages.pack(
            *packed_batches,
            path=output,
            claims=claims,
            agree=agree,
            anonymous=anonymous,
            allow=allow or (),
            image=image,
            wheels=wheels,
            report=not no_report,
            without=given(str),
            **chosen,
        )
    except Identifying as error:
        more = [f"and {len(error.places) - SHOWN:,} places more"] if len(error.places) > SHOWN else []
        print("".join(f"{location}\n" for location in (*error.places[:SHOWN], *more)), end="", file=sys.stderr)
        raise
    if packed is None:
        print("nothing was written")
        raise typer.Exit(1)
    if as_json:
        print_json(packed)
    else:
        print("".join(f"{line}\n" for line in _about_names(packed.preview)), end="")
        print(f"{packed.path}: package {packed.id[:10]}, {packed.preview.members:,} files")


def _listed(text: str) -> list[str]:
    """Return the words of a list with commas."""
    return [one.strip() for one in text.split(",") if one.strip()]


def _about_names(preview: Preview) -> Iterator[str]:
    """Yield the words that an anonymous package was searched for; they are not in the package."""
    if preview.searched:
        yield f"no file has one of these words: {', '.join(preview.searched)}"
    if preview.general:
        yield f"not searched, because they show nothing: {', '.join(preview.general)}"

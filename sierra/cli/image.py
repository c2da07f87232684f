"""`sierra image`: images in which runs execute: build, pin, inspect, import and export them."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sierra.cli import lazy_parameters
from sierra.cli.output import cell, fields, note, print_json, readable, table
from sierra.util.processors import ARCH
from sierra.util.text import size

if TYPE_CHECKING:
    from sierra.containers.images.image_contents import Contents

app = typer.Typer(
    cls=lazy_parameters.Group,
    name="image",
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Build, pin, inspect, import and export images for runs.",
    context_settings={"help_option_names": ["-h", "--help"]},
)

Name = Annotated[
    str | None,
    typer.Argument(metavar="NAME", help="A tag, a file, or a recipe's folder (default: [container] image in sierra.toml)."),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]
PACKAGES = 12


@app.command(cls=lazy_parameters.Command)
def build(
    recipes: Annotated[
        list[str] | None, typer.Argument(metavar="RECIPE", help="Folders with a Containerfile (default: [container] image).")
    ] = None,
    network: Annotated[bool, typer.Option("--network", help="Let the Containerfile's commands use the network.")] = False,
    as_json: AsJson = False,
) -> None:
    """Build images from recipes; repeated builds give the same id.

    A recipe is a folder with a Containerfile. If the folder has a program called rootfs, this program is run first, with the
    path of the tar file that it must write into the folder. Podman builds the image; the image of containers/sim gets the tag
    localhost/sierra/sim.

    \b
    Examples:
      sierra image build containers/sim
      sierra image build containers/python containers/swarm
    """
    from sierra.cli.open_project import project
    from sierra.containers.images.resolve import tag

    opened, built = project(), []
    for name in recipes or (None,):
        image = opened.images.build(name, network=network)
        built.append(image)
        if not as_json:
            called = str(tag(opened.root, image.name))
            print(f"{image.id}  {image.name}, tagged {called}")
            print(f"next: sierra image pin {called if Path(image.name).is_absolute() else image.name}")
    if as_json:
        print_json(built)


@app.command("import", cls=lazy_parameters.Command)
def import_(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A docker-archive or oci-archive file.")],
    name: Annotated[
        str, typer.Option("--name", metavar="TAG", help="Tag for the image (default: its own tag, if not in use here).")
    ] = "",
    as_json: AsJson = False,
) -> None:
    """Import an image that was exported, or saved by podman or docker.

    The whole image is checked first. It goes into podman's storage; without podman, it is prepared for apptainer.

    \b
    Examples:
      sierra image import sim.tar --name localhost/sim:1
    """
    from sierra.cli.open_project import project

    opened = project()
    imported = opened.images.import_archive(file, name)
    if as_json:
        print_json(_contents(imported))
        return
    print(f"{imported.image.id}  {imported.image.name}")
    pinned = [image.name for image in opened.images.known() if image.state == "pinned" and image.id == imported.image.id]
    print(f"pinned already: {', '.join(pinned)}" if pinned else f"next: sierra image pin {imported.image.name}")


@app.command(cls=lazy_parameters.Command)
def export(
    name: Annotated[str, typer.Argument(metavar="NAME", help="A tag, a file, or a recipe's folder.")],
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The archive to write.")],
    as_json: AsJson = False,
) -> None:
    """Write an image to a file that loads elsewhere as the same image.

    If the name is pinned, the pinned image is written. The new file is read again and checked.

    \b
    Examples:
      sierra image export localhost/sim:1 sim.tar
    """
    from sierra.cli.open_project import project

    image = project().images.export(name, file)
    if as_json:
        print_json({**asdict(image), "written": str(file)})
    else:
        print(f"{image.id}  {file}")


@app.command(cls=lazy_parameters.Command)
def pin(name: Name = None, as_json: AsJson = False) -> None:
    """Pin the image that a name refers to now.

    Runs execute in the pinned image. The pin is written to sierra.lock; commit this file with the project. The whole image is
    read, checked and described. A name with {arch} pins the images for all processors that exist; --json is then a list.

    \b
    Examples:
      sierra image pin
      sierra image pin localhost/sim:1
      sierra image pin 'swarm-{arch}.sif'
    """
    from sierra.cli.open_project import project

    opened = project()
    pinned = opened.images.pin_all(name)
    for contents in pinned:
        _note_on(contents)
        if not as_json:
            print(f"{contents.image.id}  {contents.image.name}: pinned in sierra.lock")
    if as_json:
        print_json([_contents(contents) for contents in pinned] if ARCH in opened.images.name(name) else _contents(pinned[0]))


def _note_on(found: Contents) -> None:
    """Print notes on an image that was pinned."""
    if Path(found.image.name).is_absolute():
        note(f"{found.image.name} exists only on this machine; for other machines, use a tag or a file in the project")
    if found.user:
        note(f"the image's USER {found.user!r} is ignored: processes run as the user who executes them")


@app.command(cls=lazy_parameters.Command)
def show(
    name: Name = None,
    programs: Annotated[
        list[str] | None, typer.Option("--program", metavar="WORD", help="Show which program this command starts in the image.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show the content of an image.

    Prints its id, layers, labels, recipe and packages, and the programs given with --program.

    \b
    Examples:
      sierra image show
      sierra image show localhost/sim:1 --program python3
    """
    from sierra.cli.open_project import project

    contents = project().images.contents(name)
    shown = {**_contents(contents), "programs": {word: _program(contents, word) for word in programs or ()}}
    if as_json:
        print_json(shown)
        return
    plain = ("name", "id", "kind", "architecture", "file", "sha256", "squashfs", "created", "size", "files")
    fields({key: readable(cell(shown[key])) for key in plain if shown[key] not in ("", None)})
    for key in ("layers", "labels", "variables", "packages", "programs", "recipe"):
        _print_part(key, shown[key])


@app.command(cls=lazy_parameters.Command)
def ls(as_json: AsJson = False) -> None:
    """List the project's images, and where they are stored.

    State "moved": the name now refers to another image than the pinned one. State "gone": it refers to no image.

    \b
    Example:
      sierra image ls
    """
    from sierra.cli.open_project import project
    from sierra.containers.images.image import short

    known = project().images.known()
    if as_json:
        print_json(known)
        return
    rows = [
        (
            readable(image.name or "-"),
            short(image.id) if image.id else "",
            image.state,
            short(image.now) if image.now and image.now != image.id else "",
            image.architecture,
            ", ".join(where for where, there in (("podman", image.podman), ("squashfs", image.squashfs)) if there),
            size(image.size) if image.size is not None else "",
        )
        for image in known
    ]
    table(("name", "image", "state", "current", "architecture", "stored in", "size"), rows, right=("size",))


def _contents(found: Contents) -> dict[str, object]:
    """Return everything about an image except the list of its files."""
    row = {**asdict(found.image), "squashfs": found.squashfs, "created": found.created, "size": found.size}
    more = {"labels": found.labels, "packages": found.packages, "recipe": found.recipe, "manifests": found.manifests}
    return {**row, **more, "files": len(found.files)}


def _program(found: Contents, word: str) -> dict[str, str | None] | None:
    path = found.program(word)
    return None if path is None else {"path": path, "real": found.real(path), "sha256": found.sha256(path)}


def _print_part(name: str, part: object) -> None:
    """Print a list, a table or a text of an image in a few lines."""

    match part:
        case dict():
            lines = [f"{key}: {_short(value)}" for key, value in part.items()]
        case str():
            lines = part.splitlines()
        case list() | tuple():
            lines = [str(item) for item in part]
        case _:
            lines = []
    if lines:
        print(f"\n{name}:")
    for line in lines:
        print(f"  {readable(line)}")


def _short(value: object) -> str:
    match value:
        case None:
            return "not found"
        case dict():
            return ", ".join(f"{key} {text}" for key, text in value.items())
        case list() | tuple():
            more = f" and {len(value) - PACKAGES} more (--json has them all)" if len(value) > PACKAGES else ""
            return ", ".join(value[:PACKAGES]) + more
        case _:
            return str(value)

"""`sierra video`: make the videos of a batch."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from sierra.cli import complete
from sierra.cli.arguments import AsJson, Jobs, names_of_given
from sierra.cli.figures import PREFIX, from_here
from sierra.cli.output import note, print_json
from sierra.errors import UsageError

if TYPE_CHECKING:
    from sierra.api import Project
    from sierra.extensions.videos.render import RenderedVideos


def video(
    words: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[HASH [HASH]] [NAME]...",
            autocompletion=complete.batches_and_figures,
            help="Batch id or prefix, or the name of a query (default: the last batch); two, also as LABEL=HASH, are shown "
            "side by side. Then names of videos (default: all).",
        ),
    ] = None,
    jobs: Jobs = None,
    quiet: Annotated[bool, typer.Option("-q", "--quiet", help="Show no progress.")] = False,
    captured: Annotated[
        bool, typer.Option("--capture", help="Execute the runs of HASH once more to render frames, and make no video.")
    ] = False,
    runs: Annotated[
        int | None, typer.Option("--runs", metavar="K", min=1, help="With --capture: the first K runs of each experiment.")
    ] = None,
    runner: Annotated[
        str | None, typer.Option("--on", metavar="RUNNER", help="With --capture: where runs execute, as in sierra run.")
    ] = None,
    engine: Annotated[
        str | None,
        typer.Option("--engine", metavar="ENGINE", help="With --capture: the container engine (default: as recorded)."),
    ] = None,
    again: Annotated[
        bool, typer.Option("--again", help="With --capture: also runs whose frames are recorded already.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Make the videos of a batch, or of two side by side.

    sierra.toml declares them. They are made from recorded results; nothing is executed. Each file appears whole or not at all,
    in the folder of the batch's figures. `sierra figures --check` tells whether they still follow from the store. Videos of two
    batches show A, B and, for matrices, A − B, for each experiment that both have. Exit status 1 means that a file could not be
    made; a note says why.

    With --capture, recorded runs of a batch, experiment, run or execution are executed once more, with the recorded code and
    inputs; [capture] in sierra.toml and the platform say how the simulator renders. Statistics, figures and replays never use
    such an execution. Its other outputs are compared with the measured ones: if they differ, the frames show something else
    than what was measured, and videos say so. The exit code is 1 then, and if an execution failed.

    \b
    Examples:
      sierra video
      sierra video --capture 722b00 --runs 2
      sierra video 722b00 heat
      sierra video slow=722b00 fast=518b72
    """
    from sierra.cli.open_project import project
    from sierra.cli.progress import counting
    from sierra.extensions.videos import videos

    if captured:
        from sierra.extensions.videos.capture_command import capture

        if len(words or ()) > 1:
            raise UsageError(f"--capture takes one id, not {len(words or ())}")
        if quiet:
            raise UsageError("--quiet: not with --capture")
        capture(words[0] if words else None, runs or 1, jobs, runner or "local", engine, again, as_json)
        return
    if refused := names_of_given({"--runs": runs, "--on": runner, "--engine": engine, "--again": again}):
        raise UsageError(f"{refused}: only with --capture")

    opened = project()
    batches, names = _split(opened, words or [])
    with counting(quiet=quiet) as progress:
        rendered = videos(opened, *batches, names=names, jobs=jobs, progress=progress)
    _print(rendered, as_json=as_json)


def left_out(
    no_videos: Annotated[bool, typer.Option("--no-videos", help="Leave out the videos that were made.")] = False,
) -> str | None:
    """Return the kind of deliverables that `sierra package` leaves out."""
    return "video" if no_videos else None


def _print(rendered: RenderedVideos, *, as_json: bool) -> None:
    """Print the files and the notes; end with exit status 1 if a video could not be made."""
    for text in rendered.notes:
        note(text)
    if as_json:
        print_json({"files": [str(path) for path in rendered.files], "notes": rendered.notes})
    else:
        for path in rendered.files:
            print(from_here(path))
    if not rendered.complete:
        raise typer.Exit(1)


def _split(opened: Project, words: list[str]) -> tuple[list[str], list[str]]:
    """Return the batches, which come first, and the names of videos. Raises UsageError for more than two batches."""
    from sierra.extensions.videos import table

    declared = table.declared(opened.config)
    is_name = [
        word in declared or not ("=" in word or word in opened.config.queries or PREFIX.fullmatch(word)) for word in words
    ]
    count = is_name.index(True) if True in is_name else len(words)
    if count > 2:
        raise UsageError(f"a video shows two batches at most, not {count}")
    return words[:count], words[count:]

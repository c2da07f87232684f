"""`sierra video --capture`: execute recorded runs once more with rendering, for their frames."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from sierra.cli import complete
from sierra.cli.arguments import AsJson, Jobs, Runner
from sierra.cli.output import note, print_json, table

if TYPE_CHECKING:
    from sierra.extensions.videos.capture_runs import Captures


def capture(
    prefix: Annotated[
        str | None,
        typer.Argument(
            metavar="[HASH]",
            autocompletion=complete.ids,
            help="Id of a batch, experiment, run or execution, or the name of a query (default: the last batch).",
        ),
    ] = None,
    runs: Annotated[int, typer.Option("--runs", metavar="K", min=1, help="The first K runs of each experiment.")] = 1,
    jobs: Jobs = None,
    runner: Runner = "local",
    engine: Annotated[
        str | None,
        typer.Option("--engine", metavar="ENGINE", help="Container engine: podman, apptainer, none (default: as recorded)."),
    ] = None,
    again: Annotated[bool, typer.Option("--again", help="Also capture runs whose frames are recorded already.")] = False,
    as_json: AsJson = False,
) -> None:
    """Execute recorded runs again to render frames.

    A capture uses the recorded code and inputs, as a replay does; [capture] in sierra.toml and the platform say how the
    simulator renders. Statistics, figures and replays never use such an execution. Its other outputs are compared with the
    measured ones: if they differ, the frames show something else than what was measured, and videos say so. The exit code is
    1 then, and if an execution failed.

    \b
    Examples:
      sierra video --capture
      sierra video --capture 722b00 --runs 2
      sierra video --capture && sierra video
    """
    from sierra.cli import open_project
    from sierra.cli.progress import watching
    from sierra.extensions.videos import capture as capture_frames

    project = open_project.project()
    with watching(quiet=as_json) as display:
        answer = capture_frames(
            project,
            prefix,
            runs=runs,
            jobs=jobs,
            runner=runner,
            engine=engine,
            again=again,
            observer=None if as_json else display,
        )
    if as_json:
        print_json(answer)
    else:
        _print(answer)
    if answer.interrupted:
        raise typer.Exit(130)
    if not answer.verdict.fine:
        raise typer.Exit(1)


def _print(answer: Captures) -> None:
    from sierra.util.hashing import short
    from sierra.util.text import counted

    if answer.interrupted:
        print("interrupted: nothing was compared; sierra video --capture continues, and executes only what is missing")
        return
    if answer.known:
        note(f"{counted(answer.known, 'run')} captured before by the same rendering (--again captures them again)")
    rows = [[short(run.run), short(run.execution), run.frames, run.verdict, run.reason or ""] for run in answer.made]
    if rows:
        table(["run", "execution", "frames", "other outputs", "reason"], rows, right=["frames"])

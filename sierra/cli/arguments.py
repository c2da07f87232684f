"""Arguments and options that several commands have."""

from __future__ import annotations

from typing import Annotated

import typer

from sierra.cli import complete

ShownId = Annotated[
    str,
    typer.Argument(
        metavar="HASH", autocompletion=complete.ids, help="Id of a batch, experiment, run or execution; a prefix is enough."
    ),
]
ClusterId = Annotated[
    str,
    typer.Argument(
        metavar="HASH",
        autocompletion=complete.sessions,
        help="Batch id, or session id from `sierra status`; a prefix is enough.",
    ),
]
Jobs = Annotated[
    int | None, typer.Option("-j", "--jobs", metavar="N", help="Number of parallel runs (default: number of cores).")
]
Runner = Annotated[
    str,
    typer.Option(
        "--on",
        metavar="RUNNER",
        autocompletion=complete.runners,
        help="Where runs execute: local, slurm, pbs, or a cluster of sierra.toml.",
    ),
]
Controller = Annotated[
    str | None, typer.Option("--controller", metavar="NAME", autocompletion=complete.controllers, help="The controller.")
]
Scenario = Annotated[
    str | None, typer.Option("--scenario", metavar="NAME", autocompletion=complete.scenarios, help="The scenario.")
]
Sets = Annotated[
    list[str] | None, typer.Option("--set", metavar="XPATH=VALUE", help="Change the template in all runs. May be repeated.")
]
EngineOfRuns = Annotated[
    str | None,
    typer.Option("--engine", metavar="ENGINE", help="Container engine: podman, apptainer, none (default: the project's)."),
]
DrawFigures = Annotated[bool | None, typer.Option("--figures/--no-figures", help="Draw the figures (default) or not.")]
Long = Annotated[bool, typer.Option("--long", help="Show full ids, and do not shorten text to fit the terminal.")]
Yes = Annotated[bool, typer.Option("--yes", "-y", help="Do not ask for confirmation.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text.")]
AsJsonList = Annotated[bool, typer.Option("--json", help="Print a JSON list instead of text.")]

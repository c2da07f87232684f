"""Arguments and options that several commands have."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated

import typer

from sierra.cli import complete

if TYPE_CHECKING:
    from sierra.model import Measure as MeasureName


class Measure(StrEnum):
    """The measure that reduces a run to one value."""

    final = "final"
    mean = "mean"
    time_mean = "time_mean"
    time_to = "time_to"


class Format(StrEnum):
    """The format of a result."""

    table = "table"
    csv = "csv"
    json = "json"
    markdown = "markdown"
    parquet = "parquet"


MEASURES: dict[Measure, MeasureName] = {
    Measure.final: "final",
    Measure.mean: "mean",
    Measure.time_mean: "time_mean",
    Measure.time_to: "time_to",
}
"""The measures as the Python API names them."""


def names_of_given(options: Mapping[str, object]) -> str:
    """Return the names of the options that were given, with commas; not those with None, False, an empty text or list."""
    return ", ".join(name for name, value in options.items() if not (value is None or value is False or value in ("", [], ())))


ShownId = Annotated[
    str | None,
    typer.Argument(
        metavar="HASH",
        autocompletion=complete.ids,
        show_default=False,
        help="Id of a batch, experiment, run or execution; a prefix is enough (default: the last batch).",
    ),
]
ClusterId = Annotated[
    str | None,
    typer.Argument(
        metavar="HASH",
        autocompletion=complete.sessions,
        show_default=False,
        help="Batch id, or session id from `sierra ls --jobs`; a prefix is enough. Or the name of a query (default: the last "
        "batch with cluster jobs; to cancel, the only one).",
    ),
]
Criteria = Annotated[
    list[str],
    typer.Argument(
        metavar="QUERY",
        autocompletion=complete.criteria,
        help="Criteria, one per axis. The name of a query in sierra.toml stands for its criteria. "
        "Or a batch id prefix: execute its missing runs with the recorded code. Or a FILE.json with a request.",
    ),
]
RunsEach = Annotated[int | None, typer.Option("--runs", metavar="N", help="Runs per experiment.")]
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
RunnerOfRuns = Annotated[
    str | None,
    typer.Option(
        "--on",
        metavar="RUNNER",
        autocompletion=complete.runners,
        help="Where runs execute: local, slurm, pbs, or a cluster of sierra.toml (default: its runner, local).",
    ),
]
Controller = Annotated[
    str | None, typer.Option("--controller", metavar="NAME", autocompletion=complete.controllers, help="The controller.")
]
Scenario = Annotated[
    str | None, typer.Option("--scenario", metavar="NAME", autocompletion=complete.scenarios, help="The scenario.")
]
TargetNames = Annotated[
    str | None,
    typer.Option(
        "--target",
        metavar="NAME[,NAME...]",
        autocompletion=complete.targets,
        help="Targets in sierra.toml; there is a batch for each.",
    ),
]
TargetName = Annotated[
    str | None, typer.Option("--target", metavar="NAME", autocompletion=complete.targets, help="A target in sierra.toml.")
]
TargetOfBatch = Annotated[
    str | None,
    typer.Option("--target", metavar="NAME", autocompletion=complete.targets, help="The last batch of this target instead."),
]
Sets = Annotated[
    list[str] | None, typer.Option("--set", metavar="XPATH=VALUE", help="Change the template in all runs. May be repeated.")
]
EngineOfRuns = Annotated[
    str | None,
    typer.Option("--engine", metavar="ENGINE", help="Container engine: podman, apptainer, none (default: the project's)."),
]
Only = Annotated[
    str | None,
    typer.Option("--only", metavar="CONDITION", help='Execute only these experiments: "population_size<=4 and noise=0,0.5".'),
]
DrawFigures = Annotated[bool | None, typer.Option("--figures/--no-figures", help="Draw the figures (default) or not.")]
Long = Annotated[bool, typer.Option("--long", help="Show full ids, and do not shorten text to fit the terminal.")]
Yes = Annotated[bool, typer.Option("--yes", "-y", help="Do not ask for confirmation.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text.")]
AsJsonList = Annotated[bool, typer.Option("--json", help="Print a JSON list instead of text.")]
OneColumn = Annotated[str, typer.Option("--column", "-c", metavar="COLUMN", help="The column (default: the only one).")]
OneOutput = Annotated[
    str, typer.Option("--table", metavar="OUTPUT", help="The output with the column (default: the only one).")
]
MeasureOfRun = Annotated[
    Measure | None,
    typer.Option(
        "--measure",
        "-m",
        help="Value of a run: final, its last value; mean of its rows; time_mean over time; time_to a threshold "
        "(default: final; in a table of events, mean).",
    ),
]
Threshold = Annotated[float | None, typer.Option("--threshold", metavar="X", help="For time_to: the value to reach or exceed.")]

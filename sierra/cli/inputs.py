"""`sierra inputs`: write the inputs and commands of a query's runs, and execute nothing."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sierra.cli import plan_query
from sierra.cli.arguments import AsJson, Controller, Criteria, EngineOfRuns, Only, RunsEach, Scenario, Sets
from sierra.cli.output import note, print_json
from sierra.util.text import counted


def inputs(
    query: Criteria,
    to: Annotated[Path, typer.Option("--to", metavar="DIR", help="The folder to write; it must be new or empty.")],
    runs: RunsEach = None,
    controller: Controller = None,
    scenario: Scenario = None,
    sets: Sets = None,
    only: Only = None,
    engine: EngineOfRuns = None,
    as_json: AsJson = False,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask for confirmation of many runs.")] = False,
) -> None:
    """Write all inputs and commands, and execute nothing.

    For sites that start programs in their own way. Each run gets a folder with its input files, command.json and the empty
    folder output, where its command is to be started. manifest.csv lists all runs with their ids, values, seeds and folders.
    The folder appears as a whole, or not at all.

    \b
    Examples:
      sierra inputs population_size.Log8 --runs 10 --to ../inputs
      sierra inputs population_size.Log8 --only "population_size=8" --to ../inputs
    """
    from sierra.cli import open_project
    from sierra.cli.progress import Planning
    from sierra.execution.write_inputs import MANIFEST, check_target
    from sierra.query.grammar import setting
    from sierra.util.hashing import short

    check_target(to)
    project = open_project.project()
    settings = plan_query.Settings(
        runs=runs, controller=controller, scenario=scenario, sets=[setting(text) for text in sets or ()]
    )
    plan = plan_query.plan(project, query, settings, engine=engine, observer=Planning(agreed=yes, quiet=as_json))
    written = project.write_inputs(plan, to, only=only)
    if as_json:
        print_json(written)
        return
    for text in written.notes:
        note(text)
    part = f" of {counted(written.experiments, 'experiment')}" + (" selected by --only" if only else "")
    print(f"batch {short(written.batch)}: {plan.text}")
    print(f"wrote {counted(written.runs, 'run')}{part}; {to / MANIFEST} lists them")

"""`sierra run --inputs`: write the inputs and commands of a query's runs, and execute nothing."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sierra.cli import plan_query
from sierra.cli.arguments import AsJson, Controller, Criteria, EngineOfRuns, Only, RunsEach, Scenario, Sets, TargetNames
from sierra.cli.output import note, print_json
from sierra.util.text import counted


def inputs(
    query: Criteria,
    to: Annotated[Path, typer.Option("--to", metavar="DIR", help="The folder to write; it must be new or empty.")],
    runs: RunsEach = None,
    controller: Controller = None,
    scenario: Scenario = None,
    sets: Sets = None,
    target: TargetNames = None,
    only: Only = None,
    engine: EngineOfRuns = None,
    as_json: AsJson = False,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask for confirmation of many runs.")] = False,
) -> None:
    """Write all inputs and commands, and execute nothing.

    For sites that start programs in their own way. Each run gets a folder with its input files, command.json and the empty
    folder output, where its command is to be started; execute.sh does so. manifest.csv lists all runs with their ids,
    values, seeds and folders. The folder appears as a whole, or not at all. With several targets, it gets such a folder for
    each.

    \b
    Examples:
      sierra run population_size.Log8 --runs 10 --inputs ../inputs
      sierra run population_size.Log8 --only "population_size=8" --inputs ../inputs
      sierra run population_size.Log8 --target sim,robots --inputs ../inputs
    """
    from sierra.cli import open_project, render_summary
    from sierra.cli.progress import Planning
    from sierra.design.query.grammar import setting
    from sierra.execution.write_inputs import MANIFEST, check_target

    check_target(to)
    project = open_project.project()
    settings = plan_query.Settings(
        runs=runs, controller=controller, scenario=scenario, sets=[setting(text) for text in sets or ()]
    )
    observer = Planning(agreed=yes, quiet=as_json)
    plans = plan_query.plans(project, query, settings, target, engine=engine, observer=observer)
    if len(plans) > 1:
        to.mkdir(exist_ok=True)
    answers: dict[str, object] = {}
    for plan in plans:
        folder = to / (plan.target or "") if len(plans) > 1 else to
        written = project.plans.write_inputs(plan, folder, only=only)
        answers[plan.target or ""] = written
        if as_json:
            continue
        for text in written.notes:
            note(text)
        part = f" of {counted(written.experiments, 'experiment')}" + (" selected by --only" if only else "")
        print(render_summary.heading(written.batch, plan.text, plan.target))
        print(f"wrote {counted(written.runs, 'run')}{part}; {folder / MANIFEST} lists them")
    if as_json:
        print_json({"targets": answers} if len(plans) > 1 else answers[plans[0].target or ""])

"""`sierra run`: run a query's experiments and reuse finished runs."""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sierra.cli import complete

if TYPE_CHECKING:
    from sierra.api import Project
    from sierra.execution.observer import Observer
    from sierra.execution.resolve_plan import Plan

STDERR = 2


def run(
    query: Annotated[
        list[str],
        typer.Argument(
            metavar="QUERY",
            autocompletion=complete.criteria,
            help="Criteria, one per axis. The name of a query in sierra.toml stands for its criteria. "
            "Or a batch id prefix: execute its missing runs with the recorded code. Or a FILE.json with a request.",
        ),
    ],
    runs: Annotated[int | None, typer.Option("--runs", metavar="N", help="Runs per experiment.")] = None,
    controller: Annotated[
        str | None, typer.Option("--controller", metavar="NAME", autocompletion=complete.controllers, help="The controller.")
    ] = None,
    scenario: Annotated[
        str | None, typer.Option("--scenario", metavar="NAME", autocompletion=complete.scenarios, help="The scenario.")
    ] = None,
    sets: Annotated[
        list[str] | None, typer.Option("--set", metavar="XPATH=VALUE", help="Change the template in all runs. May be repeated.")
    ] = None,
    jobs: Annotated[
        int | None, typer.Option("-j", "--jobs", metavar="N", help="Number of parallel runs (default: number of cores).")
    ] = None,
    runner: Annotated[
        str,
        typer.Option(
            "--on",
            metavar="RUNNER",
            autocompletion=complete.runners,
            help="Where runs execute: local, slurm, pbs, or a cluster of sierra.toml.",
        ),
    ] = "local",
    detach: Annotated[bool, typer.Option("--detach", help="Submit to a cluster, and return without waiting.")] = False,
    engine: Annotated[
        str | None,
        typer.Option("--engine", metavar="ENGINE", help="Container engine: podman, apptainer, none (default: the project's)."),
    ] = None,
    dry_run: Annotated[bool, typer.Option("-n", "--dry-run", help="Show what would execute, and execute nothing.")] = False,
    explain: Annotated[bool, typer.Option("--explain", help="Show why runs execute or are reused.")] = False,
    fail_fast: Annotated[bool, typer.Option("--fail-fast", help="Stop at the first failed run.")] = False,
    figures: Annotated[bool | None, typer.Option("--figures/--no-figures", help="Draw the figures (default) or not.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text.")] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask for confirmation of many runs.")] = False,
) -> None:
    """Run a query's experiments and reuse finished runs.

    Executes runs without a successful result, records them, and draws the figures. On a cluster, Ctrl-C asks whether to detach
    from the jobs or to cancel them; use sierra status, attach and cancel for detached jobs.

    \b
    Criteria:
      population_size.Log8             1, 2, 4, 8
      population_size.Linear100.C10    10, 20, ... 100
      max_speed.1.9.C5                 1, 3, 5, 7, 9
      max_speed=0.2,0.4,1.6            these values
      noise=0:1:5                      from, to, number of values
      scenario=low,high                groups of changes in sierra.toml
      montecarlo.C20                   only the random seed changes

    \b
    Examples:
      sierra run population_size.Log8 --runs 10
      sierra run noise=0:1:5 scenario=low,high -j 4
      sierra run population_size=4 --set "//arena/@size=20"
      sierra run scalability noise=0,0.1 --dry-run --explain
      sierra run 774d
      sierra run query.json
      sierra run population_size.Log8 --on slurm --detach
      sierra run population_size.Log8 --on slurm --dry-run --explain
    """
    from sierra.cli import open_project, render_estimate, render_summary
    from sierra.cli.output import note, print_json
    from sierra.cli.progress import Planning, watching
    from sierra.config import user
    from sierra.query.grammar import setting
    from sierra.query.query_input import SUFFIX

    project = open_project.project()
    asked: dict[str, Any] = {
        "runs": runs,
        "controller": controller,
        "scenario": scenario,
        "sets": [setting(text) for text in sets or ()],
    }
    observer = Planning(agreed=yes, quiet=as_json)
    if query[0].endswith(SUFFIX):
        plan = _from_file(project, query, asked, engine=engine, observer=observer)
    else:
        plan = project.plan(*query, **asked, engine=engine, observer=observer)
    if not dry_run:
        _check_log(plan)
    told: dict[str, Any] = {}
    if dry_run or explain:
        told = _preview(project, plan, explain=explain, as_json=as_json)
        proposed = project.proposal(plan, runner, detach=detach)
        told |= {"proposal": proposed and asdict(proposed)}
        if proposed and not as_json:
            render_estimate.show(proposed, explain=explain, script=dry_run)
        if dry_run:
            for text in (*plan.notes, *(proposed.notes if proposed else ())):
                note(text)
            if as_json:
                print_json(told)
            return
    else:
        told = _again(project, plan)
    with watching(quiet=as_json) as display:
        summary = project.execute(
            plan,
            jobs=jobs,
            fail_fast=fail_fast,
            figures=user.load().figures if figures is None else figures,
            observer=display,
            runner=runner,
            detach=detach,
        )
    more: dict[str, Any] = {name: told[name] for name in ("reasons", "new_because", "proposal") if name in told}
    render_summary.tell(project, summary, more if as_json else None, detached=detach)


def _from_file(project: Project, query: list[str], asked: dict[str, Any], *, engine: str | None, observer: Observer) -> Plan:
    """Return the plan of the request in a file. Print a note if the file names a batch that the request no longer gives."""
    from sierra.cli.output import note
    from sierra.errors import UsageError
    from sierra.query import query_input
    from sierra.util.hashing import short

    if len(query) > 1 or any(asked.values()):
        raise UsageError(
            f"{query[0]} is a complete request; leave out other criteria, --runs, --controller, --scenario and --set"
        )
    found = query_input.read(Path(query[0]))
    plan = project.resolve(found.request, engine=engine, observer=observer)
    if found.batch not in (None, plan.batch.id):
        inside = Path(query[0]).resolve().is_relative_to(project.root)
        hint = " (the file is part of its source: move it elsewhere, or let git ignore it)" if inside else ""
        note(f"the project has changed since {query[0]} was written{hint}: then it was batch {short(found.batch)}")
    return plan


def _preview(project: Project, plan: Plan, *, explain: bool, as_json: bool) -> dict[str, Any]:
    """Print the runs that would execute, and with `explain` the reasons."""
    from sierra.cli import render_status
    from sierra.cli.output import table
    from sierra.cli.render_reasons import PREVIEW, text
    from sierra.execution import cluster_status
    from sierra.execution.reasons import ChangeReason, Reason
    from sierra.execution.reuse import foreseen
    from sierra.execution.reuse import states as states_of
    from sierra.explain.why_new_runs import other_programs, why_new
    from sierra.query.query_input import KEY
    from sierra.util.hashing import short
    from sierra.util.text import counted

    store = project.stored()
    states = foreseen(plan, store, states_of(plan, store))
    anew = sum(state.anew for state in states.values())
    missing = {run for run, state in states.items() if not state.succeeded and not state.anew}
    there = missing & cluster_status.claimed(store).keys() if store and missing else set()
    now = cluster_status.seen(store, there) if store and there else []
    todo = len(missing) - len(there)
    on_cluster = Reason(ChangeReason.ON_CLUSTER)
    reasons = Counter(on_cluster if run in there else state.change for run, state in states.items())
    told: dict[str, Any] = {
        KEY: plan.request.model_dump(mode="json", exclude_defaults=True),
        "batch": plan.batch.id,
        "query": plan.text,
        "experiments": len(plan.batch.experiments),
        "runs": len(states),
        "to_execute": todo,
        "reused": len(states) - len(missing),
        "to_judge": anew,
        "on_clusters": len(there),
        "clusters": [asdict(one) for one in now],
        "reasons": {text(reason, PREVIEW): count for reason, count in reasons.most_common()},
        "notes": list(plan.notes),
        "new_because": why_new(plan, store) if explain and reasons[Reason(ChangeReason.NEW)] else [],
    }
    if explain and store and reasons[Reason(ChangeReason.PROGRAMS)]:
        told["other_programs"] = other_programs(plan, store)
    if as_json:
        return told
    print(f"batch {short(plan.batch.id)}: {plan.text}")
    axes = [axis.name for axis in plan.batch.axes]
    here = missing - there
    rows = [
        [*experiment.values.values(), len(experiment.runs), sum(run.id in here for run in experiment.runs)]
        for experiment in plan.batch.experiments
    ]
    table([*axes, "runs", "to execute"], rows, right=["runs", "to execute"])
    if explain:
        for reason, number in told["reasons"].items():
            print(f"{counted(number, 'run')}: {reason}")
        for line in (*told["new_because"], *told.get("other_programs", ())):
            print(f"  {line}")
    else:
        beside = f", {len(there)} {'is' if len(there) == 1 else 'are'} on a cluster and would be followed" if there else ""
        judged = f", {anew} would be evaluated again because [outputs] or [success] have changed" if anew else ""
        print(f"{todo} of {counted(len(states), 'run')} would execute{judged}{beside}")
    for line in render_status.lines(now):
        print(line)
    return told


def _check_log(plan: Plan) -> None:
    """Raise UsageError if standard error is redirected into the project's code.

    Such a log would change the code during the batch, and each run would fail when it ends.
    """
    from sierra.errors import UsageError

    log = plan.seen.named(STDERR)
    if log is not None:
        raise UsageError(
            f"output is redirected into the project ({log}), which would change its source and make all runs fail; "
            f"redirect it elsewhere, or let git ignore it ({plan.seen.advice([os.fsencode(log)])})"
        )


def _again(project: Project, plan: Plan) -> dict[str, Any]:
    """Print and return the reasons why runs execute again although the same query was run before."""
    from sierra.cli.output import note
    from sierra.explain.why_new_runs import why_again

    why = why_again(plan, project.stored())
    if why:
        note(f"this query was submitted before, but its runs execute again: {'; '.join(why)}")
    return {"new_because": why} if why else {}

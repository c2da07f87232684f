"""`sierra run`: run a query's experiments and reuse finished runs."""

from __future__ import annotations

import os
from collections.abc import Set as AbstractSet
from typing import TYPE_CHECKING, Annotated

import typer

from sierra.cli import plan_query
from sierra.cli.arguments import (
    AsJson,
    Controller,
    Criteria,
    DrawFigures,
    EngineOfRuns,
    Jobs,
    Only,
    Runner,
    RunsEach,
    Scenario,
    Sets,
)
from sierra.cli.output import note, print_json, table
from sierra.util.text import counted

if TYPE_CHECKING:
    from sierra.api import Project
    from sierra.execution.plan_json import PlanPreview
    from sierra.execution.resolve_plan import Plan
    from sierra.query.condition import Selection

STDERR = 2


def run(
    query: Criteria,
    runs: RunsEach = None,
    controller: Controller = None,
    scenario: Scenario = None,
    sets: Sets = None,
    jobs: Jobs = None,
    runner: Runner = "local",
    detach: Annotated[bool, typer.Option("--detach", help="Submit to a cluster, and return without waiting.")] = False,
    engine: EngineOfRuns = None,
    dry_run: Annotated[bool, typer.Option("-n", "--dry-run", help="Show what would execute, and execute nothing.")] = False,
    explain: Annotated[bool, typer.Option("--explain", help="Show why runs execute or are reused.")] = False,
    only: Only = None,
    fail_fast: Annotated[bool, typer.Option("--fail-fast", help="Stop at the first failed run.")] = False,
    figures: DrawFigures = None,
    as_json: AsJson = False,
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
      sierra run population_size.Log8 --only "population_size<=4"
      sierra run 774d
      sierra run query.json
      sierra run population_size.Log8 --on slurm --detach
      sierra run population_size.Log8 --on slurm --dry-run --explain
    """
    from sierra.cli import open_project, render_summary
    from sierra.cli.progress import Display, Planning, watching
    from sierra.cli.render_reasons import build
    from sierra.config import user
    from sierra.query import condition
    from sierra.query.grammar import setting

    project = open_project.project()
    observer = Planning(agreed=yes, quiet=as_json)
    settings = plan_query.Settings(
        runs=runs, controller=controller, scenario=scenario, sets=[setting(text) for text in sets or ()]
    )
    plan = plan_query.plan(project, query, settings, engine=engine, observer=observer)
    selection = condition.select(only, plan.batch) if only is not None else None
    more: dict[str, object] = {}
    state = plan.build
    if not dry_run:
        _check_log(plan)
        plan = project.build(plan, observer=Display())
    if dry_run or explain:
        built = build(state, dry_run=dry_run) if state else None
        preview = _preview(
            project, plan, selection, runner, built, detach=detach, explain=explain, dry_run=dry_run, quiet=as_json
        )
        if dry_run and as_json:
            print_json(preview.as_dict())
        if dry_run:
            return
        more = {"reasons": preview.reasons, "new_because": preview.new_because, "proposal": preview.proposal}
        more |= {"build": preview.build} if preview.build else {}
    elif why := _again(project, plan):
        more = {"new_because": why}
    with watching(quiet=as_json) as display:
        summary = project.execute(
            plan,
            jobs=jobs,
            fail_fast=fail_fast,
            figures=user.load().figures if figures is None else figures,
            observer=display,
            runner=runner,
            detach=detach,
            only=only,
        )
    render_summary.print_and_exit(project, summary, more if as_json else None, detached=detach)


def _preview(
    project: Project,
    plan: Plan,
    selection: Selection | None,
    runner: str,
    built: str | None,
    *,
    detach: bool,
    explain: bool,
    dry_run: bool,
    quiet: bool,
) -> PlanPreview:
    """Return the preview of a plan, with `explain` also its reasons; print it unless `quiet`.

    `built` says whether products are built.
    """
    from sierra.cli import render_estimate
    from sierra.cli.render_reasons import PREVIEW, change, new_runs, text
    from sierra.execution.cluster_status import seen
    from sierra.execution.dry_run import forecast
    from sierra.execution.plan_json import PlanPreview
    from sierra.execution.reasons import ChangeReason, Reason
    from sierra.explain.why_new_runs import other_programs, why_new

    store = project.stored()
    runs = selection.runs if selection else None
    found = forecast(plan, store, runs)
    reasons = found.reasons
    new = explain and reasons[Reason(ChangeReason.NEW)]
    other = explain and store and reasons[Reason(ChangeReason.PROGRAMS)]
    proposal = project.proposal(plan, runner, detach=detach, runs=runs)
    preview = PlanPreview(
        request=plan.request,
        batch=plan.batch.id,
        query=plan.text,
        experiments=len(plan.batch.experiments),
        selected=len(selection.experiments) if selection else None,
        runs=len(found.states),
        to_execute=len(found.to_execute),
        reused=len(found.states) - len(found.to_execute) - len(found.on_clusters),
        to_reevaluate=found.to_reevaluate,
        on_clusters=len(found.on_clusters),
        clusters=tuple(seen(store, found.on_clusters)) if store and found.on_clusters else (),
        reasons={text(reason, PREVIEW): count for reason, count in reasons.most_common()},
        notes=plan.notes,
        new_because=tuple(new_runs(why_new(plan, store))) if new else (),
        other_programs=tuple(map(change, other_programs(plan, store))) if other and store else None,
        build=built,
        proposal=proposal,
    )
    if not quiet:
        _print(plan, preview, selection, found.to_execute, explain=explain)
        if proposal:
            render_estimate.show(proposal, explain=explain, script=dry_run)
    for message in (*plan.notes, *(proposal.notes if proposal else ())) if dry_run else ():
        note(message)
    return preview


def _print(
    plan: Plan, preview: PlanPreview, selection: Selection | None, to_execute: AbstractSet[str], *, explain: bool
) -> None:
    from sierra.cli import render_status
    from sierra.util.hashing import short

    print(f"batch {short(preview.batch)}: {preview.query}")
    rows = [
        [*experiment.values.values(), len(experiment.runs), sum(run.id in to_execute for run in experiment.runs)]
        for experiment in plan.batch.experiments
        if selection is None or experiment.ordinal in selection.experiments
    ]
    if selection is not None:
        print(f"{len(rows)} of {counted(preview.experiments, 'experiment')} selected by --only")
    table([*(axis.name for axis in plan.batch.axes), "runs", "to execute"], rows, right=["runs", "to execute"])
    if preview.build:
        print(preview.build)
    if explain:
        for reason, number in preview.reasons.items():
            print(f"{counted(number, 'run')}: {reason}")
        for line in (*preview.new_because, *(preview.other_programs or ())):
            print(f"  {line}")
    else:
        followed, judged = preview.on_clusters, preview.to_reevaluate
        follow_up = f", {followed} {'is' if followed == 1 else 'are'} on a cluster and would be followed" if followed else ""
        again = f", {judged} would be evaluated again because [outputs] or [success] have changed" if judged else ""
        print(f"{preview.to_execute} of {counted(preview.runs, 'run')} would execute{again}{follow_up}")
    for line in render_status.lines(preview.clusters):
        print(line)


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


def _again(project: Project, plan: Plan) -> list[str]:
    """Print and return the reasons why runs execute again although the same query was run before."""
    from sierra.execution.reuse import is_repeated

    store = project.stored()
    if store is None or is_repeated(plan, store):
        return []
    from sierra.cli.render_reasons import change
    from sierra.explain.why_new_runs import why_again

    why = [change(one) for one in why_again(plan, store)]
    if why:
        note(f"this query was submitted before; since then: {'; '.join(why)}")
    return why

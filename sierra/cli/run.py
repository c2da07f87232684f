"""`sierra run`: run a query's experiments and reuse finished runs."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from collections.abc import Set as AbstractSet
from pathlib import Path
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
    RunnerOfRuns,
    RunsEach,
    Scenario,
    Sets,
    TargetNames,
    names_of_given,
)
from sierra.cli.output import note, print_json, table
from sierra.errors import SierraError, UsageError
from sierra.util.lazy_definitions import dataclass
from sierra.util.text import counted, size

if TYPE_CHECKING:
    from sierra.api import Project
    from sierra.design.query.condition import Selection
    from sierra.execution.observer import Observer
    from sierra.execution.plan import Plan
    from sierra.execution.plan_json import PlanPreview
    from sierra.execution.summary import Summary
    from sierra.runners.cluster.resource_estimate import Estimate

STDERR = 2


def run(
    query: Criteria,
    runs: RunsEach = None,
    controller: Controller = None,
    scenario: Scenario = None,
    sets: Sets = None,
    target: TargetNames = None,
    jobs: Jobs = None,
    runner: RunnerOfRuns = None,
    detach: Annotated[bool, typer.Option("--detach", help="Submit to a cluster, and return without waiting.")] = False,
    engine: EngineOfRuns = None,
    dry_run: Annotated[bool, typer.Option("-n", "--dry-run", help="Show what would execute, and execute nothing.")] = False,
    explain: Annotated[bool, typer.Option("--explain", help="Show why runs execute or are reused.")] = False,
    only: Only = None,
    fail_fast: Annotated[bool, typer.Option("--fail-fast", help="Stop at the first failed run.")] = False,
    retry: Annotated[bool, typer.Option("--retry", help="Execute also runs that failed twice in the same way.")] = False,
    figures: DrawFigures = None,
    as_json: AsJson = False,
    yes: Annotated[
        bool,
        typer.Option(
            "--yes", help="Do not ask for confirmation of many runs. Start supervised trials without a person, and accept all."
        ),
    ] = False,
    until: Annotated[
        str | None,
        typer.Option(
            "--until",
            metavar="RULE",
            help="Execute more and more runs until intervals are narrow enough, as in 'ci(coverage) < 0.02'; needs --max-runs.",
        ),
    ] = None,
    max_runs: Annotated[
        int | None, typer.Option("--max-runs", metavar="N", help="With --until: the runs per experiment of the last look.")
    ] = None,
    inputs: Annotated[
        Path | None,
        typer.Option(
            "--inputs",
            metavar="DIR",
            help="Only write all inputs and commands into this folder, which must be new or empty; execute nothing.",
        ),
    ] = None,
) -> None:
    """Run a query's experiments and reuse finished runs.

    Executes runs without a successful result, records them, and draws the figures. On a cluster, Ctrl-C asks whether to detach
    from the jobs or to cancel them; use sierra ls --jobs, attach and cancel for detached jobs.

    With --inputs, for sites that start programs in their own way, each run gets a folder with its input files, command.json and
    the empty folder output, where its command is to be started; execute.sh does so. manifest.csv lists all runs with their ids,
    values, seeds and folders. The folder appears as a whole, or not at all. With several targets, it gets such a folder for
    each.

    \b
    Criteria:
      population_size.Log8             1, 2, 4, 8
      population_size.Linear100.C10    10, 20, ... 100
      max_speed.1.9.C5                 1, 3, 5, 7, 9
      max_speed=0.2,0.4,1.6            these values
      noise=0:1:5                      from, to, number of values
      scenario=low,high                groups of changes in sierra.toml
      'law="random walk",none'         texts with blanks, brackets and others
      montecarlo.C20                   only the random seed changes

    \b
    Examples:
      sierra run population_size.Log8 --runs 10
      sierra run noise=0:1:5 scenario=low,high -j 4
      sierra run population_size=4 --set "//arena/@size=20"
      sierra run scalability noise=0,0.1 --dry-run --explain
      sierra run population_size.Log8 --only "population_size<=4"
      sierra run population_size.Log8 --target sim,robots
      sierra run 9e1c
      sierra run query.json
      sierra run population_size.Log8 --on slurm --detach
      sierra run population_size.Log8 --on slurm --dry-run --explain
      sierra run population_size.Log8 --runs 10 --inputs ../inputs
      sierra run scalability --until "ci(coverage) < 0.02" --max-runs 200
      sierra run scalability --until "ci(median(coverage)) < 5%" --max-runs 99
    """
    from sierra.cli import open_project, render_summary
    from sierra.cli.progress import Planning
    from sierra.config import user
    from sierra.design.query.grammar import setting

    if inputs is not None:
        others = {
            "--jobs": jobs,
            "--on": runner,
            "--detach": detach,
            "--dry-run": dry_run,
            "--explain": explain,
            "--fail-fast": fail_fast,
            "--retry": retry,
            "--figures": figures,
            "--until": until,
            "--max-runs": max_runs,
        }
        if refused := names_of_given(others):
            raise UsageError(f"--inputs executes nothing; leave out {refused}")
        from sierra.cli.inputs import inputs as write_inputs

        write_inputs(query, inputs, runs, controller, scenario, sets, target, only, engine, as_json, yes)
        return
    project = open_project.project()
    observer = Planning(agreed=yes, quiet=as_json)
    settings = plan_query.Settings(
        runs=runs, controller=controller, scenario=scenario, sets=[setting(text) for text in sets or ()]
    )
    options = Options(
        runner=runner,
        jobs=jobs,
        only=only,
        detach=detach,
        dry_run=dry_run,
        explain=explain,
        fail_fast=fail_fast,
        retry=retry,
        figures=user.load().figures if figures is None else figures,
        as_json=as_json,
    )
    if until is not None or max_runs is not None:
        _until(project, query, settings, target, engine, observer, options, until, max_runs)
        return
    plans = plan_query.plans(project, query, settings, target, engine=engine, observer=observer)
    if not dry_run:
        for plan in plans:
            _check(project, plan, options)
    answers: dict[str, object] = {}
    summaries: list[Summary] = []
    for index, plan in enumerate(plans):
        if len(plans) > 1 and not dry_run:
            note(f"target {plan.target} ({index + 1} of {len(plans)}): {counted(len(plan.batch.runs), 'run')}")
        summary, answers[plan.target or ""] = _run(project, plan, options)
        if summary is not None:
            summaries.append(summary)
            if summary.interrupted or (fail_fast and summary.failed):
                break
    together = _together(project, plans, summaries, options)
    if as_json:
        print_json({"targets": answers, "figures": together} if len(plans) > 1 else answers[plans[0].target or ""])
    render_summary.leave(summaries, detached=detach)


@dataclass(frozen=True, slots=True)
class Options:
    """Options of `sierra run` that are the same for all targets."""

    runner: str | None
    jobs: int | None
    only: str | None
    detach: bool
    dry_run: bool
    explain: bool
    fail_fast: bool
    retry: bool
    figures: bool
    as_json: bool


def _until(
    project: Project,
    query: list[str],
    settings: plan_query.Settings,
    target: str | None,
    engine: str | None,
    observer: Observer,
    options: Options,
    until: str | None,
    max_runs: int | None,
) -> None:
    """Execute a query with more and more runs, or only preview it."""
    from sierra.cli import run_until
    from sierra.cli.progress import watching
    from sierra.cli.render_reasons import build
    from sierra.execution.plan import session_step

    if until is None or max_runs is None:
        raise UsageError("--until and --max-runs belong together: --until 'ci(coverage) < 0.02' --max-runs 200")
    if options.detach or options.only is not None:
        name, why = ("--detach", "waits for each look") if options.detach else ("--only", "needs all experiments")
        raise UsageError(f"--until {why}; leave out {name}")
    plan = project.plans.resolve(run_until.request(project, query, settings, target), engine=engine, observer=observer)
    planned = project.studies.planned(plan, until=until, max_runs=max_runs)
    if options.dry_run or options.explain:
        run_until.show_plan(planned, json=options.as_json)
        look = run_until.next_look(project, plan, planned)
        built = build(look.build, dry_run=options.dry_run) if look.build else None
        preview = _preview(project, look, None, built, options)
        if options.dry_run:
            if options.as_json:
                print_json(run_until.answer_plan(planned, preview))
            return
    _check(project, plan, options)
    with watching(quiet=options.as_json or session_step(plan.project) is not None) as display:
        outcome = project.studies.run(
            plan,
            until=until,
            max_runs=max_runs,
            jobs=options.jobs,
            fail_fast=options.fail_fast,
            figures=options.figures,
            observer=display,
            runner=options.runner,
            planning=observer,
        )
    run_until.finish(project, outcome, json=options.as_json)


def _run(project: Project, plan: Plan, options: Options) -> tuple[Summary | None, dict[str, object]]:
    """Execute a plan, or only preview it; print the result unless it is to be JSON. Return the summary and the JSON."""
    from sierra.cli import render_summary
    from sierra.cli.progress import Display, watching
    from sierra.cli.render_reasons import build
    from sierra.design.query import condition
    from sierra.execution.plan import session_step

    selection = condition.select(options.only, plan.batch, plan.project.config) if options.only is not None else None
    more: dict[str, object] = {}
    state = plan.build
    if not options.dry_run:
        plan = project.plans.build(plan, observer=Display())
    if options.dry_run or options.explain:
        preview = _preview(project, plan, selection, build(state, dry_run=options.dry_run) if state else None, options)
        if options.dry_run:
            return None, preview.as_dict()
        more = {"reasons": preview.reasons, "new_because": preview.new_because, "proposal": preview.proposal}
        more |= {"build": preview.build} if preview.build else {}
    elif why := _again(project, plan):
        more = {"new_because": why}
    early = plan.notes if plan.batch.spec.robots is not None else ()
    for text in early:  # before anything moves
        note(text)
    with watching(quiet=options.as_json or session_step(plan.project) is not None) as display:
        summary = project.execute(
            plan,
            jobs=options.jobs,
            fail_fast=options.fail_fast,
            retry=options.retry,
            figures=options.figures,
            observer=display,
            runner=options.runner,
            detach=options.detach,
            only=options.only,
        )
    if options.as_json:
        render_summary.print_notes(summary, early)
        return summary, render_summary.answer(project, summary, more)
    render_summary.print_text(project, summary, early)
    return summary, {}


def _together(project: Project, plans: Sequence[Plan], summaries: Sequence[Summary], options: Options) -> list[str]:
    """Draw the batches of several targets together, if all were executed; print and return the files."""
    if len(plans) < 2 or not options.figures or len(summaries) < len(plans):
        return []
    if any(summary.interrupted or summary.detached for summary in summaries):
        return []
    from sierra.cli.figures import from_here

    try:
        paths, notes = project.deliverables.draw_targets([plan.target or "" for plan in plans], plans[0].batch.id)
    except SierraError as error:
        paths, notes = [], [f"the targets are not drawn together: {error}"]
    for text in notes:
        note(text)
    if not options.as_json:
        for path in paths:
            print(from_here(path))
    return list(map(str, paths))


def _preview(project: Project, plan: Plan, selection: Selection | None, built: str | None, options: Options) -> PlanPreview:
    """Return the preview of a plan, with `--explain` also its reasons; print it unless it is to be JSON.

    `built` says whether products are built.
    """
    from sierra.cli.render_reasons import PREVIEW, new_runs, text
    from sierra.execution.cluster_status import seen
    from sierra.execution.dry_run import forecast, has_other_files
    from sierra.execution.plan_json import PlanPreview
    from sierra.execution.reasons import ChangeReason, Reason

    store, explain = project.stored(), options.explain
    runs = selection.runs if selection else None
    expected = forecast(plan, store, runs, retry=options.retry)
    reasons = expected.reasons
    new = explain and reasons[Reason(ChangeReason.NEW)]
    other = explain and not plan.lacking and has_other_files(reasons)
    if new or other:
        from sierra.explain.why_new_runs import other_programs, why_new
    proposal = project.plans.estimate(plan, project.plans.runner(plan, options.runner), detach=options.detach, runs=runs)
    preview = PlanPreview(
        request=plan.request,
        batch=plan.batch.id,
        query=plan.text,
        target=plan.target,
        experiments=len(plan.batch.experiments),
        selected=len(selection.experiments) if selection else None,
        runs=len(expected.states),
        to_execute=len(expected.to_execute),
        reused=len(expected.states) - len(expected.to_execute) - len(expected.on_clusters) - len(expected.given_up),
        given_up=len(expected.given_up),
        to_reevaluate=expected.to_reevaluate,
        on_clusters=len(expected.on_clusters),
        clusters=tuple(seen(store, expected.on_clusters)) if store and expected.on_clusters else (),
        reasons={text(reason, PREVIEW): count for reason, count in reasons.most_common()},
        notes=(*plan.notes, *([f"nothing can be executed or reused here: {plan.lacking}"] if plan.lacking else [])),
        new_because=tuple(new_runs(why_new(plan, store))) if new else (),
        other_programs=tuple(difference.whole for difference in other_programs(plan, store)) if other and store else None,
        build=built,
        proposal=proposal,
    )
    if not options.as_json:
        _print(plan, preview, selection, expected.to_execute, explain=explain)
        if proposal:
            show_estimate(proposal, explain=explain, script=options.dry_run)
    for message in (*preview.notes, *(proposal.notes if proposal else ())) if options.dry_run else ():
        note(message)
    return preview


def _print(
    plan: Plan, preview: PlanPreview, selection: Selection | None, to_execute: AbstractSet[str], *, explain: bool
) -> None:
    from sierra.cli import render_status, render_summary

    print(render_summary.heading(preview.batch, preview.query, preview.target))
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
        failed = f", {preview.given_up} failed twice in the same way (--retry)" if preview.given_up else ""
        print(f"{preview.to_execute} of {counted(preview.runs, 'run')} would execute{again}{follow_up}{failed}")
    for line in render_status.lines(preview.clusters):
        print(line)


def _check(project: Project, plan: Plan, options: Options) -> None:
    """Check what can be known before the first of several batches executes. Raises SierraError."""
    _check_log(plan)
    plan.check_programs()
    project.plans.runner(plan, options.runner, detach=options.detach, jobs=options.jobs)
    project.plans.check_attended(plan, options.only)


def _check_log(plan: Plan) -> None:
    """Raise UsageError if standard error is redirected into the project's code.

    Such a log would change the code during the batch, and each run would fail when it ends.
    """
    log = plan.seen.named(STDERR)
    if log is not None:
        raise UsageError(
            f"output is redirected into the project ({log}), which would change its source and may make runs fail; "
            f"redirect it elsewhere, or let git ignore it ({plan.seen.advice([os.fsencode(log)])})"
        )


def _again(project: Project, plan: Plan) -> list[str]:
    """Print and return the reasons why runs execute again although the same query was run before."""
    from sierra.execution.reuse import is_repeated

    store = project.stored()
    if store is None or is_repeated(plan, store):
        return []
    from sierra.explain.why_new_runs import why_again

    why = [difference.whole for difference in why_again(plan, store)]
    if why:
        note(f"this query was submitted before; since then: {'; '.join(why)}")
    return why


def show_estimate(proposal: Estimate, *, explain: bool, script: bool) -> None:
    """Print an estimate; with `explain` also the reasons for its settings, with `script` also the submission script."""
    for line in _lines(proposal):
        print(line)
    if explain:
        table(
            ("setting", "value", "reason"),
            [(setting.name, "" if setting.value is None else setting.value, setting.why) for setting in proposal.settings],
        )
    if script and proposal.script is not None:
        print(f"submission script for {proposal.runner}:")
        print("".join(f"    {line}\n" for line in proposal.script.splitlines()), end="")


def _lines(proposal: Estimate) -> Iterator[str]:
    from sierra.execution.progress_display import duration

    tasks, runs = counted(proposal.array_tasks, "array task"), counted(proposal.longest, "run")
    cores = counted(proposal.cpus, "core")
    wall = "the default time" if proposal.wall_s is None else duration(proposal.wall_s)
    yield f"on {proposal.runner} ({proposal.scheduler}): {tasks} of up to {runs}, each {cores} for {wall}"
    most = "" if proposal.most_core_hours is None else f", at most {proposal.most_core_hours:.3g} (the requested time)"
    if proposal.core_hours is None:
        yield f"core-hours: unknown, no run has been timed yet{most}"
    else:
        yield f"core-hours: about {proposal.core_hours:.3g}{most}"
    wrote = "unknown size" if proposal.bytes is None else f"about {size(proposal.bytes)}"
    yield f"on the shared file system: about {proposal.files} files, {wrote}"

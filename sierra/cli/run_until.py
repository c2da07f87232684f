"""`sierra run --until`: execute a query with more and more runs until its intervals are narrow enough."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from sierra.cli.output import note, print_json, readable, table
from sierra.cli.plan_query import Settings
from sierra.errors import UsageError
from sierra.util.hashing import short

if TYPE_CHECKING:
    from sierra.api import Project
    from sierra.deliverables.studies.study import Outcome
    from sierra.design.query.query_request import QueryRequest
    from sierra.execution.plan import Plan
    from sierra.execution.plan_json import PlanPreview
    from sierra.execution.summary import Summary

COLUMNS = ("n", "value", "low", "high", "half_width", "wanted", "holds")


def request(project: Project, query: list[str], settings: Settings, target: str | None) -> QueryRequest:
    """Return the request of the first look. Raises UsageError for a query that cannot get more runs."""
    from sierra.design.query import query_request
    from sierra.stats.looks import FIRST
    from sierra.store.store import PREFIX

    if target is not None and "," in target:
        raise UsageError("--until takes one target; run the command once for each")
    if PREFIX.fullmatch(query[0].lower()) and query[0] not in project.config.queries:
        raise UsageError(f"batch {query[0]} is executed as it was recorded, with its number of runs; --until needs the query")
    if not query[0].endswith(query_request.SUFFIX):
        submitted = query_request.request(query, **settings, target=target)
    elif len(query) > 1 or target or any(value for name, value in settings.items() if name != "runs"):
        raise UsageError(f"{query[0]} is a complete request; leave out other criteria, --controller, --scenario and --set")
    else:
        submitted = query_request.read(Path(query[0])).request
        submitted = submitted.model_copy(update={"runs": settings["runs"] or submitted.runs})
    return submitted.model_copy(update={"runs": submitted.runs or FIRST})


def show_plan(outcome: Outcome, *, json: bool) -> None:
    """Print what is fixed before the first look, and the looks that are recorded, unless it is to be JSON."""
    if not json:
        _print_design(outcome)
        _print_looks(outcome)
        print()


def answer_plan(outcome: Outcome, preview: PlanPreview) -> dict[str, object]:
    """Return the JSON of a dry run: the study, and the look that would be next."""
    return {"study": outcome.as_dict(), "look": preview.as_dict()}


def next_look(project: Project, plan: Plan, outcome: Outcome) -> Plan:
    """Return the plan of the next look of a study; of a finished one, that of its last look."""
    done = len(outcome.looks)
    runs = outcome.design.schedule[done if outcome.decision == "continue" else max(done - 1, 0)]
    if done == 0 or runs == outcome.design.schedule[0]:
        return plan
    return project.plans.resolve(plan.request.model_copy(update={"runs": runs}), engine=plan.engine.name)


def finish(project: Project, outcome: Outcome, *, json: bool) -> None:
    """Print a study that was executed, and exit with its code."""
    from sierra.cli import render_summary

    summary = outcome.summary
    if json:
        if summary is not None:
            render_summary.print_notes(summary)
        batch = render_summary.answer(project, summary, {}) if summary is not None else None
        print_json({"study": outcome.as_dict(), "batch": batch})
    else:
        if summary is not None:
            render_summary.print_text(project, summary)
            print()
        print_study(outcome)
    _leave(outcome, summary)


def _leave(outcome: Outcome, summary: Summary | None) -> None:
    """Exit with the code of the study, if it is not 0."""
    from sierra.cli import render_summary

    if summary is not None:
        if summary.detached:
            note("the study continues with the same command, once the jobs have ended")
            raise typer.Exit(130)
        render_summary.leave([summary])
    if outcome.decision != "reached":
        raise typer.Exit(1)


def print_study(outcome: Outcome, *, long: bool = False) -> None:
    """Print a study for people: what was fixed, the looks with their decisions, and the last intervals."""
    _print_design(outcome)
    _print_looks(outcome, long=long)
    if not outcome.looks:
        print("no look is recorded yet; the same sierra run command continues the study")
        return
    last = outcome.looks[-1]
    names = list(next(iter(outcome.experiments.values()), {}))
    rows = [
        [*(outcome.experiments.get(interval.ordinal, {}).get(name) for name in names), interval.condition]
        + [getattr(interval, column) for column in COLUMNS]
        for interval in last.intervals
    ]
    if rows:
        print()
        table([*names, "condition", *COLUMNS], rows, right=COLUMNS[:-1])
    print(f"\n{readable(_conclusion(outcome))}")
    if outcome.problem:
        print(readable(f"the record does not follow from the store any more: {outcome.problem}"))


def _conclusion(outcome: Outcome) -> str:
    """Return the decision in words, with what to do next."""
    last, most = outcome.looks[-1].row, outcome.design.schedule[-1]
    match last.decision:
        case "reached":
            return f"reached at look {last.number} with {last.runs} runs per experiment: {last.reason}"
        case "not reached":
            need = outcome.needed
            more = f"; about {need} runs per experiment would be needed" if need else ""
            return f"not reached with {most} runs per experiment: {last.reason}{more}"
        case "stopped":
            return f"stopped at look {last.number}: {last.reason}; the same command repeats this look"
        case _:
            return f"not finished: {last.reason}; the same sierra run command continues with look {last.number + 1}"


def _print_design(outcome: Outcome) -> None:
    from sierra.deliverables.studies import wording

    made = outcome.design
    print(readable(f"study {short(made.row.study)}: {made.row.query}"))
    print(readable(f"until {made.row.rule} in every experiment; ci: half of the interval's width"))
    print(f"schedule: {wording.of_schedule(made.schedule)}")
    print(wording.of_correction(made.row.alpha, made.level, len(made.schedule)))


def _print_looks(outcome: Outcome, *, long: bool = False) -> None:
    if outcome.looks:
        rows = [
            [
                look.row.number,
                look.row.runs,
                look.row.batch if long else short(look.row.batch),
                look.row.decision,
                look.row.reason,
            ]
            for look in outcome.looks
        ]
        print()
        table(["look", "runs", "batch", "decision", "reason"], rows, right=["look", "runs"], width=0 if long else None)

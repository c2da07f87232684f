"""`sierra why`: explain why runs were executed or not."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

from sierra.cli.arguments import AsJson, ShownId
from sierra.cli.output import cell, members, print_json, readable

if TYPE_CHECKING:
    from sierra.execution.reasons import ChangeReason
    from sierra.explain.effective_executions import EffectiveRuns
    from sierra.explain.history import Cause, Event
    from sierra.explain.why_executed import Why

LINES = 10


def why(
    prefix: ShownId = None,
    as_json: AsJson = False,
) -> None:
    """Explain why runs were executed or not.

    Lists each session and each replay in order, with the reasons why it executed runs: a run was new (with the change that made
    it new), had failed, or was executed with other programs or evaluated by other rules before. Then shows which executions are
    effective. Nothing is executed.

    \b
    Examples:
      sierra why
      sierra why 9e1c
      sierra why 4fc167aa --json
    """
    from sierra.cli.open_project import given_or_last, project

    opened = project()
    answer = opened.records.why(given_or_last(prefix, opened))
    if as_json:
        print_json(_answer(answer))
    else:
        for line in lines(answer):
            print(line)


def _answer(answer: Why) -> dict[str, object]:
    from sierra.cli.render_reasons import EFFECTIVE, HISTORY, new_runs, next_run, text

    def with_reason(shown: Cause | EffectiveRuns, words: Mapping[ChangeReason, str]) -> dict[str, object]:
        return {**(members(shown) or {}), "reason": text(shown.reason, words), "change": shown.reason.kind}

    def with_causes(event: Event) -> dict[str, object]:
        return {**(members(event) or {}), "causes": [with_reason(cause, HISTORY) for cause in event.causes]}

    return {
        "kind": answer.found.kind,
        "id": answer.found.id,
        "runs": answer.runs,
        "history": [with_causes(event) for event in answer.history],
        "new_because": {batch: new_runs(runs) for batch, runs in answer.new_because.items()},
        "effective": [with_reason(each, EFFECTIVE) for each in answer.effective],
        "next_run": next_run(answer.next_run),
        "clusters": answer.clusters,
    }


def lines(answer: Why) -> Iterator[str]:
    """Yield the lines of the explanation."""
    from sierra.cli import render_status
    from sierra.cli.render_reasons import EFFECTIVE, next_run, text
    from sierra.util.hashing import short

    many = f": {_runs(answer.runs)}" if answer.found.kind in ("batch", "experiment") else ""
    yield f"{answer.found.kind} {short(answer.found.id)}{many}"
    idle = 0
    explained: set[str] = set()
    for event in answer.history:
        if (
            event.kind == "session"
            and event.ended
            and not (event.executed or event.reevaluated)
            and answer.found.kind != "execution"
        ):
            idle += 1
            continue
        yield from _event_lines(event, answer, because=event.batch not in explained)
        explained.add(event.batch)
    if idle:
        yield f"submitted again {idle} time{'s' * (idle > 1)}: no run was executed"
    if not answer.history:
        yield "it was never executed"
    yield "effective executions:"
    for runs in answer.effective[:LINES]:
        yield f"  batch {short(runs.batch)}: {_standing(runs)}{readable(text(runs.reason, EFFECTIVE))}"
    if len(answer.effective) > LINES:
        yield f"  and {len(answer.effective) - LINES} more (--json has them all)"
    yield from render_status.lines(answer.clusters)
    yield "if the query is repeated now:"
    for line in next_run(answer.next_run):
        yield f"  {readable(line)}"


def _standing(one: EffectiveRuns) -> str:
    from sierra.util.hashing import short

    if one.is_effective:
        return f"execution {short(one.execution or '')}: " if one.runs == 1 else f"{one.runs} runs: "
    return (
        "no effective execution: "
        if one.runs == 1
        else f"{one.runs} runs without an effective execution (run {short(one.run)}, …): "
    )


def _event_lines(event: Event, answer: Why, *, because: bool) -> Iterator[str]:
    from sierra.cli.render_reasons import HISTORY, new_runs, text
    from sierra.util.hashing import short

    many = answer.runs > 1
    failed = f", {event.failed} of them failed" if many else " and failed"
    reused = f", {event.reused} reused" if event.reused is not None and answer.found.kind == "batch" else ""
    counts = f"{_runs(event.executed)} " * many + "executed" + failed * bool(event.failed) + reused
    unended = "" if event.ended else ", and did not finish"
    what = "submitted" if event.kind == "session" else event.kind
    yield f"{cell(event.when)} {what} (batch {short(event.batch)}): {counts}{unended}"
    for cause in event.causes[:LINES]:
        which = (
            f"{_runs(cause.executions)} (execution {short(cause.execution)}{', …' * (cause.executions > 1)})"
            if many
            else f"execution {short(cause.execution)}"
        )
        yield f"  {which}: {readable(text(cause.reason, HISTORY))}"
        if cause.new and because:
            for line in new_runs(answer.new_because[event.batch]) if event.batch in answer.new_because else ():
                yield f"    {readable(line)}"
    if event.reevaluated:
        yield readable(f"  {_runs(event.reevaluated)} evaluated again by other rules, not executed: {event.other_rules}")
    for line in event.notes:
        yield f"  {readable(line)}"
    if len(event.causes) > LINES:
        yield f"  and {len(event.causes) - LINES} more reasons (--json has them all)"


def _runs(count: int) -> str:
    return "1 run" if count == 1 else f"{count} runs"

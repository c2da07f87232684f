"""The printed form of a session's summary, for `sierra run` and `sierra attach`."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from sierra.cli.output import note, table
from sierra.errors import Missing
from sierra.util.hashing import short
from sierra.util.kept_log import last_lines
from sierra.util.text import counted

if TYPE_CHECKING:
    from sierra.api import Project
    from sierra.execution.cluster_status import ClusterSession
    from sierra.execution.summary import Summary

COUNTED = ("runs", "succeeded", "accepted", "failed")


def print_notes(summary: Summary, printed: Collection[str] = ()) -> None:
    """Print the notes of a summary, without those that were printed before."""
    for text in summary.notes:
        if text not in printed:
            note(text)


def print_text(project: Project, summary: Summary, printed: Collection[str] = ()) -> None:
    """Print a summary for people; `printed` are notes that were printed before."""
    print_notes(summary, printed)
    _print(summary, project.jobs.left(summary))


def answer(project: Project, summary: Summary, more: Mapping[str, object]) -> dict[str, object]:
    """Return a summary for JSON, together with `more`."""
    return {**_answer(summary), "detached": [_left(session) for session in project.jobs.left(summary)], **more}


def leave(summaries: Sequence[Summary], *, detached: bool = False) -> None:
    """Exit with the code for these results, if it is not 0."""
    if any(one.interrupted for one in summaries):
        raise typer.Exit(130)
    if any(one.failed or (one.missing > one.left_out and not detached) for one in summaries):
        raise typer.Exit(1)
    for one in summaries:
        if one.figure_error:
            raise Missing(one.figure_error)


def heading(batch: str, query: str, target: str | None) -> str:
    """Return the first line about a batch."""
    return f"batch {short(batch)}{f' (target {target})' if target else ''}: {query}"


def _left(one: ClusterSession) -> dict[str, object]:
    names = ("session", "runner", "scheduler", "jobs", "array_tasks", "runs", "since")
    return {name: getattr(one, name) for name in names}


def _answer(summary: Summary) -> dict[str, object]:
    names = (
        "batch",
        "query",
        "target",
        "experiments",
        "runs",
        "executed",
        "reexecuted",
        "reused",
        "awaited",
        "reevaluated",
        "failed",
        "missing",
        "selected",
        "left_out",
        "interrupted",
    )
    answer: dict[str, object] = {name: getattr(summary, name) for name in names}
    answer["figures"] = list(summary.figures)
    answer["counts"] = [{**counted.values, **{name: getattr(counted, name) for name in COUNTED}} for counted in summary.counts]
    answer["outcomes"] = dict(summary.outcomes)
    answer["failures"] = [asdict(failure) for failure in summary.failures]
    answer["outputs"] = asdict(summary.outputs) if summary.outputs else None
    answer["notes"] = list(summary.notes)
    answer["figure_error"] = summary.figure_error
    return answer


def _print(summary: Summary, left: Sequence[ClusterSession]) -> None:
    from sierra.cli import ask_detach, render_outputs
    from sierra.cli.figures import from_here

    print(heading(summary.batch, summary.query, summary.target))
    axes = list(summary.counts[0].values)
    names = [name for name in COUNTED if name != "accepted" or any(counts.accepted for counts in summary.counts)]
    rows = [[*counts.values.values(), *(getattr(counts, name) for name in names)] for counts in summary.counts]
    table([*axes, *names], rows, right=names)
    failed = f", {summary.failed} failed" if summary.failed else ""
    wanted = summary.missing - summary.left_out
    missing = f", {wanted} {'pending' if left else 'not executed'}" if wanted else ""
    others = f", {summary.left_out} left out" if summary.left_out else ""
    awaited = f" ({summary.awaited} executed meanwhile by another session)" if summary.awaited else ""
    judged = f" ({summary.reevaluated} evaluated again by the changed [outputs] or [success])" if summary.reevaluated else ""
    runs = counted(summary.runs, "run")
    if summary.selected is not None:
        print(f"{summary.selected} of {counted(summary.experiments, 'experiment')} selected by --only")
    print(f"{runs}: {summary.executed} executed, {summary.reused} reused{awaited}{failed}{missing}{others}{judged}")
    if summary.outcomes:
        ends = ", ".join(f"{end} in {count}" for end, count in summary.outcomes.items())
        print(f"ended as [success] accept names: {ends} of {runs}")
    if summary.outputs:
        print("\n".join(render_outputs.short_lines(summary.outputs)))
    _print_failures(summary)
    if left:
        print("\n".join(ask_detach.lines(left, summary.batch)))
    elif summary.interrupted:
        print("interrupted: finished runs are recorded; run the same command again to continue")
    if summary.figures:
        print("figures:")
        for files in _by_figure(summary.figures):
            others = ", ".join(path.suffix for path in files[1:])
            print(f"  {from_here(files[0])}{others and f' (and {others})'}")


def _by_figure(paths: Iterable[str]) -> Iterable[list[Path]]:
    """Return the files of each figure, one for each format."""
    found: dict[Path, list[Path]] = {}
    for path in map(Path, paths):
        found.setdefault(path.with_suffix(""), []).append(path)
    return found.values()


def _print_failures(summary: Summary) -> None:
    for failure in summary.failures:
        values = ", ".join(f"{name}={value}" for name, value in failure.experiment.items())
        several = f"{failure.count} runs failed, e.g." if failure.count > 1 else "failed:"
        print(f"{several} {short(failure.run)} ({values}, run {failure.number}): {failure.reason}")
        for line in last_lines(failure.log or "", 5):
            print(f"    {line}")
    more = summary.failed - sum(failure.count for failure in summary.failures)
    if more > 0:
        print(f"and {more} more for other reasons (see sierra show {short(summary.batch)})")

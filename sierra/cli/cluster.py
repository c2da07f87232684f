"""`sierra status`, `sierra attach`, `sierra cancel`: what was submitted to a cluster, from any shell, day or login node."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from sierra.adopting import Cancelled
    from sierra.standing import Standing

COLUMNS = ("batch", "query", "session", "runner", "jobs", "elements", "done", "failed", "runs", "state", "followed by", "since")


def status(
    prefix: Annotated[
        str | None, typer.Argument(metavar="HASH", help="A batch, or a session, by the beginning of its id (default: all).")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON list instead.")] = False,
) -> None:
    """Say what is on clusters, and how it stands.

    What has finished of that is recorded first, where no other process follows. The scheduler is asked once.

    \b
    Examples:
      sierra status
      sierra status 774d --json
    """
    from sierra.cli import opened
    from sierra.cli.output import note, print_json, table

    found = opened.project().status(prefix, say=note)
    if as_json:
        print_json([asdict(one) for one in found])
    elif found:
        table(COLUMNS, [_row(one) for one in found], right=("elements", "done", "failed", "runs"))
    else:
        print("nothing is on a cluster" if prefix is None else f"nothing of {prefix} is on a cluster")


def attach(
    prefix: Annotated[
        str, typer.Argument(metavar="HASH", help="A batch, or a session of `sierra status`, by the beginning of its id.")
    ],
    figures: Annotated[
        bool | None, typer.Option("--figures/--no-figures", help="Draw figures, or nothing (default: figures).")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead.")] = False,
) -> None:
    """Follow to its end what is on a cluster and nobody follows.

    What finishes is recorded, what is lost is submitted again; then the figures are drawn, and all is summed up as by
    sierra run. Ctrl-C asks whether it is to go on by itself.

    \b
    Example:
      sierra attach 774d
    """
    from sierra import settings
    from sierra.cli import opened, summaries
    from sierra.cli.output import note
    from sierra.cli.progress import watching

    project = opened.project()
    drawn = settings.load().figures if figures is None else figures
    with watching(quiet=as_json) as display:
        summary = project.attach(prefix, figures=drawn, watch=display.show, say=note, leave=display.leave)
    summaries.tell(project, summary, {} if as_json else None)


def cancel(
    prefix: Annotated[
        str, typer.Argument(metavar="HASH", help="A batch, or a session of `sierra status`, by the beginning of its id.")
    ],
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON list instead.")] = False,
) -> None:
    """Cancel what is on a cluster; what had finished is recorded.

    \b
    Example:
      sierra cancel 774d
    """
    from sierra.cli import opened
    from sierra.cli.output import note, print_json

    done = opened.project().cancel(prefix, say=note)
    if as_json:
        print_json([asdict(one) for one in done])
        return
    for one in done:
        print(_cancelled(one))


def _row(one: Standing) -> Sequence[Any]:
    from sierra.cli.output import readable
    from sierra.hashing import short
    from sierra.wording import few

    return (
        short(one.batch),
        readable(one.query or "(a replay)"),
        one.session,
        one.runner,
        few(one.jobs, 3) or "not known",
        one.elements,
        one.done,
        one.failed,
        one.runs,
        readable(_state(one)),
        one.attended or "",
        one.since,
    )


def _state(one: Standing) -> str:
    """How its elements stand, in a few words."""
    if one.ended:
        return "ended"
    words = ["cancelled"] if one.cancelled else []
    if one.queued is None:
        words.append("unreachable")
    elif one.queued or one.running:
        words += [f"{count} {what}" for count, what in ((one.queued, "queued"), (one.running, "running")) if count]
    elif not one.stuck:
        words.append("gone; sierra attach goes on with what is missing" if not one.attended else "gone")
    if one.stuck:
        words.append(f"never begins: {one.stuck}")
    return ", ".join(words)


def _cancelled(one: Cancelled) -> str:
    from sierra.wording import counted

    ending = f"; {one.ending} is still ending it" if one.ending else ""
    failed = f" ({one.failed} of them failed)" if one.failed else ""
    return f"session {one.session}: {counted(one.kept, 'run')} kept{failed}, {one.missing} not executed{ending}"

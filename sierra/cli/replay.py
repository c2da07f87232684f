"""`sierra replay`: the same numbers, or where they part."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from sierra.replay import Compared, Replay

SHOWN = 10


def replay(
    prefix: Annotated[
        str, typer.Argument(metavar="HASH", help="A batch, experiment, run or execution, by the beginning of its id.")
    ],
    runs: Annotated[int | None, typer.Option("--runs", metavar="K", help="The first K runs of each experiment alone.")] = None,
    jobs: Annotated[int | None, typer.Option("-j", "--jobs", metavar="N", help="Runs at a time (default: cores).")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead.")] = False,
) -> None:
    """Execute recorded runs again, from the record alone, and compare.

    The recorded source is restored to a folder of its own, inputs come from the store. Each output is identical (the same
    bytes), equal (the same values), within tolerance (as declared in sierra.toml), or different: then where, and how far.
    The exit code is 0 if nothing is different or failed.

    \b
    Examples:
      sierra replay 774d
      sierra replay 774d --runs 2 --json
    """
    from sierra.cli import opened
    from sierra.cli.output import note, print_json
    from sierra.cli.progress import watching

    project = opened.project()
    with watching(quiet=as_json) as watch:
        answer = project.replay(prefix, runs=runs, jobs=jobs, watch=watch)
    if as_json:
        print_json(_answer(answer))
    else:
        for text in answer.notes:
            note(text)
        _print(answer)
    if answer.interrupted:
        raise typer.Exit(130)
    if not answer.verdict.fine:
        raise typer.Exit(1)


def _answer(answer: Replay) -> dict[str, Any]:
    return {
        "replay": answer.id,
        "kind": answer.found.kind,
        "target": answer.found.id,
        "verdict": None if answer.interrupted else answer.verdict,
        "runs": len(answer.runs),
        "counts": {str(verdict): count for verdict, count in answer.counts.items()},
        "notes": list(answer.notes),
        "interrupted": answer.interrupted,
        "outputs": [
            {
                "run": run.taken.run,
                "experiment": run.taken.experiment,
                "number": run.taken.number,
                "path": path,
                **asdict(found),
            }
            for run in answer.runs
            for path, found in run.outputs.items()
        ],
    }


def _print(answer: Replay) -> None:
    from sierra.hashing import short

    if answer.interrupted:
        print("interrupted: nothing was compared")
        return
    told = [run for run in answer.runs if run.verdict != "identical"]
    for run in told[:SHOWN]:
        _print_run(run)
    if len(told) > SHOWN:
        print(f"and {len(told) - SHOWN} more (--json has them all)")
    counts = ", ".join(f"{count} {verdict}" for verdict, count in sorted(answer.counts.items()))
    print(f"{answer.found.kind} {short(answer.found.id)}: {answer.verdict} ({len(answer.runs)} runs: {counts})")


def _print_run(run: Compared) -> None:
    from sierra.hashing import short

    for path, agreement in run.outputs.items():
        if agreement.verdict != "identical":
            where = f" {path}" if path else ""
            print(f"{agreement.verdict}: run {short(run.taken.run)} (number {run.taken.number}){where}: {agreement.why}")
            if agreement.growth and not agreement.verdict.fine:
                print(f"    apart in each tenth of the rows: {', '.join(f'{far:.3g}' for far in agreement.growth)}")

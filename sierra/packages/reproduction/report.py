"""The reports on a reproduction: `reproduction.md` for people, and `reproduction.json` for programs."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from sierra.deliverables.claims.model import Evaluated
from sierra.packages.reproduction.outcome import ReproducedBatch, Reproduction
from sierra.packages.reproduction.workspace import REPORT
from sierra.store.segments import disk_errors
from sierra.util.fs import write_whole
from sierra.util.hashing import short
from sierra.util.text import one_line

if TYPE_CHECKING:
    from sierra.packages.reproduction.drawn_again import DrawnAgain

FORMAT = "sierra reproduction 1"
SHOWN = 20
"""Runs with different outputs that the report names for each batch."""


def write(done: Reproduction) -> None:
    """Write both reports to the folder of the reproduction. Raises Missing if the disk is full."""
    with disk_errors(done.folder):
        write_whole(done.folder / f"{REPORT}.json", (json.dumps(as_json(done), indent=2) + "\n").encode())
        write_whole(done.folder / f"{REPORT}.md", ("\n".join(_lines(done)) + "\n").encode())


def as_json(done: Reproduction) -> dict[str, Any]:
    """Return a reproduction as values of JSON."""
    return {
        "format": FORMAT,
        "package": done.package,
        "title": done.title,
        "verdict": done.verdict,
        "exit_code": done.exit_code,
        "folder": str(done.folder),
        "notes": list(done.notes),
        "left_out": list(done.left_out),
        "batches": [_batch(batch) for batch in done.batches],
        "claims": [_claim(done, claim) for claim in done.claims],
        "drawn": [_drawn(deliverable) for deliverable in done.drawn],
        "numbers": {name: {"recorded": before, "reproduced": now} for name, (before, now) in done.numbers.items()},
    }


def _batch(batch: ReproducedBatch) -> dict[str, Any]:
    replay = batch.replay
    return {
        "batch": batch.planned.batch,
        "query": batch.planned.query,
        "verdict": str(replay.verdict) if replay and not replay.interrupted else None,
        "interrupted": bool(replay and replay.interrupted),
        "executed": batch.executed,
        "runs": batch.planned.of,
        "complete": batch.complete,
        "reason": batch.reason,
        "engine": batch.planned.engine if replay else None,
        "replay": replay.id if replay else None,
        "counts": {str(verdict): count for verdict, count in replay.counts.items()} if replay else {},
        "notes": list(replay.notes) if replay else [],
        "experiments": [
            {"experiment": each.id, "values": dict(each.values), "verdict": str(each.verdict), "runs": len(each.runs)}
            for each in (replay.experiments if replay else ())
        ],
    }


def _drawn(one: DrawnAgain) -> dict[str, Any]:
    found = {name: getattr(one, name) for name in ("kind", "name", "batches", "same", "difference", "problem")}
    return {**found, "reproduced": one.reproduced is not None}


def _claim(done: Reproduction, claim: Evaluated) -> dict[str, Any]:
    return {
        "name": claim.name,
        "says": claim.says,
        "shown": claim.shown,
        "verdict": str(claim.verdict),
        "registered": str(claim.registered),
        "registration": claim.registration.reason,
        "ground": str(claim.ground),
        "text": claim.text,
        "n": claim.n,
        "batches": list(claim.batches),
        "executed": executed(done, claim.batches),
    }


def executed(done: Reproduction, batches: Sequence[str]) -> str:
    """Return how many runs of these batches were executed again, in words."""
    known = [one for one in done.batches if one.planned.batch in batches]
    return f"{sum(one.executed for one in known):,} of {sum(one.planned.of for one in known):,} runs executed again"


CLAIMS = ("| claim | verdict | registered | numbers | n | ground |", "| --- | --- | --- | --- | --- | --- |")


def _lines(done: Reproduction) -> Iterator[str]:
    yield f"# Reproduction of {_text(done.title) or 'a package'}"
    yield ""
    yield f"**{done.verdict}**"
    yield ""
    yield f"Package: `{done.package}`"
    if done.claims:
        yield from ("", "## Claims", "", *CLAIMS)
        for claim in done.claims:
            ground = f"{claim.ground} ({executed(done, claim.batches)})"
            cells = (
                f"{claim.name}: {_text(claim.says)}",
                f"**{claim.verdict}**",
                str(claim.registered),
                _text(claim.text),
                str(claim.n),
                ground,
            )
            yield f"| {' | '.join(cells)} |"
    yield from ("", "## Batches", "")
    for batch in done.batches:
        yield from _of_batch(batch)
    if done.drawn:
        lines = [f"{deliverable.kind} {deliverable.name}: {_compared(deliverable)}" for deliverable in done.drawn]
        yield from _listed("Figures, tables and comparisons (see index.html)", lines)
    changed = [f"{name}: {before}, now {now}" for name, (before, now) in done.numbers.items() if before != now]
    same = [f"{len(done.numbers) - len(changed)} of {len(done.numbers)} are the same"] if done.numbers else []
    yield from _listed("Numbers in the text", [*same, *changed])
    yield from _listed("Left out", done.left_out)
    yield from _listed("Notes", [f"{short(batch.planned.batch)}: {note}" for batch in done.batches for note in _notes(batch)])
    yield from _listed("Notes on the package", done.notes)


def _compared(one: DrawnAgain) -> str:
    """Return how a deliverable from the reproduced runs differs from that of the recorded ones, in words."""
    if one.problem:
        return f"not made: {one.problem}"
    return "the same values" if one.same else f"other values: {one.difference}"


def _notes(one: ReproducedBatch) -> Sequence[str]:
    return one.replay.notes if one.replay else ()


def _of_batch(batch: ReproducedBatch) -> Iterator[str]:
    yield f"- batch {short(batch.planned.batch)} ({_text(batch.planned.query)}): **{_text(batch.verdict)}**"
    if batch.replay is None:
        return
    counts = Counter(str(run.verdict) for run in batch.replay.runs)
    yield f"  - executed {batch.planned.place}: {', '.join(f'{count} {verdict}' for verdict, count in sorted(counts.items()))}"
    bad = [(run, path, output) for run in batch.replay.runs for path, output in run.outputs.items() if not output.verdict.fine]
    for run, path, output in bad[:SHOWN]:
        where = f" {_text(path)}" if path else ""
        yield f"  - {output.verdict}: run {short(run.taken.run)} (number {run.taken.number}){where}: {_text(output.reason)}"
    if len(bad) > SHOWN:
        yield f"  - {len(bad) - SHOWN:,} more outputs that differ"


def _listed(title: str, lines: Sequence[str]) -> Iterator[str]:
    if lines:
        yield from ("", f"## {title}", "")
        yield from (f"- {_text(line)}" for line in lines)


def _text(text: object) -> str:
    """Return a text that a package may have made, as one line without marks of Markdown and HTML."""
    return "".join(f"\\{sign}" if sign in r"\`*_[]<>|#~" else sign for sign in one_line(text))

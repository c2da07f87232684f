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
        "batches": [_batch(one) for one in done.batches],
        "claims": [_claim(done, one) for one in done.claims],
        "drawn": [_drawn(one) for one in done.drawn],
        "numbers": {name: {"recorded": before, "reproduced": now} for name, (before, now) in done.numbers.items()},
    }


def _batch(one: ReproducedBatch) -> dict[str, Any]:
    replay = one.replay
    return {
        "batch": one.planned.batch,
        "query": one.planned.query,
        "verdict": str(replay.verdict) if replay and not replay.interrupted else None,
        "interrupted": bool(replay and replay.interrupted),
        "executed": one.executed,
        "runs": one.planned.of,
        "complete": one.complete,
        "reason": one.reason,
        "engine": one.planned.engine if replay else None,
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


def _claim(done: Reproduction, one: Evaluated) -> dict[str, Any]:
    return {
        "name": one.name,
        "says": one.says,
        "shown": one.shown,
        "verdict": str(one.verdict),
        "registered": str(one.registered),
        "registration": one.registration.reason,
        "ground": str(one.ground),
        "text": one.text,
        "n": one.n,
        "batches": list(one.batches),
        "executed": executed(done, one.batches),
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
        for one in done.claims:
            ground = f"{one.ground} ({executed(done, one.batches)})"
            cells = (
                f"{one.name}: {_text(one.says)}",
                f"**{one.verdict}**",
                str(one.registered),
                _text(one.text),
                str(one.n),
                ground,
            )
            yield f"| {' | '.join(cells)} |"
    yield from ("", "## Batches", "")
    for batch in done.batches:
        yield from _of_batch(batch)
    if done.drawn:
        lines = [f"{one.kind} {one.name}: {_found(one)}" for one in done.drawn]
        yield from _listed("Figures, tables and comparisons (see index.html)", lines)
    changed = [f"{name}: {before}, now {now}" for name, (before, now) in done.numbers.items() if before != now]
    same = [f"{len(done.numbers) - len(changed)} of {len(done.numbers)} are the same"] if done.numbers else []
    yield from _listed("Numbers in the text", [*same, *changed])
    yield from _listed("Left out", done.left_out)
    yield from _listed("Notes", [f"{short(one.planned.batch)}: {note}" for one in done.batches for note in _notes(one)])
    yield from _listed("Notes on the package", done.notes)


def _found(one: DrawnAgain) -> str:
    """Return how a deliverable from the reproduced runs differs from that of the recorded ones, in words."""
    if one.problem:
        return f"not made: {one.problem}"
    return "the same values" if one.same else f"other values: {one.difference}"


def _notes(one: ReproducedBatch) -> Sequence[str]:
    return one.replay.notes if one.replay else ()


def _of_batch(one: ReproducedBatch) -> Iterator[str]:
    yield f"- batch {short(one.planned.batch)} ({_text(one.planned.query)}): **{_text(one.verdict)}**"
    if one.replay is None:
        return
    counts = Counter(str(run.verdict) for run in one.replay.runs)
    yield f"  - executed {one.planned.place}: {', '.join(f'{count} {verdict}' for verdict, count in sorted(counts.items()))}"
    bad = [(run, path, found) for run in one.replay.runs for path, found in run.outputs.items() if not found.verdict.fine]
    for run, path, found in bad[:SHOWN]:
        where = f" {_text(path)}" if path else ""
        yield f"  - {found.verdict}: run {short(run.taken.run)} (number {run.taken.number}){where}: {_text(found.reason)}"
    if len(bad) > SHOWN:
        yield f"  - {len(bad) - SHOWN:,} more outputs that differ"


def _listed(title: str, lines: Sequence[str]) -> Iterator[str]:
    if lines:
        yield from ("", f"## {title}", "")
        yield from (f"- {_text(line)}" for line in lines)


def _text(text: object) -> str:
    """Return a text that a package may have made, as one line without marks of Markdown and HTML."""
    return "".join(f"\\{sign}" if sign in r"\`*_[]<>|#~" else sign for sign in one_line(text))

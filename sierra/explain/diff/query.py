"""Differences of the query and of the parts that runs are made from: spec, template, files beside the inputs, seeds."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence

from sierra.execution import around
from sierra.explain.diff.load_sides import ComparedRuns
from sierra.explain.diff.model import ARROW, Difference, changed, shown
from sierra.model import Value
from sierra.store.row_types import SharedFileRow
from sierra.store.store import Snapshot
from sierra.util.text import few

SHOWN = 8
QUOTED = frozenset(" \t\r\n\"'\\")
"""Characters that `shlex` does not read as a part of a word."""


def query(before: ComparedRuns, after: ComparedRuns, pairs: Sequence[tuple[int, int]]) -> Iterator[Difference]:
    """Yield differences of axes, values, number of runs, controller, scenario and --set."""
    if before.found.kind == "batch":
        yield from changed("query", "axes", before.batch.axes, after.batch.axes)
        yield from _values(before, after)
        yield from _cells(before, after, pairs)
    else:
        old, new = (next(iter(side.cells.values())) for side in (before, after))
        for name in dict.fromkeys((*old, *new)):
            if name not in ("controller", "scenario"):
                yield from changed("query", name, old.get(name), new.get(name))
    for name in ("controller", "scenario"):
        yield from changed("query", name, _whole(before, name), _whole(after, name))
    yield from changed("query", "target", *(side.target for side in (before, after)))
    if not before.is_one:
        yield from changed("query", "runs", _runs(before), _runs(after), called="runs per experiment")
    old_sets, new_sets = before.batch.overrides, after.batch.overrides
    for change in (*old_sets, *new_sets):
        if (change in old_sets) != (change in new_sets):
            what = "was removed" if change in old_sets else "was added"
            was, now = (change if change in sets else None for sets in (old_sets, new_sets))
            yield Difference("query", "set", f"--set {change} {what}", was, now)


def _whole(side: ComparedRuns, name: str) -> Value | None:
    """Return a controller or a scenario if it is the same in all experiments, else None."""
    values = {cell.get(name) for cell in side.cells.values()}
    return values.pop() if len(values) == 1 else None


def _runs(side: ComparedRuns) -> int | float:
    each = side.runs / max(1, len(side.cells))
    return int(each) if each.is_integer() else each


def _values(before: ComparedRuns, after: ComparedRuns) -> Iterator[Difference]:
    """Yield differences of the values of the axes that both sides have."""
    for axis in before.batch.axes:
        if axis in after.batch.axes:
            old, new = (list(dict.fromkeys(cell[axis] for cell in side.cells.values())) for side in (before, after))
            for difference in changed("query", axis, old, new):
                line = f"{axis}: {few([shown(v) for v in old], SHOWN)} {ARROW} {few([shown(v) for v in new], SHOWN)}"
                yield Difference("query", axis, line, old, new, difference.details)


def _cells(before: ComparedRuns, after: ComparedRuns, pairs: Sequence[tuple[int, int]]) -> Iterator[Difference]:
    """Yield a difference with the experiments that only one side has."""
    only = [
        [_called(side, ordinal) for ordinal in side.cells if ordinal not in shared]
        for side, shared in zip((before, after), map(set, zip(*pairs, strict=True)) if pairs else ((), ()), strict=True)
    ]
    if any(only) and (len(before.batch.axes) > 1 or before.batch.axes != after.batch.axes):
        line = f"experiments: {len(before.cells)} {ARROW} {len(after.cells)}, {len(pairs)} of them in both"
        details = (*(f"removed: {name}" for name in only[0]), *(f"added: {name}" for name in only[1])) if pairs else ()
        yield Difference("query", "experiments", line, only[0], only[1], details)


def _called(side: ComparedRuns, ordinal: int) -> str:
    return " ".join(f"{name}={shown(side.cells[ordinal][name])}" for name in side.batch.axes)


def spec(before: ComparedRuns, after: ComparedRuns) -> Iterator[Difference]:
    """Yield differences of the spec, without source and image, and for batches of the template."""
    old, new = before.spec, after.spec
    yield from changed("platform", "platform", old.platform, new.platform)
    yield from changed("command", "command", _line(old.command), _line(new.command))
    was, now = map(around.described, (old, new))
    for name in sorted(was.keys() | now.keys()):
        yield from changed("command", name, was.get(name), now.get(name))
    for name in sorted(old.environment.keys() | new.environment.keys()):
        yield from changed("variables", name, old.environment.get(name), new.environment.get(name))
    if before.found.kind == "batch":
        yield from changed("template", "template", before.batch.template, after.batch.template)
        yield from _template(before, after)


def _line(words: Sequence[str]) -> str:
    """Return a command as it is written in `sierra.toml`: only words with blanks or quotes are quoted."""
    return " ".join(word if word and not set(word) & QUOTED else shlex.quote(word) for word in words)


def _template(before: ComparedRuns, after: ComparedRuns) -> Iterator[Difference]:
    was, now = (side.batch.template_sha256 for side in (before, after))
    if was != now and before.batch.template and after.batch.template:
        yield Difference("template", "sha256", f"template: {after.batch.template} has changed", was, now)


BESIDE = "SELECT * FROM shared_files WHERE shared = $s ORDER BY name"


def files_beside(snapshot: Snapshot, before: ComparedRuns, after: ComparedRuns) -> Iterator[Difference]:
    """Yield a difference for each file beside the inputs (`files` in `sierra.toml`) that differs."""
    was, now = ({row.name: row for row in _beside(snapshot, side)} for side in (before, after))
    for name in sorted(was.keys() | now.keys()):
        old, new = was.get(name), now.get(name)
        if old is None or new is None:
            yield Difference("inputs", name, f"file beside the inputs: {name} was {'removed' if old else 'added'}")
        elif old.sha256 != new.sha256:
            yield Difference("inputs", name, f"file beside the inputs: {name} has changed", old.sha256, new.sha256)
        elif old.executable != new.executable:
            word = "is executable now" if new.executable else "is not executable any more"
            yield Difference("inputs", name, f"file beside the inputs: {name} {word}")


def _beside(snapshot: Snapshot, side: ComparedRuns) -> Sequence[SharedFileRow]:
    if side.plan:
        return side.plan.shared_files
    snapshot.views.make(("shared_files",))
    return snapshot.select(SharedFileRow, BESIDE, s=side.spec.shared_files or "")


def base_seed(before: ComparedRuns, after: ComparedRuns) -> Iterator[Difference]:
    """Yield the difference of the base seed of two batches or experiments."""
    if not before.is_one:
        yield from changed("seed", "base", before.batch.base_seed, after.batch.base_seed, called="base seed")


def seeds(snapshot: Snapshot, before: ComparedRuns) -> Iterator[Difference]:
    """Yield the difference of the seeds of paired runs."""
    [(count, others, was, now)] = snapshot.run(
        "SELECT count(*), count(*) FILTER (was_seed <> now_seed), "
        "arg_min(was_seed, (ordinal, number)) FILTER (was_seed <> now_seed), "
        "arg_min(now_seed, (ordinal, number)) FILTER (was_seed <> now_seed) FROM both_sides"
    )
    if others:
        where = "" if before.is_one else f" (in {others} of {count} runs; this is the first)"
        yield Difference("seed", "seed", f"seed: {was} {ARROW} {now}{where}", was, now)

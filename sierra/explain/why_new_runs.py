"""Reasons for new runs: differences between a plan and the most similar recorded batch."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator
from typing import Any

from sierra.containers import images
from sierra.containers.images.diff import files, packages
from sierra.containers.images.image_contents import Contents
from sierra.containers.session_containers import other_host_access
from sierra.errors import Damaged, Missing, NotFound, SierraError
from sierra.execution import plan_from_record
from sierra.execution.records import batch_row, is_kept
from sierra.execution.resolve_plan import Plan
from sierra.model import Value
from sierra.provenance import fingerprint_programs, source
from sierra.provenance.dependency_model import mentioned
from sierra.provenance.source import suggest_exclusions
from sierra.provenance.source.manifest import changed
from sierra.query import grammar, ranges
from sierra.store.store import Store
from sierra.util.hashing import short
from sierra.util.text import few

LIKE = """
SELECT b.*, r.command, r.variables, r.source, r.image, r.host_access
FROM batches b JOIN specs r USING (spec) LEFT JOIN (SELECT batch, max(lamport) AS asked FROM sessions GROUP BY batch) s
USING (batch)
WHERE b.axes = $axes AND b.batch <> $batch
ORDER BY coalesce(s.asked, b.lamport) DESC LIMIT 1
"""
KNOWN = """
SELECT (SELECT count(*) FROM batches WHERE batch = $batch) AS kept,
       (SELECT arg_max(programs, lamport) FROM sessions WHERE batch = $batch) AS programs
"""
SHOWN = 10
ASKED = ("query", "runs", "controller", "scenario", "base_seed")
CHANGES = "sierra.toml changes the template differently (variables, changes, controllers, scenarios, seed, platforms)"


def why_new(plan: Plan, store: Store | None) -> list[str]:
    """Return the differences between a plan and the last batch over the same axes, one line each."""
    if store is None:
        return ["the store is still empty"]
    if is_kept(plan, store):
        return ["this batch is recorded; an earlier session ended before it executed these runs"]
    rows = store.rows(LIKE, axes=[axis.name for axis in plan.batch.axes], batch=plan.batch.id)
    if not rows:
        return ["no batch with these variables is recorded"]
    before = rows[0]
    lines = [*_made_from(plan, store, before), *_asked(plan, before)]
    return [f"compared with batch {short(before['batch'])} ({before['query']}):", *(lines or [CHANGES])]


def why_other(plan: Plan, store: Store, batch: str) -> list[str]:
    """Return the differences between a plan and a recorded batch, one line each."""
    [before] = store.rows("SELECT b.*, r.* EXCLUDE (spec) FROM batches b JOIN specs r USING (spec) WHERE b.batch = $b", b=batch)
    return [*_made_from(plan, store, before), *_asked(plan, before)] or [CHANGES]


def why_again(plan: Plan, store: Store | None) -> list[str]:
    """Return the reasons why a repeated query executes runs again.

    The list is empty for a query that is not a repetition, or that executes nothing again.
    """
    if store is None:
        return []
    [known] = store.rows(KNOWN, batch=plan.batch.id)
    if known["kept"]:
        return other_programs(plan, store) if known["programs"] not in (None, plan.programs.id) else []
    rows = store.rows(LIKE, axes=[axis.name for axis in plan.batch.axes], batch=plan.batch.id)
    if not rows or _asked(plan, rows[0]):
        return []
    return list(_made_from(plan, store, rows[0])) or [CHANGES]


SPELLED = """
SELECT batch, query FROM batches
WHERE axes = $axes AND spec = $spec AND template_sha256 = $template_sha256 AND base_seed = $base_seed AND overrides = $overrides
    AND controller IS NOT DISTINCT FROM $controller AND scenario IS NOT DISTINCT FROM $scenario
    AND NOT EXISTS (SELECT 1 FROM batches WHERE batch = $batch)
ORDER BY lamport DESC, batch LIMIT $most
"""
SHARED = "SELECT 1 FROM batch_runs WHERE batch = $batch AND list_contains($runs, run) LIMIT 1"
LOOKED_AT = 100


def respelled(plan: Plan, store: Store) -> Iterator[str]:
    """Yield a line if runs are new only because a number is written differently than in a recorded batch, such as 0.0 for 0.

    Numbers are kept as they are written, because a simulator may distinguish them (roslaunch takes 1 for an int, 1.0 for a
    double).
    """
    if not any(isinstance(value, int | float) for axis in plan.batch.axes for value in axis.values):
        return
    row = batch_row(plan)
    names = ("axes", "spec", "template_sha256", "base_seed", "overrides", "controller", "scenario", "batch")
    for before in store.rows(SPELLED, most=LOOKED_AT, **{name: row[name] for name in names}):
        found = _spelled_otherwise(plan, before["query"])
        if found is None:
            continue
        name, now, then = found
        runs = [one.runs[0].id for one in plan.batch.experiments if one.values[name] == now]
        if not store.rows(SHARED, batch=before["batch"], runs=runs):
            yield (
                f"{name}={now} is written {then} in batch {short(before['batch'])} ({before['query']}), "
                f"so the input has different bytes and runs are new; write {name}={then} to reuse the recorded runs"
            )
            return


def _spelled_otherwise(plan: Plan, before: str) -> tuple[str, Value, Value] | None:
    """Return an axis and one of its values, now and in another query, if the same number is written differently; else None."""
    with contextlib.suppress(SierraError):  # densities have values only with a template
        asked = {one.name: ranges.values(one.scale) for one in grammar.parse_all(before.split())}
        for axis in plan.batch.axes:
            theirs = {value: value for value in asked[axis.name]}
            for value in axis.values:
                if str(then := theirs.get(value, value)) != str(value):
                    return axis.name, value, then
    return None


def _made_from(plan: Plan, store: Store, before: dict[str, Any]) -> Iterator[str]:
    """Yield the differences in command, variables, platform, image, source and template."""
    yield from _recipe(plan, before)
    yield from _image(plan, store, before)
    if before["source"] != plan.batch.spec.source:
        yield from _source(plan, store, before["source"])
    if before["template_sha256"] != plan.template_sha256:
        yield f"the template {plan.project.config.template} has changed"


PROGRAMS = """
SELECT name, kind, version, sha256 FROM programs
WHERE programs = (
    SELECT arg_max(programs, lamport) FROM executions JOIN batch_runs USING (run)
    WHERE batch_runs.batch = $batch AND purpose = 'run'
)
"""


def other_programs(plan: Plan, store: Store) -> list[str]:
    """Return the programs that differ from those of the batch's last execution, one line each."""
    words = mentioned(plan.batch.spec.command, plan.project.root)
    return list(fingerprint_programs.differences(store.rows(PROGRAMS, batch=plan.batch.id), plan.programs, words))


def _recipe(plan: Plan, before: dict[str, Any]) -> list[str]:
    spec = plan.batch.spec
    lines = []
    if before["command"] != list(spec.command):
        lines.append(f"the command was {' '.join(before['command'])!r} and is {' '.join(spec.command)!r}")
    variables = json.loads(before["variables"])
    for name in sorted(variables.keys() | spec.environment.keys()):
        if variables.get(name) != spec.environment.get(name):
            lines.append(f"the variable {name} was {variables.get(name)!r} and is {spec.environment.get(name)!r}")
    if before["platform"] != spec.platform:
        lines.append(f"the platform was {before['platform']} and is {spec.platform}")
    return lines


def _image(plan: Plan, store: Store, before: dict[str, Any]) -> Iterator[str]:
    """Yield the differences of the image, of its content, and of the host access of runs."""
    spec = plan.batch.spec
    if before["image"] != spec.image:
        was, now = _recorded(store, before["image"]), _known(plan, store)
        called = [one.image.name if one else "" for one in (was, now)]
        ids = [images.short(identity) if identity else "none" for identity in (before["image"], spec.image)]
        told = [f"{name} ({identity})" if name else identity for name, identity in zip(called, ids, strict=True)]
        yield f"the image was {told[0]} and is {told[1]}"
        if was and now:
            yield _inside(was, now, mentioned(spec.command, plan.project.root))
    if reach := other_host_access(before["host_access"] or (), spec.host_access):
        yield f"the host access of runs has changed: {', '.join(reach)}"


def _recorded(store: Store, identity: str | None) -> Contents | None:
    """Return the record of an image; None if it cannot be read, which `sierra fsck` reports."""
    with contextlib.suppress(Missing, NotFound, Damaged):
        return plan_from_record.image_contents(store, identity) if identity else None
    return None


def _known(plan: Plan, store: Store) -> Contents | None:
    """Return what is known about a plan's image without reading the whole image."""
    if plan.image is None:
        return None
    return images.contents(store.paths, plan.image) or _recorded(store, plan.image.id)


def _inside(was: Contents, now: Contents, words: frozenset[str]) -> str:
    """Return a line with the packages that differ or, if none do, the files."""
    changes = [
        f"{change.text} ({manager})"
        for manager, those in packages(was.packages, now.packages, words).items()
        for change in those
    ]
    if changes:
        return f"the images differ in packages: {few(changes, SHOWN)}"
    texts = [change.text for change in files(was.listing, now.listing)]
    return f"the images differ in files: {few(texts, SHOWN)}" if texts else "both images have the same packages and files"


def _source(plan: Plan, store: Store, tree: str) -> list[str]:
    rows = store.rows("SELECT files FROM sources WHERE tree = $t LIMIT 1", t=tree)
    if not rows or plan.source is None:
        return ["the source has changed"]
    paths = changed(store.object(rows[0]["files"]), plan.source.manifest)
    advice = suggest_exclusions.advice(map(os.fsencode, paths), source.paths(plan.source.manifest))
    return [f"the source has changed: {few(paths, SHOWN)}", *([] if advice == suggest_exclusions.ONLY_SAID else [advice])]


def _asked(plan: Plan, before: dict[str, Any]) -> list[str]:
    """Return the differences in the query, one line each."""
    now = batch_row(plan)
    names = [name for name in ASKED if name not in now["axes"]]
    lines = [f"{name} was {before[name]!r} and is {now[name]!r}" for name in names if before[name] != now[name]]
    lines += [f"--set {change} was added" for change in now["overrides"] if change not in before["overrides"]]
    return lines + [f"--set {change} was removed" for change in before["overrides"] if change not in now["overrides"]]

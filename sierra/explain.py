"""Why runs are new: what differs between a plan and the batch most like it that is recorded."""

from __future__ import annotations

import json
from typing import Any

from sierra.plans import Plan
from sierra.provenance.source import changed
from sierra.store import Store

LIKE = """
SELECT b.*, r.command, r.variables, r.source, r.image
FROM batches b JOIN recipes r USING (recipe) LEFT JOIN (SELECT batch, max(ended) AS answered FROM sessions GROUP BY batch) s
USING (batch)
WHERE b.axes = $axes AND b.batch <> $batch
ORDER BY coalesce(s.answered, b.created) DESC LIMIT 1
"""
SHOWN = 10


def why_new(plan: Plan, store: Store | None) -> list[str]:
    """What makes the runs of a plan others than those of the last batch over the same axes, a line each."""
    if store is None:
        return ["nothing is recorded here yet"]
    if store.rows("SELECT 1 FROM batches WHERE batch = $b LIMIT 1", b=plan.batch.id):
        return ["this batch is recorded; an asking that was ended left these runs for later"]
    rows = store.rows(LIKE, axes=[axis.name for axis in plan.batch.axes], batch=plan.batch.id)
    if not rows:
        return ["no batch over these variables is recorded"]
    before = rows[0]
    lines = [f"compared with batch {before['batch'][:10]} ({before['query']}):"]
    lines += _recipe(plan, before)
    if before["source"] != plan.batch.recipe.source:
        lines += _source(plan, store, before["source"])
    if before["template_sha256"] != plan.template_sha256:
        lines.append(f"the template {plan.project.config.template} has changed")
    lines += _asked(plan, before)
    return lines if len(lines) > 1 else [*lines, "other values, runs or changes are asked for"]


PROGRAMS = """
SELECT name, path, sha256 FROM programs
WHERE programs = (SELECT arg_max(programs, ended) FROM executions JOIN members USING (run) WHERE members.batch = $batch)
"""


def other_programs(plan: Plan, store: Store) -> list[str]:
    """Which programs are others than those that the batch was last executed with, a line each."""
    before = {row["name"]: row for row in store.rows(PROGRAMS, batch=plan.batch.id)}
    now = {program.name: program for program in plan.programs.all}
    lines = []
    for name in sorted(before.keys() | now.keys()):
        old, new = before.get(name), now.get(name)
        if old is None or new is None or old["sha256"] != new.sha256:
            was = f"{old['path']} ({old['sha256'][:10]})" if old else "not there"
            lines.append(f"{name}: was {was}, is {f'{new.path} ({new.sha256[:10]})' if new else 'not there'}")
    return lines


def _recipe(plan: Plan, before: dict[str, Any]) -> list[str]:
    recipe = plan.batch.recipe
    lines = []
    if before["command"] != list(recipe.command):
        lines.append(f"the command was {' '.join(before['command'])!r} and is {' '.join(recipe.command)!r}")
    variables = json.loads(before["variables"])
    for name in sorted(variables.keys() | recipe.environment.keys()):
        if variables.get(name) != recipe.environment.get(name):
            lines.append(f"the variable {name} was {variables.get(name)!r} and is {recipe.environment.get(name)!r}")
    if before["platform"] != recipe.platform:
        lines.append(f"the platform was {before['platform']} and is {recipe.platform}")
    if before["image"] != recipe.image:
        lines.append(f"the image was {before['image']} and is {recipe.image}")
    return lines


def _source(plan: Plan, store: Store, tree: str) -> list[str]:
    rows = store.rows("SELECT files FROM sources WHERE tree = $t LIMIT 1", t=tree)
    if not rows:
        return ["the source has changed"]
    files = changed(store.object(rows[0]["files"]), plan.source.manifest)
    more = f" and {len(files) - SHOWN} more" if len(files) > SHOWN else ""
    return [f"the source has changed: {', '.join(files[:SHOWN])}{more}"]


def _asked(plan: Plan, before: dict[str, Any]) -> list[str]:
    now = {
        "controller": plan.query.controller or plan.project.config.controller,
        "scenario": plan.query.scenario or plan.project.config.scenario,
        "base_seed": plan.query.base_seed,
    }
    return [f"{name} was {before[name]!r} and is {value!r}" for name, value in now.items() if before[name] != value]

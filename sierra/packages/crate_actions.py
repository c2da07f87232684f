"""The actions of a package's RO-Crate: what was executed when, on which values, with what result.

Each batch has an OrganizeAction (SIERRA executed the batch) whose result is a CreateAction (the batch's results were made).
Each run that was executed has a CreateAction, and a ControlAction by which its step of the workflow started it. A run's
execution is the effective one of its batch, or else the last one.

With more than `MOST` executions, each experiment has these two actions instead, and the batch's description says so.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import NamedTuple

from sierra.packages.crate_graph import Entity, Graph, local, moment, ref
from sierra.store.store import Store

MOST = 2000
"""The largest number of executions with an action each."""
EXECUTED = """
SELECT e.batch, e.ordinal, e.experiment, m.run, m.seed, m.spec, x.execution, x.started, x.ended, x.status, x.reason
FROM batch_runs m JOIN experiments e USING (batch, ordinal)
LEFT JOIN effective f USING (batch, ordinal, run)
LEFT JOIN (
SELECT run, arg_max(execution, (lamport, execution)) AS execution FROM executions WHERE purpose = 'run' GROUP BY run
) l ON l.run = m.run
JOIN executions x ON x.execution = coalesce(f.execution, l.execution)
ORDER BY e.batch, e.ordinal, m.number
"""
BATCHES = """
SELECT b.batch, b.query, b.axes, coalesce(s.started, b.created) AS started, s.ended, b.experiments, b.runs, b.template,
coalesce(f.good, 0) AS good
FROM batches b
LEFT JOIN (SELECT batch, min(started) AS started, max(ended) AS ended FROM sessions GROUP BY batch) s USING (batch)
LEFT JOIN (SELECT batch, count(*) AS good FROM effective GROUP BY batch) f USING (batch)
ORDER BY b.lamport, b.batch
"""


class Batch(NamedTuple):
    """A packed batch: its times are those of its sessions."""

    batch: str
    query: str | None
    axes: list[str]
    started: datetime
    ended: datetime | None
    experiments: int
    runs: int
    template: str
    good: int
    """The number of runs with an effective execution."""


class _Executed(NamedTuple):
    """The execution of a run in an experiment."""

    batch: str
    ordinal: int
    experiment: str
    run: str
    seed: int | None
    spec: str
    execution: str
    started: datetime | None
    ended: datetime | None
    status: str
    reason: str | None


@dataclass(frozen=True, slots=True)
class Around:
    """The entities that all actions refer to."""

    workflow: Entity
    sierra: Entity
    agents: Sequence[Entity]
    results: Entity
    templates: Mapping[str, Entity]
    """The packed templates, by path in the project."""
    tools: Mapping[str, Entity]
    """The programs, by specification."""
    steps: Mapping[str, Entity]
    """The steps of the workflow, by specification."""
    images: Mapping[str, Entity]
    """The container images, by specification."""
    commands: Mapping[str, Sequence[str]]
    """Programs with arguments, by specification."""


def batches(store: Store) -> list[Batch]:
    """Return the packed batches in the order in which they were submitted."""
    return store.select(Batch, BATCHES)


def add(graph: Graph, store: Store, around: Around) -> list[Entity]:
    """Add all actions, and return references to them. A value's parameter is `parameter(name)`."""
    rows = store.select(_Executed, EXECUTED)
    each = len({row.execution for row in rows}) <= MOST
    values = _values(graph, store)
    found: list[Entity] = []
    controls: dict[str, list[Entity]] = {}
    for key, group in _groups(rows, each=each):
        objects = _unique(one for row in group for one in values.get((row.batch, row.ordinal), ()))
        action = graph.add(_action(key, group, objects, around))
        steps = _unique(around.steps[row.spec] for row in group)
        started = {"@type": "ControlAction", "name": f"start of {key[1:15]}", "instrument": steps, "object": action}
        control = graph.add({"@id": f"{key}-control", **started})
        found += [action, control]
        for owner in dict.fromkeys(row.batch for row in group):
            controls.setdefault(owner, []).append(control)
    for batch in batches(store):
        used = _unique(one for place, some in values.items() if place[0] == batch.batch for one in some)
        found += _organized(graph, batch, used, controls.get(batch.batch, []), around, each=each)
    return found


def parameter(name: str) -> str:
    """Return the id of the parameter for an independent variable."""
    return local("variable", name)


def _values(graph: Graph, store: Store) -> dict[tuple[str, int], list[Entity]]:
    """Add the values of the variables, and return references to those of each experiment, by batch and ordinal."""
    axes = {batch.batch: batch.axes for batch in batches(store)}
    found: dict[tuple[str, int], list[Entity]] = {}
    numbers: dict[tuple[str, str], int] = {}
    for row in store.rows("SELECT * FROM experiments ORDER BY batch, ordinal"):
        place = (str(row["batch"]), int(str(row["ordinal"])))
        for name in axes[place[0]]:
            if (value := _plain(row.get(name))) is not None:
                number = numbers.setdefault((name, repr(value)), len(numbers) + 1)
                fields = {"@type": "PropertyValue", "name": name, "value": value, "exampleOfWork": ref(parameter(name))}
                found.setdefault(place, []).append(graph.add({"@id": local("value", number), **fields}))
    return found


def _plain(value: object) -> str | int | float | None:
    """Return a value as JSON can have it: numbers without a decimal form as text."""
    if value is None or isinstance(value, str | int) or (isinstance(value, float) and math.isfinite(value)):
        return value
    return str(value)


def _groups(rows: Iterable[_Executed], *, each: bool) -> Iterator[tuple[str, list[_Executed]]]:
    """Yield the id of each action with its rows: an action for each execution, or for each experiment."""
    found: dict[str, list[_Executed]] = {}
    for row in rows:
        found.setdefault(local("run", row.execution) if each else local("experiment", row.experiment), []).append(row)
    yield from found.items()


def _action(key: str, rows: Sequence[_Executed], objects: Sequence[Entity], around: Around) -> Entity:
    """Return the CreateAction of an execution, or of all executions of an experiment."""
    runs = {row.execution: row for row in rows}
    failed = [row for row in runs.values() if row.status != "ok"]
    first = rows[0]
    commands = dict.fromkeys(shlex.join(around.commands[row.spec]) for row in rows)
    single = key.startswith("#run-")
    return {
        "@id": key,
        "@type": "CreateAction",
        "name": f"run {first.run[:10]}" if single else f"experiment {first.experiment[:10]}, {len(runs)} runs",
        "identifier": first.run if single else first.experiment,
        "description": "; ".join(commands) + (f" (seed {first.seed})" if single and first.seed is not None else ""),
        "instrument": _unique(around.tools[row.spec] for row in rows),
        "agent": around.agents,
        "object": objects,
        "result": around.results,
        "startTime": moment(min((row.started for row in rows if row.started), default=None)),
        "endTime": moment(max((row.ended for row in rows if row.ended), default=None)),
        "containerImage": _unique(around.images[row.spec] for row in rows if row.spec in around.images),
        **_status(_error(failed, single=single)),
    }


def _error(failed: Sequence[_Executed], *, single: bool) -> str:
    if failed and single:
        return failed[0].reason or failed[0].status
    return f"{len(failed)} runs failed" if failed else ""


def _status(error: str) -> Entity:
    return {"actionStatus": f"http://schema.org/{'Failed' if error else 'Completed'}ActionStatus", "error": error}


def _organized(
    graph: Graph, batch: Batch, values: Sequence[Entity], controls: Sequence[Entity], around: Around, *, each: bool
) -> list[Entity]:
    """Add the two actions of a batch, and return references to them."""
    name = f"batch {batch.batch[:10]}"
    about = f"{batch.query or 'the template as it is'}: {batch.experiments} experiments, {batch.runs} runs"
    coarse = (
        f"; described by experiment, because the package has more than {MOST} executions: the store's table executions has each"
    )
    missing = batch.runs - batch.good
    times = {"startTime": moment(batch.started), "endTime": moment(batch.ended)}
    template = [around.templates[batch.template]] if batch.template in around.templates else []
    made = {
        "@id": local("batch", batch.batch),
        "@type": "CreateAction",
        "name": name,
        "identifier": batch.batch,
        "description": about + ("" if each else coarse),
        "instrument": around.workflow,
        "agent": around.agents,
        "object": [*template, *values],
        "result": around.results,
        **times,
        **_status(f"{missing} of {batch.runs} runs have no successful execution" if missing else ""),
    }
    result = graph.add(made)
    organized = {
        "@id": local("organize", batch.batch),
        "@type": "OrganizeAction",
        "name": f"sierra run: {name}",
        "instrument": around.sierra,
        "agent": around.agents,
        "object": controls,
        "result": result,
        **times,
    }
    return [result, graph.add(organized)]


def _unique(entities: Iterable[Entity]) -> list[Entity]:
    """Return references without repetition, in order."""
    return list({entity["@id"]: entity for entity in entities}.values())

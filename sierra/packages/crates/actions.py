"""The actions of a package's RO-Crate: what was executed when, on which values, with what result.

Each batch has an OrganizeAction (SIERRA executed the batch) whose result is a CreateAction (the batch's results were made).
Each run that was executed has a CreateAction, and a ControlAction by which its step of the workflow started it. A run's
execution is the effective one of its batch, or else the last one.

With more than `MOST` runs, each experiment has these two actions instead, and the batch's description says so.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from typing import NamedTuple

from sierra.packages.crates.graph import Entity, Graph, local, moment, ref
from sierra.store.store import Store
from sierra.util.lazy_definitions import dataclass

MOST = 2000
"""The largest number of runs with an action each."""
MEMBER = "md5_number(concat_ws(' ', m.batch, m.ordinal, m.run))"
CHOSEN = "CREATE TEMP TABLE chosen (member UHUGEINT, execution UHUGEINT)"
"""The execution of each run in each experiment, by hashes, which need less memory than the ids."""
SEVERAL = """
CREATE TEMP TABLE several AS SELECT run FROM executions WHERE purpose = 'run' GROUP BY run HAVING count(*) > 1
UNION SELECT run FROM reused_executions
"""
"""The runs that may have one of several executions. Any other run has its only one, whether that is effective or not."""
EFFECTIVE = f"""
INSERT INTO chosen SELECT {MEMBER}, md5_number(execution) FROM effective m WHERE run IN (SELECT run FROM several)
"""  # noqa: S608 - of our own parts
OTHERS = f"""
INSERT INTO chosen SELECT {MEMBER}, md5_number(arg_max(x.execution, (x.lamport, x.execution)))
FROM batch_runs m JOIN executions x ON x.run = m.run AND x.purpose = 'run'
WHERE {MEMBER} NOT IN (SELECT member FROM chosen) GROUP BY ALL
"""  # noqa: S608 - of our own parts
EXECUTED = f"""
SELECT e.batch, e.ordinal, e.experiment, m.number, m.run, m.seed, m.spec, x.execution, x.started, x.ended, x.status, x.reason
FROM batch_runs m JOIN experiments e USING (batch, ordinal) JOIN chosen c ON c.member = {MEMBER}
JOIN executions x ON md5_number(x.execution) = c.execution
"""  # noqa: S608 - of our own parts
COUNT = "SELECT count(DISTINCT run) FROM batch_runs"
ACTIONS = f"""
SELECT {{key}} AS key, list(DISTINCT batch || ' ' || ordinal ORDER BY batch || ' ' || ordinal) AS places, min(run) AS run,
       min(seed) AS seed, list(DISTINCT spec ORDER BY spec) AS specs, min(started) AS started, max(ended) AS ended,
       count(DISTINCT md5_number(execution)) AS executions,
       count(DISTINCT md5_number(execution)) FILTER (status NOT IN ('ok', 'accepted')) AS failed,
       min(coalesce(reason, status)) FILTER (status NOT IN ('ok', 'accepted')) AS reason
FROM ({EXECUTED}) GROUP BY key ORDER BY min((batch, ordinal, number)), key
"""  # noqa: S608 - of our own parts
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
    """An execution, or all executions of an experiment."""

    key: str
    """The id of the execution or the experiment."""
    places: list[str]
    """The experiments, as the batch's id and the position in the batch."""
    run: str
    seed: int | None
    specs: list[str]
    started: datetime | None
    ended: datetime | None
    executions: int
    failed: int
    reason: str | None
    """The reason why one of them failed, if any did."""

    @property
    def batches(self) -> list[str]:
        return list(dict.fromkeys(experiment.partition(" ")[0] for experiment in self.places))


@dataclass(frozen=True, slots=True)
class Around:
    """The entities that all actions refer to."""

    batches: Sequence[Batch]
    """The packed batches in the order in which they were submitted."""
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
    images: Mapping[str, Sequence[Entity]]
    """The container images, by specification: several for several processors."""
    commands: Mapping[str, Sequence[str]]
    """Programs with arguments, by specification."""


def batches(store: Store) -> list[Batch]:
    """Return the packed batches in the order in which they were submitted."""
    return store.select(Batch, BATCHES)


def add(graph: Graph, store: Store, around: Around) -> list[Entity]:
    """Add all actions, and return references to them. A value's parameter is `parameter(name)`."""
    each = store.values(int, COUNT)[0] <= MOST
    values = _values(graph, store, around.batches)
    actions: list[Entity] = []
    controls: dict[str, list[Entity]] = {}
    for row in _executed(store, "execution" if each else "experiment"):
        objects = _unique(value for experiment in row.places for value in values.get(experiment, ()))
        key = local("run" if each else "experiment", row.key)
        action = graph.add(_action(key, row, objects, around, single=each))
        steps = _unique(around.steps[spec] for spec in row.specs)
        started = {"@type": "ControlAction", "name": f"start of {key[1:15]}", "instrument": steps, "object": action}
        control = graph.add({"@id": f"{key}-control", **started})
        actions += [action, control]
        for owner in row.batches:
            controls.setdefault(owner, []).append(control)
    for batch in around.batches:
        used = _unique(value for experiment, some in values.items() if experiment.startswith(batch.batch) for value in some)
        actions += _organized(graph, batch, used, controls.get(batch.batch, []), around, each=each)
    return actions


def _executed(store: Store, key: str) -> list[_Executed]:
    """Return the executions, or the experiments; `key` is the column with their ids."""
    with store.snapshot() as snapshot:
        snapshot.views.make(("effective", "batch_runs", "executions", "reused_executions"))
        for statement in (CHOSEN, SEVERAL):
            snapshot.run(statement)
        if snapshot.run("SELECT 1 FROM several LIMIT 1"):
            snapshot.run(EFFECTIVE)
        snapshot.run(OTHERS)
        return snapshot.select(_Executed, ACTIONS.format(key=key))


def parameter(name: str) -> str:
    """Return the id of the parameter for an independent variable."""
    return local("variable", name)


def _values(graph: Graph, store: Store, packed: Sequence[Batch]) -> dict[str, list[Entity]]:
    """Add the values of the variables, and return references to those of each experiment, by its place."""
    axes = {batch.batch: batch.axes for batch in packed}
    refs: dict[str, list[Entity]] = {}
    numbers: dict[tuple[str, str], int] = {}
    for row in store.rows("SELECT * FROM experiments ORDER BY batch, ordinal"):
        batch = str(row["batch"])
        for name in axes[batch]:
            if (value := _plain(row.get(name))) is not None:
                number = numbers.setdefault((name, repr(value)), len(numbers) + 1)
                fields = {"@type": "PropertyValue", "name": name, "value": value, "exampleOfWork": ref(parameter(name))}
                refs.setdefault(f"{batch} {row['ordinal']!s}", []).append(graph.add({"@id": local("value", number), **fields}))
    return refs


def _plain(value: object) -> str | int | float | None:
    """Return a value as JSON can have it: numbers without a decimal form as text."""
    if value is None or isinstance(value, str | int) or (isinstance(value, float) and math.isfinite(value)):
        return value
    return str(value)


def _action(key: str, row: _Executed, objects: Sequence[Entity], around: Around, *, single: bool) -> Entity:
    """Return the CreateAction of an execution, or of all executions of an experiment."""
    commands = dict.fromkeys(shlex.join(around.commands[spec]) for spec in row.specs)
    several = f"{row.failed} runs failed" if row.failed else ""
    return {
        "@id": key,
        "@type": "CreateAction",
        "name": f"run {row.run[:10]}" if single else f"experiment {row.key[:10]}, {row.executions} runs",
        "identifier": row.run if single else row.key,
        "description": "; ".join(commands) + (f" (seed {row.seed})" if single and row.seed is not None else ""),
        "instrument": _unique(around.tools[spec] for spec in row.specs),
        "agent": around.agents,
        "object": objects,
        "result": around.results,
        "startTime": moment(row.started),
        "endTime": moment(row.ended),
        "containerImage": _unique(image for spec in row.specs for image in around.images.get(spec, ())),
        **_status((row.reason or "") if single else several),
    }


def _status(error: str) -> Entity:
    return {"actionStatus": f"http://schema.org/{'Failed' if error else 'Completed'}ActionStatus", "error": error}


def _organized(
    graph: Graph, batch: Batch, values: Sequence[Entity], controls: Sequence[Entity], around: Around, *, each: bool
) -> list[Entity]:
    """Add the two actions of a batch, and return references to them."""
    name = f"batch {batch.batch[:10]}"
    about = f"{batch.query or 'the template as it is'}: {batch.experiments} experiments, {batch.runs} runs"
    coarse = f"; described by experiment, because the package has more than {MOST} runs: the store's table executions has each"
    missing = batch.runs - batch.good
    times = {"startTime": moment(batch.started), "endTime": moment(batch.ended)}
    template = [around.templates[batch.template]] if batch.template in around.templates else []
    action = {
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
    result = graph.add(action)
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

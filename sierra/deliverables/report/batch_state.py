"""The state of a batch for its report: its record, and how its runs have ended so far."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Mapping
from typing import NamedTuple

from sierra.config.project_file import LoadedProject
from sierra.errors import SierraError
from sierra.execution import sessions, show_record, targets
from sierra.execution.shown_records import ShownBatch
from sierra.store.store import Store
from sierra.util.hashing import short
from sierra.util.lazy_definitions import dataclass

STATES = """
WITH members AS (SELECT DISTINCT ordinal, run FROM batch_runs WHERE batch = $b),
tried AS (SELECT run, arg_max(status, lamport) AS last FROM executions WHERE purpose = 'run' GROUP BY run),
good AS (SELECT DISTINCT ordinal, run, outcome FROM effective WHERE batch = $b)
SELECT ordinal, CASE WHEN outcome = 'success' THEN 'ok' WHEN outcome IS NOT NULL THEN 'accepted: ' || outcome
       WHEN last IS NULL THEN 'not executed' WHEN last IN ('ok', 'accepted') THEN 'outdated' ELSE last END AS state,
       count(*) AS runs
FROM members LEFT JOIN tried USING (run) LEFT JOIN good USING (ordinal, run) GROUP BY ALL ORDER BY ordinal, state
"""
"""The ends of the runs of each experiment: ok, an accepted outcome, not executed, or the status of the last execution."""
RUNS = "SELECT DISTINCT run FROM batch_runs WHERE batch = $b"
ACCEPTED = "accepted: "
"""The beginning of the states of runs that have ended as [success] accepts."""
LEFT_OUT = ("not executed", "outdated")
"""States of runs that the next `sierra run` executes, although nothing went wrong in them."""


class _State(NamedTuple):
    ordinal: int
    state: str
    runs: int


@dataclass(frozen=True, slots=True)
class BatchState:
    """A batch, its record, and the numbers of its runs."""

    project: LoadedProject
    """The project for the target of the batch's last request."""
    store: Store
    shown: ShownBatch
    states: Mapping[int, Mapping[str, int]]
    """The number of runs by the position of the experiment and by state: see `STATES`."""
    executing: int
    """The number of unfinished runs that living sessions have claimed."""

    @property
    def id(self) -> str:
        return self.shown.row.batch

    @property
    def short(self) -> str:
        return short(self.id)

    @property
    def query(self) -> str:
        """The criteria as they were requested last."""
        return self.shown.sessions[-1].query if self.shown.sessions else self.shown.row.query

    @property
    def counts(self) -> Mapping[str, int]:
        """Return the number of runs by state."""
        total: Counter[str] = Counter()
        for states in self.states.values():
            total.update(states)
        return dict(total)

    @property
    def succeeded(self) -> int:
        return self.counts.get("ok", 0)

    @property
    def unexecuted(self) -> int:
        """The number of runs that the next `sierra run` executes, although nothing went wrong in them."""
        return sum(self.counts.get(state, 0) for state in LEFT_OUT)

    @property
    def unsuccessful(self) -> int:
        """The number of runs whose last execution failed, was cut off, or is invalid."""
        return self.shown.row.runs - self.succeeded - self.accepted - self.unexecuted

    @property
    def accepted(self) -> int:
        """The number of runs that are results although they were not successful."""
        return sum(runs for state, runs in self.counts.items() if state.startswith(ACCEPTED))


def read(project: LoadedProject, store: Store, batch: str) -> BatchState:
    """Return the state of the batch with this id. Raises NotFound, Damaged."""
    shown = show_record.batch(store, batch)
    states: dict[int, dict[str, int]] = {}
    for row in store.select(_State, STATES, b=batch):
        states.setdefault(row.ordinal, {})[row.state] = row.runs
    own = targets.of_batch(project, store, batch)
    missing = any(state in LEFT_OUT for some in states.values() for state in some)
    return BatchState(own, store, shown, states, executing(store, batch) if missing else 0)


def executing(store: Store, batch: str) -> int:
    """Return how many runs of a batch living sessions have claimed; 0 in a store that cannot be written."""
    runs = claimed(store)
    return len(runs.intersection(store.values(str, RUNS, b=batch))) if runs else 0


def claimed(store: Store) -> set[str]:
    """Return the unfinished runs that living sessions have claimed; none in a store that cannot be written."""
    runs: set[str] = set()
    with contextlib.suppress(SierraError), sessions.exclusively(store.paths) as locks:
        living = sessions.alive(store.paths) if locks else sessions.all_of(store.paths)
        runs = {run for paths in living for run in sessions.claims(paths)}
    return runs

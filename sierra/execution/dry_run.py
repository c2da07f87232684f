"""Forecast of a session: which runs of a plan it would execute, follow on a cluster, evaluate again or reuse now."""

from __future__ import annotations

from collections import Counter
from collections.abc import Container, Mapping
from collections.abc import Set as AbstractSet

from sierra.execution.cluster_status import claimed
from sierra.execution.plan import Plan
from sierra.execution.reasons import ChangeReason, Reason
from sierra.execution.reuse import State, foreseen, states
from sierra.store.store import Store
from sierra.util.lazy_definitions import dataclass


@dataclass(frozen=True, slots=True)
class Forecast:
    """States of the runs, by run id, and what would happen to the runs without a successful execution."""

    states: Mapping[str, State]
    to_execute: AbstractSet[str]
    on_clusters: AbstractSet[str]
    """Runs that a cluster executes now; they would be followed."""
    given_up: AbstractSet[str] = frozenset()
    """Runs that failed twice in the same way, and would not be executed again."""

    @property
    def to_reevaluate(self) -> int:
        """Return the number of runs that would be evaluated again from the record."""
        return sum(state.reevaluated for state in self.states.values())

    @property
    def reasons(self) -> Counter[Reason]:
        """Return the numbers of runs by the reason why they would be executed or reused."""
        followed = Reason(ChangeReason.ON_CLUSTER)
        return Counter(followed if run in self.on_clusters else state.change for run, state in self.states.items())


def has_other_files(reasons: Mapping[Reason, int]) -> bool:
    """Check whether runs would execute because programs, or files that runs used, have changed."""
    return any(reason.kind in (ChangeReason.PROGRAMS, ChangeReason.UNOBSERVED) for reason in reasons)


def forecast(plan: Plan, store: Store | None, runs: Container[str] | None = None, *, retry: bool = False) -> Forecast:
    """Return the forecast for these runs of a plan (None: all). `retry`: also those that failed twice. Executes nothing."""
    found = {run: state for run, state in foreseen(plan, store, states(plan, store)).items() if runs is None or run in runs}
    missing = {run for run, state in found.items() if not (state.succeeded or state.reevaluated)}
    given_up = set() if retry else {run for run in missing if found[run].failed_twice}
    on_clusters = missing & claimed(store).keys() if store and missing else set()
    return Forecast(found, missing - on_clusters - given_up, on_clusters, given_up - on_clusters)

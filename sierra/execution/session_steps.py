"""Steps of sessions: extensions that execute the runs of some projects themselves, one by one and in their own order."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from collections.abc import Set as AbstractSet
from typing import TYPE_CHECKING, Protocol

from sierra.util.lazy_definitions import dataclass, field

if TYPE_CHECKING:
    from sierra.execution.follow import Followed
    from sierra.execution.observer import ProgressCounter
    from sierra.execution.plan import Plan
    from sierra.execution.sessions import Session
    from sierra.model import Run
    from sierra.runners.base import Runner
    from sierra.store.store import Store
    from sierra.util.json_types import JsonView


@dataclass(frozen=True, slots=True)
class Core:
    """The session for which a step executes runs, and the core's functions for that."""

    plan: Plan
    store: Store
    session: Session
    counter: ProgressCounter
    runner: Callable[[], Runner]
    """Makes a runner, which executes one run."""
    execute: Callable[[Run, int, Runner, Mapping[str, JsonView]], Followed]
    """Executes a run by a runner, and records it with a row of `trials`. The number is that of earlier tries in the session."""
    is_enough: Callable[[], bool]
    """Returns True if no more runs are to be executed: see `sierra.execution.follow.follow`."""


@dataclass(slots=True)
class Outcome:
    """The outcome of the runs that a step has executed."""

    interrupted: bool = False
    """True if the user ended the session, at a prompt or by a signal."""
    skipped: set[str] = field(default_factory=set)
    """Runs that were skipped."""
    inconsistent: set[str] = field(default_factory=set)
    """Runs with an execution that is inconsistent with other executions."""
    notes: dict[str, None] = field(default_factory=dict)
    """Notes for the user, each once."""


class SessionStep(Protocol):
    """Executes the runs of a project. It is made anew for each use; `sierra.execution.plan.session_step` returns it."""

    runs: str
    """The name of such runs in messages, in the plural."""

    def check(self, runner: str, *, stays: bool, jobs: int | None) -> None:
        """Raise UsageError if a runner cannot execute such runs; `jobs` is the requested number of runs at a time.

        `stays`: the runner's work survives this process.
        """
        ...

    def check_missing(self, runs: AbstractSet[str]) -> None:
        """Raise Missing if these runs cannot be executed now. It is called before anything is written."""
        ...

    def execute(self, wanted: AbstractSet[str], core: Core) -> Outcome:
        """Execute these runs. Raises the errors of the runner, ConfigError and Missing."""
        ...

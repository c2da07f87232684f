"""The step of a session whose runs are supervised trials."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Set as AbstractSet
from typing import TYPE_CHECKING

from sierra.config.extensions import given
from sierra.errors import Missing, UsageError

if TYPE_CHECKING:
    from sierra.config.project_file import Project
    from sierra.execution.session_steps import Core, Outcome
    from sierra.extensions.trials.supervisor import Supervisor
    from sierra.extensions.trials.table import Trials

UNATTENDED = "trials are supervised here ([trials]): run in a terminal, or answer all prompts with --yes"


class Supervision:
    """The supervisors of a call of `sierra run` or of a block of Python: one for each target."""

    def __init__(self, make: Callable[[Trials], Supervisor | None], operator: str | None = None) -> None:
        """`make` returns a supervisor of trials, or None if nobody is there; `operator` is a name that was given for it."""
        self.operator = operator
        self._make = make
        self._made: dict[str | None, Supervisor | None] = {}

    def of(self, target: str | None, trials: Trials) -> Supervisor | None:
        """Return the supervisor of a target's trials; None if nobody is there."""
        if target not in self._made:
            self._made[target] = self._make(trials)
        return self._made[target]


class SupervisedTrials:
    """Executes runs as supervised trials: see `sierra.execution.session_steps.SessionStep`."""

    runs = "supervised trials"

    def __init__(self, target: str | None, trials: Trials) -> None:
        self._target = target
        self._trials = trials

    def check(self, runner: str, *, stays: bool, jobs: int | None) -> None:
        if stays:
            where = f"runs on {runner!r} begin when the cluster has room; use a runner such as local"
            raise UsageError(f"[trials] supervised: {where}")
        if jobs is not None and jobs > 1:
            raise UsageError(f"[trials] supervised: trials are executed one after the other; leave out --jobs {jobs}")

    def check_missing(self, runs: AbstractSet[str]) -> None:
        if runs:
            self._supervisor()

    def execute(self, wanted: AbstractSet[str], core: Core) -> Outcome:
        from sierra.extensions.trials.conduct import Conduct

        return Conduct(self._trials, self._supervisor(), core).conduct(wanted)

    def _supervisor(self) -> Supervisor:
        """Return the supervisor. Raises Missing without one."""
        supervisors = (supervision.of(self._target, self._trials) for supervision in given(Supervision))
        if supervisor := next(filter(None, supervisors), None):
            return supervisor
        raise Missing(UNATTENDED)


def step(config: Project) -> SupervisedTrials | None:
    """Return what executes the runs of a project; None if they are not supervised. Raises UsageError for a useless operator."""
    trials: Trials | None = config.added("trials", None)
    if trials is not None and trials.supervised:
        return SupervisedTrials(config.target, trials)
    for supervision in given(Supervision):
        if supervision.operator is not None:
            raise UsageError(
                f"--operator {supervision.operator}: nobody supervises these runs; set supervised = true in [trials]"
            )
    return None

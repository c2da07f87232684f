"""Plans of queries: what they would execute, where, and with which products and inputs."""

from __future__ import annotations

import os
from collections.abc import Container, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Unpack

from sierra.api.noun import Noun
from sierra.errors import UsageError
from sierra.store.store import Store

if TYPE_CHECKING:
    from sierra.api.options import Settings
    from sierra.design.query.condition import Selection
    from sierra.design.query.query_request import QueryRequest
    from sierra.execution.observer import Observer
    from sierra.execution.plan import Plan
    from sierra.execution.write_inputs import WrittenInputs
    from sierra.runners.cluster.resource_estimate import Estimate


class Plans(Noun):
    """Plans of queries: `project.plans`. `project.plan` returns one."""

    def of_targets(
        self,
        *query: str,
        targets: Sequence[str],
        runs: int | None = None,
        engine: str | None = None,
        observer: Observer | None = None,
        **settings: Unpack[Settings],
    ) -> list[Plan]:
        """Return the plans of a query for several targets: the arguments are those of `Project.plan`.

        The runs of their batches are pairs: they have the same values and the same seeds. Raises QueryError if they have not.

        >>> project.plans.of_targets("population_size=1,2", targets=["sim", "robots"])
        Traceback (most recent call last):
        sierra.errors.UsageError: ...
        """
        from sierra.execution import targets as of_query

        of_query.check_names(targets)
        plan = partial(self._project.plan, *query, runs=runs, engine=engine, observer=observer, **settings)
        plans = [plan(target=name) for name in targets]
        of_query.check_pairs(plans)
        return plans

    def resolve(self, request: QueryRequest, *, engine: str | None = None, observer: Observer | None = None) -> Plan:
        """Return the plan of a query request: see `Project.plan`.

        >>> from sierra.design.query.query_request import request
        >>> len(project.plans.resolve(request(["population_size=1,2"], runs=2)).batch.runs)
        4
        """
        from sierra.execution import resolve_plan
        from sierra.execution.observer import Observer
        from sierra.explain.unbuilt_programs import unbuilt

        plan = resolve_plan.plan(self._loaded, request, engine=engine, report=(observer or Observer()).planning)
        return replace(plan, notes=(*plan.notes, *unbuilt(plan, self._project.stored())))

    def check_attended(self, plan: Plan, only: str | None = None) -> None:
        """Check that no missing run of a plan needs a person who is not there. Raises Missing.

        `only`: the condition of the runs that are to be executed, as in `Project.run`.

        >>> project.plans.check_attended(project.plan("population_size=8"))
        """
        from sierra.execution.plan import session_step

        step = session_step(plan.project)
        if step is None:
            return
        from sierra.execution.reuse import states

        selected = selection(plan, only)
        runs = selected.runs if selected else {run.id for run in plan.batch.runs}
        recorded = states(plan, self._project.stored())
        step.check_missing({run for run, state in recorded.items() if run in runs and not state.succeeded})

    def runner(self, plan: Plan, runner: str | None = None, *, detach: bool = False, jobs: int | None = None) -> str:
        """Return the name of the runner of a plan: `runner`, or the one in `sierra.toml`. Raises ConfigError, UsageError.

        `jobs`: the requested number of runs at a time, which an extension may refuse.

        >>> project.plans.runner(project.plan("population_size=8"))
        'local'
        """
        from sierra import runners
        from sierra.execution.plan import session_step

        name, tables = runner or plan.project.config.runner, plan.project.config.runner_tables
        stays = runners.find(name, tables)(1).stays
        if not stays and detach:
            raise UsageError(
                f"cannot detach from runner {name!r}: its runs end with this process; only cluster jobs can be detached"
            )
        if step := session_step(plan.project):
            step.check(name, stays=stays, jobs=jobs)
        return name

    def write_inputs(self, plan: Plan, folder: str | os.PathLike[str], *, only: str | None = None) -> WrittenInputs:
        """Write the inputs and commands of a plan's runs into a new folder, and execute nothing.

        `only`: as in `Project.run`. See `sierra.execution.write_inputs` for the files. Raises UsageError if the folder is not
        empty.

        >>> project.plans.write_inputs(project.plan("population_size=1,2", runs=2), "../inputs").runs
        4
        """
        from sierra.execution import write_inputs

        return write_inputs.write(plan, Path(folder), selection(plan, only))

    def build(self, plan: Plan, *, observer: Observer | None = None) -> Plan:
        """Build the products of `[build]` if they are not up to date; return the plan with them.

        `Project.execute` does this too. `observer` receives a notice before something is built. Raises SierraError if the build
        fails.

        >>> project.plans.build(project.plan("population_size=1,2", runs=2)).build is None
        True
        """
        plan.check_programs()
        if plan.build is None or plan.build.reason is None:
            return plan
        from sierra.execution.observer import Observer
        from sierra.execution.ready_build import ready

        built = ready(plan, Store.create(self._project.paths.store), observer or Observer())
        built.check_programs()
        return built

    def estimate(self, plan: Plan, runner: str, *, detach: bool = False, runs: Container[str] | None = None) -> Estimate | None:
        """Return an estimate of the cluster resources that a plan needs: see `sierra.runners.cluster.resource_estimate`.

        `runs`: the ids of the runs to submit, None for all. Return None if the runner is not a cluster, or if there is no run
        to submit.

        >>> print(project.plans.estimate(project.plan("population_size=8"), "local"))
        None
        """
        from sierra.execution import submission_proposal

        return submission_proposal.proposal(plan, self._project.stored(), runner, detach=detach, runs=runs)


def selection(plan: Plan, only: str | None) -> Selection | None:
    """Return the selection of experiments by the condition `only`; None for all of them."""
    if only is None:
        return None
    from sierra.design.query import condition

    return condition.select(only, plan.batch, plan.project.config)

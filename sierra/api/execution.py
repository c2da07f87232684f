"""Nouns about executing: plans of queries, studies, and jobs on clusters; and what their summaries get."""

from __future__ import annotations

import os
from collections.abc import Container, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from sierra.api.noun import Noun, observer_for
from sierra.errors import Missing, UsageError
from sierra.model import Measure
from sierra.store.store import Store

if TYPE_CHECKING:
    from sierra.api.project import Project
    from sierra.deliverables.power import RunsForPower
    from sierra.deliverables.sample_size import RunsNeeded
    from sierra.deliverables.studies.study import Outcome as StudyOutcome
    from sierra.design.query.condition import Selection
    from sierra.design.query.query_request import QueryRequest
    from sierra.execution.cluster_status import ClusterSession
    from sierra.execution.observer import Observer
    from sierra.execution.outputs_taken import TakenOutputs
    from sierra.execution.plan import Plan
    from sierra.execution.summary import Summary
    from sierra.execution.takeover import Cancelled
    from sierra.execution.write_inputs import WrittenInputs
    from sierra.runners.cluster.resource_estimate import Estimate


class Plans(Noun):
    """Plans of queries: `project.plans`. `project.plan` returns one."""

    def of_targets(
        self,
        *query: str,
        targets: Sequence[str],
        runs: int | None = None,
        controller: str | None = None,
        scenario: str | None = None,
        sets: Sequence[tuple[str, str]] = (),
        engine: str | None = None,
        observer: Observer | None = None,
    ) -> list[Plan]:
        """Return the plans of a query for several targets: the arguments are those of `Project.plan`.

        The runs of their batches are pairs: they have the same values and the same seeds. Raises QueryError if they have not.

        >>> project.plans.of_targets("population_size=1,2", targets=["sim", "robots"])
        Traceback (most recent call last):
        sierra.errors.UsageError: ...
        """
        from sierra.execution import targets as of_query

        of_query.check_names(targets)
        plan = partial(self._project.plan, *query, runs=runs, controller=controller, scenario=scenario, sets=sets)
        plans = [plan(target=name, engine=engine, observer=observer) for name in targets]
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

        name, tables = runner or plan.project.config.runner, plan.project.config.runners
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


class Studies(Noun):
    """Studies, and numbers of runs: `project.studies`."""

    def run(
        self,
        plan: Plan,
        *,
        until: str,
        max_runs: int,
        jobs: int | None = None,
        fail_fast: bool = False,
        figures: bool = True,
        observer: Observer | None = None,
        runner: str | None = None,
        progress: bool | None = None,
        planning: Observer | None = None,
    ) -> StudyOutcome:
        """Execute a query with more and more runs until its intervals are narrow enough.

        `sierra.deliverables.studies.study` has the rules.
        `plan` is the plan of the first look; its number of runs per experiment grows by a factor of 1.5 from look to look, up
        to `max_runs`. `until` is the rule: see `sierra.design.query.until`. The rule and the schedule are recorded before the
        first look, and each look with its decision. The same arguments continue a study, and execute nothing twice. `planning`
        receives the progress of planning. The other arguments are those of `Project.execute`. Raises the errors of
        `Project.plan`, and NotFound for a rule that does not fit the runs.

        >>> outcome = project.studies.run(project.plan("population_size=1", runs=3), until="ci(coverage) < 100", max_runs=6)
        >>> print(outcome.decision, [look.row.runs for look in outcome.looks])
        reached [3]
        """
        from sierra.deliverables.studies import study

        planned = study.design(self._loaded, plan, until, max_runs)
        told = observer or observer_for(progress)

        def larger(runs: int) -> Plan:
            request = plan.request.model_copy(update={"runs": runs})
            return self._project.plans.resolve(request, engine=plan.engine.name, observer=planning or told)

        def execute(look: Plan) -> Summary:
            return self._project.execute(look, jobs=jobs, fail_fast=fail_fast, figures=False, observer=told, runner=runner)

        plan.check_programs()
        self._project.plans.runner(plan, runner)
        store = Store.create(self._project.paths.store)
        outcome = study.conduct(self._loaded, store, planned, plan, study.Actions(larger, execute), told)
        if not figures or outcome.summary is None or outcome.decision in (None, "continue"):
            return outcome
        return replace(outcome, summary=drawn(self._project, outcome.summary))

    def planned(self, plan: Plan, *, until: str, max_runs: int) -> StudyOutcome:
        """Return the study that `run` would begin or continue, with the looks that are recorded. Executes nothing.

        >>> plan = project.plan("population_size=1", runs=2)
        >>> project.studies.planned(plan, until="ci(coverage) < 5%", max_runs=5).design.schedule
        (2, 3, 5)
        """
        from sierra.deliverables.studies import study

        planned = study.design(self._loaded, plan, until, max_runs)
        store = self._project.stored()
        return (study.find(store, planned.row.study) if store else None) or study.Outcome(planned, (), {})

    def runs_needed(
        self,
        prefix: str | None = None,
        *,
        half_width: float,
        column: str = "",
        table: str = "",
        measure: Measure | None = None,
        threshold: float | None = None,
    ) -> RunsNeeded:
        """Return how many runs each experiment needs for a 95 % interval of mean ± `half_width`, with a batch as the pilot.

        Raises NotFound, UsageError, and SierraError if no experiment has two runs.

        >>> project.studies.runs_needed(summary.batch, half_width=100).runs
        2
        """
        from sierra.deliverables import sample_size

        batch = self._project.records.batch(prefix)
        return sample_size.runs_needed(self._loaded, self._store, batch, half_width, table, column, measure, threshold)

    def runs_for_power(
        self,
        *words: str,
        difference: float | None = None,
        power: float = 0.8,
        runs: int | None = None,
        by: str | None = None,
        groups: Sequence[str] = (),
        column: str = "",
        table: str = "",
        measure: Measure | None = None,
        threshold: float | None = None,
        paired: bool | Literal["auto"] = "auto",
        alpha: float = 0.05,
    ) -> RunsForPower:
        """Return how many runs of each group a comparison needs to find a difference with a probability, the power.

        `words` are the pilot: one batch (default: the batch requested last), or the two batches to compare, as for
        `project.comparisons.make`. The pilot's runs are drawn again and again, and tested by the test that the comparison would
        use. `difference` is that of the groups, in the column's unit; without it, it is that of the pilot. With one batch and
        no `by`, each experiment is the pilot of a group, and a second group differs from it by `difference`. The answer also
        has the power with `runs` runs. Raises NotFound, UsageError, and SierraError if there is nothing to compare.

        >>> found = project.studies.runs_for_power(summary.batch, difference=100)
        >>> found.comparisons[0].test, found.runs > 2
        ('Mann-Whitney test', True)
        """
        from sierra.api.comparisons import requested
        from sierra.deliverables import power as planning

        wanted = planning.Wanted(difference, power, runs)
        pilot = self._project.comparisons.groups(words)
        comparison = requested(
            by=by,
            groups=tuple(groups),
            column=column,
            table=table,
            measure=measure,
            threshold=threshold,
            paired=paired,
            alpha=alpha,
        )
        return planning.runs_for_power(self._loaded, self._store, pilot, comparison, wanted)


class Jobs(Noun):
    """Jobs on clusters: `project.jobs`."""

    def status(self, prefix: str | None = None, *, observer: Observer | None = None) -> list[ClusterSession]:
        """Return the state of cluster jobs, of all batches or of one. Record the runs that have finished there first.

        >>> project.jobs.status()
        []
        """
        from sierra.execution import sessions, unrecorded

        store = self._project.stored()
        if store is not None and observer is not None:
            for session in unrecorded.found(store.paths):
                observer.notice(str(session))
        if store is None or (prefix is None and not sessions.submitted(store.paths)):
            return []
        from sierra.execution import cluster_status

        return cluster_status.standing(store, prefix, observer)

    def left(self, summary: Summary) -> list[ClusterSession]:
        """Return the state of the cluster jobs that the summary's session left running.

        >>> project.jobs.left(summary)
        []
        """
        if not summary.detached:
            return []
        from sierra.execution import cluster_status

        sessions = (cluster_status.submitted(self._store.paths.session(session)) for session in summary.detached)
        return [session for session in sessions if session is not None]

    def attach(
        self,
        prefix: str,
        *,
        figures: bool = True,
        observer: Observer | None = None,
        progress: bool | None = None,
    ) -> Summary:
        """Reattach to a detached batch and wait for it. Raises NotFound if the batch has no jobs on a cluster.

        >>> project.jobs.attach(summary.batch)
        Traceback (most recent call last):
        sierra.errors.NotFound: ...
        """
        from sierra.execution import takeover

        batch = self._project.records.id(prefix)
        summary = described(self._project, takeover.follow(self._store, batch, observer or observer_for(progress)))
        return drawn(self._project, summary) if figures else summary

    def cancel(self, prefix: str, *, observer: Observer | None = None) -> list[Cancelled]:
        """Cancel a batch's jobs on a cluster, and keep finished runs. Raises NotFound if the batch has no jobs there.

        >>> project.jobs.cancel(summary.batch)
        Traceback (most recent call last):
        sierra.errors.NotFound: ...
        """
        from sierra.execution import takeover
        from sierra.execution.observer import Observer

        return takeover.cancel(self._store, self._project.records.id(prefix), observer or Observer())


def described(project: Project, summary: Summary) -> Summary:
    """Return the summary with a description of the outputs, if its sessions are the first with such tables or files."""
    if summary.interrupted or not summary.sessions:
        return summary
    from sierra.execution import outputs_taken

    if not any(outputs_taken.is_new(project.store, session) for session in summary.sessions):
        return summary
    return replace(summary, outputs=taken(project, summary.batch, inside=False))


def taken(project: Project, batch: str, *, inside: bool) -> TakenOutputs:
    """Return how a batch's outputs were read; with `inside`, also by a look into its files."""
    from sierra.execution import outputs_taken, targets

    declared = targets.of_batch(project.loaded, project.store, batch).config.outputs
    outputs = outputs_taken.taken(project.store, batch, declared, inside=inside)
    return replace(outputs, target=targets.recorded(project.store, batch)) if project.targets else outputs


def drawn(project: Project, summary: Summary) -> Summary:
    """Return the summary with figures, if there is something to draw."""
    if summary.interrupted or summary.detached or summary.missing + summary.failed == summary.runs:
        return summary
    from sierra.deliverables import render

    try:
        files, notes = render.figures(project.loaded, project.store, summary.batch, again=False)
    except Missing as error:
        return replace(summary, figure_error=str(error))
    return replace(summary, figures=tuple(map(str, files)), notes=(*summary.notes, *notes))

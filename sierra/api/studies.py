"""Studies: how many runs are enough, and executions until they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

from sierra.api.noun import Noun
from sierra.api.options import observer_for
from sierra.model import Measure
from sierra.store.store import Store

if TYPE_CHECKING:
    from sierra.deliverables.power import RunsForPower
    from sierra.deliverables.sample_size import RunsNeeded
    from sierra.deliverables.studies.study import Outcome as StudyOutcome
    from sierra.execution.observer import Observer
    from sierra.execution.plan import Plan
    from sierra.execution.summary import Summary


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
        from sierra.api.summaries import drawn
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

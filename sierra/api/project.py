"""A project: the methods to plan, run, replay and query, and nouns with all others."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from sierra.api.noun import FORMER, former_method, noun, observer_for, slots, within_project
from sierra.config import current_project, find_project
from sierra.errors import UsageError
from sierra.store.layout import ProjectPaths, StorePaths
from sierra.store.store import Store

if TYPE_CHECKING:
    import pandas as pd

    from sierra.api.claims import Claims
    from sierra.api.comparisons import Comparisons
    from sierra.api.deliverables import Deliverables
    from sierra.api.execution import Jobs, Plans, Studies
    from sierra.api.images import Images
    from sierra.api.packages import Packages
    from sierra.api.paper import Paper
    from sierra.api.records import Maintenance, Records, Sources
    from sierra.config import project_file
    from sierra.execution.list_batches import ListedBatch
    from sierra.execution.observer import Observer
    from sierra.execution.plan import Plan
    from sierra.execution.run_options import RunOptions
    from sierra.execution.summary import Summary
    from sierra.execution.trial import Trial
    from sierra.replay.verdicts import Replay, Tolerances
    from sierra.store.derived_tables import Rules
    from sierra.store.public_result import Result


@within_project
class Project:
    """A project: its `sierra.toml` and its store. `sierra.open` returns one.

    Methods accept ids as prefixes of at least 4 digits. All errors are subclasses of `SierraError`. A method that waits for
    runs shows its progress in a notebook; elsewhere it shows none. `progress` overrides this: True shows it, False does not.

    Methods about one kind of thing belong to a noun, as in `project.images.pin()`: `dir(project)` lists the nouns.

    >>> project = sierra.open(".")
    >>> project.root.name
    'project'
    """

    plans: Plans = noun("execution")
    studies: Studies = noun("execution")
    jobs: Jobs = noun("execution")
    records: Records = noun()
    deliverables: Deliverables = noun()
    comparisons: Comparisons = noun()
    claims: Claims = noun()
    paper: Paper = noun()
    packages: Packages = noun()
    images: Images = noun()
    sources: Sources = noun("records")
    maintenance: Maintenance = noun("records")

    def __init__(self, path: str | os.PathLike[str] = ".", *, received: bool = False) -> None:
        """Open the project that contains the folder `path`, or only the store there. Raises Missing if there is neither.

        If it was `received` from somebody, names of its queries do not stand for batches: nothing of it is planned here.
        """
        self.received = received
        self.folder = find_project.find_store(Path(path))
        self.paths = ProjectPaths(self.folder.root)

    def _plugins(self) -> AbstractContextManager[None]:
        """Return a context in which the names of plug-ins in files of the project count. Nothing is read for it."""
        return current_project.within((self.root, ""), lambda: self.loaded.declared_plugins())

    def _repr_html_(self) -> str:
        from sierra.util import html
        from sierra.util.hashing import short

        batches = self.batches[-html.ROWS :] if self.stored() else []
        rows = ((short(batch.batch), batch.query, batch.runs, batch.failed, batch.missing) for batch in batches)
        return html.page(f"SIERRA project {self.root}", ("batch", "query", "runs", "failed", "missing"), rows)

    def __repr__(self) -> str:
        return f"sierra.open({str(self.root)!r})"

    @property
    def root(self) -> Path:
        """The absolute path of the project's folder."""
        return self.folder.root

    @property
    def file(self) -> Path:
        """The absolute path of the project's file: `sierra.toml` or `pyproject.toml`.

        >>> project.file.name
        'sierra.toml'
        """
        return self.folder.file

    @cached_property
    def loaded(self) -> project_file.LoadedProject:
        """The project's file with its configuration; if only a store exists, its outputs are the ones that were recorded last.

        >>> project.loaded.written
        True
        """
        from sierra.config import project_file

        loaded = project_file.read(self.folder)
        if loaded.written:
            return loaded
        from sierra.execution import plan_from_record

        outputs = plan_from_record.last_outputs(self.store)
        return replace(loaded, config=loaded.config.model_copy(update={"outputs": outputs}))

    @property
    def config(self) -> project_file.Project:
        """The content of `sierra.toml`, for its default target; if there is no file, the settings that the store implies."""
        return self.loaded.config

    @property
    def targets(self) -> tuple[str, ...]:
        """The names of the targets in `sierra.toml`.

        >>> project.targets
        ()
        """
        return self.loaded.targets

    @property
    def store(self) -> Store:
        """The project's store. Raises Missing if nothing has been run yet."""
        store = Store(self.paths.store, self._rules)
        return store.confined() if self.folder.is_package else store

    def _rules(self) -> Rules:
        """Return the derived tables, and the limits on SQL. A project without any is not validated: that takes too long."""
        from sierra.config.targets import inner_table
        from sierra.store.derived_tables import Rules

        declared = (find_project.settings(self.folder.file) or {}) if self.folder.written else {}
        tables = (declared, *inner_table(declared, "targets").values())
        accepts = any("accept" in inner_table(table, "success") for table in tables)
        return self.loaded.rules() if {"tables", "sql"} & declared.keys() or accepts else Rules()

    def stored(self) -> Store | None:
        """Return the project's store; None if there is none yet."""
        return self.store if StorePaths(self.paths.store).format.exists() else None

    def plan(
        self,
        *query: str,
        runs: int | None = None,
        controller: str | None = None,
        scenario: str | None = None,
        sets: Sequence[tuple[str, str]] = (),
        target: str | None = None,
        engine: str | None = None,
        observer: Observer | None = None,
    ) -> Plan:
        """Return the plan of a query: the batch that it would execute, with all ids.

        `sets` are pairs of XPath and value. `target` is the name of a target in `sierra.toml`. `engine` is the engine that
        isolates the runs; it overrides the project's. `observer` receives the progress of planning.

        A prefix of a recorded batch's id instead of a query plans that batch with the recorded code and inputs. Raises
        QueryError, UsageError, TemplateError. A program that is not found is named by the plan's `lacking`; to execute such a
        plan raises Missing.

        >>> plan = project.plan("population_size=1,2,4", runs=3)
        >>> len(plan.batch.experiments), len(plan.batch.runs)
        (3, 9)
        """
        from sierra.design.query import query_request
        from sierra.store.store import PREFIX

        [word] = query if len(query) == 1 else ("",)
        if PREFIX.fullmatch(word.lower()) and word not in self.config.queries and self.stored():
            if runs or controller or scenario or sets or target:
                raise UsageError(
                    f"batch {word} is executed as it was recorded; "
                    "leave out --runs, --controller, --scenario, --set and --target"
                )
            from sierra.execution import plan_from_record

            return plan_from_record.plan(self.loaded, self.store, word, contained=engine)
        request = query_request.request(query, runs=runs, controller=controller, scenario=scenario, sets=sets, target=target)
        return self.plans.resolve(request, engine=engine, observer=observer)

    def run(
        self,
        *query: str,
        runs: int | None = None,
        controller: str | None = None,
        scenario: str | None = None,
        sets: Sequence[tuple[str, str]] = (),
        target: str | None = None,
        jobs: int | None = None,
        fail_fast: bool = False,
        figures: bool = True,
        observer: Observer | None = None,
        engine: str | None = None,
        runner: str | None = None,
        detach: bool = False,
        progress: bool | None = None,
        only: str | None = None,
        retry: bool = False,
    ) -> Summary:
        """Run a query: execute its missing runs, record them, and draw the figures.

        `jobs` is the number of runs that execute at the same time (default: the user's setting, or the number of usable cores).
        `observer` receives the progress and notices instead: see `Observer`. `runner` is where runs execute: `local`, or the
        name of a cluster (default: the `runner` in `sierra.toml`); with `detach`, this function returns once the jobs are
        submitted. `only` is a condition that selects the experiments to execute, as in `population_size<=4`: see
        `sierra.design.query.condition`. Runs that failed twice in the same way are executed again only with `retry`.
        The summary counts failed runs; they raise no error. Raises the errors of `plan`, and Missing if the disk is full, or if
        an extension needs a person to execute them.

        >>> summary = project.run("population_size=1,2", runs=2, figures=False)
        >>> summary.runs, summary.failed, summary.missing
        (4, 0, 0)
        """
        plan = self.plan(*query, runs=runs, controller=controller, scenario=scenario, sets=sets, target=target, engine=engine)
        return self.execute(
            plan,
            jobs=jobs,
            fail_fast=fail_fast,
            figures=figures,
            observer=observer,
            runner=runner,
            detach=detach,
            progress=progress,
            only=only,
            retry=retry,
        )

    def execute(
        self,
        plan: Plan,
        *,
        jobs: int | None = None,
        fail_fast: bool = False,
        figures: bool = True,
        observer: Observer | None = None,
        runner: str | None = None,
        detach: bool = False,
        progress: bool | None = None,
        only: str | None = None,
        retry: bool = False,
    ) -> Summary:
        """Execute a plan as `run` does. `observer` receives progress and notices, and decides about jobs on a cluster.

        >>> project.execute(project.plan("population_size=1,2", runs=2), figures=False).executed
        0
        """
        from sierra.api.execution import described, drawn, selection
        from sierra.execution import execute
        from sierra.execution.run_options import RunOptions

        plan.check_programs()
        selected = selection(plan, only)
        options = RunOptions(
            slots(jobs),
            self.plans.runner(plan, runner, detach=detach, jobs=jobs),
            fail_fast,
            None if selected is None else selected.runs,
            observer=observer or observer_for(progress),
            detach=detach,
            retry=retry,
        )
        self.plans.check_attended(plan, only)
        store = Store.create(self.paths.store)
        if self.config.claims:
            self._register_claims(store, options.observer)
        plan = self.plans.build(plan, observer=options.observer)
        probed = self._probe(plan, store, options) if self._is_probed(plan) else ()
        summary = execute.run(plan, store, options)
        summary = described(self, replace(summary, notes=(*probed, *summary.notes)))
        return drawn(self, summary) if figures else summary

    def _register_claims(self, store: Store, observer: Observer) -> None:
        from sierra.deliverables.claims.registration import register

        for name, reason in register(self.loaded, store).refused.items():
            observer.notice(f"claim {name} is not registered: {reason}")

    @staticmethod
    def _is_probed(plan: Plan) -> bool:
        """Return whether a run is executed twice before the batch; an extension's step executes each run once."""
        from sierra.execution.plan import session_step

        return plan.project.config.determinism.probe and session_step(plan.project) is None

    def try_run(
        self,
        *query: str,
        controller: str | None = None,
        scenario: str | None = None,
        sets: Sequence[tuple[str, str]] = (),
        target: str | None = None,
        seed: int | None = None,
        experiment: int = 0,
        engine: str | None = None,
        observer: Observer | None = None,
        show: Callable[[str, bytes], None] = lambda log, content: None,
    ) -> Trial:
        """Execute one run without recording it: the first one of an experiment of a query; return what it did.

        Without a query, the template stays as it is, except for the seed. `seed` is the run's seed instead of the one that the
        batch would use. `show` receives what the program prints while it runs: `stdout` or `stderr`, and the next bytes.
        The run's folder stays until the next trial. A build that the run needs is recorded. Raises the errors of `plan`.

        >>> trial = project.try_run("population_size=4")
        >>> str(trial.status), [(file.path, file.table, file.rows) for file in trial.files]
        ('ok', [('swarm.csv', 'swarm', 5)])
        """
        from sierra.design.query import query_request
        from sierra.execution import trial
        from sierra.execution.observer import Observer

        observer = observer or Observer()
        words = query or (trial.UNCHANGED,)
        request = query_request.request(words, runs=1, controller=controller, scenario=scenario, sets=sets, target=target)
        plan = self.plans.build(self.plans.resolve(request, engine=engine, observer=observer), observer=observer)
        run, files = trial.choose(plan, experiment, seed)
        return trial.attempt(plan, run, files, StorePaths(self.paths.store), observer, show)

    def sql(self, text: str, *, within: str | None = None, **parameters: object) -> Result:
        """Return the result of one SQL statement: an Arrow table that notebooks show (see `Result`).

        `$name` in the statement takes its value from the keyword `name`. `within` is a prefix of a batch's id: then the
        tables show only the runs and outputs of that batch. Otherwise they show those of all batches, regardless of their code.
        If a column v has numbers in some runs and texts in others, the texts are in v_text, and the schema's metadata
        `sierra:note` reports it. Raises SqlError, and UsageError for `batch` where `within` is meant.

        >>> project.sql("SELECT max(coverage) AS most FROM swarm WHERE tick = $t", within=summary.batch, t=0).num_rows
        1
        """
        from sierra.store.public_result import Result

        if "batch" in parameters and "$batch" not in text:
            raise UsageError(f"the statement has no $batch; to query one batch, write within={parameters['batch']!r}")
        return Result(self.store.sql(text, within=None if within is None else self.records.batch(within), **parameters))

    def frame(self, table: str, *, within: str | None = None, **parameters: object) -> pd.DataFrame:
        """Return a table of the store, or the result of a SQL statement, as a pandas data frame.

        `table` is a name, as `SHOW TABLES` lists them, or a statement; the other arguments are those of `sql`. The frame has a
        row for each row and a column for each column of the table; `DESCRIBE` gives the units. Raises SqlError, and Missing if
        pandas is not installed (the extra `figures`).

        >>> project.frame("swarm", within=summary.batch).shape[0]
        20
        >>> list(project.frame("SELECT avg(coverage) AS mean FROM swarm").columns)
        ['mean']
        """
        named = re.fullmatch(r"[^\W\d]\w*", table)
        return self.sql(f'FROM "{table}"' if named else table, within=within, **parameters).frame()

    @property
    def batches(self) -> list[ListedBatch]:
        """All batches, the most recently requested last: see `sierra.execution.list_batches.ListedBatch`.

        >>> project.batches[0].query
        'population_size=1,2'
        """
        from sierra.execution import list_batches

        return list_batches.batches(self.store)

    def replay(
        self,
        prefix: str,
        *,
        runs: int | None = None,
        jobs: int | None = None,
        runner: str = "local",
        engine: str | None = None,
        tolerances: Tolerances | None = None,
        keep: bool = False,
        record: bool = True,
        unattended: bool = False,
        observer: Observer | None = None,
        progress: bool | None = None,
    ) -> Replay:
        """Replay a batch, experiment, run or execution from the record alone, and compare the results.

        `runs`: replay at most this number of runs of each experiment, the first ones. `tolerances`: by output and column (`*`:
        all); they override those in `sierra.toml`. `keep`: do not remove the restored source and the folders of the runs.
        Without `record`, nothing is written to the store, which may be read-only. `unattended`: robots may move without a
        person, although their trials are supervised. `observer` receives differences from the recorded environment before
        anything executes. Raises NotFound, and Missing if something necessary no longer exists, or if robots need a person.

        >>> print(project.replay(summary.batch, runs=1).verdict)
        identical
        """
        from sierra.replay import replay
        from sierra.replay.options import ReplayOptions

        options = ReplayOptions(slots(jobs), runs, runner, engine, tolerances or {}, keep, unattended=unattended)
        execute = replay.replay if record else replay.unrecorded
        return execute(self.loaded, self.store, self.records.id(prefix), options, observer or observer_for(progress))

    def statistics(
        self,
        prefix: str | None,
        output: str,
        column: str,
        *,
        measure: str | None = "auto",
        threshold: float | None = None,
        times: str | None = None,
        statistics: Sequence[str] = (),
        where: str = "",
    ) -> Result:
        """Return statistics of a column over the runs of each experiment of a batch: n, mean, sd, interval, median, ….

        `statistics` chooses some by name: `mean`, `median`, `iqm`, `sd`, `iqr`, `mad`, `range`, quantiles such as `q90`, and
        plug-ins; for `time_to` also `km_median` and `restricted_mean`, in which runs that never reach the threshold count as
        censored. Each has the columns `NAME`, `NAME_low`, `NAME_high` and `NAME_interval`, the method of its 95 % interval.
        `where` is an SQL condition on the rows that count.

        First, `measure` reduces each run to one value: `final`, `mean` of its rows, `time_mean` (by trapezoids, or by
        steps with `times="carry"`), or `time_to` a `threshold`; `auto` is `final`, or `mean` in a table of events: without a
        time column, and with different numbers of rows. With `measure=None`,
        there is a row for each experiment and time instead: the runs' `own` times, or common ones (`carry`: last values
        carried forward, `linear`: interpolated). With `measure="time_to"` and `times="own"`, there is a row for each step of
        the Kaplan-Meier curves: the part of the runs that has not reached the threshold at `t` (`remaining`), its interval, and
        the numbers of runs `at_risk`, `reached` and `censored`. Column `experiment` is the experiment's place in the batch; the
        values of the axes follow it. The schema's metadata hold the statement (`sierra:sql`) and notes on everything that is
        not in the numbers (`sierra:note`). Values have the unit of the column. Raises NotFound, UsageError.

        >>> project.statistics(summary.batch, "swarm", "coverage", measure="mean").column("n").to_pylist()
        [2, 2]
        """
        from sierra.deliverables import run_statistics

        batch = self.records.batch(prefix)
        return run_statistics.StatisticsResult(
            run_statistics.statistics(
                self.loaded, self.store, batch, output, column, measure, threshold, times, statistics, where=where
            )
        )

    def _probe(self, plan: Plan, store: Store, options: RunOptions) -> tuple[str, ...]:
        from sierra.replay import determinism  # loads everything that a replay needs

        return determinism.probe(plan, store, options)

    if not TYPE_CHECKING:  # so that a type checker reports former names, and names that do not exist

        def __getattr__(self, name: str) -> object:
            if name not in FORMER:
                raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
            return former_method(self, name)

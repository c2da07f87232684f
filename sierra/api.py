"""The Python interface of SIERRA: the actions of the command line, as functions that return values.

The examples in docstrings are executed by a test, in a project with the variables `population_size` and `noise` whose runs
write a table `swarm` with the columns `tick` and `coverage`.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import cached_property, partial, wraps
from pathlib import Path
from types import FunctionType
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from sierra.config import current_project, find_project
from sierra.errors import ConfigError, Damaged, Missing, NotFound, UsageError
from sierra.model import Measure
from sierra.store.layout import ProjectPaths, StorePaths
from sierra.store.store import Store
from sierra.util import processors
from sierra.util.lazy_definitions import regex
from sierra.util.processors import ARCH

if TYPE_CHECKING:
    import pandas as pd

    from sierra.config import project_file
    from sierra.config.output_tables import Key
    from sierra.containers.images.image import Image
    from sierra.containers.images.image_contents import Contents
    from sierra.containers.images.listing import Known
    from sierra.deliverables.check import Checked, ShownDeliverable
    from sierra.deliverables.claims.evaluate import Evaluated
    from sierra.deliverables.claims.registration import NewRegistrations
    from sierra.deliverables.claims.regression import Changed
    from sierra.deliverables.comparison import Compared
    from sierra.deliverables.errors_of_models import ModelErrors
    from sierra.deliverables.paper.folder import Written as PaperWritten
    from sierra.deliverables.power import RunsForPower
    from sierra.deliverables.report.files import Written
    from sierra.deliverables.sample_size import RunsNeeded
    from sierra.deliverables.studies.study import Outcome as StudyOutcome
    from sierra.design.query.query_request import QueryRequest
    from sierra.execution.cluster_status import ClusterSession
    from sierra.execution.list_batches import ListedBatch
    from sierra.execution.observer import Observer
    from sierra.execution.outputs_taken import TakenOutputs
    from sierra.execution.plan import Plan
    from sierra.execution.run_options import RunOptions
    from sierra.execution.shown_records import Shown, ShownClaim, ShownSession
    from sierra.execution.summary import Summary
    from sierra.execution.takeover import Cancelled
    from sierra.execution.trial import Trial
    from sierra.execution.write_inputs import WrittenInputs
    from sierra.explain.diff.compare import Comparison
    from sierra.explain.why_executed import Why
    from sierra.maintenance.fsck import Report
    from sierra.maintenance.gc import Collection
    from sierra.maintenance.remove import Removal
    from sierra.maintenance.repair import Repair
    from sierra.packages.pack import Packed, Preview
    from sierra.packages.parts.metadata import Metadata
    from sierra.packages.reading.differences import PackageDifferences
    from sierra.packages.reading.imports import Imported
    from sierra.packages.reproduction.outcome import Reproduction, Statement
    from sierra.packages.subject import ImageForm
    from sierra.provenance.commits_between import Known as CommitInRepository
    from sierra.provenance.source.share_refs import Shared
    from sierra.replay.verdicts import Replay, Tolerances
    from sierra.runners.cluster.resource_estimate import Estimate
    from sierra.store.derived_tables import Rules
    from sierra.store.export_recorded_files import Listing, Outcome
    from sierra.store.public_result import Result
    from sierra.store.row_types import SourceRow

PACKAGED = ".zip"
"""The ending of packages."""
IN_PACKAGE = regex(r"(?:([^=/]+)=)?(.+\.zip)(?::(\w+))?")
"""A batch in a package: an optional label, the path, and an optional prefix of the batch's id."""


T = TypeVar("T")


def _within_project(project: type[T]) -> type[T]:
    """Let the plug-ins of a project count in all of its methods: see `sierra.config.current_project`."""
    for name, method in vars(project).items():
        if isinstance(method, FunctionType) and not name.startswith("_"):
            setattr(project, name, _within(method))
    return project


def _within(method: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(method)
    def call(project: Project, *arguments: Any, **named: Any) -> Any:
        with project._plugins():
            return method(project, *arguments, **named)

    return call


@_within_project
class Project:
    """A project: its `sierra.toml` and its store. `sierra.open` returns one.

    Methods accept ids as prefixes of at least 4 digits. All errors are subclasses of `SierraError`. A method that waits for
    runs shows its progress in a notebook; elsewhere it shows none. `progress` overrides this: True shows it, False does not.

    >>> project = sierra.open(".")
    >>> project.root.name
    'project'
    """

    def __init__(self, path: str | os.PathLike[str] = ".", *, received: bool = False) -> None:
        """Open the project that contains the folder `path`, or only the store there. Raises Missing if there is neither.

        If it was `received` from somebody, names of its queries do not stand for batches: nothing of it is planned here.
        """
        self._received = received
        self._found = find_project.find_store(Path(path))
        self.paths = ProjectPaths(self._found.root)

    @cached_property
    def _loaded(self) -> project_file.LoadedProject:
        return self._read()

    def _read(self) -> project_file.LoadedProject:
        """Return the project as its file is now; if only a store exists, its outputs are the ones that were recorded last."""
        from sierra.config import project_file

        loaded = project_file.read(self._found)
        if loaded.written:
            return loaded
        from sierra.execution import plan_from_record

        outputs = plan_from_record.last_outputs(self.store)
        return replace(loaded, config=loaded.config.model_copy(update={"outputs": outputs}))

    def _plugins(self) -> AbstractContextManager[None]:
        """Return a context in which the names of plug-ins in files of the project count. Nothing is read for it."""
        return current_project.within((self.root, ""), lambda: self._loaded.declared_plugins())

    def _repr_html_(self) -> str:
        from sierra.util import html
        from sierra.util.hashing import short

        batches = self.batches[-html.ROWS :] if self.stored() else []
        rows = ((short(one.batch), one.query, one.runs, one.failed, one.missing) for one in batches)
        return html.page(f"SIERRA project {self.root}", ("batch", "query", "runs", "failed", "missing"), rows)

    def __repr__(self) -> str:
        return f"sierra.open({str(self.root)!r})"

    @property
    def root(self) -> Path:
        """The absolute path of the project's folder."""
        return self._found.root

    @property
    def file(self) -> Path:
        """The absolute path of the project's file: `sierra.toml` or `pyproject.toml`.

        >>> project.file.name
        'sierra.toml'
        """
        return self._found.file

    @property
    def loaded(self) -> project_file.LoadedProject:
        """The project's file with its configuration, for extensions.

        >>> project.loaded.written
        True
        """
        return self._loaded

    @property
    def config(self) -> project_file.Project:
        """The content of `sierra.toml`, for its default target; if there is no file, the settings that the store implies."""
        return self._loaded.config

    @property
    def targets(self) -> tuple[str, ...]:
        """The names of the targets in `sierra.toml`.

        >>> project.targets
        ()
        """
        return self._loaded.targets

    @property
    def store(self) -> Store:
        """The project's store. Raises Missing if nothing has been run yet."""
        store = Store(self.paths.store, self._rules)
        return store.confined() if self._found.is_package else store

    def _rules(self) -> Rules:
        """Return the derived tables, and the limits on SQL. A project without any is not validated: that takes too long."""
        from sierra.config.targets import inner_table
        from sierra.store.derived_tables import Rules

        declared = (find_project.settings(self._found.file) or {}) if self._found.written else {}
        tables = (declared, *inner_table(declared, "targets").values())
        accepts = any("accept" in inner_table(table, "success") for table in tables)
        return self._loaded.rules() if {"tables", "sql"} & declared.keys() or accepts else Rules()

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

            return plan_from_record.plan(self._loaded, self.store, word, contained=engine)
        request = query_request.request(query, runs=runs, controller=controller, scenario=scenario, sets=sets, target=target)
        return self.resolve(request, engine=engine, observer=observer)

    def plans(
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
        """Return the plans of a query for several targets: the arguments are those of `plan`.

        The runs of their batches are pairs: they have the same values and the same seeds. Raises QueryError if they have not.

        >>> project.plans("population_size=1,2", targets=["sim", "robots"])
        Traceback (most recent call last):
        sierra.errors.UsageError: ...
        """
        from sierra.execution import targets as of_query

        of_query.check_names(targets)
        plan = partial(self.plan, *query, runs=runs, controller=controller, scenario=scenario, sets=sets)
        plans = [plan(target=name, engine=engine, observer=observer) for name in targets]
        of_query.check_pairs(plans)
        return plans

    def resolve(self, request: QueryRequest, *, engine: str | None = None, observer: Observer | None = None) -> Plan:
        """Return the plan of a query request: see `plan`.

        >>> from sierra.design.query.query_request import request
        >>> len(project.resolve(request(["population_size=1,2"], runs=2)).batch.runs)
        4
        """
        from sierra.execution import resolve_plan
        from sierra.execution.observer import Observer
        from sierra.explain.unbuilt_programs import unbuilt

        plan = resolve_plan.plan(self._loaded, request, engine=engine, report=(observer or Observer()).planning)
        return replace(plan, notes=(*plan.notes, *unbuilt(plan, self.stored())))

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
        from sierra.design.query import condition
        from sierra.execution import execute
        from sierra.execution.run_options import RunOptions

        plan.check_programs()
        selected = None if only is None else condition.select(only, plan.batch, plan.project.config).runs
        options = RunOptions(
            slots(jobs),
            self.runner_of(plan, runner, detach=detach, jobs=jobs),
            fail_fast,
            selected,
            observer=observer or observer_for(progress),
            detach=detach,
            retry=retry,
        )
        self.check_attended(plan, only)
        store = Store.create(self.paths.store)
        if self.config.claims:
            self._register_claims(store, options.observer)
        plan = self.build(plan, observer=options.observer)
        probed = self._probe(plan, store, options) if self._is_probed(plan) else ()
        summary = execute.run(plan, store, options)
        summary = self._described(replace(summary, notes=(*probed, *summary.notes)))
        return self._drawn(summary) if figures else summary

    def study(
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
        receives the progress of planning. The other arguments are those of `execute`. Raises the errors of `plan`, and NotFound
        for a rule that does not fit the runs.

        >>> outcome = project.study(project.plan("population_size=1", runs=3), until="ci(coverage) < 100", max_runs=6)
        >>> print(outcome.decision, [look.row.runs for look in outcome.looks])
        reached [3]
        """
        from sierra.deliverables.studies import study

        planned = study.design(self._loaded, plan, until, max_runs)
        told = observer or observer_for(progress)

        def larger(runs: int) -> Plan:
            request = plan.request.model_copy(update={"runs": runs})
            return self.resolve(request, engine=plan.engine.name, observer=planning or told)

        def execute(look: Plan) -> Summary:
            return self.execute(look, jobs=jobs, fail_fast=fail_fast, figures=False, observer=told, runner=runner)

        plan.check_programs()
        self.runner_of(plan, runner)
        store = Store.create(self.paths.store)
        outcome = study.conduct(self._loaded, store, planned, plan, study.Actions(larger, execute), told)
        if not figures or outcome.summary is None or outcome.decision in (None, "continue"):
            return outcome
        return replace(outcome, summary=self._drawn(outcome.summary))

    def planned_study(self, plan: Plan, *, until: str, max_runs: int) -> StudyOutcome:
        """Return the study that `study` would begin or continue, with the looks that are recorded. Executes nothing.

        >>> plan = project.plan("population_size=1", runs=2)
        >>> project.planned_study(plan, until="ci(coverage) < 5%", max_runs=5).design.schedule
        (2, 3, 5)
        """
        from sierra.deliverables.studies import study

        planned = study.design(self._loaded, plan, until, max_runs)
        store = self.stored()
        return (study.find(store, planned.row.study) if store else None) or study.Outcome(planned, (), {})

    def check_attended(self, plan: Plan, only: str | None = None) -> None:
        """Check that no missing run of a plan needs a person who is not there. Raises Missing.

        `only`: the condition of the runs that are to be executed, as in `run`.

        >>> project.check_attended(project.plan("population_size=8"))
        """
        from sierra.execution.plan import session_step

        step = session_step(plan.project)
        if step is None:
            return
        from sierra.design.query import condition
        from sierra.execution.reuse import states

        selected = None if only is None else condition.select(only, plan.batch, plan.project.config)
        runs = selected.runs if selected else {run.id for run in plan.batch.runs}
        step.check_missing({run for run, one in states(plan, self.stored()).items() if run in runs and not one.succeeded})

    @staticmethod
    def _is_probed(plan: Plan) -> bool:
        """Return whether a run is executed twice before the batch; an extension's step executes each run once."""
        from sierra.execution.plan import session_step

        return plan.project.config.determinism.probe and session_step(plan.project) is None

    def runner_of(self, plan: Plan, runner: str | None = None, *, detach: bool = False, jobs: int | None = None) -> str:
        """Return the name of the runner of a plan: `runner`, or the one in `sierra.toml`. Raises ConfigError, UsageError.

        `jobs`: the requested number of runs at a time, which an extension may refuse.

        >>> project.runner_of(project.plan("population_size=8"))
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
        plan = self.build(self.resolve(request, engine=engine, observer=observer), observer=observer)
        run, files = trial.choose(plan, experiment, seed)
        return trial.attempt(plan, run, files, StorePaths(self.paths.store), observer, show)

    def write_inputs(self, plan: Plan, folder: str | os.PathLike[str], *, only: str | None = None) -> WrittenInputs:
        """Write the inputs and commands of a plan's runs into a new folder, and execute nothing.

        `only`: as in `run`. See `sierra.execution.write_inputs` for the files. Raises UsageError if the folder is not empty.

        >>> project.write_inputs(project.plan("population_size=1,2", runs=2), "../inputs").runs
        4
        """
        from sierra.design.query import condition
        from sierra.execution import write_inputs

        selection = None if only is None else condition.select(only, plan.batch, plan.project.config)
        return write_inputs.write(plan, Path(folder), selection)

    def build(self, plan: Plan, *, observer: Observer | None = None) -> Plan:
        """Build the products of `[build]` if they are not up to date; return the plan with them. `execute` does this too.

        `observer` receives a notice before something is built. Raises SierraError if the build fails.

        >>> project.build(project.plan("population_size=1,2", runs=2)).build is None
        True
        """
        plan.check_programs()
        if plan.build is None or plan.build.reason is None:
            return plan
        from sierra.execution.observer import Observer
        from sierra.execution.ready_build import ready

        built = ready(plan, Store.create(self.paths.store), observer or Observer())
        built.check_programs()
        return built

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
        return Result(self.store.sql(text, within=None if within is None else self.batch(within), **parameters))

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

    def show(self, prefix: str) -> Shown | ShownClaim | StudyOutcome:
        """Return the record of a batch, experiment, run, execution, session, study or registered claim, by a prefix of its id.

        Each kind has a class in `sierra.execution.shown_records`, a study in `sierra.deliverables.studies.study`; its `as_dict`
        returns what `sierra show --json` prints. Raises NotFound.

        >>> project.show(summary.batch).kind
        'batch'
        """
        from sierra.execution.show_record import show
        from sierra.execution.shown_records import ShownBatch, ShownExecution

        prefix = self.record_id(prefix)
        if (outcome := self._shown_other(prefix)) is not None:
            return outcome
        try:
            shown = show(self.store, prefix)
        except NotFound:
            if (session := self._session(prefix)) is None:
                raise
            return session
        match shown:
            case ShownBatch():
                last = next((self._log_file(session.session) for session in reversed(shown.sessions)), None)
                return replace(shown, history=self._history(shown.source), log_file=last)
            case ShownExecution():
                return replace(shown, log_file=self._log_file(shown.row.session))
            case _:
                return shown

    def deliverable(self, file: str | os.PathLike[str]) -> ShownDeliverable:
        """Return the record of a figure's file: what it shows, from which data, and whether it still follows from the store.

        The file is found by its content, so that it may have another name or be in another folder. Raises NotFound.

        >>> project.deliverable(project.figures(summary.batch)[0]).problem is None
        True
        """
        from sierra.deliverables import check

        return check.find(self._loaded, self.store, Path(file), self.compare_declared)

    def _shown_other(self, prefix: str) -> StudyOutcome | ShownClaim | None:
        """Return the study or the registered claim with this id; None if the id is that of another object."""
        try:
            found = self.store.identify(prefix)
        except NotFound:
            return None
        if found.kind == "claim":
            return self._shown_claim(found.id)
        if found.kind != "study":
            return None
        from sierra.deliverables.studies import study

        outcome = study.find(self.store, found.id)
        return outcome and study.checked(self._loaded, self.store, outcome)

    def _shown_claim(self, claim: str) -> ShownClaim:
        import json

        from sierra.execution.shown_records import ShownClaim
        from sierra.store.row_types import RegisteredClaimRow
        from sierra.util.json_types import as_object

        text = "SELECT * FROM registered_claims WHERE claim = $claim ORDER BY lamport, name"
        rows = self.store.select(RegisteredClaimRow, text, claim=claim)
        try:
            form = as_object(json.loads(rows[0].text))
        except (ValueError, RecursionError) as error:
            raise Damaged(f"the record of claim {claim[:10]} is not JSON; sierra fsck names what is damaged") from error
        return ShownClaim(claim, form, rows)

    def _session(self, prefix: str) -> ShownSession | None:
        """Return the record of a session, or only its log file if it is not recorded; None if there is not exactly one."""
        from sierra.execution.shown_records import ShownSession
        from sierra.store import session_log_file
        from sierra.store.row_types import SessionRow
        from sierra.store.store import PREFIX

        start = prefix.lower()
        if not PREFIX.fullmatch(start):
            return None
        recorded = self.store.select(SessionRow, "SELECT * FROM sessions WHERE starts_with(session, $p)", p=start)
        logged = (path.stem for path in session_log_file.logs(self.store.paths) if path.stem.startswith(start))
        found: dict[str, SessionRow | None] = {**dict.fromkeys(logged), **{row.session: row for row in recorded}}
        if len(found) != 1:
            return None
        [(session, row)] = found.items()
        return ShownSession(session, row, self._log_file(session))

    def _log_file(self, session: str) -> str | None:
        """Return the path of a session's log file; None if it has none any more."""
        from sierra.store import session_log_file

        path = session_log_file.find(self.store.paths, session)
        return str(path) if path else None

    def _history(self, source: SourceRow | None) -> CommitInRepository | None:
        """Return the recorded commit of a source as the repository has it now; None if the repository does not have it."""
        if not (source and source.commit):
            return None
        from sierra.provenance import commits_between

        return commits_between.known(self.root, source.commit)

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
        return execute(self._loaded, self.store, self.record_id(prefix), options, observer or observer_for(progress))

    def proposal(self, plan: Plan, runner: str, *, detach: bool = False, runs: Container[str] | None = None) -> Estimate | None:
        """Return an estimate of the cluster resources that a plan needs: see `sierra.runners.cluster.resource_estimate`.

        `runs`: the ids of the runs to submit, None for all. Return None if the runner is not a cluster, or if there is no run
        to submit.

        >>> print(project.proposal(project.plan("population_size=8"), "local"))
        None
        """
        from sierra.execution import submission_proposal

        return submission_proposal.proposal(plan, self.stored(), runner, detach=detach, runs=runs)

    def status(self, prefix: str | None = None, *, observer: Observer | None = None) -> list[ClusterSession]:
        """Return the state of cluster jobs, of all batches or of one. Record the runs that have finished there first.

        >>> project.status()
        []
        """
        from sierra.execution import sessions, unrecorded

        store = self.stored()
        if store is not None and observer is not None:
            for one in unrecorded.found(store.paths):
                observer.notice(str(one))
        if store is None or (prefix is None and not sessions.submitted(store.paths)):
            return []
        from sierra.execution import cluster_status

        return cluster_status.standing(store, prefix, observer)

    def left(self, summary: Summary) -> list[ClusterSession]:
        """Return the state of the cluster jobs that the summary's session left running.

        >>> project.left(summary)
        []
        """
        if not summary.detached:
            return []
        from sierra.execution import cluster_status

        found = (cluster_status.submitted(self.store.paths.session(session)) for session in summary.detached)
        return [one for one in found if one is not None]

    def attach(
        self,
        prefix: str,
        *,
        figures: bool = True,
        observer: Observer | None = None,
        progress: bool | None = None,
    ) -> Summary:
        """Reattach to a detached batch and wait for it. Raises NotFound if the batch has no jobs on a cluster.

        >>> project.attach(summary.batch)
        Traceback (most recent call last):
        sierra.errors.NotFound: ...
        """
        from sierra.execution import takeover

        summary = self._described(takeover.follow(self.store, self.record_id(prefix), observer or observer_for(progress)))
        return self._drawn(summary) if figures else summary

    def cancel(self, prefix: str, *, observer: Observer | None = None) -> list[Cancelled]:
        """Cancel a batch's jobs on a cluster, and keep finished runs. Raises NotFound if the batch has no jobs there.

        >>> project.cancel(summary.batch)
        Traceback (most recent call last):
        sierra.errors.NotFound: ...
        """
        from sierra.execution import takeover
        from sierra.execution.observer import Observer

        return takeover.cancel(self.store, self.record_id(prefix), observer or Observer())

    def diff(self, before: str, after: str) -> Comparison:
        """Return the differences between two batches, experiments, runs or executions, by prefixes of their ids.

        Differences that probably affect results come first: see `sierra.explain.diff.compare.Comparison`.
        Raises NotFound, UsageError.

        >>> other = project.run("population_size=1,2", runs=1, figures=False)
        >>> [one.name for one in project.diff(summary.batch, other.batch).differences]
        ['runs']
        """
        from sierra.explain.diff.compare import compare

        return compare(self._loaded, self.store, self.record_id(before), self.record_id(after))

    def diff_packages(self, before: str, after: str) -> PackageDifferences:
        """Return the differences between two batches of which at least one is in a package.

        Each is a prefix of a batch's id, or the path of a package: with `:HASH` for one of its batches, else its batch with the
        same id as the other one, or its only one. Raises NotFound, Missing, Damaged.

        >>> project.diff_packages(summary.batch, "theirs.zip")
        Traceback (most recent call last):
            ...
        sierra.errors.Missing: theirs.zip: No such file or directory
        """
        from contextlib import ExitStack

        from sierra.packages.reading import differences

        packaged = {word: match for word in (before, after) if (match := IN_PACKAGE.fullmatch(word))}
        own = {word: self.batch(word) for word in (before, after) if word not in packaged}
        with ExitStack() as opened:
            sides = [
                differences.of_batch(*self._batch_in_package(match[2], match[3], own.values()))
                if (match := packaged.get(word))
                else differences.of_batch(self.store, own[word])
                for word in (before, after)
            ]
            return differences.compare(*map(opened.enter_context, sides))

    def why(self, prefix: str) -> Why:
        """Explain why runs were executed or not, which executions are effective, and what the query would execute now.

        >>> project.why(summary.batch).found.kind
        'batch'
        """
        from sierra.explain import why_executed as why

        return why.why(self._loaded, self.store, self.record_id(prefix))

    def pin(self, name: str | None = None) -> Contents:
        """Pin the image that a name (default: `[container] image`) refers to now in `sierra.lock`; return its content.

        Of a name with `{arch}`, this pins the image for this machine's processor: see `pin_all`. Raises Missing if there is no
        image of that name, Damaged if its content does not match its hash; it pins nothing then.
        """
        from sierra.containers import images

        return images.pin(self.root, Store.create(self.paths.store).paths, self._image(name))

    def pin_all(self, name: str | None = None) -> list[Contents]:
        """Pin the images for all processors that a name with `{arch}` refers to; of another name, its only image.

        Raises as `pin`, and Missing if there is an image for no processor.
        """
        from sierra.containers import images

        store = Store.create(self.paths.store).paths
        return [images.pin(self.root, store, one) for one in images.existing(self.root, self.image_name(name))]

    def build_image(self, name: str | None = None, *, network: bool = False) -> Image:
        """Build an image from a Containerfile folder of the project, and return it. This does not pin it."""
        from sierra.containers.images import build

        return build.build(self.root, self._image(name), network=network)

    def import_image(self, file: str | os.PathLike[str], name: str = "") -> Contents:
        """Import an image's archive after checking it, and return the image's content.

        If podman is available, the image goes into podman's storage, with the tag `name`.
        """
        from sierra.containers.images import import_export

        return import_export.import_archive(self.root, Store.create(self.paths.store).paths, Path(file), name)

    def export_image(self, name: str | None, file: str | os.PathLike[str]) -> Image:
        """Write an image, as it is pinned, to a file. Loading that file elsewhere gives the same image."""
        from sierra.containers.images import import_export

        return import_export.export(self.root, self._image(name), Path(file))

    def image(self, name: str | None = None) -> Contents:
        """Return the content of an image: of the pinned image, otherwise of the image that the name refers to now."""
        from sierra.containers import images

        name = self._image(name)
        image = images.all_pinned(self.root).get(name) or images.named(self.root, name)
        return images.examine(self.root, Store.create(self.paths.store).paths, image)

    def images(self) -> list[Known]:
        """Return the images that the project knows, and where they are: see `sierra.containers.images.listing.Known`."""
        from sierra.containers.images import listing

        named = [self._image(None)] if self.config.container else []
        return listing.listing(self.root, StorePaths(self.paths.store), named)

    def _image(self, name: str | None) -> str:
        """Return the name of an image as `image_name`, with this machine's processor in the place of `{arch}`."""
        return self.image_name(name).replace(ARCH, processors.here())

    def image_name(self, name: str | None) -> str:
        """Return the given name of an image in the project's spelling; without one, the name of the project's image.

        Raises UsageError if there is neither.

        >>> project.image_name("docker.io/library/debian:12")
        'docker.io/library/debian:12'
        """
        from sierra.containers.images import resolve

        own = self.config.container.image if self.config.container else ""
        if name is None and not own:
            raise UsageError(f'{self._loaded.file} names no image; give the name of an image, or set [container] image = "…"')
        return resolve.spelled(self.root, name, own) if name else own

    def push_sources(self, remote: str | None = None) -> list[Shared]:
        """Push the recorded sources, including submodules, to a git remote: see `sierra.provenance.source.share_refs`."""
        from sierra.provenance import source

        self._check_git()
        return source.share(self.root, "push", remote)

    def fetch_sources(self, remote: str | None = None) -> list[Shared]:
        """Fetch the sources that others have pushed, including submodules: see `sierra.provenance.source.share_refs`."""
        from sierra.provenance import source

        self._check_git()
        return source.share(self.root, "fetch", remote)

    def _check_git(self) -> None:
        """Raise UsageError if the project's source is identified without git."""
        if not self.config.source.git:
            raise UsageError("[source] git = false: the store has the code, and git has none to share; remove the setting")

    def fsck(self, *, tell: Callable[[str], None] = lambda text: None) -> Report:
        """Check all records and files: see `sierra.maintenance.fsck.Report`. `tell` receives the progress.

        >>> project.fsck().findings
        ()
        """
        from sierra.maintenance import fsck

        return fsck.check(StorePaths(self.paths.store), self.root, tell).report

    def repair(self, *, dry_run: bool = False, tell: Callable[[str], None] = lambda text: None) -> Repair:
        """Repair the store and check it: see `sierra.maintenance.repair`. Nothing is deleted.

        >>> project.repair(dry_run=True).done
        ()
        """
        from sierra.maintenance import repair

        return repair.repair(StorePaths(self.paths.store), self.root, dry_run=dry_run, tell=tell)

    def removal(self, *prefixes: str) -> Removal:
        """Return what `remove` would delete for these ids of batches, experiments, runs or executions. Raises NotFound.

        >>> type(project.removal(summary.batch)).__name__
        'Removal'
        """
        from sierra.maintenance import remove

        return remove.plan(self.store, tuple(map(self.record_id, prefixes)))

    def remove(
        self, *prefixes: str, agree: Callable[[Removal], bool] = lambda removal: True, observer: Observer | None = None
    ) -> Removal | None:
        """Remove the records of these ids, if `agree` returns true for the preview; return None if it returns false.

        Runs that other batches have keep their executions. `observer` receives a notice about each session that died and cannot
        be recorded. Raises NotFound for an unknown id, Missing if the disk is full, and SierraError while one of the batches is
        executing. If it raises, nothing changes.

        >>> print(project.remove(summary.batch, agree=lambda removal: False))
        None
        """
        from sierra.maintenance import remove

        return remove.remove(self.store, tuple(map(self.record_id, prefixes)), agree, observer)

    def collection(self, *, damaged: bool = False, raw: bool = False) -> Collection:
        """Return what `collect` would remove: see `sierra.maintenance.gc.Collection`.

        >>> project.collection().sessions
        0
        """
        from sierra.maintenance import gc

        return gc.plan(self.store, self.root, damaged=damaged, raw=raw)

    def collect(
        self,
        *,
        damaged: bool = False,
        raw: bool = False,
        agree: Callable[[Collection], bool] = lambda collection: True,
        observer: Observer | None = None,
    ) -> Collection | None:
        """Remove unneeded files and merge small segments, if `agree` returns true for the preview; otherwise return None.

        `damaged`: also remove segments that a repair put aside; `raw`: also remove the bytes of files that became tables.
        `observer` receives a notice about each session that cannot be recorded. Raises Missing if the disk is full; then
        nothing is lost.

        >>> project.collect(agree=lambda collection: False) is None or project.collection().nothing
        True
        """
        from sierra.maintenance import gc

        return gc.collect(self.store, self.root, damaged=damaged, raw=raw, agree=agree, observer=observer)

    def files(self, prefix: str, *paths: str, to: str | os.PathLike[str] | None = None) -> Listing | list[Outcome]:
        """Return a list of the recorded files of an id; with `to`, write them to that folder and return the outcomes.

        `paths` are paths in the listing, or globs; without any, all files. Raises NotFound for a path that matches nothing.

        >>> len(project.files(summary.batch, "swarm.csv").files)
        4
        """
        from sierra.store import export_recorded_files

        listed = export_recorded_files.listing(self.store, prefix, paths)
        return listed if to is None else list(export_recorded_files.extract(self.store, listed, Path(to)))

    def figures(self, prefix: str | None = None, name: str | None = None, *, formats: Sequence[str] = ()) -> list[Path]:
        """Draw a batch's figures again (all, or the one called `name`); return the files. Default: the batch requested last.

        `formats` are of `png`, `pdf`, `svg`, `html` and `pgf`; default: those that `sierra.toml` declares. Raises NotFound,
        and UsageError for an unknown format.

        >>> sorted({path.suffix for path in project.figures(summary.batch)})
        ['.pdf', '.png', '.svg', '.tex', '.txt']
        """
        return self.draw(prefix, name, formats=formats)[0]

    def draw(
        self, prefix: str | None = None, name: str | None = None, *, formats: Sequence[str] = ()
    ) -> tuple[list[Path], list[str]]:
        """Draw as `figures` does; return the files, and notes on figures that could not be drawn.

        Without a prefix, a figure or table called `name` that is bound to queries (`query` in `sierra.toml`) shows the last
        batches of these.

        >>> drawn, notes = project.draw(summary.batch, formats=["html"])
        """
        if prefix is None and name is not None and (words := self._queries_of(name)):
            return self._draw_bound(name, words, formats)
        return self._deliver(self.batch(prefix), name, formats=formats)

    def _queries_of(self, name: str) -> Sequence[str]:
        """Return the queries that a figure or table is bound to."""
        declared = self.config.figures.get(name) or self.config.paper_tables.get(name)
        return declared.query if declared else ()

    def _draw_bound(self, name: str, words: Sequence[str], formats: Sequence[str]) -> tuple[list[Path], list[str]]:
        from sierra.deliverables import comparison, overlay, render
        from sierra.deliverables.figures.formats import named
        from sierra.execution.batches_of_queries import BatchesOfQueries

        batches = comparison.of_queries(BatchesOfQueries(self._loaded, self.store), words)
        if len(batches) == 1:
            [batch] = batches.values()
            return self._deliver(batch, name, formats=formats)
        return render.overlaid(self._loaded, self.store, batches, name, overlay.BATCH, formats=named(formats))

    def check_figures(self, prefix: str | None = None) -> list[Checked]:
        """Return whether each figure that was drawn of a batch still follows from the store. Default: the batch requested last.

        A figure's `problem` is None if its files are those that were drawn and the store gives the same data; else the reason.
        Tables, comparisons, reports and other deliverables are checked, too.

        >>> {checked.problem for checked in project.check_figures(summary.batch)}
        {None}
        """
        from sierra.deliverables import check

        return check.check(self._loaded, self.store, self.batch(prefix), self.compare_declared)

    def draw_batches(self, *words: str, name: str | None = None, formats: Sequence[str] = ()) -> tuple[list[Path], list[str]]:
        """Draw several batches together: in figures with a line for each batch, and in tables with the batches side by side.

        `words` are batches as in `compare`: prefixes or names of queries, also as `LABEL=PREFIX`, in the order of the lines.
        `name`: the only figure or table. Return the files, and notes on what could not be drawn. Raises NotFound,
        UsageError.

        >>> project.draw_batches(summary.batch)
        Traceback (most recent call last):
        sierra.errors.UsageError: ...
        """
        from sierra.deliverables import overlay, render
        from sierra.deliverables.figures.formats import named

        if len(words) < 2:
            raise UsageError("name two batches or more, to draw them together")
        found = self.groups_of(words)
        return render.overlaid(self._loaded, self.store, found, name, overlay.BATCH, formats=named(formats))

    def paper_queries(self) -> list[QueryRequest]:
        """Return the queries that figures, tables, comparisons and numbers of `sierra.toml` are bound to, for `resolve`.

        Raises NotFound if there are none.

        >>> project.paper_queries()
        Traceback (most recent call last):
        sierra.errors.NotFound: ...
        """
        from sierra.deliverables.paper import make

        self._paper_package()
        return make.requests(self._loaded)

    def _paper_package(self) -> str:
        """Return the id of the package that `[paper]` names; "" if it names none. Raises Missing, Damaged."""
        from sierra.deliverables.paper.bound_files import named
        from sierra.packages import archive

        if not (name := self.config.paper.package):
            return ""
        if not (self.root / name).exists():
            raise Missing(f"[paper] package: {name} does not exist; make it by sierra package, or remove the key")
        with named("[paper]", "package"):
            return archive.identity(self.root / name)

    def paper(self) -> PaperWritten:
        """Write the folder of the paper from the last batches of its queries: see `sierra.deliverables.paper`.

        Executes nothing. The result has the `changed`, `removed` and `edited` files; the latter are left as they are. Raises
        NotFound for a query that was not run, and SierraError for what cannot be made.

        >>> project.paper()
        Traceback (most recent call last):
        sierra.errors.NotFound: ...
        """
        from sierra.deliverables.paper import make

        if self.config.claims:
            self._register_claims(self.store)
        return make.make(self._loaded, self.store, self._paper_package())

    def check_paper(self) -> list[str]:
        """Return one line for each fault of the paper's folder, and for each query without a batch of the present code.

        Without a store, the files are compared with `provenance.json` alone. Raises NotFound if the paper was not made.

        >>> project.check_paper()
        Traceback (most recent call last):
        sierra.errors.NotFound: ...
        """
        from sierra.deliverables.paper import make

        stored = self.stored()
        try:
            return list(make.faults(self._loaded, stored, self._paper_package() if stored else ""))
        except Missing as error:
            if (self.root / self.config.paper.package).exists():
                raise
            return [str(error), *make.faults(self._loaded, None, "")]

    def model_errors(self, prefix: str | None = None, name: str | None = None) -> ModelErrors:
        """Return how far `[models.NAME]` are from the data of a batch: all, or the one called `name`.

        `table` is an Arrow table with a row for each model and experiment: the values of the variables, the number `n` of runs,
        the number of `compared` points (times, for a model over time), the means of `data` and `predicted` over them, `bias`
        (mean of predicted − data), `rmse`, the `largest` deviation and the time `at` which it is, and the number of
        `intervals` of which the model is `inside`. Values have the unit of the column. `failed` has models without a
        prediction. Commands of models are executed. Raises NotFound, or SierraError if the model called `name` fails.

        >>> project.model_errors(summary.batch)
        Traceback (most recent call last):
        sierra.errors.NotFound: sierra.toml declares no [models.NAME]
        """
        from sierra.deliverables import errors_of_models

        return errors_of_models.errors(self._loaded, self.store, self.batch(prefix), name)

    def draw_together(
        self, targets: Sequence[str], prefix: str | None = None, name: str | None = None, *, formats: Sequence[str] = ()
    ) -> tuple[list[Path], list[str]]:
        """Draw the last batches of one query for several targets together, in figures that have a line for each target.

        The query is that of the batch with this prefix; by default, the last one that was requested for any of the targets.
        Return the files, and notes on figures that could not be drawn. Raises UsageError if the runs are no pairs.

        >>> project.targets
        ()
        """
        from sierra.deliverables import overlay, render
        from sierra.deliverables.figures.formats import named
        from sierra.execution import targets as of_query

        of_query.check_names(targets)
        for target in targets:
            self._loaded.for_target(target)  # raises an error for an unknown one
        batch = self.batch(prefix) if prefix else None
        found = overlay.batches(self.store, targets, batch)
        return render.overlaid(self._loaded, self.store, found, name, formats=named(formats))

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

        batch = self.batch(prefix)
        return run_statistics.StatisticsResult(
            run_statistics.statistics(
                self._loaded, self.store, batch, output, column, measure, threshold, times, statistics, where=where
            )
        )

    def paper_table(self, statistics: Result, format: str = "latex", *, caption: str = "", label: str = "") -> str:
        """Return statistics as the text of a table for papers: `latex` (with booktabs), `markdown` or `html`.

        `statistics` is the result of `statistics`, with chosen ones. Numbers are rounded to two significant digits of their
        uncertainty, as in `0.714 ± 0.021`. Headers have labels and units. Raises UsageError.

        >>> found = project.statistics(summary.batch, "swarm", "coverage", statistics=["mean"])
        >>> print(project.paper_table(found, "markdown").splitlines()[0])
        | population size | coverage |
        """
        from sierra.deliverables import paper_tables, run_statistics

        found = statistics.statistics if isinstance(statistics, run_statistics.StatisticsResult) else None
        return paper_tables.text(self._loaded, self.store, found, format, caption, label)

    def compare(
        self,
        *words: str,
        by: Sequence[str] = (),
        groups: Sequence[str] = (),
        column: str = "",
        table: str = "",
        measure: Measure | None = None,
        threshold: float | None = None,
        over_time: bool = False,
        method: str = "auto",
        paired: bool | Literal["auto"] = "auto",
        against: str | None = None,
        margin: float | None = None,
        alpha: float = 0.05,
    ) -> Compared:
        """Compare groups of runs: tests, effect sizes, intervals, and a paragraph of text with the conclusions.

        `words` are batches: prefixes of ids or names of queries in `sierra.toml`, also as `LABEL=PREFIX`. With one batch
        (default: the batch requested last), `by` is the variable whose values are compared; with several variables, the
        comparison is factorial. The other arguments are the keys of `[comparisons.NAME]`. Raises NotFound, UsageError, and
        SierraError if there is nothing to compare.

        >>> pair = project.compare(summary.batch, by=["population_size"]).pairs[0]
        >>> pair.first, pair.second, pair.verdict.value
        ('population_size=1', 'population_size=2', 'too few runs')
        """
        given = {
            "by": tuple(by),
            "groups": tuple(groups),
            "column": column,
            "table": table,
            "measure": measure,
            "threshold": threshold,
            "over_time": over_time,
            "method": method,
            "paired": paired,
            "against": against,
            "margin": margin,
            "alpha": alpha,
        }
        return self._compared(words, given)

    def compare_declared(self, name: str, batch: str | None = None) -> Compared:
        """Make a comparison that `sierra.toml` declares in `[comparisons.NAME]`.

        `batch` is the batch within which values are compared; default: the last batch of the comparison's `query`, or else the
        batch requested last. Raises the errors of `compare`, and NotFound for an unknown name.

        >>> project.compare_declared("noise")
        Traceback (most recent call last):
        sierra.errors.NotFound: ...
        """
        from sierra.util.text import like

        declared = self.config.comparisons
        if name not in declared:
            raise NotFound(f"sierra.toml has no [comparisons.{name}]; {like(name, list(declared))}")
        asked = declared[name]
        within = bool(asked.by) or not asked.groups
        if batch is not None and not within:
            raise UsageError(f"[comparisons.{name}] names its batches in groups; leave out the batch")
        if within and batch is None and asked.query:
            from sierra.execution.batches_of_queries import BatchesOfQueries

            batch = BatchesOfQueries(self._loaded, self.store).last(*asked.query)
        words = ((batch,) if batch else ()) if within else asked.groups
        return self._compared(words, asked.model_dump() | ({} if within else {"groups": ()}), name)

    def _compared(self, words: Sequence[str], given: Mapping[str, object], name: str = "") -> Compared:
        from sierra.config.deliverable_tables import Comparison
        from sierra.config.validate import options
        from sierra.deliverables import comparison

        asked = options(Comparison, {key: value for key, value in given.items() if value is not None}, "the comparison")
        groups, packaged = self._groups_with_packages(words)
        store = self.store if len(packaged) < len(groups) else next(iter(packaged.values()))
        return comparison.compare(self._loaded, store, name, groups, asked, packaged)

    def _groups_with_packages(self, words: Sequence[str]) -> tuple[dict[str, str], dict[str, Store]]:
        """Return the batches that words name, by group, and the stores of the groups that are in packages."""
        found = {word: match for word in words if (match := IN_PACKAGE.fullmatch(word))}
        others = [word for word in words if word not in found]
        own = self.groups_of(others) if others or not found else {}
        rest, groups, packaged = iter(own.items()), dict[str, str](), dict[str, Store]()
        for word in words or own:
            if word in found:
                label, path, prefix = found[word].groups()
                group = label or Path(path).stem
                packaged[group], batch = self._batch_in_package(path, prefix, own.values())
            else:
                group, batch = next(rest)
            if group in groups:
                raise UsageError(f"two groups have the name {group!r}; give them different ones: LABEL=HASH")
            groups[group] = batch
        if len({(store.paths.root, groups[group]) for group, store in packaged.items()}) < len(packaged):
            raise UsageError("a batch cannot be compared with itself; name other batches, or one batch and --by VARIABLE")
        return groups, packaged

    def _batch_in_package(self, path: str, prefix: str | None, others: Iterable[str]) -> tuple[Store, str]:
        """Return the store of a package, and its batch with this prefix: else the only one, or one that is among others."""
        store, batches = self._packaged(path)
        named = [batch for batch in batches if batch.startswith(prefix or "")]
        same = [batch for batch in named if batch in others] if len(named) > 1 else named
        if len(same) != 1:
            known = ", ".join(batch[:10] for batch in batches)
            raise NotFound(f"{path}: name one of its batches, as {Path(path).name}:HASH; it has {known}")
        return store, same[0]

    def groups_of(self, words: Sequence[str]) -> dict[str, str]:
        """Return the batches that words name, by the names of their groups. Raises NotFound, UsageError.

        >>> len(project.groups_of([summary.batch]))
        1
        """
        from sierra.deliverables import comparison

        named = [self._labelled_batch(word) for word in words] or [("", self.batch())]
        if len({batch for _, batch in named}) < len(named):
            raise UsageError("a batch cannot be compared with itself; name other batches, or one batch and --by VARIABLE")
        return comparison.labelled(self._loaded, self.store, named)

    def _labelled_batch(self, word: str) -> tuple[str, str]:
        """Return the label ("" for none) and the batch of a word: `LABEL=PREFIX`, `PREFIX`, or the same with a query's name."""
        label, equals, rest = word.rpartition("=")
        if equals and not label:
            raise UsageError(f"{word!r} has no label before =; write LABEL=HASH")
        batch = self.batch(rest)
        return label or ("" if batch.startswith(rest.lower()) else rest), batch

    def claims(self, *names: str) -> tuple[Evaluated, ...]:
        """Return whether the claims of `sierra.toml` hold on the recorded runs: all, or those with these names.

        Each has a `verdict`, its numbers as `text`, `n`, the `ground` of the verdict, and the word `registered`: `planned` or
        `exploratory`. Claims that are not registered yet are registered first, if the store can be written. p values are
        corrected for all claims of the project on the same table of pairs, also if only some are evaluated. A claim that cannot
        be evaluated is no error: its verdict is "can't tell". Raises NotFound for an unknown name, and if there are no claims.

        >>> project.claims()
        Traceback (most recent call last):
            ...
        sierra.errors.NotFound: sierra.toml declares no [claims.NAME]
        """
        from sierra.deliverables.claims import evaluate

        if self.config.claims and not self._found.is_package:
            with contextlib.suppress(Missing):  # the words say what is not registered
                self._register_claims(Store.create(self.paths.store))
        return evaluate.evaluate(self._loaded, self.store, names)

    def register_claims(self) -> NewRegistrations:
        """Record the text of each claim of `sierra.toml` that is not recorded yet; evaluate none.

        A claim that is recorded before its runs are executed is planned. The result has the names of the `new` and the `known`
        claims, and the reasons why others are `refused`. Raises NotFound if there are no claims, Missing if the store cannot be
        written.

        >>> project.register_claims()
        Traceback (most recent call last):
            ...
        sierra.errors.NotFound: sierra.toml declares no [claims.NAME]
        """
        if not self.config.claims:
            raise NotFound("sierra.toml declares no [claims.NAME]")
        return self._register_claims(Store.create(self.paths.store))

    def _register_claims(self, store: Store, observer: Observer | None = None) -> NewRegistrations:
        from sierra.deliverables.claims.registration import register

        found = register(self._loaded, store)
        if observer is not None:
            for name, reason in found.refused.items():
                observer.notice(f"claim {name} is not registered: {reason}")
        return found

    def claims_against(self, baseline: str, *names: str) -> tuple[Changed, ...]:
        """Return how claims have changed since a baseline: all, or those with these names.

        Each has a `verdict`, its numbers as `text`, and the evaluation as `now`. Raises NotFound for an unknown baseline or
        claim.

        >>> project.claims_against("v1")
        Traceback (most recent call last):
            ...
        sierra.errors.NotFound: sierra.baselines.json has no baseline 'v1'; set it by: sierra claims --keep v1
        """
        from sierra.deliverables.claims import baseline as baselines
        from sierra.deliverables.claims import regression

        before = baselines.read(self.paths.root, baseline)
        return regression.compare(self.config, self.claims(*names), before)

    def set_baseline(self, name: str, *words: str) -> tuple[Path, tuple[Evaluated, ...], tuple[str, ...]]:
        """Write the results of claims to `sierra.baselines.json`; return the file, the results, and the claims left out.

        `words` are prefixes of batches' ids, or the path of one package; without any, the batches are those of the project as
        it is now. Raises NotFound if no batch decides any claim.

        >>> project.set_baseline("v1")
        Traceback (most recent call last):
            ...
        sierra.errors.NotFound: sierra.toml declares no [claims.NAME]
        """
        from sierra.deliverables.claims import baseline, evaluate

        if not re.fullmatch(r"[\w.-]+", name):
            raise UsageError(f"{name!r} is no name of a baseline; use letters, digits, '.', '_' and '-'")
        store, among = self._chosen_batches(words)
        found = evaluate.evaluate(self._loaded, store, among=among)
        kept = tuple(one for one in found if one.batches)
        if not kept:
            raise NotFound(f"no claim can be evaluated: {found[0].text}")
        left = tuple(one.name for one in found if not one.batches)
        return baseline.write(self.paths.root, name, self.config, kept), kept, left

    def _chosen_batches(self, words: Sequence[str]) -> tuple[Store, list[str] | None]:
        """Return the store and the ids of the batches that words name, or those of a package; None for no words."""
        packages = [word for word in words if word.endswith(PACKAGED)]
        if packages and len(words) > 1:
            raise UsageError("name one package, or batches of this project")
        if packages:
            return self._packaged(packages[0])
        return self.store, [self.batch(word) for word in words] or None

    def _packaged(self, path: str) -> tuple[Store, list[str]]:
        """Return the store of a package and the ids of its batches. Raises Missing, Damaged."""
        from sierra.packages.reading import received

        opened = received.open_package(Path(path))
        return opened.store, [one.batch for one in opened.manifest.batches]

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

        >>> project.runs_needed(summary.batch, half_width=100).runs
        2
        """
        from sierra.deliverables import sample_size

        batch = self.batch(prefix)
        return sample_size.runs_needed(self._loaded, self.store, batch, half_width, table, column, measure, threshold)

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

        `words` are the pilot: one batch (default: the batch requested last), or the two batches to compare, as for `compare`.
        The pilot's runs are drawn again and again, and tested by the test that `compare` would use. `difference` is that of the
        groups, in the column's unit; without it, it is that of the pilot. With one batch and no `by`, each experiment is the
        pilot of a group, and a second group differs from it by `difference`. The answer also has the power with `runs` runs.
        Raises NotFound, UsageError, and SierraError if there is nothing to compare.

        >>> found = project.runs_for_power(summary.batch, difference=100)
        >>> found.comparisons[0].test, found.runs > 2
        ('Mann-Whitney test', True)
        """
        from sierra.config.deliverable_tables import Comparison
        from sierra.config.validate import options
        from sierra.deliverables import power as planning

        wanted = planning.Wanted(difference, power, runs)
        given = {
            "by": by,
            "groups": tuple(groups),
            "column": column,
            "table": table,
            "measure": measure,
            "threshold": threshold,
            "paired": paired,
            "alpha": alpha,
        }
        asked = options(Comparison, {key: value for key, value in given.items() if value is not None}, "the comparison")
        return planning.runs_for_power(self._loaded, self.store, self.groups_of(words), asked, wanted)

    def draw_comparison(self, compared: Compared) -> list[Path]:
        """Draw the figure of a comparison; return the files.

        >>> compared = project.compare(summary.batch, by=["population_size"])
        >>> sorted({path.suffix for path in project.draw_comparison(compared)})
        ['.pdf', '.png', '.svg', '.tex', '.txt']
        """
        from sierra.deliverables import comparison_figure

        return comparison_figure.draw(compared, self.store, self.paths, self.config.figure_formats)

    def paper_comparison(
        self,
        compared: Compared,
        format: str = "latex",
        *,
        figures: Sequence[str | os.PathLike[str]] = (),
        folder: str | os.PathLike[str] | None = None,
        caption: str = "",
        label: str = "",
    ) -> str:
        """Return a comparison as text for papers: `latex` (with booktabs), `markdown` or `html`.

        It has the table and the paragraph. With `figures`, the files of `draw_comparison`, it also has the figure, named
        relative to `folder` (default: the working directory). Raises UsageError.

        >>> compared = project.compare(summary.batch, by=["population_size"])
        >>> print(project.paper_comparison(compared, "markdown").splitlines()[0])
        | population size | difference | A12 | p | verdict |
        """
        from sierra.deliverables import comparison_text

        place = Path(folder) if folder is not None else None
        return comparison_text.text(compared, format, list(map(Path, figures)), place, caption, label)

    def report(
        self,
        *words: str,
        every: bool = False,
        to: str | os.PathLike[str] | None = None,
        tell: Callable[[str], None] = lambda text: None,
    ) -> Written:
        """Write a report of batches: one page of HTML that needs nothing but itself: see `sierra.deliverables.report`.

        `words` are prefixes of batches' ids or names of queries; without any, the batch requested last. `every`: all batches;
        of more than 50, only the list. `to` is the file (default: one in `figures/reports`); it is replaced only if it is a
        report. `tell` receives the progress. Raises NotFound, UsageError for a file that is no report, Missing.

        >>> written = project.report(summary.batch)
        >>> written.file.suffix, written.notes
        ('.html', ())
        """
        from sierra.deliverables.report import files, make, recorded

        if every and words:
            raise UsageError("--all is about all batches; leave out the others")
        source = make.ReportSource(self._loaded, self.store, self.compare_declared)
        batches = [one.batch for one in reversed(self.batches)] if every else [self._labelled_batch(word)[1] for word in words]
        batches = list(dict.fromkeys(batches)) or [self.batch()]
        if to is not None:
            files.check(Path(to))
        made = make.of_batches(source, batches, tell, f"All batches of {self.root.name}" if every else "")
        file = files.default(self.paths, batches, every=every) if to is None else Path(to)
        files.write(file, recorded.named(made))
        notes = (*made.notes, *recorded.record(self.store, self.root, file, made))
        return files.Written(file, tuple(made.batches), notes)

    def batch(self, prefix: str | None = None, *, target: str | None = None) -> str:
        """Return the id of a batch from a prefix or the name of a query; without one, that of the batch requested last.

        With `target`, that of the batch requested last for it.

        Raises NotFound, Missing, and UsageError for an unknown target, or for a prefix together with a target.

        >>> project.batch(summary.batch[:10]) == summary.batch
        True
        """
        if target is not None:
            self._loaded.for_target(target)  # raises an error for an unknown one
            if prefix is not None:
                raise UsageError(f"batch {prefix} is one of a target already; leave out --target")
        if prefix is not None:
            return self.store.batch_id(self.record_id(prefix))
        known = [one for one in self.batches if target is None or target in one.targets]
        if not known:
            of = f" for target {target!r}" if target else ""
            raise Missing(f"no batch is recorded{of} yet; record one with sierra run")
        return known[-1].batch

    def record_id(self, word: str) -> str:
        """Return the id of the batch of a query in `sierra.toml`, if this is its name; else the word, a prefix of any id.

        Raises NotFound for a query that has not been run with the project as it is, UsageError for a name that begins an id.

        >>> project.record_id("4fc1")
        '4fc1'
        """
        from sierra.store.store import PREFIX

        may_be_id = PREFIX.fullmatch(word.lower()) is not None
        try:
            if self._received or word not in self.config.queries:
                return word
        except ConfigError:
            if not may_be_id:
                raise
            return word  # records can be read whatever the file says
        batch = self._asked((word,), None)
        with contextlib.suppress(NotFound):
            if may_be_id and self.store.resolve(word).id != batch:
                raise UsageError(
                    f"{word!r} is the name of a query, and an id begins with it; write more digits, or {batch[:10]}"
                )
        return batch

    def metadata(self, *, write: bool = False) -> Metadata:
        """Compare CITATION.cff with `[package]`; with `write`, write it if it is not there.

        Raises ConfigError if `[package]` has no title, authors or licence.

        >>> project.metadata()
        Traceback (most recent call last):
            ...
        sierra.errors.ConfigError: [package] in sierra.toml needs title, authors, license
        """
        from sierra.packages.parts import metadata

        return metadata.compare(self.config.package, self.root, write=write)

    def package(
        self,
        *batches: str,
        path: str | os.PathLike[str],
        claims: bool = False,
        agree: Callable[[Preview], bool] = lambda preview: True,
        image: ImageForm = "none",
        wheels: bool = False,
        pythons: Sequence[str] = (),
        machines: Sequence[str] = (),
        report: bool = True,
        without: Sequence[str] = (),
        anonymous: bool = False,
        allow: Sequence[str] = (),
    ) -> Packed | None:
        """Write a reproduction package of these batches, if `agree` returns true for the preview: see `sierra.packages.pack`.

        `batches` are prefixes of ids, or names of queries. With `claims`, also those that the claims of `sierra.toml` rest on.
        `anonymous`: for double-blind review, see `sierra.packages.anonymity.anonymous`; `allow`: texts in which names are
        accepted there.

        `image`: the forms in which container images are packed, `oci`, `sif`, `both` or `none`. With `wheels`, Python
        packages are packed for these versions of Python (as `3.12`) and processors (as `x86_64`); by default, for this Python.
        `report`: false to leave out the report, which is made now. `without`: kinds of deliverables that are left out, such as
        `figure`.

        Raises NotFound if such a batch has not been recorded, UsageError if there is no batch or the file exists, ConfigError
        if `[package]` has no title, authors or licence, Missing for a source that no longer exists, Identifying if an anonymous
        package would name people or machines.

        >>> project.package(summary.batch, path="results.zip")
        Traceback (most recent call last):
            ...
        sierra.errors.ConfigError: [package] in sierra.toml needs title, authors, license
        """
        from sierra.packages import pack
        from sierra.packages.anonymity.anonymous import Anonymity
        from sierra.packages.subject import Options

        options = Options(image, wheels, tuple(pythons), tuple(machines), report, tuple(without))
        if allow and not anonymous:
            raise UsageError("--allow accepts names in anonymous packages; add --anonymous")
        pack.check_needs(self._loaded, Path(path), options, anonymous=anonymous)
        if claims:
            from sierra.deliverables.claims import evaluate

            decide = evaluate.batches(self._loaded, self.store)
            batches = (*batches, *(batch for ids in decide.values() for batch in ids))
        batches = tuple(map(self.record_id, batches))
        if not batches:
            raise UsageError("name the batches to be packed")
        anonymity = Anonymity(self._loaded, allow) if anonymous else None
        return pack.pack(self._loaded, self.store, batches, Path(path), agree=agree, options=options, anonymity=anonymity)

    def import_package(self, path: str | os.PathLike[str], *, observer: Observer | None = None) -> Imported:
        """Add the records of a package to the store, and keep where they came from: see `sierra.packages.reading.imports`.

        In batches that were executed here, imported executions do not count. `observer` receives a notice about each session
        that died here and cannot be recorded. Raises Missing, Damaged, UsageError; then nothing changes.

        >>> project.import_package("results.zip")
        Traceback (most recent call last):
            ...
        sierra.errors.Missing: results.zip: No such file or directory
        """
        from sierra.packages.reading import imports

        return imports.import_package(Store.create(ProjectPaths(self.root).store), Path(path), observer)

    def outputs(self, *query: str, target: str | None = None) -> TakenOutputs:
        """Return how a batch's outputs were read: its tables, and the files that became no table, with the reasons.

        `query` is a prefix of the batch's id, or its criteria; without any, it is the batch requested last (for `target`).
        Raises NotFound, Missing, QueryError.

        >>> [(table.name, table.rows) for table in project.outputs(summary.batch).tables]
        [('swarm', '5 rows')]
        """
        return self._taken(self._asked(query, target), inside=True)

    def declare_outputs(self, *query: str, target: str | None = None) -> dict[str, dict[str, Key]]:
        """Write the undeclared tables of a batch into `sierra.toml`, as `[outputs.NAME]`; return what was written.

        If the batch is for a target, the tables are written into the table of this target. Tables that exist stay the same.
        Files that a reader can take but that made no table, such as CSV in a subfolder, become tables with the next run of the
        query. Nothing is executed again. Raises UsageError if the file cannot be changed without changing anything else in it.

        >>> project.declare_outputs(summary.batch)
        {'swarm': {'file': 'swarm.csv'}}
        """
        from sierra.execution.outputs_taken import comments, proposed
        from sierra.setup import declare_outputs

        found = self.outputs(*query, target=target)
        tables = proposed(found)
        declare_outputs.write(self._found, tables, comments(found), found.target if found.target in self.targets else None)
        return tables

    def _taken(self, batch: str, *, inside: bool) -> TakenOutputs:
        from sierra.execution import outputs_taken, targets

        declared = targets.of_batch(self._loaded, self.store, batch).config.outputs
        found = outputs_taken.taken(self.store, batch, declared, inside=inside)
        return replace(found, target=targets.recorded(self.store, batch)) if self.targets else found

    def _asked(self, query: Sequence[str], target: str | None) -> str:
        """Return the id of the batch that a prefix or a query names; without either, that of the batch requested last."""
        from sierra.store.store import PREFIX

        store = self.store
        if not query or (len(query) == 1 and PREFIX.fullmatch(query[0].lower()) and query[0] not in self.config.queries):
            return self.batch(*query, target=target)
        batch = self.plan(*query, target=target).batch.id
        if not store.values(str, "SELECT batch FROM batches WHERE batch = $b", b=batch):
            raise NotFound(f"the query {' '.join(query)!r} has not been run with this project as it is; see sierra ls")
        return batch

    def _described(self, summary: Summary) -> Summary:
        """Return the summary with a description of the outputs, if its sessions are the first with such tables or files."""
        if summary.interrupted or not summary.sessions:
            return summary
        from sierra.execution import outputs_taken

        if not any(outputs_taken.is_new(self.store, session) for session in summary.sessions):
            return summary
        return replace(summary, outputs=self._taken(summary.batch, inside=False))

    def _probe(self, plan: Plan, store: Store, options: RunOptions) -> tuple[str, ...]:
        from sierra.replay import determinism  # loads everything that a replay needs

        return determinism.probe(plan, store, options)

    def _drawn(self, summary: Summary) -> Summary:
        """Return the summary with figures, if there is something to draw."""
        if summary.interrupted or summary.detached or summary.missing + summary.failed == summary.runs:
            return summary
        try:
            drawn, notes = self._deliver(summary.batch, again=False)
        except Missing as error:
            return replace(summary, figure_error=str(error))
        return replace(summary, figures=tuple(map(str, drawn)), notes=(*summary.notes, *notes))

    def _deliver(
        self, batch: str, name: str | None = None, *, again: bool = True, formats: Sequence[str] = ()
    ) -> tuple[list[Path], list[str]]:
        from sierra.deliverables import render
        from sierra.deliverables.figures.formats import named

        return render.figures(self._loaded, self.store, batch, name, again=again, formats=named(formats))


def reproduce(
    package: str | os.PathLike[str],
    *,
    into: str | os.PathLike[str] | None = None,
    claims: Sequence[str] = (),
    budget: float | None = None,
    jobs: int | None = None,
    engine: str | None = None,
    runner: str = "local",
    agree: Callable[[Statement], None] | None = None,
    observer: Observer | None = None,
    progress: bool | None = None,
) -> Reproduction:
    """Execute the runs of a package again, compare the results, and decide its claims; a package is a zip or a folder.

    The copy of the package and the reports are in the folder `into`, by default in one beside the package. `claims`: the names
    of the claims, by default all. `budget`: time for the runs in seconds, by their recorded durations. `agree` receives what
    would be executed, and where, before anything is; it must raise an error to prevent that. By default, only containers
    without network are accepted. Raises Missing, Damaged for a package that is not safe, UsageError for unsuitable options.

    >>> from sierra.api import reproduce
    >>> reproduce("results.zip")
    Traceback (most recent call last):
    sierra.errors.Missing: results.zip: No such file or directory
    """
    from sierra.packages.reproduction import reproduce as steps

    options = steps.Options(slots(jobs), tuple(claims), budget, engine, runner)
    folder = None if into is None else Path(into)
    return steps.reproduce(Path(package), folder, options, agree or steps.isolated_only, observer or observer_for(progress))


def report_package(
    package: str | os.PathLike[str],
    *,
    to: str | os.PathLike[str] | None = None,
    tell: Callable[[str], None] = lambda text: None,
) -> Written:
    """Write a report of the batches in a package, and execute nothing of it.

    `to` is the file; by default, it is beside the package: `results-report.html` for `results.zip`. The other arguments and the
    errors are those of `Project.report`; Damaged for a package that is not safe.

    >>> from sierra.api import report_package
    >>> report_package("results.zip")
    Traceback (most recent call last):
    sierra.errors.Missing: results.zip: No such file or directory
    """
    from sierra.packages.reading import received, report

    return report.write(received.open_package(Path(package)), None if to is None else Path(to), tell)


def observer_for(wanted: bool | None) -> Observer:
    """Return the observer that shows the progress of executions, if that is `wanted`; None: in terminals and notebooks."""
    from sierra.execution import progress_display as progress

    return progress.observer(wanted)


def slots(jobs: int | None) -> int:
    """Return the number of runs at a time: `jobs`, or the user's setting, or the number of usable cores.

    Raises UsageError for less than 1.
    """
    from sierra.config import user
    from sierra.worker.machine import usable_cores

    slots = (user.load().jobs or usable_cores()) if jobs is None else jobs
    if slots < 1:
        raise UsageError(f"cannot execute {slots} runs at a time; use 1 or more")
    return slots

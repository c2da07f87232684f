"""Plans: a resolved query with everything that its results depend on, before anything executes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Protocol

from sierra.config import extensions
from sierra.config.output_tables import Output, Success
from sierra.config.project_file import LoadedProject
from sierra.containers import container_setup
from sierra.containers.engines.base import Engine
from sierra.containers.images.image import AnyImage
from sierra.design.query.query_request import QueryRequest
from sierra.errors import Missing
from sierra.execution import commands
from sierra.execution.build.state import BuildState
from sierra.execution.checkout import Checkout
from sierra.execution.run_limits import RunLimits
from sierra.ingest.base import Used
from sierra.ingest.recording_context import Context
from sierra.model import IN_PROJECT, Batch, Purpose, Query, Run
from sierra.provenance import reported_versions, source
from sierra.provenance.change_guard import ChangeGuard
from sierra.provenance.dependency_model import Programs
from sierra.store.row_types import EnvironmentRow, SharedFileRow
from sierra.templates.base import Files
from sierra.util.hashing import short
from sierra.util.lazy_definitions import dataclass, field, replace

if TYPE_CHECKING:
    from sierra.execution.session_steps import SessionStep


class Inputs(Protocol):
    """Source of the input files of runs."""

    def files(self, batch: Batch, wanted: Callable[[Run], bool]) -> Iterator[tuple[Run, Files]]:
        """Yield the input files of the wanted runs, one run at a time; a run that is twice in the batch may come twice."""
        ...


@dataclass(frozen=True, slots=True)
class Plan:
    """A resolved query with everything that its results depend on, before anything executes."""

    project: LoadedProject
    request: QueryRequest
    query: Query
    text: str
    batch: Batch
    inputs: Inputs
    source: source.Source | None
    """Source of the code; None for a recorded batch."""
    source_id: str | None
    checkout: Checkout | None
    """Checkout to execute instead of the project's current files; None to execute those."""
    programs: Programs
    environment: EnvironmentRow
    engine: Engine
    image: AnyImage | None
    """Image that runs execute in."""
    limits: RunLimits
    template_sha256: str
    outputs: Mapping[str, Output]
    success: Success
    readers: Used
    """Readers of other packages that the outputs need."""
    seen: ChangeGuard
    """Guard that notices changes of the code and programs since planning."""
    notes: tuple[str, ...] = ()
    shared_files: tuple[SharedFileRow, ...] = ()
    """Files beside the inputs of runs; empty for a recorded batch, whose files the store has."""
    build: BuildState | None = None
    """State of the products of `[build]`; None without it."""
    plugins: Mapping[str, str] = field(default_factory=dict)
    """The SHA-256 of the files of plug-ins of the project, by name: `{project}/robosim.py`."""
    lacking: str = ""
    """Reason why this machine cannot execute the runs, such as a program that was not found; empty if it can."""

    @property
    def target(self) -> str | None:
        """Return the target that the batch is requested for; None if there is none."""
        return self.project.config.target if self.source else self.request.target  # a recorded batch has the recorded one

    def check_programs(self) -> None:
        """Raise Missing if this machine lacks a program that the runs need."""
        if self.lacking:
            raise Missing(self.lacking)

    def _repr_html_(self) -> str:
        from sierra.util import html

        batch = self.batch
        axes = tuple(axis.name for axis in batch.axes)
        rows = ((*experiment.values.values(), len(experiment.runs)) for experiment in batch.experiments)
        title = f"plan of batch {short(batch.id)}: {self.text}, {len(batch.runs)} runs"
        return html.page(title, (*axes, "runs"), rows, self.notes, total=len(batch.experiments))

    def files(self, run: Run) -> Files:
        """Return the input files of a run."""
        return next(files for one, files in self.inputs.files(self.batch, lambda one: one.id == run.id) if one.id == run.id)

    def snapshot(self, content: Callable[[str], bytes | None]) -> Checkout:
        """Return a checkout of the current code; `content` returns a file that git does not have, by git's hash."""
        manifest = self.source.manifest if self.source else b""
        used = tuple((program.name, program.kind) for program in self.programs.all)
        mounted = Programs(tuple(program for program in self.programs.all if program.name.startswith(container_setup.MOUNTS)))
        converted = self.source.converted if self.source else {}
        recorded = {f"{IN_PROJECT}{path}": sha256 for path, sha256 in converted.items()}
        git = self.project.config.source.git
        return Checkout(self.project.root, self.batch.spec, manifest, used, content, mounted, recorded=recorded, use_git=git)


def session_step(project: LoadedProject) -> SessionStep | None:
    """Return the step of an extension that executes the runs of a project; None if the core executes them.

    Raises Missing if that extension is not installed.
    """
    if project.lacking:
        raise Missing(project.lacking)
    return next(extensions.called("sessions", project.config), None)


def versioned(plan: Plan) -> Plan:
    """Return the plan with the versions that its programs report; this executes the programs."""
    variables = commands.declared(plan.batch.spec.environment, plan.project.root)
    return replace(
        plan,
        programs=reported_versions.with_versions(plan.programs, plan.project.config.programs, variables, plan.project.root),
    )


def context(plan: Plan, session: str = "", number: int | None = None) -> Context:
    """Return the context that recording needs for a session that executes this plan."""
    return Context(
        session=session,
        batch=plan.batch.id,
        purpose=Purpose.RUN,
        environment=plan.environment.environment,
        programs=plan.programs.id,
        outputs=plan.outputs,
        success=plan.success,
        number=number,
        raw=plan.project.config.store.raw,
        readers=plan.readers,
        engines=plan.project.config.engines,
    )

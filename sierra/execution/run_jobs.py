"""The execution service: it isolates the runs of a session, makes their jobs, follows these to their end, and records them.

Queries (`executor`) and replays (`sierra.replay`) execute through it.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from sierra.config.execution_tables import Container
from sierra.config.project_file import LoadedProject
from sierra.containers import on_hosts
from sierra.containers.container_setup import GPU, Isolation, contain
from sierra.containers.engines.base import Capabilities, Engine
from sierra.containers.images.image import AnyImage, here
from sierra.containers.on_hosts import HostContainers
from sierra.errors import ConfigError
from sierra.execution import commands, shared_files
from sierra.execution.follow import Followed, follow
from sierra.execution.observation import choose_runs
from sierra.execution.observation.plan_files import folders
from sierra.execution.observer import ProgressCounter
from sierra.execution.project_source import not_in_checkouts
from sierra.execution.run_limits import RunLimits
from sierra.execution.sessions import Session
from sierra.ingest.changed_files import Doubt
from sierra.ingest.observations import recorded_name
from sierra.ingest.recorder import Recorder
from sierra.ingest.recording_context import Context
from sierra.model import Helps, Job, Limits, Purpose, Run, RunSpec, Times
from sierra.provenance import environment, tracer
from sierra.provenance.change_guard import ChangeGuard
from sierra.provenance.dependency_model import Programs
from sierra.runners.base import Runner, Work, Wraps, check_members, needed
from sierra.store import ownership_marks
from sierra.store.layout import StorePaths, user_digests
from sierra.store.row_types import EnvironmentRow, SharedFileRow
from sierra.store.segments import disk_errors
from sierra.store.store import Store
from sierra.templates.base import Files
from sierra.util import worker_zip
from sierra.util.fs import write_whole
from sierra.util.lazy_definitions import dataclass, replace
from sierra.worker.devices import BELOW_ROCR, ROCR


@dataclass(frozen=True, slots=True)
class Setup:
    """The specification, engine, limits and code that the runs of a session share."""

    project: LoadedProject
    spec: RunSpec
    engine: Engine
    image: AnyImage | None
    limits: RunLimits
    root: Path
    """Folder of the code."""
    environment: EnvironmentRow
    """Environment of this process."""


class JobService:
    """Executes runs of one session."""

    def __init__(self, setup: Setup, store: Store, session: Session, *, stays: bool, images: StorePaths | None = None) -> None:
        """Prepare the isolation of the runs. Raises ConfigError, Missing.

        `stays`: they execute on a cluster. `images`: the store that has the files of images, if it is not `store`.
        """
        _check_resources(setup)
        self._setup = setup
        self._store = store
        self._session = session
        self._stays = stays
        self._image = None if setup.spec.robots is not None else here(setup.image)
        """The image in which runs execute; None for runs on robots, each of which has its own."""
        self._beside = self._shared_files()
        self._begun: set[int] = set()
        """The experiments of which runs were executed."""
        self._hosts = self._on_hosts(images or store.paths)
        if setup.spec.robots is not None:
            self.isolation = Isolation(setup.engine, Capabilities(""), notes=self._hosts.notes if self._hosts else ())
            return
        self.isolation = contain(
            setup.engine,
            self._image,
            setup.spec,
            setup.project.config.container,
            setup.limits.of_containers,
            code=setup.root,
            project=setup.project.root,
            store=images or store.paths,
            session=session.id,
            elsewhere=stays,
        )
        if self.isolation.box:
            with disk_errors(session.paths.root):
                write_whole(session.paths.worker, worker_zip.packed())

    def _on_hosts(self, store: StorePaths) -> HostContainers | None:
        """Return the containers of runs on robots; None for other runs, and without containers. Raises as `contain`."""
        setup, container = self._setup, self._setup.project.config.container
        if setup.spec.robots is None or setup.image is None or setup.engine.name == "none":
            return None
        given = container or Container(image=setup.image.name)
        root = setup.project.root
        return on_hosts.contain(
            setup.engine,
            setup.image,
            setup.spec,
            given,
            setup.limits.of_containers,
            root=root,
            store=store,
            session=self._session.id,
        )

    def _shared_files(self) -> Sequence[SharedFileRow]:
        """Make the session's folder with the files beside the inputs of runs; return the files."""
        setup = self._setup
        if setup.spec.shared_files is None:
            return ()
        rows = shared_files.recorded(self._store, setup.spec.shared_files)
        shared_files.make(rows, self._session.paths.shared, setup.project.root, self._store)
        return rows

    def doubt(self, files: ChangeGuard) -> Doubt | None:
        """Return why results cannot be attributed to the programs or the image at the start; None if nothing has changed."""
        if reason := self.isolation.doubt():
            return Doubt(reason)
        if (reason := files.doubt()) is None:
            return None
        changed = files.changed_source() if self._is_observed() else None
        names = None if changed is None else self._named(changed, files.programs)
        absent = frozenset(names[path] for path, is_other in (changed or {}).items() if is_other) if names else frozenset()
        is_shared = any(service.shared for service in self._setup.spec.around.services)  # it may have read files for any run
        return Doubt(reason, None if names is None else frozenset(names.values()), absent, by_siblings=not is_shared)

    def _named(self, paths: Iterable[str], programs: Programs) -> dict[str, str] | None:
        """Return the names of files in records of observed runs; None if such records leave out one of them."""
        from sierra.worker.file_names import Names

        names = Names(self._folders(programs))
        return None if any(map(names.left_out, paths)) else {path: recorded_name(names.name(path)) for path in paths}

    def execute_jobs(
        self,
        runner: Runner,
        context: Context,
        inputs: Iterable[tuple[Run, Files]],
        count: int,
        programs: Programs,
        counter: ProgressCounter,
        *,
        times: Times | None = None,
        detach: bool = False,
        doubt: Callable[[], Doubt | None] = lambda: None,
        enough: Callable[[], bool] = lambda: False,
        kept: Path | None = None,
        attempt: int = 0,
        experiments: Collection[int] = (),
        observed: bool = False,
    ) -> Followed:
        """Execute `count` runs of these experiments with these inputs, and record them. Raises the runner's errors.

        `times` are the expected durations for a cluster. `doubt` and `kept`: see `Recorder`. `detach` and `enough`: see
        `sierra.execution.follow.follow`. `attempt`: how often the session has executed these runs before. `observed`:
        the first of each experiment is observed, whatever it takes.
        """
        executing = runner.wrapped if isinstance(runner, Wraps) else runner
        on_robots = self._setup.spec.robots is not None
        check_members(executing, executing.name, on_robots=on_robots, contained=self._hosts is not None)
        context = replace(context, **self.isolation.context)
        context.save(self._session.paths.context)
        record = self._setup.project.config.environment.record
        builder = self._builder(context)
        work = Work(
            self._observed(
                ((run, builder.job(run, files, attempt)) for run, files in inputs),
                context.batch,
                programs,
                set() if observed else self._begun,
                choose_runs.affordable(context.batch, experiments, count),
            ),
            count,
            context.batch,
            (*needed(programs, self._search()), *self.isolation.needed),
            times,
            not detach,
            environment.recorded(record),
            self._setup.environment._asdict(),
            self._setup.root,
            ownership_marks.identity(self._store.paths),
            self._hosts,
            self.isolation.files,
            self._setup.limits.most.gpus,
            self._setup.project.config.links,
            self._setup.limits.most.cores or 1,
        )
        recorder = Recorder(self._store, self._session.paths, context, kept, doubt)
        try:
            with _without_byte_code():
                return follow(runner, recorder, self._store, self._session, counter, work, detach=detach, enough=enough)
        finally:
            if not self._stays:
                self.isolation.close()

    def _builder(self, context: Context) -> commands.CommandBuilder:
        setup, success = self._setup, context.success
        return commands.CommandBuilder(
            setup.spec,
            setup.root,
            setup.engine,
            self._limits(),
            self._session.id,
            setup.project.root,
            image=self._image,
            box=self._hosts.box if self._hosts else self.isolation.box,
            programs=self._session.paths.worker,
            allots=self._stays or setup.limits.most.gpus is not None,
            stays=self._stays,
            beside=self._session.paths.shared if self._beside else None,
            checkpoint=partial(self._store.paths.checkpoint, programs=context.programs)
            if context.purpose == Purpose.RUN
            else None,
            success=sorted(success.statuses),
            accept=sorted(success.accepted_statuses),
            timeouts={name: table.timeout for name, table in setup.project.config.services.items()},
            observed=self._is_observed(),
        )

    def _limits(self) -> RunLimits:
        """Return the limits of runs; files beside the input of a run do not count as its output."""
        beside = sum(row.size for row in self._beside)

        def with_files_beside(limits: Limits) -> Limits:
            return limits if limits.output_bytes is None else replace(limits, output_bytes=limits.output_bytes + beside)

        return self._setup.limits.changed(with_files_beside)

    def _observed(
        self,
        jobs: Iterable[tuple[Run, Job]],
        batch: str,
        programs: Programs,
        begun: set[int],
        affordable: Mapping[int, float],
    ) -> Iterable[Job]:
        """Return the jobs; those that are to be observed have the folders that names of files refer to (see `choose`)."""
        if not self._is_observed():
            return (job for _, job in jobs)
        helps = None if self._stays else Helps(tracer.usable(), str(user_digests()))
        named = self._folders(programs)
        return choose_runs.choose(jobs, batch, self._setup.project.config, named, helps, begun, affordable)

    def _folders(self, programs: Programs) -> dict[str, str]:
        """Return the folders that names of observed files refer to."""
        project = self._setup.project
        named = {name: str(folder) for name, folder in folders(self._setup.root, programs, self._search()).items()}
        named["store"] = str(self._store.paths.root.resolve())
        root = str(project.root.resolve())
        if root != named["project"]:
            named["project:given"] = root  # links in a checkout may lead there
        return named | {f"unlisted:{number}": f"{root}/{name}" for number, name in enumerate(not_in_checkouts(project))}

    def _is_observed(self) -> bool:
        """Return whether runs may be observed."""
        return self._setup.image is None and self._setup.project.config.observe != "none"

    def _search(self) -> str:
        """Return the PATH of the runs."""
        setup = self._setup
        return commands.declared(setup.spec.environment, setup.root, setup.project.root, image=self._image)["PATH"]


def _check_resources(setup: Setup) -> None:
    """Check that runs that request cores or GPUs can be given some. Raises ConfigError."""
    spec = setup.spec
    if setup.limits.most.cores is not None and spec.robots is not None:
        raise ConfigError("[limits] cores: runs on robots hold no cores of their own; remove it")
    if setup.limits.most.gpus is None:
        return
    if spec.robots is not None:
        raise ConfigError("[limits] gpus: runs on robots are given no GPUs; remove it")
    if fixed := [name for name in (*BELOW_ROCR, ROCR) if name in spec.environment]:
        raise ConfigError(f"[limits] gpus: SIERRA sets {fixed[0]} for each run, but it is also declared; remove one of both")
    if setup.image is not None and setup.engine.name != "none" and GPU not in spec.host_access:
        raise ConfigError("[limits] gpus: the containers of runs can use no GPU; add gpu = true to [container]")


@contextmanager
def _without_byte_code() -> Iterator[None]:
    """Import modules without writing `__pycache__`: that changes folders, which observed runs may have listed."""
    before, sys.dont_write_bytecode = sys.dont_write_bytecode, True
    try:
        yield
    finally:
        sys.dont_write_bytecode = before

"""Plans: a resolved query with everything that its results depend on, before anything executes: query → design → inputs."""

from __future__ import annotations

import difflib
import json
import os
import re
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from sierra import platforms, templates
from sierra.config import plugin_registry
from sierra.config.change_tables import OWN_PLACEHOLDERS
from sierra.config.output_tables import Output, Success
from sierra.config.project_file import LoadedProject, Project
from sierra.containers import container_setup, engines, images
from sierra.containers.engines.base import Engine
from sierra.containers.images.image import Image
from sierra.design import platform_options, run_values
from sierra.design.expand import Expansion
from sierra.design.factorial_design import GROUPED, PlanningProgress, design, ignore_progress, mentions
from sierra.errors import ConfigError, Missing, QueryError
from sierra.execution import around, commands, shared_files, targets
from sierra.execution.build import recipe as build_recipe
from sierra.execution.build.state import BuildState, look
from sierra.execution.checkout import INSIDE, Checkout, programs_in
from sierra.ingest.base import Used
from sierra.ingest.base import used as used_readers
from sierra.ingest.recording_context import Context
from sierra.model import Batch, Design, Experiment, Limits, Purpose, Query, Run, RunSpec, Set
from sierra.provenance import environment, referenced_files, reported_versions, source
from sierra.provenance.change_guard import ChangeGuard, guard
from sierra.provenance.compiled_languages import is_compiled
from sierra.provenance.dependency_model import Programs
from sierra.query import grammar
from sierra.query.query_request import QueryRequest
from sierra.store.layout import CONFIG, DRAWN, FIGURES, LOCK, PYPROJECT, STORE, ProjectPaths, StorePaths
from sierra.store.row_mapper import of_fields
from sierra.store.row_types import EnvironmentRow, SharedFileRow
from sierra.store.schema import RESERVED, check_name
from sierra.store.store import Store
from sierra.templates.base import ARGUMENTS, Files
from sierra.util import html
from sierra.util.hashing import short
from sierra.util.text import few
from sierra.version import __version__

BARE = re.compile(r"[^\W\d]\w*")
"""Pattern of a word that is not a criterion, because it has no range."""


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
    image: Image | None
    """Image that runs execute in."""
    limits: Limits
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

    @property
    def target(self) -> str | None:
        """Return the target that the batch is requested for; None if there is none."""
        return self.project.config.target if self.source else self.request.target  # a recorded batch has the recorded one

    def _repr_html_(self) -> str:
        batch = self.batch
        axes = tuple(axis.name for axis in batch.axes)
        rows = ((*experiment.values.values(), len(experiment.runs)) for experiment in batch.experiments)
        title = f"plan of batch {short(batch.id)}: {self.text}, {len(batch.runs)} runs"
        return html.page(title, (*axes, "runs"), rows, self.notes, total=len(batch.experiments))

    def snapshot(self, content: Callable[[str], bytes | None]) -> Checkout:
        """Return a checkout of the current code; `content` returns a file that git does not have, by git's hash."""
        manifest = self.source.manifest if self.source else b""
        used = tuple((program.name, program.kind) for program in self.programs.all)
        mounted = Programs(tuple(program for program in self.programs.all if program.name.startswith(container_setup.MOUNTS)))
        return Checkout(self.project.root, self.batch.spec, manifest, used, content, mounted)


def resolve(project: LoadedProject, request: QueryRequest) -> Query:
    """Return the query of a request, with the project's defaults; a name of a query in `sierra.toml` stands for its criteria.

    Raises QueryError.
    """
    project.check_written()
    config, words = project.config, request.criteria
    names = [word for word in words if word in config.queries]
    if len(names) > 1:
        raise QueryError(f"{names[0]!r} and {names[1]!r} are both named queries; use one of them, with more criteria if needed")
    for word in words:
        if word == grammar.MONTE_CARLO:
            raise QueryError(
                f"{word!r} needs a number of experiments, which differ only in their seeds; use, for example, {word}.C20"
            )
        if word not in names and BARE.fullmatch(word):
            close = difflib.get_close_matches(word, config.queries, 1, cutoff=0.5)
            hint = (
                f"; did you mean {close[0]!r}?" if close else f"; a criterion needs a range, such as {word}.Log8 or {word}=1,2"
            )
            raise QueryError(f"{word!r} is not a query in sierra.toml{hint}")
    named = config.queries[names[0]] if names else None
    spelled = [part for word in words for part in (named.criteria if named and word in names else (word,))]
    query = Query(
        criteria=grammar.parse_all(spelled, config.criteria),
        runs=request.runs or (named and named.runs) or config.runs,
        controller=request.controller or (named and named.controller) or None,
        scenario=request.scenario or (named and named.scenario) or None,
        sets=tuple(Set(one.xpath, one.value, why=f"--set {one.xpath}") for one in request.overrides),
        base_seed=config.seed.base,
    )
    targets.check(project, query)
    return query


def plan(
    project: LoadedProject, request: QueryRequest, *, engine: str | None = None, report: PlanningProgress = ignore_progress
) -> Plan:
    """Resolve a requested query into a plan. `engine` replaces the project's engine; `report` receives the progress.

    Executes nothing, except that it asks a Python for its path, the loader for libraries, and an engine for its image. Writes
    nothing, except that git writes the source's tree.

    Raises an error for a mistake in project, query, template, source or programs.
    """
    project = project.for_target(request.target)
    query = resolve(project, request)
    project = replace(project, config=platform_options.merged(project.config, query))
    config, root = project.config, project.root
    _check_names(project)
    plugin_registry.check(config)
    readers = used_readers(config.outputs, config.readers)
    template = templates.of_project(config, root)
    platform = platforms.find(config.platform, config)
    contained, image = _contained(project, engine)
    box = config.container if image else None
    made = config.build.produces if config.build else ()
    declared = run_values.declared(config, _named_values(query, config))
    command = commands.command(platform, root, contained=image is not None, made=made, declared=declared, project=config)
    surroundings = around.declared(config, root, declared, contained=image is not None, made=made)
    around.check_ports(config, command, surroundings)
    variables = {**commands.environment(platform, config), **(box.variables if box else {})}
    values = commands.used_values((*command, *surroundings.words), declared, config)
    own = _own(project)
    code = _code(project, own)
    held = source.paths(code.manifest)
    texts = [root / path for path in config.template_paths]
    _check_paths(config, query, root)
    written = (text.replace(IN_PROJECT, "") for text in _written(config))
    data = referenced_files.data(texts, written, root, held, own)
    if box:
        data = container_setup.data(data, box, root)
    beside = shared_files.find(config, root)
    folder = os.path.dirname(config.template) if config.template and config.files else ""  # noqa: PTH120
    spec = RunSpec(
        config.platform,
        command,
        commands.with_values(variables, declared),
        code.tree,
        image.id if image else None,
        container_setup.host_access(box),
        (*map(os.path.normpath, config.templates.values()), *values.named, *([f"{folder}/"] if folder else [])),
        beside[0].shared if beside else None,
        surroundings,
    )
    designed = design(query, config, platform, template, report)
    expansion = Expansion(designed, template, platform, spec, values, folder)
    batch = expansion.batch(report)
    if twice := set(batch.runs[0].names).intersection(row.name for row in beside):
        raise ConfigError(f"files: each run has a generated {min(twice)} in its folder; rename the file")
    _check_arguments(batch, config, command, declared)
    built = _build_state(project, replace(spec, environment=variables, named_inputs=(), shared_files=None), code, contained)
    used = _used(spec, code, root, data, built)
    checkout = _committed(root, spec, code, used) if code.checkout else None
    executed = checkout.programs() if checkout else used
    named = {text.replace(IN_PROJECT, "") for text in _set_by(designed)} | _given_by(designed, command)
    uncounted = referenced_files.named_by_values(named, texts, root, held, used)
    return Plan(
        project=project,
        request=request,
        query=query,
        text=" ".join(grammar.text(criterion) for criterion in query.criteria),
        batch=batch,
        inputs=expansion,
        source=code,
        source_id=code.id,
        checkout=checkout,
        programs=executed,
        environment=this_environment(config),
        engine=contained,
        image=image,
        limits=commands.limits(config),
        template_sha256=template.sha256,
        outputs=config.outputs,
        success=config.success,
        readers=readers,
        seen=guard(root, b"" if checkout else code.manifest, executed),
        shared_files=beside,
        build=built,
        notes=(
            *code.notes,
            *_doubts(designed, spec.words, config),
            *_outdated(root, image),
            *_texts(designed, config, template),
            *_same(batch),
            *_unobserved(config, image),
            *used.notes,
            *(_unbuilt(built, used, held) if built else ()),
            *(f"{file} is named only by the query: changes of this file are not detected" for file in uncounted),
        ),
    )


def _unobserved(config: Project, image: Image | None) -> Iterator[str]:
    """Yield a note if the project requests an observation that is not possible.

    A tracer outside a container sees the engine, and paths of the container's own root folder. For an ordinary user, engines
    need setuid programs, which get no rights under a tracer.
    """
    if image is not None and "observe" in config.model_fields_set and config.observe != "none":
        yield f'observe = "{config.observe}" has no effect on runs in containers: their image identifies their programs'


def _build_state(project: LoadedProject, spec: RunSpec, code: source.Source, engine: Engine) -> BuildState | None:
    """Return the state of the products; None without `[build]`. Raises ConfigError, Missing."""
    table, root = project.config.build, project.root
    if table is None:
        return None
    if code.checkout:
        raise ConfigError(
            '[source] dirty = "ignore" executes the commit, but [build] builds the files on disk, which differ from it; '
            'commit or stash the changes, or use dirty = "record"'
        )
    box = project.config.container if spec.image else None
    store = StorePaths(ProjectPaths(root).store)
    recipe = build_recipe.complete(build_recipe.declared(table, spec, code.manifest), root, root, box)
    return look(recipe, root, Store(store.root) if store.format.is_file() else None)


def _used(spec: RunSpec, code: source.Source, root: Path, data: Programs, built: BuildState | None) -> Programs:
    """Return the programs and files that runs use. Before the first build, none may be known."""
    if built is None:
        return programs_in(spec, code.manifest, root, data)
    made = referenced_files.existing((f"{{project}}/{one.name}" for one in built.products), root)
    known = {one.path for one in data.all}
    data = Programs((*data.all, *(one for one in made.all if one.path not in known)), data.notes)
    try:
        return programs_in(spec, code.manifest, root, data, made={one.name for one in built.products})
    except Missing:
        if built.reason is None:
            raise
        return data


def _unbuilt(built: BuildState, used: Programs, held: Container[bytes]) -> Iterator[str]:
    """Yield a note on compiled files of the project that runs use, and that are neither products nor source."""
    own = (one for one in used.all if one.name.startswith(INSIDE) and is_compiled(one.path))
    made = {one.name for one in built.products}
    names = [name for one in own if (name := one.name.removeprefix(INSIDE)) not in made and os.fsencode(name) not in held]
    if names and built.reason is None:
        yield f"runs use {few(names, 3)}, which no pattern of [build] produces matches: add it if the build makes it"


def this_environment(config: Project) -> EnvironmentRow:
    """Return the record of this process's environment."""
    return of_fields(EnvironmentRow, environment.capture(__version__, config.environment.record))


def _contained(project: LoadedProject, name: str | None) -> tuple[Engine, Image | None]:
    """Return the engine and the image of the runs, and verify that the image is still the pinned one.

    Raises ConfigError, Missing.
    """
    container = project.config.container
    engine = engines.find(name or (container.engine if container else "none"), project.config.engines)
    if engine.name == "none":
        return engine, None
    if container is None:
        raise ConfigError(f'{engine.name} needs an image: set [container] image = "…" in {project.file}')
    image = images.pinned(project.root, container.image)
    images.verify(project.root, image)
    return engine, image


def _outdated(root: Path, image: Image | None) -> Iterator[str]:
    if image and images.outdated(root, StorePaths(ProjectPaths(root).store), image):
        yield f"{image.name} has changed since its image was built: run sierra image build {image.name}, then pin it"


def code(project: LoadedProject, *, dirty: str | None = None) -> source.Source:
    """Return the source of a project as it is now; `dirty` replaces the project's setting."""
    return _code(project, _own(project), dirty)


def _own(project: LoadedProject) -> tuple[str, ...]:
    """Return the paths that SIERRA writes, or whose meaning it hashes; they do not belong to the source."""
    return (
        STORE,
        LOCK,
        *_drawn(project.root),
        CONFIG,
        PYPROJECT if project.file.name == PYPROJECT else CONFIG,
        *(path for template in project.config.template_paths for path in _inside(template)),
        *(table.file for table in project.config.tables.values() if table.file is not None),
        *(model.file for model in project.config.models.values() if model.file is not None),
    )


def not_in_checkouts(project: LoadedProject) -> tuple[str, ...]:
    """Return the files and folders of a project that no checkout of its source has, except those that git ignores."""
    return (*_own(project), ".git")


def _code(project: LoadedProject, own: Sequence[str], dirty: str | None = None) -> source.Source:
    wanted, store = project.config.source, StorePaths(ProjectPaths(project.root).store)
    return source.capture(
        project.root,
        paths=wanted.paths,
        without=own,
        prose=bool(wanted.paths) or project.config.build is not None,  # a build may read what describes the project
        dirty=dirty or wanted.dirty,
        large=wanted.max_untracked,
        memory=store.files if store.format.is_file() else None,
    )


def _committed(root: Path, spec: RunSpec, code: source.Source, used: Programs) -> Checkout:
    """Return a checkout of the commit's code, which is executed instead of the current files."""
    known = tuple((program.name, program.kind) for program in used.all)
    return Checkout(root, spec, code.manifest, known, lambda blob: None)


def out_of_reach(plan: Plan, logs: Sequence[str] | None) -> Iterator[str]:
    """Yield a hint if a template names files by relative paths, which do not exist in a run's folder.

    `logs` are logs of failed runs: the hint then names only files that they mention. With None, it names all.
    """
    config, root = plan.project.config, plan.project.root
    made = {*plan.batch.runs[0].names, *(row.name for row in plan.shared_files)}
    meant: dict[str, Path] = {}
    for template in (root / path for path in config.template_paths):
        beside = {os.path.relpath(root / name, template.parent) for name in made} if config.templates or config.files else made
        for word in referenced_files.relative_names(template, _written(config), root):
            if os.path.normpath(word) not in beside and (logs is None or any(Path(word).name in log for log in logs)):
                meant.setdefault(word, template.parent)
    if meant:
        paths = [os.path.normpath(os.path.relpath(folder / word, root)) for word, folder in meant.items()]
        where = "it is" if len(meant) == 1 else "they are"
        yield (
            f"the template names {few([repr(word) for word in meant], 3)} by a relative path: "
            f"{where} in the project, but runs execute in other folders; {_how_to_reach(plan, paths)}"
        )


def _how_to_reach(plan: Plan, paths: Sequence[str]) -> str:
    """Return a hint how a template can name files of the project."""
    if any(path.split("/")[0] == os.pardir for path in paths):
        absolute = "use its absolute path (all ids then depend on this machine)"
        return f"it is outside of the project: {absolute}, and mount it into the container" if plan.image else absolute
    named = dict.fromkeys((*plan.project.config.files, *(path.rpartition("/")[0] or path for path in paths)))
    files = json.dumps(list(named), ensure_ascii=False)
    change = f'let a change set the path, with value = "{IN_PROJECT}{paths[0]}"'
    return f"set files = {files} in sierra.toml, above all tables, to have them beside the input, or {change}"


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


def _drawn(root: Path) -> list[str]:
    """Return the folders that figures were drawn to; other files in `figures` belong to the project."""
    return [f"{FIGURES}/{mark.parent.name}" for mark in ProjectPaths(root).figures.glob(f"*/{DRAWN}*")]


def _inside(template: str) -> list[str]:
    """Return the template's path if it is in the project.

    The source leaves it out, because the inputs that are made from it are hashed.
    """
    path = os.path.normpath(template)
    return [] if path.startswith((os.pardir, os.sep)) else [path]


WRITTEN = ("value", "xml", "per_run")
"""Keys whose texts may become part of an input. Texts of other keys are XPaths and names, and `/x` is not a file there."""


def _written(config: Project) -> Iterator[str]:
    """Yield the texts that the project's changes may put into a template, for any query."""
    changes = config.model_dump(include={"variables", "changes", "run_changes", "per_run", "controllers", "scenarios"})
    pending: list[tuple[bool, object]] = [(False, changes)]
    while pending:
        match pending.pop():
            case True, str() as text:
                yield text
            case stands, dict() as table:
                pending.extend((stands or key in WRITTEN, value) for key, value in table.items())
            case stands, list() | tuple() as items:
                pending.extend((stands, item) for item in items)


def _doubts(designed: Design, command: Sequence[str], config: Project) -> Iterator[str]:
    """Yield warnings about settings that are allowed but probably not intended."""
    mentioned = " ".join(command)
    seeded = any(mentions(change, "seed") for change in designed.per_run)
    if designed.query.runs > 1 and not seeded and not config.seed.environment and "{seed}" not in mentioned:
        hint = f"{_place_of_seed(config)}, or use {{seed}} in the command (SIERRA_SEED also has it)"
        yield f"neither inputs nor command contain the seed: {hint}"
    for name, values in designed.lists.items():
        if len(values) < designed.query.runs:
            yield f"[per_run] {name} has {len(values)} items for {designed.query.runs} runs: run {len(values)} uses the first"
    if config.template_paths and not any(word in mentioned for word in ("{input}", "{run}", commands.SPLICED)):
        yield "the command does not contain {input}: all experiments are the same unless it finds the generated file itself"


def _place_of_seed(config: Project) -> str:
    """Return the lines that could give runs their seeds."""
    if config.template_paths:
        return 'set seed = "XPATH"'
    return 'set seed = { argument = "--seed {value}" } or seed = { environment = "SEED" }'


def _texts(designed: Design, config: Project, template: templates.Template) -> Iterator[str]:
    """Yield warnings about variables with text values where the template has numbers; a range may be mistyped."""
    for axis in designed.axes:
        variable = config.variables.get(axis.name)
        if variable is not None and variable.set is not None and not axis.numeric:
            here = template.find(variable.set)
            if here and all(re.fullmatch(r"\s*[+-]?\d+(\.\d*)?\s*", value) for value in here):
                texts = f"{axis.name} has text values ({axis.values[0]!r}, …)"
                yield f"{texts}, but the template has the number {here[0].strip()} there"


def _set_by(designed: Design) -> set[str]:
    """Return the texts that a query puts into the template: values of `--set`, and values of axes that are not numeric."""
    names = [axis.name for axis in designed.axes if not axis.numeric]
    found = {change.value for change in designed.query.sets}
    for cell in designed.cells if names else ():
        for change in cell.changes:
            if isinstance(change, Set):
                filled = change.value
                for name in names:
                    filled = filled.replace(f"{{{name}}}", str(cell.values[name]))
                found.add(filled)
    return found


def _given_by(designed: Design, command: Sequence[str]) -> set[str]:
    """Return the texts in which the command of a run contains a value, from the project's root."""
    words = [word for word in command if commands.NAMED.search(word)]
    found: set[str] = set()
    for cell in designed.cells if words else ():
        texts = {name: str(value) for name, value in cell.values.items() if name not in OWN_PLACEHOLDERS}
        for word in words:
            [filled] = commands.with_texts((word,), texts)
            found.update(part.removeprefix("{project}/") for part in re.split("[:;,=]", filled) if filled != word)
    return found


IN_PROJECT = "{project}/"


def _check_paths(config: Project, query: Query, root: Path) -> None:
    """Raise ConfigError if a template or a change names a file of the project by its absolute path on this machine."""
    inside = re.compile("(?:" + "|".join(re.escape(f"{one}/") for one in {root, root.resolve()}) + r")([^\s\"'<>,;]+)")
    texts = [(path, referenced_files.text(root / path)) for path in config.template_paths]
    texts += [("sierra.toml", text) for text in _written(config)]
    texts += [(change.why, change.value) for change in query.sets]
    for where, text in texts:
        if found := inside.search(text):
            raise ConfigError(
                f"{where}: {found[0]} is a path of this machine, and ids must not depend on it; "
                f'write value = "{IN_PROJECT}{found[1]}" in a change'
            )


def _named_values(query: Query, config: Project) -> list[str]:
    """Return the names that have a value in the experiments of a query."""
    chosen = [kind for kind in GROUPED if getattr(query, kind) or getattr(config, kind)]
    return [*(criterion.name for criterion in query.criteria), *chosen]


def _check_arguments(batch: Batch, config: Project, command: Sequence[str], declared: run_values.Declared) -> None:
    """Raise ConfigError if `{arguments}` stands for nothing, or if both template and variables give arguments."""
    given = ARGUMENTS in batch.runs[0].names
    if given and declared.arguments is not None:
        raise ConfigError(f'{few(config.template_paths, 1)} provides arguments; use no "argument" of variables or the seed too')
    if commands.SPLICED in command and not given:
        of = f"{config.template} provides none" if config.template else "there is none"
        raise ConfigError(f"command: {commands.SPLICED} needs a template that provides arguments; {of}")


def _same(batch: Batch) -> Iterator[str]:
    """Yield a warning if experiments are identical because their values change nothing; it names two and counts the others."""
    first: dict[tuple[str, ...], Experiment] = {}
    again = [(one, other) for other in batch.experiments if (one := first.setdefault(_key(other), other)) is not other]
    for one, other in again[:1]:
        more = f" (also in {len(again) - 1} other cases)" if again[1:] else ""
        yield f"{_called(one)} and {_called(other)} have the same runs: their inputs do not differ{more}"


def _key(experiment: Experiment) -> tuple[str, ...]:
    return tuple(run.id for run in experiment.runs)


def _called(experiment: Experiment) -> str:
    return " ".join(f"{name}={value}" for name, value in experiment.values.items())


def _check_names(project: LoadedProject) -> None:
    """Check the names of outputs and variables against the store's own, and that the store's path is not a file.

    Also checks that an output has no column names together with a header. Raises ConfigError, Missing.
    """
    for name, output in project.config.outputs.items():
        if not check_name(name):
            raise ConfigError(f"{project.file}: [outputs.{name}]: the store itself has a table {name!r}; use another name")
        if output.columns and output.header:
            hint = "columns is only for a CSV without header; set header = false too, or remove columns"
            raise ConfigError(f"{project.file}: [outputs.{name}]: {hint}")
    for name in project.config.variables:
        if name.lower() in RESERVED:
            raise ConfigError(
                f"{project.file}: variable {name!r}: the store itself has a column of that name; use another name"
            )
        if name in GROUPED:
            raise ConfigError(
                f"{project.file}: variable {name!r}: {name}s are not values but sets of changes; declare each in [{name}s.NAME]"
            )
    root = ProjectPaths(project.root)
    if root.store.exists() and not root.store.is_dir():
        raise Missing(f"{root.store} is a file, but the store must be a folder with this path")

"""Making plans of requested queries: query → design → inputs.

Also: checks of a plan before anything executes: names, paths and arguments that cannot work.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from sierra import templates
from sierra.config import project_file
from sierra.config.project_file import LoadedProject, Project
from sierra.containers import container_setup, engines, images
from sierra.containers.engines.base import Engine
from sierra.containers.images.image import AnyImage, Image
from sierra.design import platform_options, platforms, robots, run_values
from sierra.design.expand import Expansion
from sierra.design.factorial_design import GROUPED, PlanningProgress, design, ignore_progress
from sierra.design.query import grammar
from sierra.design.query.query_request import QueryRequest
from sierra.errors import ConfigError, Missing
from sierra.execution import (
    around,
    commands,
    input_texts,
    members,
    plan_notes,
    project_source,
    resolve_query,
    run_limits,
    shared_files,
)
from sierra.execution.build import recipe as build_recipe
from sierra.execution.build.state import BuildState, compare_products
from sierra.execution.checkout import Checkout, programs_in
from sierra.execution.plan import Plan
from sierra.ingest.base import used as used_readers
from sierra.ingest.base import with_files
from sierra.model import IN_PROJECT, Batch, Query, RunSpec
from sierra.provenance import environment, referenced_files, source
from sierra.provenance.change_guard import guard
from sierra.provenance.dependency_model import Kind, Program, Programs
from sierra.store.layout import ProjectPaths, StorePaths
from sierra.store.row_mapper import of_fields
from sierra.store.row_types import EnvironmentRow
from sierra.store.schema import RESERVED, check_name
from sierra.store.store import Store
from sierra.templates.base import ARGUMENTS
from sierra.util import processors
from sierra.util.fs import unescaped
from sierra.util.hashing import sha256
from sierra.util.text import few
from sierra.util.version import __version__


def check_paths(config: Project, query: Query, root: Path) -> None:
    """Raise ConfigError if a template or a change names a file of the project by its absolute path on this machine."""
    inside = re.compile("(?:" + "|".join(re.escape(f"{folder}/") for folder in {root, root.resolve()}) + r")([^\s\"'<>,;]+)")
    texts = [(path, referenced_files.text(root / path)) for path in config.template_paths]
    texts += [("sierra.toml", text) for text in input_texts.written(config)]
    texts += [(change.why, change.value) for change in query.sets]
    for where, text in texts:
        if path_here := inside.search(text):
            raise ConfigError(
                f"{where}: {path_here[0]} is a path of this machine, and ids must not depend on it; "
                f'write value = "{IN_PROJECT}{path_here[1]}" in a change'
            )


def check_arguments(batch: Batch, config: Project, command: Sequence[str], declared: run_values.Declared) -> None:
    """Raise ConfigError if `{arguments}` stands for nothing, or if both template and variables give arguments."""
    given = ARGUMENTS in batch.runs[0].names
    if given and declared.arguments is not None:
        raise ConfigError(f'{few(config.template_paths, 1)} provides arguments; use no "argument" of variables or the seed too')
    if commands.SPLICED in command and not given:
        of = f"{config.template} provides none" if config.template else "there is none"
        raise ConfigError(f"command: {commands.SPLICED} needs a template that provides arguments; {of}")


def check_names(project: LoadedProject) -> None:
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
        if (group := name.lower()) in GROUPED and (name != group or getattr(project.config, f"{group}s")):
            cure = f"is [variables.{name}] or [{group}s.NAME], not both" if name == group else f"is written {group!r}"
            raise ConfigError(f"{project.file}: variable {name!r}: a {group} {cure}")
    root = ProjectPaths(project.root)
    if root.store.exists() and not root.store.is_dir():
        raise Missing(f"{root.store} is a file, but the store must be a folder with this path")


OF_INPUTS = ("platforms", "templates", "criteria")
"""The kinds of plug-ins that make the inputs of runs."""


def plan(
    project: LoadedProject, request: QueryRequest, *, engine: str | None = None, report: PlanningProgress = ignore_progress
) -> Plan:
    """Resolve a requested query into a plan. `engine` replaces the project's engine; `report` receives the progress.

    Executes nothing, except that it asks a Python for its path, the loader for libraries, and an engine for its image. Writes
    nothing, except that git writes the source's tree.

    Raises an error for a mistake in project, query, template or source. The plan tells if this machine lacks a program; no id
    depends on that.
    """
    with project.plugins():
        return _plan(project, request, engine, report)


def _plan(project: LoadedProject, request: QueryRequest, engine: str | None, report: PlanningProgress) -> Plan:
    project = project.for_target(resolve_query.target(project, request))
    query = resolve_query.resolve(project, request)
    project = replace(project, config=members.configured(platform_options.merged(project.config, query)))
    config, root = project.config, project.root
    check_names(project)
    project.plugin_files()
    project_file.check_plugins(config)
    readers = used_readers(config.outputs, config.readers)
    outputs = with_files(config.outputs, root)
    template = templates.of_project(config, root)
    platform = platforms.find(config.platform, config)
    contained, image = _contained(project, engine)
    box = config.container if image else None
    produced = config.build.produces if config.build else ()
    declared = run_values.declared(config, _named_values(query, config))
    command = commands.command(
        platform, root, contained=image is not None, produced=produced, declared=declared, project=config
    )
    surroundings = around.declared(config, root, declared, contained=image is not None, produced=produced)
    around.check_ports(config, command, surroundings)
    groups = members.of_groups(config, root, declared, produced, contained=image is not None)
    variables = commands.environment(platform, config, declared, contained=box is not None)
    of_groups = tuple(word for argv in (groups or {}).values() for word in argv)
    filled = commands.as_written(variables)
    values = commands.used_values((*command, *of_groups, *surroundings.words, *filled), declared, config)
    own = project_source.own_paths(project)
    code = project_source.code(project)
    held = source.paths(code.manifest)
    texts = [root / path for path in config.template_paths]
    check_paths(config, query, root)
    written = (text.replace(IN_PROJECT, "") for text in input_texts.written(config))
    data = referenced_files.data(texts, written, root, held, own)
    of_plugins = tuple(_of_plugins(project.plugin_files(OF_INPUTS), root))
    data = replace(
        data, all=(*data.all, *(program for program in _converted(code, root) if program not in of_plugins), *of_plugins)
    )
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
        (
            *map(os.path.normpath, config.templates.values()),
            *values.named,
            *([robots.FILE] if config.robots else []),
            *([f"{folder}/"] if folder else []),
        ),
        beside[0].shared if beside else None,
        surroundings,
        groups,
    )
    members.check_paths(spec.words if groups is not None else ())
    designed = design(query, config, platform, template, report)
    expansion = Expansion(designed, template, platform, spec, values, folder, config.robots)
    batch = expansion.batch(report)
    if twice := set(batch.runs[0].names).intersection(row.name for row in beside):
        raise ConfigError(f"files: each run has a generated {min(twice)} in its folder; rename the file")
    check_arguments(batch, config, command, declared)
    built = _build_state(project, replace(spec, environment=variables, named_inputs=(), shared_files=None), code, contained)
    used, lacking = found_or(data, lambda: _used(spec, code, root, data, built))
    checkout = _committed(root, spec, code, used) if code.checkout else None
    executed, lacking = found_or(used, checkout.programs) if checkout and not lacking else (used, lacking)
    named = {text.replace(IN_PROJECT, "") for text in input_texts.set_by(designed)} | input_texts.given_by(
        designed, (*command, *filled)
    )
    shared = {str(root / row.name) for row in beside}
    by_values = referenced_files.named_by_values(named, texts, root, held, used)
    uncounted = [file for file in by_values if os.path.normpath(file) not in shared]
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
        limits=run_limits.of_experiments(config, batch.experiments),
        template_sha256=template.sha256,
        outputs=outputs,
        success=config.success,
        readers=readers,
        seen=guard(root, b"" if checkout else code.manifest, executed, code.listed, code.since),
        shared_files=beside,
        build=built,
        lacking=lacking,
        plugins={program.name: program.sha256 for program in of_plugins},
        notes=(
            *code.notes,
            *plan_notes.not_repeated(designed, config, texts),
            *plan_notes.doubts(designed, (*spec.words, *filled), config),
            *plan_notes.unreadable_outputs(config),
            *plan_notes.outdated(root, image),
            *plan_notes.texts_of_numbers(designed, config, template),
            *plan_notes.same(batch),
            *plan_notes.unobserved(config, image),
            *used.notes,
            *(plan_notes.unbuilt(built, used, held) if built else ()),
            *(f"{file} is named only by the query: changes of this file are not detected" for file in uncounted),
        ),
    )


def _converted(code: source.Source, root: Path) -> Iterator[Program]:
    """Yield the files of the source whose bytes on disk git would not restore: the source's id does not show these bytes."""
    for path, digest in code.converted.items():
        yield Program(f"{IN_PROJECT}{path}", str(root / unescaped(path)), digest, Kind.FILE)


def _of_plugins(plugins: Mapping[str, bytes], root: Path) -> Iterator[Program]:
    """Yield the files of plug-ins that make inputs: a run that they made is reused only while they stay the same."""
    for path, content in plugins.items():
        yield Program(f"{IN_PROJECT}{path}", str(root / path), sha256(content), Kind.FILE)


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
    used = replace(recipe.programs, all=(*recipe.programs.all, *_converted(code, root)))
    recipe = replace(recipe, programs=used)
    return compare_products(recipe, root, Store(store.root) if store.format.is_file() else None)


def _used(spec: RunSpec, code: source.Source, root: Path, data: Programs, built: BuildState | None) -> Programs:
    """Return the programs and files that runs use. Before the first build, none may be known."""
    if built is None:
        return programs_in(spec, code.manifest, root, data)
    products = referenced_files.existing((f"{{project}}/{program.name}" for program in built.products), root)
    known = {program.path for program in data.all}
    data = Programs((*data.all, *(program for program in products.all if program.path not in known)), data.notes)
    try:
        used = programs_in(spec, code.manifest, root, data, products={program.name for program in built.products})
        return _built(used, built, spec)
    except Missing:
        if built.reason is None:
            raise
        return data


def _built(used: Programs, built: BuildState, spec: RunSpec) -> Programs:
    """Return the programs without products for processors for which the build makes none: they may be of any age.

    Robots do not get these. Raises Missing if it is this machine that needs one.
    """
    left_out = built.recipe.left_out(used)
    if left_out and spec.robots is None:
        name = left_out[0].name.removeprefix(IN_PROJECT)
        processors_built = ", ".join(built.recipe.processors)
        raise Missing(f'runs need {name}, but [build] is for {processors_built}; add "{processors.here()}" to arch in [build]')
    return replace(used, all=tuple(program for program in used.all if program not in left_out))


def found_or(files: Programs, find: Callable[[], Programs]) -> tuple[Programs, str]:
    """Return the programs that a function finds, and an empty text. If one is missing, return `files` and the reason."""
    try:
        return find(), ""
    except Missing as error:
        return files, str(error)


def this_environment(config: Project) -> EnvironmentRow:
    """Return the record of this process's environment."""
    return of_fields(EnvironmentRow, environment.capture(__version__, config.environment.record))


def _contained(project: LoadedProject, name: str | None) -> tuple[Engine, AnyImage | None]:
    """Return the engine and the image of the runs, and verify that the image is still the pinned one.

    Images for several processors on robots are only verified when it is known which of them are needed.

    Raises ConfigError, Missing.
    """
    container = project.config.container
    engine = engines.find(name or (container.engine if container else "none"), project.config.engines)
    if engine.name == "none":
        return engine, None
    if container is None:
        raise ConfigError(f'{engine.name} needs an image: set [container] image = "…" in {project.file}')
    image = images.pinned_for_hosts(project.root, container.image)
    if project.config.robots is None:
        images.verify(project.root, image.on(processors.here()))
    elif isinstance(image, Image):
        images.unchanged(project.root, image)
    return engine, image


def _committed(root: Path, spec: RunSpec, code: source.Source, used: Programs) -> Checkout:
    """Return a checkout of the commit's code, which is executed instead of the current files."""
    known = tuple((program.name, program.kind) for program in used.all)
    return Checkout(root, spec, code.manifest, known, lambda blob: None)


def _named_values(query: Query, config: Project) -> list[str]:
    """Return the names that have a value in the experiments of a query."""
    chosen = [kind for kind in GROUPED if getattr(query, kind) or getattr(config, kind)]
    return [*(criterion.name for criterion in query.criteria), *chosen]

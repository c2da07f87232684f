"""Notes on a plan: settings that are allowed, but probably not intended."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Container, Iterable, Iterator, Sequence
from pathlib import Path

from sierra import templates
from sierra.config.change_tables import VALUE
from sierra.config.project_file import Project
from sierra.containers import images
from sierra.containers.images.image import AnyImage
from sierra.design.factorial_design import mentions
from sierra.execution import commands, input_texts
from sierra.execution.build.state import BuildState
from sierra.execution.plan import Plan
from sierra.model import IN_PROJECT, INDEX, POSE, Batch, Design, Experiment
from sierra.provenance import referenced_files
from sierra.provenance.compiled_languages import is_compiled
from sierra.provenance.dependency_model import Programs
from sierra.store.layout import ProjectPaths, StorePaths
from sierra.util.text import few

NO_GPU_MEMORY = re.compile(
    "CUDA_ERROR_OUT_OF_MEMORY|CUDA out of memory|cudaErrorMemoryAllocation|hipErrorOutOfMemory|HIP out of memory|"
    "RESOURCE_EXHAUSTED: Out of memory|no supported devices"
)
"""Messages of programs that cannot reserve memory of a GPU: of CUDA, PyTorch, ROCm and JAX."""


def unobserved(config: Project, image: AnyImage | None) -> Iterator[str]:
    """Yield a note if the project requests an observation that is not possible.

    A tracer outside a container sees the engine, and paths of the container's own root folder. For an ordinary user, engines
    need setuid programs, which get no rights under a tracer.
    """
    if image is not None and "observe" in config.model_fields_set and config.observe != "none":
        yield f'observe = "{config.observe}" has no effect on runs in containers: their image identifies their programs'


def unbuilt(built: BuildState, used: Programs, held: Container[bytes]) -> Iterator[str]:
    """Yield a note on compiled files of the project that runs use, and that are neither products nor source."""
    own = (one for one in used.all if one.name.startswith(IN_PROJECT) and is_compiled(one.path))
    made = {one.name for one in built.products}
    names = [name for one in own if (name := one.name.removeprefix(IN_PROJECT)) not in made and os.fsencode(name) not in held]
    if names and built.reason is None:
        yield f"runs use {few(names, 3)}, which no pattern of [build] produces matches: add it if the build makes it"


def outdated(root: Path, image: AnyImage | None) -> Iterator[str]:
    """Yield a note if what an image was built from has changed since."""
    for one in images.every(image):
        if images.outdated(root, StorePaths(ProjectPaths(root).store), one):
            yield f"{one.name} has changed since its image was built: run sierra image build {one.name}, then pin it"


def doubts(designed: Design, command: Sequence[str], config: Project) -> Iterator[str]:
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
    yield from _twice(designed, config)


def _twice(designed: Design, config: Project) -> Iterator[str]:
    """Yield a note for each variable of the query whose option the command has too: a program takes one of the values."""
    for name in [axis.name for axis in designed.axes if axis.name in config.variables]:
        options = [word.partition("=")[0] for word in config.variables[name].argument if VALUE not in word.partition("=")[0]]
        own = [word for word in config.command[1:] if word.partition("=")[0] in options[:1] and VALUE not in word]
        if own:
            twice = f"the command has {own[0]!r}, which the variable {name!r} adds too"
            yield f"{twice}: one of the two has no effect; remove it there"


def not_repeated(designed: Design, config: Project, templates: Iterable[Path]) -> Iterator[str]:
    """Yield a note for each variable that repeats an element, but has no value in this query."""
    others = [name for name, table in config.variables.items() if table.repeat and name not in {a.name for a in designed.axes}]
    marks = (INDEX, *(POSE if any(config.variables[name].start for name in others) else ()))
    contents = [path.read_bytes() for path in templates] if others else []
    if left := next((mark for mark in marks if any(mark.encode() in content for content in contents)), ""):
        yield f"the query does not vary {', '.join(others)}: {left} stays as it is in the input"


def unreadable_outputs(config: Project) -> Iterator[str]:
    """Yield a note for each output of runs on robots that may not be readable, which is known only when they have moved."""
    for name, output in config.outputs.items() if config.robots is not None else ():
        if doubt := output.doubt():
            yield f"[outputs.{name}]: {doubt}"


def _place_of_seed(config: Project) -> str:
    """Return the lines that could give runs their seeds."""
    if config.template_paths:
        return 'set seed = "XPATH"'
    return 'set seed = { argument = "--seed {value}" } or seed = { environment = "SEED" }'


def texts_of_numbers(designed: Design, config: Project, template: templates.Template) -> Iterator[str]:
    """Yield warnings about variables with text values where the template has numbers; a range may be mistyped."""
    for axis in designed.axes:
        variable = config.variables.get(axis.name)
        if variable is not None and variable.set is not None and not axis.numeric:
            here = template.find(variable.set)
            if here and all(re.fullmatch(r"\s*[+-]?\d+(\.\d*)?\s*", value) for value in here):
                texts = f"{axis.name} has text values ({axis.values[0]!r}, …)"
                yield f"{texts}, but the template has the number {here[0].strip()} there"


def same(batch: Batch) -> Iterator[str]:
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


def out_of_reach(plan: Plan, logs: Sequence[str] | None) -> Iterator[str]:
    """Yield a hint if a template names files by relative paths, which do not exist in a run's folder.

    `logs` are logs of failed runs: the hint then names only files that they mention. With None, it names all.
    """
    config, root = plan.project.config, plan.project.root
    inputs = {*plan.batch.runs[0].names, *(row.name for row in plan.shared_files)}
    meant: dict[str, Path] = {}
    for template in (root / path for path in config.template_paths):
        beside = (
            {os.path.relpath(root / name, template.parent) for name in inputs} if config.templates or config.files else inputs
        )
        for word in referenced_files.relative_names(template, input_texts.written(config), root):
            if os.path.normpath(word) not in beside and (logs is None or any(Path(word).name in log for log in logs)):
                meant.setdefault(word, template.parent)
    if meant:
        paths = [os.path.normpath(os.path.relpath(folder / word, root)) for word, folder in meant.items()]
        where = "it is" if len(meant) == 1 else "they are"
        yield (
            f"the template names {few([repr(word) for word in meant], 3)} by a relative path: "
            f"{where} in the project, but runs execute in other folders; {_how_to_reach(plan, paths)}"
        )


def without_gpu_memory(gpus: float | None, logs: Sequence[str]) -> Iterator[str]:
    """Yield a hint if runs that hold `gpus` GPUs each have failed because a GPU had too little memory, as their logs say."""
    if message := next(filter(None, map(NO_GPU_MEMORY.search, logs)), None):
        if gpus is None:
            cure = "set [limits] gpus, such as 1 or 0.25, so that fewer runs use one at a time"
        elif gpus < 1:
            cure = f"raise [limits] gpus above {gpus:g}, so that fewer runs use one at a time"
        else:
            cure = "each run had its own, so that a run must use less, or needs more GPUs"
        yield f"a GPU had too little memory ({message[0]}): {cure}"


def _how_to_reach(plan: Plan, paths: Sequence[str]) -> str:
    """Return a hint how a template can name files of the project."""
    if any(path.split("/")[0] == os.pardir for path in paths):
        absolute = "use its absolute path (all ids then depend on this machine)"
        return f"it is outside of the project: {absolute}, and mount it into the container" if plan.image else absolute
    named = dict.fromkeys((*plan.project.config.files, *(path.rpartition("/")[0] or path for path in paths)))
    files = json.dumps(list(named), ensure_ascii=False)
    change = f'let a change set the path, with value = "{IN_PROJECT}{paths[0]}"'
    return f"set files = {files} in sierra.toml, above all tables, to have them beside the input, or {change}"

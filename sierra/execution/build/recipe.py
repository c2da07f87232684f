"""The recipe of a build: the command with everything that its products depend on, and the id that follows from it."""

from __future__ import annotations

import os
import shlex
import shutil
from collections.abc import Iterator
from collections.abc import Set as AbstractSet
from itertools import chain
from pathlib import Path, PurePosixPath

from sierra.config.execution_tables import BuildTable, Container
from sierra.containers import container_setup
from sierra.errors import ConfigError, Missing
from sierra.execution import build_products, checkout, commands
from sierra.model import IN_PROJECT, Around, RunSpec
from sierra.provenance import fingerprint_programs, source
from sierra.provenance.compiled_languages import LANGUAGES, compilers
from sierra.provenance.dependency_model import NOTHING, Kind, Program, Programs
from sierra.util import processors
from sierra.util.hashing import digest
from sierra.util.json_types import JsonView
from sierra.util.lazy_definitions import dataclass, regex, replace
from sierra.util.processors import ARCH

PLATFORM = "build"
"""The platform in the specification of a build."""
KNOWN = ("project", "python", "arch")
FLAGS = regex(r"\w*FLAGS|CMAKE_\w+|" + "|".join(variable for variable, _ in LANGUAGES))
"""Pattern of the names of variables that hold compilers or their flags."""


@dataclass(frozen=True, slots=True)
class Recipe:
    """The command of a build, and its inputs."""

    spec: RunSpec
    """Command, variables, source, image and host access; the command is as declared."""
    folder: str
    produces: tuple[str, ...]
    manifest: bytes
    """The list of the source's files."""
    wall: float | None = None
    """The time limit of the command in seconds; not part of the id."""
    processors: tuple[str, ...] = ()
    """The processors that `{arch}` stands for, one after the other; empty if the recipe does not have it."""
    programs: Programs = NOTHING
    compilers: tuple[str, ...] = ()
    """The paths of the compilers among the programs."""

    @property
    def id(self) -> str:
        """Return the id of the build: the hash of its inputs."""
        return build_id(self.spec, self.folder, self.produces, self.programs.id, self.processors)

    @property
    def patterns(self) -> tuple[str, ...]:
        """Return the patterns of the products for all processors."""
        names = self.processors or (ARCH,)
        return tuple(dict.fromkeys(pattern.replace(ARCH, name) for pattern in self.produces for name in names))

    def left_out(self, used: Programs) -> list[Program]:
        """Return the programs among those used that an earlier build made for processors for which this one makes none."""
        own = [one for one in used.all if one.name.startswith(IN_PROJECT)]
        named = ((one, one.name.removeprefix(IN_PROJECT)) for one in own)
        return [one for one, name in named if _matches(name, self.produces) and not _matches(name, self.patterns)]

    @property
    def executions(self) -> tuple[Recipe, ...]:
        """Return the recipe for each execution of the command: one for each processor, if command or variables name it."""
        texts = (*self.spec.command, *self.spec.environment.values())
        if not any(ARCH in text for text in texts):
            return (self,)
        return tuple(self._for(name) for name in self.processors)

    def _for(self, processor: str) -> Recipe:
        values, spec = {"arch": processor}, self.spec
        filled = commands.with_texts(spec.environment.values(), values)
        variables = dict(zip(spec.environment, filled, strict=True))
        return replace(self, spec=replace(spec, command=commands.with_texts(spec.command, values), environment=variables))

    @property
    def flags(self) -> dict[str, str]:
        """Return the declared variables that hold compilers or their flags."""
        return {name: value for name, value in sorted(self.spec.environment.items()) if FLAGS.fullmatch(name)}

    def placed(self, root: Path) -> RunSpec:
        """Return the specification in which words that name files in `root` begin with `{project}/`; products stay."""
        made = set(build_products.names(root, self.patterns))
        words = (_in_project(word, root, self.folder, made) for word in self.spec.command)
        return replace(self.spec, command=tuple(words))


def _matches(name: str, patterns: tuple[str, ...]) -> bool:
    return any(build_products.matches(name, pattern) for pattern in patterns)


def build_id(spec: RunSpec, folder: str, produces: tuple[str, ...], programs: str, processors: tuple[str, ...] = ()) -> str:
    """Return the id of a build: the hash of its inputs."""
    inputs: dict[str, JsonView] = {**spec.preimage(), "folder": folder, "produces": list(produces), "programs": programs}
    return digest("build", {**inputs, "processors": list(processors)} if processors else inputs)


def declared(table: BuildTable, runs: RunSpec, manifest: bytes) -> Recipe:
    """Return the recipe of `[build]`, without programs; it has the variables, image and host access of the runs.

    Raises ConfigError for an unknown placeholder.
    """
    for word in table.command:
        for _, name in commands.PLACEHOLDER.findall(word):
            if name and name not in KNOWN:
                known = "{project}, {python} and {arch}"
                raise ConfigError(f"[build] command: unknown placeholder {{{name}}} in {word!r}; known are {known}")
    folder = PurePosixPath(table.folder).as_posix()
    spec = replace(runs, platform=PLATFORM, command=table.command, around=Around(), robots=None)
    texts = (*table.command, *table.produces, *spec.environment.values())
    names = table.arch or (processors.here(),)
    used = tuple(dict.fromkeys(names)) if any(ARCH in text for text in texts) else ()
    return Recipe(spec, folder, table.produces, manifest, table.wall, used)


def complete(recipe: Recipe, root: Path, project: Path, box: Container | None) -> Recipe:
    """Return the recipe with the programs that it uses; the code is in `root`. Raises Missing if a program is not found."""
    each = [_complete(one, root, project, box) for one in recipe.executions]
    used = dict.fromkeys(chain.from_iterable(one.programs.all for one in each))
    notes = dict.fromkeys(chain.from_iterable(one.programs.notes for one in each))
    found = dict.fromkeys(chain.from_iterable(one.compilers for one in each))
    return replace(recipe, programs=Programs(tuple(used), tuple(notes)), compilers=tuple(found))


def _complete(recipe: Recipe, root: Path, project: Path, box: Container | None) -> Recipe:
    placed = recipe.placed(root)
    products = {f"{IN_PROJECT}{name}" for name in build_products.names(root, recipe.patterns)}
    if recipe.spec.image is not None:
        mounted = container_setup.data(NOTHING, box, project) if box else NOTHING
        used = checkout.programs_in(placed, recipe.manifest, root, mounted, project)
        return replace(recipe, programs=_inputs(used, placed, products))
    variables = commands.declared(placed.environment, root, project)
    try:
        used = checkout.programs_in(placed, recipe.manifest, root, NOTHING, project)
        compiler_names = {path: name for name, path in _compilers(recipe, variables["PATH"])}
        for path, name in compiler_names.items():
            own = fingerprint_programs.find((path,), variables, root, project=project)
            used = _with(used, tuple(replace(program, name=name) if program.path == path else program for program in own.all))
    except Missing as error:
        raise Missing(f"[build] command: {error}") from error
    return replace(recipe, programs=_inputs(used, placed, products), compilers=tuple(compiler_names))


def _inputs(used: Programs, placed: RunSpec, products: AbstractSet[str]) -> Programs:
    """Return the programs without products, and without files that a word names only by their folder: builds change both."""
    words = (*placed.command, *placed.environment.values())

    def counts(one: Program) -> bool:
        inside = one.kind is Kind.FILE and one.name.startswith(IN_PROJECT)
        return one.name not in products and (not inside or any(one.name in word for word in words))

    return replace(used, all=tuple(one for one in used.all if counts(one)))


def _with(programs: Programs, more: tuple[Program, ...]) -> Programs:
    known = {one.path for one in programs.all if one.kind != Kind.DISTRIBUTIONS}
    return Programs((*programs.all, *(one for one in more if one.path not in known)), programs.notes)


def _compilers(recipe: Recipe, search: str) -> Iterator[tuple[str, str]]:
    """Yield the name and the path of each compiler for the languages of the source that is installed."""
    for named in compilers(source.paths(recipe.manifest), recipe.spec.environment).values():
        for word in shlex.split(named)[:1]:
            if (path := shutil.which(word, path=search)) is not None:
                yield word, path


def _in_project(word: str, root: Path, folder: str, made: set[str]) -> str:
    """Return `{project}/in/build.sh` for `build.sh` if that file exists in the folder and is no product."""
    if "{" in word or not word or word.startswith(("/", "-")):
        return word
    name = os.path.normpath(f"{folder}/{word}")
    try:
        is_input = name not in made and (root / name).is_file()
    except (OSError, ValueError):
        return word
    return f"{{project}}/{name}" if is_input else word

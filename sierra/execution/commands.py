"""Commands of jobs: the argument list and environment of one execution, with placeholders filled in.

Placeholders of a command: `{input}` is the first input file, `{output}` the folder to write to (also the working directory),
`{run}` the run's own folder, `{seed}` its seed, `{project}` the project's root, `{python}` the Python that runs SIERRA, and
`{arch}` the processor of the host that executes the run (see `sierra.util.processors`). The word `{arguments}` stands for the
arguments that the template gives, or those that the variables of the query declare (`argument`); without it, these follow the
command. `{input.NAME}` is one of several templates. The name of a variable of the query stands for its value: see
`sierra.design.run_values`. `{port}`, `{port2}`, … are free ports, which the worker chooses where it executes the run; until
then, marks stand for them, and the number is in no id. `{checkpoint}` is a folder that the next execution of a run gets if this
one is cut off (see `sierra.worker.checkpoints`). `{{name}}` stands for the text `{name}`. A word that names a file
relative to the project's root becomes `{project}/word`, because runs have folders of their own.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, cast

from sierra.config.change_tables import CHECKPOINT, NOT_VARIED, OWN_PLACEHOLDERS, PORT_NAMES, WORKER_NAMES
from sierra.config.project_file import Project
from sierra.containers.engines.base import (
    HERE,
    INSIDE,
    PROJECT,
    PYTHON,
    RUN,
    WRITABLE,
    ContainerSpec,
    Engine,
    Mount,
    Process,
    run_process,
)
from sierra.containers.images.image import Image
from sierra.design import robots, run_values
from sierra.design.platforms.base import Platform
from sierra.design.run_values import Declared
from sierra.errors import ConfigError, QueryError
from sierra.execution.build_products import matches
from sierra.execution.run_limits import RunLimits
from sierra.model import ARCH_ON_ROBOT, BASE, FOLDER, IN_PROJECT, ON_ROBOT, Client, Job, Member, Run, RunSpec, Service
from sierra.provenance import pythons
from sierra.store.layout import RUN_HOME, RUN_OUTPUT, RUN_TMP
from sierra.templates.arithmetic import CHOSEN
from sierra.templates.base import ARGUMENTS, FOLDERS, PORTS, Files
from sierra.util import processors
from sierra.util.hashing import digest_plain
from sierra.util.lazy_definitions import regex
from sierra.worker import layout, ports, program
from sierra.worker.devices import requested
from sierra.worker.job import CONDUCTED
from sierra.worker.layout import RUNS
from sierra.worker.run_folder import SAFE

if TYPE_CHECKING:
    from sierra.worker import conductor

PLACEHOLDER = regex(r"\{\{([a-z_]+)\}\}|\{([a-z_]+)\}")
NAMED = regex(r"\{\{([A-Za-z_]\w*)\}\}|\{([A-Za-z_]\w*)\}", re.ASCII)
"""Like `PLACEHOLDER`, but also for names of variables."""
ONE_INPUT = regex(r"(?<!\{)\{input\.(\w+)\}")
PORT = regex(r"(?<!\{)\{services\.([A-Za-z_][A-Za-z0-9_]*)\.port\}")
"""The port of a service, which only the conductor knows (see `sierra.worker.conductor`)."""
NUMBERED_PORT = regex(r"(?<!\{)\{(port[0-9]+)\}")
ABOVE = regex(r"(?<!\{)\{project\}((?:/\.\.)+)(?=/|$)")
CODE = regex(r"(ba|da|z|k|fi)?sh|python[0-9.]*|perl|ruby|node|lua[0-9.]*|Rscript")
"""Names of programs that execute the word after an option such as `-c`."""
OF_ITSELF = regex(r"\{run\.(\.*)(\w+)\}", re.ASCII)
"""A placeholder that only a run itself fills in; with a second dot, it is a text: `{run..seed}` is `{run.seed}`."""
OF_SINGLE = ("input", "output", "run", "seed")
"""The names that have a value of their own in each run."""
SPLICED = "{arguments}"
"""The word of a command that stands for several: those in the input file `ARGUMENTS`."""
FIXED = {
    "PYTHONHASHSEED": "0",
    "PYTHONDONTWRITEBYTECODE": "1",
    "TZ": "UTC",
    "LC_ALL": "C.UTF-8",
    "LANG": "C.UTF-8",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "VECLIB_MAXIMUM_THREADS": "1",
    "NUMEXPR_NUM_THREADS": "1",
}
"""Variables that every run gets; they are part of its identity."""
OWN = ("HOME", "TMPDIR")
ROBOT_PYTHON = "python3"
"""The value of `{python}` on robots, which have a Python of their own."""
KNOWN_ON_ROBOTS = (*OWN_PLACEHOLDERS, robots.VALUE)
"""Names in braces that have a meaning of their own in commands on robots."""
_BESIDE = f"{INSIDE}/beside"
PROGRAM = f"{INSIDE}/{program.NAME}"
"""The path in a container of the worker, and of the conductor. `CONDUCTING` are the words before its plan."""
CONDUCTING = (PYTHON, "-I", "-S", PROGRAM, "conductor", RUN)
PORT_MARK = "\2{}\2"
"""The text that stands for a service's port until the conductor fills it in."""
READY_S = 30.0
"""The seconds in which a service must be ready, if nothing else is declared."""


def command(
    platform: Platform,
    root: Path,
    *,
    contained: bool = False,
    produced: Sequence[str] = (),
    declared: Declared = Declared(),  # noqa: B008 - it is immutable
    project: Project | None = None,
) -> tuple[str, ...]:
    """Return the command as it is part of a run's identity.

    `produced` are the patterns of files that a build makes: their names are names of files in the project even before it.
    `declared` is what variables give to the command. `project` says which templates there are; None: one.

    Raises ConfigError for an unknown placeholder, or for a path that does not exist in a container. Raises QueryError for a
    variable that the query does not vary.
    """
    own = KNOWN_ON_ROBOTS if project is not None and project.robots else OWN_PLACEHOLDERS
    on_robots = project is not None and project.robots is not None
    if project and project.robots and CHECKPOINT not in declared.names:
        _check_no_checkpoint((*project.robots.words, *platform.command(), *project.environment.set.values()))
    known = (*own, *(PORT_NAMES if on_robots else WORKER_NAMES), *declared.names)
    given = project.robots.command if project is not None and project.robots else ()
    words = _with_arguments(given or platform.command(), declared.arguments)
    return checked(words, root, "command", known, contained=contained, produced=produced, declared=declared, project=project)


def checked(
    argv: Iterable[str],
    root: Path,
    key: str,
    known: Sequence[str],
    *,
    contained: bool,
    produced: Sequence[str],
    declared: Declared,
    project: Project | None,
) -> tuple[str, ...]:
    """Return the words of a command in the form that is part of a run's identity. Messages name its `key`.

    Raises ConfigError for a placeholder that is not `known`, or for a path that does not exist in a container. Raises
    QueryError for a variable that the query does not vary.
    """
    words = tuple(_in_project(word, root, produced) for word in argv)
    words = tuple(_with_inputs(word, project, key) for word in words) if project else words
    _check_values(words, declared, key)
    for word in words:
        if contained and ABOVE.search(word):
            raise ConfigError(
                f"{key}: {word!r} is outside of the project, which is all that a container sees; add it to [container] mounts"
            )
        if "arguments" in known and SPLICED in word.replace(f"{{{SPLICED}}}", "") and word != SPLICED:
            raise ConfigError(f"{key}: {SPLICED} expands to several words; write it as a separate word, not {word!r}")
        for name in (*(name for _, name in PLACEHOLDER.findall(word)), *NUMBERED_PORT.findall(word)):
            if name and name not in known:
                listed = ", ".join("{" + name + "}" for name in known if name not in PORT_NAMES[1:])
                hint = f"known are {listed}; write {{{{{name}}}}} for the text {{{name}}}"
                raise ConfigError(f"{key}: unknown placeholder {{{name}}} in {word!r}; {hint}")
    return words


def _check_no_checkpoint(texts: Iterable[str]) -> None:
    """Raise ConfigError if a text of runs on robots names a checkpoint."""
    if _uses(texts, CHECKPOINT):
        raise ConfigError("{checkpoint} in the command or a variable: runs on robots have no checkpoint; remove it")


def with_values(variables: Mapping[str, str], declared: Declared) -> dict[str, str]:
    """Return environment variables with those that get values; there, they stand for their values, as in the command."""
    return {**variables, **{variable: f"{{{name}}}" for variable, name in declared.environment.items()}}


def used_values(command: Sequence[str], declared: Declared, project: Project) -> run_values.Used:
    """Return the values that runs get in their command and environment."""
    names = tuple(name for name in declared.names if name not in OWN_PLACEHOLDERS and _uses(command, name))
    return run_values.Used(names, declared.environment, always=not project.template_paths)


def _uses(command: Iterable[str], name: str) -> bool:
    return any(used == name for word in command for _, used in NAMED.findall(word))


def has_checkpoint(spec: RunSpec, files: Files) -> bool:
    """Return whether a run with these input files names its checkpoint."""
    given = run_values.read(files)
    variables = (text for name, text in spec.environment.items() if name not in given.environment)
    return (
        any(FOLDERS[CHECKPOINT].encode() in content for _, content in files)
        or (CHECKPOINT not in given.values and _uses(spec.words, CHECKPOINT))
        or _uses(variables, CHECKPOINT)
    )


def _with_arguments(words: tuple[str, ...], given: tuple[str, ...] | None) -> tuple[str, ...]:
    """Return the words with those that variables declare: in the place of `{arguments}`, or at the end."""
    if given is None:
        return words
    if SPLICED not in words:
        return (*words, *given)
    return tuple(chain.from_iterable(given if word == SPLICED else (word,) for word in words))


def _with_inputs(word: str, project: Project, where: str) -> str:
    """Return a word with the paths of templates in the run's folder. Raises ConfigError."""
    names = ", ".join(f"{{input.{name}}}" for name in project.templates)

    def filled(match: re.Match[str]) -> str:
        if match[1] not in project.templates:
            known = f"known are {names}" if names else "[templates] has none"
            raise ConfigError(f"{where}: {match[0]} in {word!r} is no template; {known}")
        return f"{{run}}/{os.path.normpath(project.templates[match[1]])}"

    if any(name == "input" for _, name in PLACEHOLDER.findall(word)) and len(project.template_paths) != 1:
        why = f"there are several templates; use {names}" if names else "there is no template; remove it, or set template"
        raise ConfigError(f"{where}: {{input}} in {word!r}: {why}")
    return ONE_INPUT.sub(filled, word)


def _check_varied(name: str, declared: Declared, key: str) -> None:
    if name in declared.others:
        raise QueryError(f'{key} uses {{{name}}}; add {name}=… to the query, or give the variable an "argument"')


def _check_values(words: Sequence[str], declared: Declared, where: str) -> None:
    """Raise an error if the query does not vary a variable in the command, or if a value would be executed."""
    for number, word in enumerate(words):
        names = [name for _, name in NAMED.findall(word) if name not in OWN_PLACEHOLDERS]
        for name in names:
            _check_varied(name, declared, "the command" if where == "command" else where)
        if not (values := [name for name in names if name in declared.names]):
            continue
        if number == 0:
            raise ConfigError(f"{where}: a value of {values[0]!r} cannot choose the program; make {word!r} an argument")
        interpreters = (other for other in words[: number - 1] if CODE.fullmatch(other.rpartition("/")[2]))
        if re.fullmatch(r"-\w*[ce]", words[number - 1]) and (program := next(interpreters, None)):
            raise ConfigError(
                f"{where}: {program} would execute a value of {values[0]!r} in {word!r} as code; give it as another argument"
            )


def environment(
    platform: Platform,
    project: Project,
    declared: Declared = Declared(),  # noqa: B008 - it is immutable
    *,
    contained: bool = False,
) -> dict[str, str]:
    """Return the declared variables of a run: SIERRA's fixed ones, the platform's and the project's. They are part of its id.

    A run that is `contained` also has the container's. Variables may have the placeholders of commands, but those that are
    passed are texts as they are. Raises ConfigError for a variable that SIERRA sets for each run, and for an input that there
    is not. Raises QueryError for a value that the query does not vary.
    """
    boxed: Mapping[str, str] = project.container.variables if project.container else {}
    for table, names in (
        ("[environment]", (*project.environment.pass_, *project.environment.set)),
        ("[container] variables:", boxed),
    ):
        if taken := [name for name in names if name in OWN or name.startswith("SIERRA_")]:
            cure = "to choose the disk, set it where sierra is started" if taken[0] == "TMPDIR" else "use another name"
            raise ConfigError(f"{table} {taken[0]}: SIERRA sets this variable for each run; {cure}")
    passed = {name: _literal(os.environ[name]) for name in project.environment.pass_ if name in os.environ}
    own = {name: ("[environment]", text) for name, text in project.environment.set.items()}
    own |= {name: ("[container] variables:", text) for name, text in boxed.items() if contained}
    filled = {name: _checked_variable(name, table, text, project, declared) for name, (table, text) in own.items()}
    return {**FIXED, **platform.environment(), **passed, **filled}


def _checked_variable(name: str, table: str, text: str, project: Project, declared: Declared) -> str:
    """Return a variable in which `{run.NAME}` stands for what only a run itself knows."""
    where = f"{table} {name}"

    def own(match: re.Match[str]) -> str:
        used = match[2]
        if not used:
            return match[0][1:-1] if match[1] in declared.names and not PLACEHOLDER.fullmatch(match[0]) else match[0]
        _check_varied(used, declared, where)
        if used in CHOSEN and used not in declared.names:
            raise QueryError(f"{where} uses {{{used}}}, but no {used} is chosen; write {{{{{used}}}}} for the text {{{used}}}")
        if used not in (*OF_SINGLE, *declared.names):
            return match[0]
        if name in NOT_VARIED:
            raise ConfigError(
                f"{where}: {{{used}}} differs between runs, but {name} says where programs are, before runs begin"
            )
        return f"{{run.{used}}}"

    return NAMED.sub(own, _with_inputs(_literal(text), project, where))


def _literal(text: str) -> str:
    """Return a variable whose text `{run.NAME}` stays a text."""
    return OF_ITSELF.sub(r"{run.\1.\2}", text)


def as_written(variables: Mapping[str, str]) -> list[str]:
    """Return the variables that runs fill in, with the placeholders of commands."""
    return [re.sub(r"\{run\.(\w+)\}", r"{\1}", text) for text in variables.values() if "{run." in text]


def declared(
    variables: Mapping[str, str], root: Path, project: Path | None = None, *, image: Image | None = None
) -> dict[str, str]:
    """Return the declared variables with this machine's paths and the PATH of runs; with an `image`, its variables too."""
    filled = within(image, {name: fill((value,), root, project=project)[0] for name, value in variables.items()})
    return {**filled, "PATH": search_path(filled)}


def within(image: Image | None, variables: Mapping[str, str]) -> dict[str, str]:
    """Return the variables of runs together with those of their image. An image without a PATH gets the engines' default."""
    return {**image.defaults, **variables} if image else dict(variables)


def on_host(spec: RunSpec, image: Image, root: Path) -> tuple[tuple[str, ...], dict[str, str]]:
    """Return, for this machine, a command that was recorded in an image, and its variables."""
    return fill(spec.command, root, {"python": PYTHON}), declared(spec.environment, root, image=image)


def search_path(variables: Mapping[str, str]) -> str:
    """Return the PATH of runs: the declared one, or the caller's."""
    return variables.get("PATH", os.environ.get("PATH", os.defpath))


def fill(
    words: Iterable[str], root: Path, values: Mapping[str, str] | None = None, *, project: Path | None = None
) -> tuple[str, ...]:
    """Return the words with the placeholders of the machine filled in, and with those in `values`.

    The code is in `root`. Paths outside of it (`{project}/../build`) are resolved in the user's `project` folder.
    """
    known = {"project": str(root), "python": sys.executable, "arch": processors.here(), **(values or {})}

    def filled(match: re.Match[str]) -> str:
        if match[1]:
            return match[0][1:-1] if match[1] in known or PLACEHOLDER.fullmatch(match[0]) else match[0]
        return known.get(match[2], match[0])

    def above(match: re.Match[str]) -> str:
        return os.path.normpath(f"{(project or root).resolve()}{match[1]}")

    return tuple(NAMED.sub(filled, ABOVE.sub(above, word)) for word in words)


def named_programs(spec: RunSpec) -> dict[str, str]:
    """Return the name of the Python that runs SIERRA by the path that `{python}` is filled with, if a command uses it.

    A virtual environment has several links to its Python, and any of them may have started SIERRA.
    """
    return {sys.executable: str(Path(sys.executable).with_name(pythons.NAMED))} if "{python}" in spec.words else {}


def with_texts(words: Iterable[str], values: Mapping[str, str]) -> tuple[str, ...]:
    """Return the words with some placeholders filled in; all else stays as it is."""
    return tuple(NAMED.sub(lambda match: values.get(match[2] or "", match[0]), word) for word in words)


def on_hosts(words: Iterable[str], spec: RunSpec) -> tuple[str, ...]:
    """Return the words for the processors that may execute runs: this machine's, or for robots, all known ones."""
    names = (processors.here(),) if spec.robots is None else processors.NAMES
    return tuple(dict.fromkeys(chain.from_iterable(with_texts(words, {"arch": name}) for name in names)))


def arguments(files: Files) -> tuple[str, ...]:
    """Return the arguments in the input files of a run. Raises ConfigError if there are none."""
    content = next((content for name, content in files if name == ARGUMENTS), None)
    if content is None:
        raise ConfigError(f"command: {SPLICED} needs a template that provides arguments; this one provides none")
    return tuple(json.loads(content))


def execution_id(session: str, run: str, attempt: int = 0) -> str:
    """Return the id of the execution of a run by a session, which may execute it several times: `attempt` counts from 0."""
    again = {"attempt": str(attempt)} if attempt else {}
    return digest_plain("execution", {"session": session, "run": run, **again})


class CommandBuilder:
    """Builder of the jobs of one session."""

    def __init__(
        self,
        spec: RunSpec,
        root: Path,
        engine: Engine,
        limits: RunLimits,
        session: str,
        project: Path | None = None,
        *,
        image: Image | None = None,
        box: ContainerSpec | None = None,
        programs: Path = Path(program.NAME),
        allots: bool = False,
        stays: bool = False,
        beside: Path | None = None,
        checkpoint: Callable[[str], Path] | None = None,
        success: Sequence[int] = (0,),
        accept: Sequence[int] = (),
        timeouts: Mapping[str, float] | None = None,
        observed: bool = False,
        python: str = sys.executable,
        arch: str = "",
    ) -> None:
        """Prepare the variables and containers that all jobs share.

        `root` is the folder of the code, `project` the user's project folder. `box` is the container specification, if runs
        execute in containers. `programs` is the zip that containers need. `allots`: the worker gives devices to runs. `stays`:
        the runs execute on a cluster. `beside` is the folder of the files that lie beside the inputs of runs. `checkpoint`
        returns the folder of a run's checkpoint by its id; without it, each execution begins with an empty one. With an `image`
        and without a `box`, runs get the image's variables on this machine. `success` are the exit statuses of a successful
        command, `accept` those of results that are no success, and `timeouts` the seconds in which services must be ready, by
        name. `observed`: services that runs share are observed. `python` is the value of `{python}` without an image, `arch`
        that of `{arch}`, by default this machine's processor.
        """
        self._success, self._accept = success, accept
        self._observed = observed
        self._timeouts = timeouts or {}
        self._spec = spec
        self._root = root
        self._engine = engine
        self._limits = limits
        self._box = box
        self._programs = programs
        self._here = RUN if box and not box.shared else HERE
        self._on_robots = spec.robots is not None
        self._checkpoint = checkpoint
        self._placed = {"project": PROJECT if box else ON_ROBOT if self._on_robots else str(root)}
        self._placed |= PORTS
        if not self._on_robots:
            self._placed[CHECKPOINT] = f"{self._here}/{layout.CHECKPOINT}"
        self._placed["arch"] = ARCH_ON_ROBOT if self._on_robots else arch or processors.here()
        python = ROBOT_PYTHON if self._on_robots else python
        self._placed["python"] = PYTHON if image else python
        self._project = Path(self._placed["project"]) if box else project
        self._environment = {
            **within(image, {name: self._fill((value,))[0] for name, value in spec.environment.items()}),
            "HOME": f"{self._here}/{RUN_HOME}",
            "TMPDIR": "/tmp" if self._here != HERE else f"{HERE}/{RUN_TMP}",  # noqa: S108 - the container's own
            "SIERRA_RUN_DIR": self._here,
            "SIERRA_SESSION": session,
        }
        self._unfilled = [name for name, text in spec.environment.items() if OF_ITSELF.search(text)]
        if not (box or self._on_robots):  # a robot has a PATH of its own
            self._environment["PATH"] = search_path(self._environment)
        if allots and (box is None or box.gpu):
            self._environment |= requested(self._environment, limits.most.gpus)
        self._search = self._environment["PATH"] if stays and not box else None
        self._beside = beside
        self._shared = self._container() if box and box.shared else None
        self._same: dict[str, tuple[str, ...]] = {}

    def job(self, run: Run, files: tuple[tuple[str, bytes], ...], attempt: int = 0) -> Job:
        """Return the job that executes a run in this session. `attempt`: how often the session has executed it before."""
        execution = execution_id(self._environment["SIERRA_SESSION"], run.id, attempt)
        seed = str(run.seed)
        own = {"SIERRA_RUN_ID": run.id, "SIERRA_SEED": seed, "SIERRA_EXECUTION": execution}
        if self._on_robots:
            members = tuple(self._members(files, seed, own))
            return Job(run.id, execution, (), {}, files, self._limits.of(run.experiment), members=members)
        given = run_values.read(files)
        values = self._values(files, seed, given.values)
        argv = self._argv(self._spec.command, files, values, alike=not given.values)
        variables = {**self._environment, **self._own_variables(self._environment, values), **own, **given.environment}
        folders = self._folders(files)
        texts = (*argv, *variables.values(), *(folders or {}).values())
        kept = self._checkpoint is not None and any(layout.CHECKPOINT in text for text in texts)
        if kept and self._shared:
            raise ConfigError('{checkpoint} needs a container for each run; set isolation = "run" in [container]')
        client = self._shared or self._contained(argv, variables, kept=kept)
        return Job(
            run.id,
            execution,
            argv,
            variables,
            files,
            self._limits.of(run.experiment),
            client,
            shared=self._shared is not None,
            folders=folders,
            checkpoint=str(self._checkpoint(run.id)) if kept and self._checkpoint else None,
            beside=(_BESIDE if self._shared else str(self._beside)) if self._beside else None,
        )

    def _members(self, files: Files, seed: str, own: Mapping[str, str]) -> Iterator[Member]:
        """Yield the parts of all robots in a run."""
        listed = robots.read(files)
        count = str(sum(robot.number != BASE for robot, _ in listed))
        groups = self._spec.robots or {}
        for robot, theirs in listed:
            given, number = run_values.read(theirs), str(robot.number)
            command = groups.get(robot.group, self._spec.command)
            values = self._values(theirs, seed, {**given.values, robots.VALUE: number})
            argv = self._argv(command, theirs, values)
            texts = with_texts(self._environment.values(), {robots.VALUE: number})
            filled = dict(zip(self._environment, texts, strict=True))
            variables = {
                **filled,
                **self._own_variables(filled, values),
                **own,
                "SIERRA_ROBOT": number,
                "SIERRA_ROBOTS": count,
                **given.environment,
            }
            yield Member(robot.number, robot.group, argv, variables, theirs, self._folders(theirs))

    def _folders(self, files: Files) -> Mapping[str, str] | None:
        """Return the paths for the marks of folders in input files; None if there are no marks. Raises ConfigError."""
        marks = (FOLDER.encode(), ports.PORT_MARK.encode())
        if not any(mark in content for _, content in files for mark in marks):
            wide = (content.replace(b"\0", b"") for _, content in files if b"\0" in content)
            if any(mark in content for content in wide for mark in marks):
                raise ConfigError(
                    "{project}, {output}, {checkpoint} and {port} can only be filled in in UTF-8; save the template as UTF-8"
                )
            return None
        project, mark = self._placed["project"], FOLDERS["project"].encode()
        if not (self._on_robots or SAFE.fullmatch(project)) and any(mark in content for _, content in files):
            raise ConfigError(
                f"{{project}} in an input would be {project!r}, which some formats would read in another way; "
                "move the project to a folder with a plain name"
            )
        paths = {FOLDERS["project"]: project, FOLDERS["output"]: f"{self._here}/{RUN_OUTPUT}"}
        if any(FOLDERS[CHECKPOINT].encode() in content for _, content in files):
            if self._on_robots:
                raise ConfigError("{checkpoint} in an input: runs on robots have no checkpoint; remove it")
            paths[FOLDERS[CHECKPOINT]] = f"{self._here}/{layout.CHECKPOINT}"
        return paths

    def _values(self, files: Files, seed: str, given: Mapping[str, str]) -> dict[str, str]:
        """Return the texts of a run's own placeholders."""
        here = self._here
        return {**given, "input": f"{here}/{files[0][0]}", "output": f"{here}/{RUN_OUTPUT}", "run": here, "seed": seed}

    def _own_variables(self, variables: Mapping[str, str], values: Mapping[str, str]) -> dict[str, str]:
        """Return the variables with placeholders that only a run itself can fill in."""

        def filled(match: re.Match[str]) -> str:
            return f"{{run.{match[1][1:]}{match[2]}}}" if match[1] else values.get(match[2], match[0])

        return {name: OF_ITSELF.sub(filled, variables[name]) for name in self._unfilled}

    def _argv(
        self, command: tuple[str, ...], files: Files, values: Mapping[str, str], *, alike: bool = False
    ) -> tuple[str, ...]:
        """Return the command of a run. If runs are `alike`, it is built once per input file name."""
        file = files[0][0]
        if alike and (same := self._same.get(file)) is not None:
            return same
        given = arguments(files) if SPLICED in command else ()
        argv = tuple(chain.from_iterable(given if word == SPLICED else self._fill((word,), values) for word in command))
        argv = self._conducted(self._located(argv), values) if self._spec.around else self._located(argv)
        if alike and not any("{seed}" in word or word == SPLICED for word in self._spec.words):
            self._same[file] = argv
        return argv

    def _located(self, argv: tuple[str, ...]) -> tuple[str, ...]:
        """Return a command with the path of its program, if a node may find another program with that name."""
        if self._search is None:
            return argv
        return (shutil.which(argv[0], path=self._search) or argv[0], *argv[1:])

    def _conducted(self, argv: tuple[str, ...], values: Mapping[str, str]) -> tuple[str, ...]:
        """Return the words by which the worker lets the conductor execute a command and what is around it."""

        def words(given: Iterable[str], own: Mapping[str, str] | None = None) -> tuple[str, ...]:
            return self._located(self._fill(given, {**values, **(own or {})}))

        def service(spec: Service) -> conductor.Service:
            own = {"port": PORT_MARK.format(spec.name)}
            kind, *ready = spec.ready
            test = words(ready, own) if kind == "command" else tuple(ready)
            if kind in ("file", "port"):
                test = self._fill(ready, {**values, **own})
            timeout = self._timeouts.get(spec.name, READY_S)
            return {"name": spec.name, "argv": words(spec.command, own), "ready": (kind, *test), "timeout": timeout}

        around, limits = self._spec.around, self._limits.most
        plan: conductor.Plan = {
            "shared": [service(spec) for spec in around.services if spec.shared],
            "observed": self._observed,
            "services": [service(spec) for spec in around.services if not spec.shared],
            "before": [words(given) for given in around.before],
            "argv": argv,
            "after": [words(given) for given in around.after],
            "success": self._success,
            "grace": limits.grace_s,
        }
        if self._accept:
            plan["accept"] = self._accept
        if limits.after_marker_s is not None:
            plan["marker"] = {"after_marker_s": limits.after_marker_s, "marker": limits.marker, "contains": limits.contains}
        return (CONDUCTED, json.dumps(plan))

    def _fill(self, words: Iterable[str], values: Mapping[str, str] | None = None) -> tuple[str, ...]:
        marked = (PORT.sub(lambda match: PORT_MARK.format(match[1]), word) for word in words)
        return fill(marked, self._root, {**self._placed, **(values or {})}, project=self._project)

    def _contained(self, argv: tuple[str, ...], variables: Mapping[str, str], *, kept: bool) -> Client | None:
        """Return the client that starts the container of one run; None without containers. `kept`: it has a checkpoint."""
        if self._box is None:
            return None
        more: tuple[Mount, ...] = ()
        if self._spec.around:
            argv, more = (*CONDUCTING, *argv[1:]), (self._mount(),)
        if kept:
            more = (*more, Mount(f"{HERE}/{layout.CHECKPOINT}", f"{RUN}/{layout.CHECKPOINT}", writable=True))
        return self._engine.client(self._box, run_process(argv, variables, *more))

    def _container(self) -> Client:
        """Return the client that starts one container for all runs of a slot, with the worker in it."""
        runs = f"{INSIDE}/runs"
        more = (Mount(str(self._beside), _BESIDE),) if self._beside else ()
        own = (Mount(f"{HERE}/{RUNS}", runs, writable=True), self._mount(), *more)
        variables = {name: self._environment[name] for name in ("PATH", "SIERRA_SESSION")} | {"HOME": runs, "TMPDIR": "/tmp"}  # noqa: S108
        argv = (PYTHON, "-I", "-S", PROGRAM, runs, "1", "-", *WRITABLE, INSIDE, runs)
        process = Process(argv, variables, own, runs, interactive=True)
        return self._engine.client(cast(ContainerSpec, self._box), process)

    def _mount(self) -> Mount:
        """Return the mount of the programs that execute runs in a container, and what is around their commands."""
        return Mount(str(self._programs), PROGRAM)


def _in_project(word: str, root: Path, produced: Sequence[str]) -> str:
    """Return `{project}/sim.py` for `sim.py` if that file exists in `root`, or if a pattern in `produced` matches it.

    Paths like `../build/sim` work too, and `bin/{arch}/sim` if there is such a file for any processor.
    """
    if "{" in word.replace(processors.ARCH, "") or not word or word.startswith(("/", "-")):
        return word
    names = dict.fromkeys(word.replace(processors.ARCH, name) for name in processors.NAMES)
    try:
        exists = any(matches(word, pattern) for pattern in produced) or any((root / name).is_file() for name in names)
    except (OSError, ValueError):
        return word
    return IN_PROJECT + word.removeprefix("./") if exists else word

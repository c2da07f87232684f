"""The command that starts the simulator, from any folder.

Runs start in a folder of their own. `sierra.execution.commands` resolves words of the command that are files of the project.
This module adds `{project}/` to words that it leaves unchanged: absolute paths into the project, the project's folders,
`--option=file`.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path

from sierra.config import extensions, project_file
from sierra.design import platforms
from sierra.design.platforms.base import Platform
from sierra.design.run_values import Declared
from sierra.errors import UsageError
from sierra.execution import commands
from sierra.setup.init import arguments, folder, named_files
from sierra.setup.init.answers import Ask, Question, checked_answer
from sierra.util.lazy_definitions import regex

EXAMPLE = "python3 sim.py {input}"
EXAMPLE_WITHOUT = "python3 sim.py --robots 4 --seed 1"
NOTHING: Mapping[str, str] = {}
TO_BUILD = ("Makefile", "makefile", "CMakeLists.txt", "Cargo.toml", "meson.build")
SHELL = regex(r"[0-9]?[<>]|&&|\|\|?$|;$|&$")


def platform(inputs: Mapping[str, object], command: str | None) -> tuple[str, Platform]:
    """Return the platform's name and the platform; `command` is None if the platform has its own.

    `inputs` are the settings of the templates.
    """
    written = str([inputs.get("template"), inputs.get("templates")])
    name = next((name for ending, name in extensions.starts().items() if f"{ending}'" in written), "command")
    table = {"platform": name, **inputs} | ({"command": command} if command else {})
    return name, platforms.find(name, project_file.parse(table, "sierra init"))


def named_template(root: Path, given: str | None) -> str | None:
    """Return the first template that a given command names as a file; None if it contains {input}."""
    words = _split(given or "")
    return None if _has_input(words) else next(iter(named_files.by_command(root, words).values()), None)


def needs_no_template(root: Path, given: str | None) -> bool:
    """Check if a given command reads no template: nothing stands for a generated file, and it has arguments with values."""
    words = _split(given or "")
    if not words or _has_input(words):
        return False
    return bool(arguments.find(words)) or not folder.templates(root)


def _has_input(words: Iterable[str]) -> bool:
    return any("{input" in word or "{run}" in word for word in words)


def choose(root: Path, template: str | None, given: str | None, ask: Ask | None) -> str | None:
    """Return the command, if the platform needs one. Raises UsageError if it can never work, Missing if none is found."""
    if template and template.endswith(tuple(extensions.starts())) and given is None:
        return None
    programs = (given is None and folder.of_netlogo(root, template)) or folder.simulators(root)
    lines = {
        name: joined([*words, "{input}"] if template and "{input}" not in words else words) for name, words in programs.items()
    }
    likely = [line for name, line in lines.items() if folder.is_started(root / name)] or list(lines.values())
    unbuilt = "; build it first, or" if any((root / name).exists() for name in TO_BUILD) else ";"
    what = f"several files could be the simulator: {', '.join(programs)};" if programs else f"no program found{unbuilt}"
    question = Question(
        "command: starts the simulator, without a shell\n"
        + (
            "({input} is the generated file; other placeholders: {output}, {seed}, {project}, {python})"
            if template
            else "(with all arguments; placeholders: {output}, {seed}, {project}, {python})"
        ),
        tuple(lines.values()),
        likely[0] if len(likely) == 1 else None,
        f"{root}: {what} give the command that starts it with --command '{EXAMPLE if template else EXAMPLE_WITHOUT}'",
    )
    return checked_answer(given, question, ask, partial(_check, root, template))


def module_path(command: str | None, root: Path) -> str | None:
    """Return the folder in which `python3 -m module` finds a module of the project; None if there is none."""
    module = re.match(r"\S*python\S* (?:.* )?-m ([^\s.]+)", command or "")
    places = {"{project}": root, "{project}/src": root / "src"}
    parts = (module[1], f"{module[1]}.py") if module else ()
    return next((place for place, path in places.items() if any((path / part).exists() for part in parts)), None)


def warnings(
    platform: Platform, root: Path, inputs: Mapping[str, object], environment: Mapping[str, str] = NOTHING
) -> Iterator[str]:
    """Yield warnings about a command that is allowed but probably wrong; `environment` tells it the name of its input."""
    root = root.resolve()
    project = project_file.parse({"command": "-", **inputs}, "sierra init") if inputs else None
    argv = commands.command(platform, root, declared=_any(platform.command()), project=project)
    program = commands.fill(argv, root)[0]
    if Path(program).is_file() and not os.access(program, os.X_OK):
        yield f"{program} is not executable; add its interpreter to the command (python3 ...), or use chmod +x"
    elif "{" not in program and shutil.which(program) is None:
        yield f"the program {program!r} does not exist yet; build or install it before the first run"
    for word in argv:
        if SHELL.match(word):
            yield f"no shell starts the command, so the program gets {word!r} as an argument; use sh -c '...' for a shell"
        if (root / word).is_dir() and not word.startswith(("/", ".")):
            yield f"{word!r} is a folder here, but each run starts in its own folder; to use this one, write {{project}}/{word}"
    if inputs and not _has_input((*argv, *environment.values())):
        yield "the command does not contain {input}, the generated file; unless the program finds it, all experiments are equal"


def services(command: str) -> Iterator[str]:
    """Yield a note on the services whose ports a command uses: they must be declared before runs can execute."""
    if names := list(dict.fromkeys(commands.PORT.findall(command))):
        tables = ", ".join(f"[services.{name}]" for name in names)
        yield f"no run was tried, because the command uses ports of services: declare {tables} with command and ready first"


def _any(words: Sequence[str]) -> Declared:
    """Return the variables that the words of a command use, as if queries had them."""
    return Declared(names=arguments.placeholders(words))


def _check(root: Path, template: str | None, text: str) -> str:
    words = _split(text)
    if not words:
        raise UsageError(f"the command is empty; use one such as: {EXAMPLE if template else EXAMPLE_WITHOUT}")
    for word in words:
        if Path(word).suffix in folder.INTERPRETERS and "{" not in word and not (root / word).exists():
            raise UsageError(f"command: there is no {word} in {root}; use a path relative to that folder")
    if template and not _has_input(words):
        words = [_with_input(word, template) for word in words]
    command = joined(_placed(word, root.resolve()) for word in arguments.with_ports(arguments.with_outputs(words, root), root))
    guessed = platform({"template": template} if template else {}, command)[1]
    commands.command(guessed, root, declared=Declared() if template else _any(guessed.command()))
    return command


def _with_input(word: str, template: str) -> str:
    """Return the word, with `{input}` if it names the template."""
    option, equals, name = word.rpartition("=")
    return f"{option}{equals}{{input}}" if name and os.path.normpath(name) == os.path.normpath(template) else word


def _split(text: str) -> list[str]:
    """Return the words of a line. Raises UsageError for an open quotation."""
    try:
        return shlex.split(text)
    except ValueError as error:
        raise UsageError(f"command {text!r}: {error}") from error


def _placed(word: str, root: Path) -> str:
    """Return the word, with `{project}/` if it names a file or folder of the project that runs would not find otherwise."""
    option, equals, name = word.rpartition("=")
    path = root / name
    found_by_jobs = not equals and path.is_file() and not name.startswith("/")
    if "{" in word or found_by_jobs or not name.strip("./") or not (path.is_file() or ("/" in name and path.is_dir())):
        return word
    inside = os.path.relpath(path, root)
    return word if inside.startswith("..") else f"{option}{equals}{{project}}/{inside}"


def joined(words: Iterable[str]) -> str:
    """Return a line that splits into these words, quoted only if necessary."""
    return " ".join(word if re.fullmatch(r"[\w@%+=:,./{}-]+", word) else shlex.quote(word) for word in words)

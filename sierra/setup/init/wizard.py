"""The steps of `sierra init`: copying an example, or writing a first `sierra.toml` from the content of a folder.

`find_out` makes a `Guess` from options, the folder and answers; `write` writes it.
"""

from __future__ import annotations

import shlex
import shutil
from dataclasses import replace
from functools import partial
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

from sierra.config.project_file import LoadedProject
from sierra.errors import SierraError, UsageError
from sierra.model import Set
from sierra.setup.init import arguments, command, folder, source, variables
from sierra.setup.init.answers import SHOWN, Ask, Options, Question
from sierra.setup.init.write import Guess, parsed, write
from sierra.store.layout import CONFIG, ProjectPaths, StorePaths
from sierra.templates.base import Template
from sierra.util.text import few

if TYPE_CHECKING:
    from sierra.execution.trial import Show, Trial

__all__ = ["Ask", "Guess", "Options", "Question", "copy_example", "find_out", "try_run", "write"]


def find_out(root: Path, options: Options, ask: Ask | None = None) -> Guess:
    """Return a guess from the options, and for the rest from the folder. If `ask` is given, it asks about uncertain values.

    Raises UsageError for a wrong option, or if there is a `sierra.toml` already; Missing if the folder does not show a value
    and nobody can be asked.
    """
    folder.check(root)
    if options.template is None and command.needs_no_template(root, options.command):
        guess = _of_arguments(root, options, ask)
        unused = folder.templates(root)
        why = f"the command has no {{input}}, so that runs do not depend on {few(unused, SHOWN)}"
        return replace(guess, notes=(*guess.notes, why)) if unused else guess
    found = folder.template(root, options.template, options.format, ask)
    return _of_template(root, *found, options, ask) if found else _of_arguments(root, options, ask)


def _of_template(root: Path, template: str, content: Template, options: Options, ask: Ask | None) -> Guess:
    """Return the guess for a program that reads a generated file."""
    started = command.choose(root, template, options.command, ask)
    platform_name, platform = command.platform(template, started)
    numbers = variables.numbers(content)
    seeds = variables.seeds(numbers)
    by_platform = platform.seed_changes()
    check_seed = partial(variables.check_seed, content)
    given_seed = None if by_platform and options.seed is None else (options.seed, ask)
    seed = variables.choose_seed(seeds, *given_seed, check_seed, "XPath of the attribute or element") if given_seed else None
    named = variables.named({path: value for path, value in numbers.items() if path not in (seed, *seeds)}, platform.criteria())
    per_run = (*by_platform, *([Set(seed, "{seed}")] if seed else []))
    likely = {} if platform.criteria() else dict(list(named.items())[:1])
    unset = [path for path in variables.unset(content) if path not in (seed, *(change.path for change in by_platform))]
    if unset:  # a placeholder without a value is an error
        likely = {name: path for name, path in named.items() if path in unset}
    chosen = variables.choose(named, likely, options.variables, ask, partial(variables.check, content, per_run))
    wrong = tuple(command.doubts(platform, root, template))
    return Guess(
        template=template,
        format=options.format,
        platform=platform_name,
        command=started,
        module_path=command.module_path(started, root),
        seed=seed,
        variables=chosen,
        other_variables={name: path for name, path in named.items() if path not in chosen.values()},
        tried=(),
        source=source.choose(root, (template,), options.source, ask),
        next=variables.first_query(platform, content, chosen),
        unset=tuple(unset),
        given=options.command is not None or ask is not None,
        doubtful=bool(wrong),
        notes=(
            *wrong,
            *variables.doubts(seed, seeds, elsewhere=bool(by_platform) or "{seed}" in (started or "")),
            *folder.doubts(root),
        ),
    )


def _of_arguments(root: Path, options: Options, ask: Ask | None) -> Guess:
    """Return the guess for a program that reads only its arguments."""
    line = command.choose(root, None, options.command, ask) or ""
    words = shlex.split(line)
    found = arguments.find(words)
    numbers = arguments.numbers(found)
    by_key = {one.key: one for one in found}
    seeds = [by_key[key].name for key in variables.seeds(numbers)]
    if any("{seed}" in word for word in words) and options.seed is None:
        seed = None
    else:
        seed = variables.choose_seed(seeds, options.seed, ask, partial(arguments.check_seed, found), "argument")
    free = {key: value for key, value in numbers.items() if by_key[key].name not in seeds}
    named = {name: by_key[key].name for name, key in variables.named(free, ()).items()}
    used = arguments.placeholders(words)
    likely = {} if used else dict(list(named.items())[:1])
    check = partial(arguments.check_variable, found, seed)
    chosen = variables.choose(named, likely, options.variables, ask, check, "NAME=ARGUMENT")
    by_name = {one.name: one for one in found}
    removed = {name: by_name[argument] for name, argument in chosen.items()}
    started = command.joined(arguments.placed(words, seed, removed.values()))
    values = {name: one.value for name, one in removed.items()}
    places = {name: f"{{{name}}}" for name in used} | {name: one.declared for name, one in removed.items()}
    first = next((variables.around(name, value) for name, value in values.items()), None)
    platform_name, platform = command.platform(None, started)
    wrong = tuple(command.doubts(platform, root, None))
    return Guess(
        template=None,
        format=None,
        platform=platform_name,
        command=started,
        module_path=command.module_path(started, root),
        seed=None,
        variables=places,
        other_variables={
            name: by_name[argument].declared for name, argument in named.items() if argument not in chosen.values()
        },
        tried=tuple(filter(None, (arguments.criterion(name, value) for name, value in values.items()))),
        source=source.choose(root, (), options.source, ask),
        next=" ".join(f"{name}=1,2" for name in used) or first,
        unset=tuple(f"{{{name}}}" for name in used),
        given=options.command is not None or ask is not None,
        doubtful=bool(wrong),
        notes=(*wrong, *arguments.doubts(started, seeds, seed), *folder.doubts(root)),
    )


def try_run(root: Path, guess: Guess, show: Show) -> Trial | str | None:
    """Execute one run with the guessed settings before they are written; nothing is recorded.

    Returns the trial; or why no run can be tried; or None if the command is doubtful, or is the platform's own. Raises
    KeyboardInterrupt.
    """
    from sierra.execution import resolve_plan, trial
    from sierra.execution.observer import Observer
    from sierra.query import query_request

    if guess.command is None or guess.doubtful:
        return None
    if guess.unset:
        of = "template" if guess.template else "command"
        return f"no run was tried, because the {of} has no value for {few(guess.unset, SHOWN)}"
    root = root.resolve()
    project = LoadedProject(root, root / CONFIG, parsed(root, guess))
    try:
        plan = resolve_plan.plan(project, query_request.request(list(guess.tried) or [trial.UNCHANGED], runs=1))
        run, files = trial.choose(plan, 0, None)
        return trial.attempt(plan, run, files, StorePaths(ProjectPaths(root).store), Observer(), show)
    except SierraError as error:
        return f"no run was tried: {error}"


def copy_example(name: str, target: Path) -> list[str]:
    """Copy a bundled example; return the files' names. Raises UsageError for an unknown name or a folder that is not empty."""
    examples = resources.files("sierra.setup") / "examples"
    known = sorted(entry.name for entry in examples.iterdir() if entry.is_dir() and not entry.name.startswith("_"))
    if name not in known:
        raise UsageError(f"no example {name!r}; known are {', '.join(known)}")
    if target.exists() and any(target.iterdir()):
        raise UsageError(f"{target} is not empty; use a new folder")
    target.mkdir(parents=True, exist_ok=True)
    with resources.as_file(examples / name) as example:
        found = [file.relative_to(example) for file in example.rglob("*") if file.is_file()]
        files = sorted(file for file in found if "__pycache__" not in file.parts)
        for file in files:
            (target / file).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(example / file, target / file)
    return [str(file) for file in files]

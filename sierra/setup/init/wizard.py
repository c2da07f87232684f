"""The steps of `sierra init`: copying an example, or writing a first `sierra.toml` from the content of a folder.

`find_out` makes a `Guess` from options, the folder and answers; `write` writes it.
"""

from __future__ import annotations

import shutil
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

from sierra.config.project_file import LoadedProject
from sierra.errors import SierraError, UsageError
from sierra.model import Set
from sierra.setup.init import command, folder, source, variables
from sierra.setup.init.answers import SHOWN, Ask, Options, Question
from sierra.setup.init.write import Guess, parsed, write
from sierra.store.layout import CONFIG, ProjectPaths, StorePaths
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
    template, content = folder.template(root, options.template, options.format, ask)
    started = command.choose(root, template, options.command, ask)
    platform_name, platform = command.platform(template, started)
    numbers = variables.numbers(content)
    seeds = variables.seeds(numbers)
    by_platform = platform.seed_changes()
    seed = None if by_platform and options.seed is None else variables.choose_seed(content, seeds, options.seed, ask)
    named = variables.named({path: value for path, value in numbers.items() if path not in (seed, *seeds)}, platform.criteria())
    per_run = (*by_platform, *([Set(seed, "{seed}")] if seed else []))
    likely = {} if platform.criteria() else dict(list(named.items())[:1])
    unset = [path for path in variables.unset(content) if path not in (seed, *(change.path for change in by_platform))]
    if unset:  # a placeholder without a value is an error
        likely = {name: path for name, path in named.items() if path in unset}
    chosen = variables.choose(content, per_run, named, likely, options.variables, ask)
    wrong = tuple(command.doubts(platform, root))
    return Guess(
        template=template,
        format=options.format,
        platform=platform_name,
        command=started,
        module_path=command.module_path(started, root),
        seed=seed,
        variables=chosen,
        other_variables={name: path for name, path in named.items() if path not in chosen.values()},
        source=source.choose(root, template, options.source, ask),
        next=variables.first_query(platform, content, chosen),
        unset=tuple(unset),
        given=(options.command is not None or ask is not None) and started is not None and not wrong,
        notes=(
            *wrong,
            *variables.doubts(seed, seeds, elsewhere=bool(by_platform) or "{seed}" in (started or "")),
            *folder.doubts(root),
        ),
    )


def try_run(root: Path, guess: Guess, show: Show) -> Trial | str | None:
    """Execute one run with the guessed settings before they are written; nothing is recorded.

    Returns the trial; or why no run can be tried; or None if the user has not given the command. Raises KeyboardInterrupt.
    """
    from sierra.execution import resolve_plan, trial
    from sierra.execution.observer import Observer
    from sierra.query import query_request

    if not guess.given:
        return None
    if guess.unset:
        return f"no run was tried, because the template has no value for {few(guess.unset, SHOWN)}"
    root = root.resolve()
    project = LoadedProject(root, root / CONFIG, parsed(root, guess))
    try:
        plan = resolve_plan.plan(project, query_request.request([trial.UNCHANGED], runs=1))
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

"""The steps of `sierra init`: copying an example, or writing a first `sierra.toml` from the content of a folder.

`find_out` makes a `Guess` from options, the folder and answers; `write` writes it.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from sierra.config import extensions
from sierra.config.project_file import LoadedProject
from sierra.errors import SierraError, UsageError
from sierra.setup.init import command, environment, folder, named_files, of_arguments, of_environment, of_template
from sierra.setup.init.answers import SHOWN, Ask, Options, Question
from sierra.setup.init.of_trial import with_findings, with_lacking, with_outputs
from sierra.setup.init.write import Guess, parsed, write
from sierra.store.layout import CONFIG, ProjectPaths, StorePaths
from sierra.util.text import few

if TYPE_CHECKING:
    from sierra.execution.trial import Show, Trial

__all__ = [
    "Ask",
    "Guess",
    "Options",
    "Question",
    "copy_example",
    "find_out",
    "try_run",
    "with_findings",
    "with_lacking",
    "with_outputs",
    "write",
]

EXAMPLES = Path(__file__).parents[1] / "examples"


def find_out(root: Path, options: Options, ask: Ask | None = None) -> Guess:
    """Return a guess from the options, and for the rest from the folder. If `ask` is given, it asks about uncertain values.

    Raises UsageError for a wrong option, or if there is a `sierra.toml` already; Missing if the folder does not show a value
    and nobody can be asked.
    """
    folder.check(root)
    assigned, started = environment.split_off(options.command or "")
    if assigned:
        reads = {**environment.read_by(root, shlex.split(started)), **assigned}
        started = command.choose(root, None, started, ask) or ""
        return of_environment.guess(root, options, ask, started, reads, tuple(assigned))
    if options.template is None:
        options = replace(options, template=command.named_template(root, options.command))
    if options.template is None and command.needs_no_template(root, options.command):
        guess = of_arguments.guess(root, options, ask)
        unused = folder.templates(root)
        why = f"the command has no {{input}}, so that runs do not depend on {few(unused, SHOWN)}"
        return replace(guess, notes=(*guess.notes, why)) if unused else guess
    template = folder.template(root, options.template, options.format, ask, named_files.main)
    return of_template.guess(root, *template, options, ask) if template else of_arguments.guess(root, options, ask)


def try_run(root: Path, guess: Guess, show: Show, *, seed: int | None = None) -> Trial | str | None:
    """Execute one run with the guessed settings before they are written, with this seed; nothing is recorded.

    Returns the trial; or why no run can be tried; or None if the command is doubtful. Raises KeyboardInterrupt.
    """
    from sierra.design.query import query_request
    from sierra.execution import resolve_plan, trial
    from sierra.execution.observer import Observer

    if guess.doubtful:
        return None
    if not guess.can_be_tried:
        of = "template" if guess.template_paths else "command"
        return f"no run was tried, because the {of} has no value for {few(guess.unset, SHOWN)}"
    root = root.resolve()
    project = LoadedProject(root, root / CONFIG, parsed(root, guess))
    try:
        plan = resolve_plan.plan(project, query_request.request(list(guess.tried) or [trial.UNCHANGED], runs=1))
        run, files = trial.choose(plan, 0, seed)
        return trial.attempt(plan, run, files, StorePaths(ProjectPaths(root).store), Observer(), show)
    except SierraError as error:
        return f"no run was tried: {error}"


def _without_absent(text: str) -> str:
    """Return a `sierra.toml` without the tables of extensions that are not there."""
    keys = [key for key in extensions.every("tables") if extensions.absent("tables", key)]
    return re.sub(rf"(?ms)^(# [^\n]*\n)*\[({'|'.join(keys)})[.\]].*?(?=^# |^\[|\Z)", "", text) if keys else text


def copy_example(name: str, target: Path) -> list[str]:
    """Copy a bundled example; return the files' names. Raises UsageError for an unknown name or a folder that is not empty."""
    examples = {**{folder.name: folder for folder in EXAMPLES.glob("[a-z]*/")}, **extensions.examples()}
    if (example := examples.get(name)) is None:
        raise UsageError(f"no example {name!r}; known are {', '.join(sorted(examples))}")
    if target.exists() and any(target.iterdir()):
        raise UsageError(f"{target} is not empty; use a new folder")
    target.mkdir(parents=True, exist_ok=True)
    paths = [file.relative_to(example) for file in example.rglob("*") if file.is_file()]
    files = sorted(file for file in paths if "__pycache__" not in file.parts)
    for file in files:
        (target / file).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(example / file, target / file)
        if file.name == CONFIG:
            (target / file).write_text(_without_absent((target / file).read_text()))
        if os.access(example / file, os.X_OK):
            mode = (target / file).stat().st_mode
            (target / file).chmod(mode | (mode & 0o444) >> 2)  # whoever can read it can execute it
    return [str(file) for file in files]

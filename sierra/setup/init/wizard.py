"""The steps of `sierra init`: copying an example, or writing a first `sierra.toml` from the content of a folder.

`find_out` makes a `Guess` from options, the folder and answers; `write` writes it.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from sierra.config import extensions
from sierra.config.output_tables import with_rotation
from sierra.config.project_file import LoadedProject
from sierra.errors import SierraError, UsageError
from sierra.ingest import open_names
from sierra.setup.init import command, folder, named_files, of_arguments, of_template
from sierra.setup.init.answers import SHOWN, Ask, Options, Question
from sierra.setup.init.write import Guess, parsed, write
from sierra.store.layout import CONFIG, RUN_STDERR, RUN_STDOUT, ProjectPaths, StorePaths
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
    "patterns",
    "rates",
    "try_run",
    "with_lacking",
    "write",
]

EXAMPLES = Path(__file__).parents[1] / "examples"
LOGS = (RUN_STDERR, RUN_STDOUT)
LAST = 1 << 14
"""The number of bytes at the end of a log that are searched for the names of files."""


def find_out(root: Path, options: Options, ask: Ask | None = None) -> Guess:
    """Return a guess from the options, and for the rest from the folder. If `ask` is given, it asks about uncertain values.

    Raises UsageError for a wrong option, or if there is a `sierra.toml` already; Missing if the folder does not show a value
    and nobody can be asked.
    """
    folder.check(root)
    if options.template is None:
        options = replace(options, template=command.named_template(root, options.command))
    if options.template is None and command.needs_no_template(root, options.command):
        guess = of_arguments.guess(root, options, ask)
        unused = folder.templates(root)
        why = f"the command has no {{input}}, so that runs do not depend on {few(unused, SHOWN)}"
        return replace(guess, notes=(*guess.notes, why)) if unused else guess
    found = folder.template(root, options.template, options.format, ask, named_files.main)
    return of_template.guess(root, *found, options, ask) if found else of_arguments.guess(root, options, ask)


def try_run(root: Path, guess: Guess, show: Show, *, seed: int | None = None) -> Trial | str | None:
    """Execute one run with the guessed settings before they are written, with this seed; nothing is recorded.

    Returns the trial; or why no run can be tried; or None if the command is doubtful. Raises KeyboardInterrupt.
    """
    from sierra.design.query import query_request
    from sierra.execution import resolve_plan, trial
    from sierra.execution.observer import Observer

    if guess.doubtful:
        return None
    if guess.unset:
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


def patterns(first: Trial, second: Trial | None = None) -> dict[str, str]:
    """Return the patterns for tables of rotated files, and of files with another name in each run, by path.

    One run alone shows dates only.
    """
    runs = [[file.path for file in one.files if file.table] for one in (first, second) if one is not None]
    found = {path: with_rotation(path, (file.path for file in first.files)) for path in runs[0]}
    found |= {path: open_names.with_date(path) or found[path] for path in runs[0] if second is None}
    found |= open_names.patterns(runs)
    return {path: pattern for path, pattern in found.items() if pattern != path}


def rates(first: Trial, second: Trial, patterns: Mapping[str, str]) -> dict[str, tuple[str, ...]]:
    """Return the columns of tables of one row that are 0 in one of two runs and 1 in the other, by the table in the first."""
    names = {patterns.get(one.path, one.path): str(one.table) for one in first.files if one.table}
    before = {one.table: one.flags for one in first.files if one.table}
    found = {}
    for one in second.files:
        table = names.get(patterns.get(one.path, one.path))
        if one.table and table:
            found[table] = tuple(name for name, value in one.flags.items() if before[table].get(name) == 1 - value)
    return {table: columns for table, columns in found.items() if columns}


def with_outputs(guess: Guess, tried: Trial) -> Guess | None:
    """Return the guess with the keys that read the tables of a run; None if there are no such tables.

    Without them, the run has failed, because a table has no names in its first line.
    """
    found = {}
    for one in tried.unread:
        if one.keys:
            pattern = open_names.with_date(str(one.keys["file"]))
            name, file = (open_names.name_of(pattern), pattern) if pattern else (one.name, one.keys["file"])
            found[name] = {**one.keys, "file": file}
    return replace(guess, outputs={**guess.outputs, **found}) if found else None


def with_lacking(root: Path, guess: Guess, tried: Trial) -> Guess | None:
    """Return the guess with the files that a failed run lacked beside its input; None if it names none of the project."""
    log = "\n".join(_end(tried.folder / name) for name in LOGS) if tried.folder else ""
    known = (*guess.files, *guess.template_paths)
    lacking = named_files.lacking(root.resolve(), log, known, tuple(folder.INTERPRETERS))
    return replace(guess, files=(*guess.files, *lacking)) if lacking else None


def _end(log: Path) -> str:
    """Return the last words that a program printed."""
    try:
        with log.open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - LAST))
            return file.read().decode("utf-8", "replace")
    except OSError:
        return ""


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
    found = [file.relative_to(example) for file in example.rglob("*") if file.is_file()]
    files = sorted(file for file in found if "__pycache__" not in file.parts)
    for file in files:
        (target / file).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(example / file, target / file)
        if file.name == CONFIG:
            (target / file).write_text(_without_absent((target / file).read_text()))
        if os.access(example / file, os.X_OK):
            mode = (target / file).stat().st_mode
            (target / file).chmod(mode | (mode & 0o444) >> 2)  # whoever can read it can execute it
    return [str(file) for file in files]

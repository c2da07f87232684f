"""The steps of `sierra init`: copying an example, or writing a first `sierra.toml` from the content of a folder.

`find_out` makes a `Guess` from options, the folder and answers; `write` writes it.

Also: the first settings of a program that reads only its arguments.

Also: settings that a tried run shows: tables that need a declaration, files that it lacks, columns of 0 and 1.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from sierra.config import extensions
from sierra.config.output_tables import ROTATION, Key, with_rotation
from sierra.config.project_file import LoadedProject
from sierra.errors import SierraError, UsageError
from sierra.ingest import open_names
from sierra.model import Status
from sierra.setup.init import (
    arguments,
    command,
    environment,
    folder,
    named_files,
    of_environment,
    of_template,
    source,
    variables,
)
from sierra.setup.init.answers import SHOWN, Ask, Options, Question
from sierra.setup.init.write import Guess, parsed, write
from sierra.store.layout import CONFIG, RUN_STDERR, RUN_STDOUT, ProjectPaths, StorePaths
from sierra.util.text import few, numbered

if TYPE_CHECKING:
    from sierra.config.output_tables import Keys
    from sierra.execution.trial import Show, Trial, TriedFile


LOGS = (RUN_STDERR, RUN_STDOUT)
LAST = 1 << 14
"""The number of bytes at the end of a log that are searched for the names of files."""
RATES, TIME, RAGGED = "rates", "time", "mismatch"


def with_outputs(guess: Guess, tried: Trial) -> Guess | None:
    """Return the guess with the keys that read the tables of a run, as it is to be tried again; None if it needs none.

    These tables are not plain ones: of some, no run would make a table, or a run would fail because of them.
    """
    added: dict[str, Keys] = {}
    declared = {keys["file"] for keys in guess.outputs.values()}
    for unread in tried.unread:
        if unread.keys and unread.path not in declared:
            path, name = str(unread.keys["file"]), unread.name
            if pattern := open_names.with_date(path) or open_names.with_values(path, tried.seed, tried.values.values()):
                path, name = pattern, open_names.name_of(pattern)
            added[name] = {**unread.keys, "file": path}
    tables = [table for table in tried.files if table.table and table.table not in guess.outputs]
    of_robots = open_names.of_robots({table.path: tuple(table.columns) for table in tables})
    for table in tables:
        of_robot = of_robots.get(table.path)
        name = open_names.name_of(of_robot) if of_robot else str(table.table)
        if (of_robot or table.keys) and name not in added:
            added[name] = {"file": of_robot or table.path, **table.keys}
    return replace(guess, outputs={**guess.outputs, **added}) if added else None


def with_lacking(root: Path, guess: Guess, tried: Trial) -> Guess | None:
    """Return the guess with the files that a failed run lacked beside its input; None if it names none of the project."""
    log = "\n".join(_end(tried.folder / name) for name in LOGS) if tried.folder else ""
    known = (*guess.files, *guess.template_paths)
    lacking = named_files.lacking(root.resolve(), log, known, tuple(folder.INTERPRETERS))
    return replace(guess, files=(*guess.files, *lacking)) if lacking else None


def with_findings(guess: Guess, first: Trial, second: Trial | None = None) -> Guess:
    """Return the guess with the declarations that tables need although they are read: patterns, times, rates.

    `second` is a run with another seed. One run alone shows dates in names only.
    """
    outputs = dict(guess.outputs)
    output_of: dict[str, str] = {}  # the name of the output by the pattern of its files; without a pattern, by its table
    open_files = _patterns(first, second)
    for file in first.files:
        if file.table is None or file.table in output_of.values():
            continue
        is_open = "*" in str(outputs.get(file.table, {}).get("file", ""))
        pattern = None if is_open else open_files.get(file.path)
        name = file.table
        if pattern and not pattern.endswith(ROTATION) and pattern not in output_of:  # one new output for all of its files
            name = next(free for free in numbered(open_names.name_of(pattern)) if free not in outputs)
        name = output_of.setdefault(pattern or name, name)
        declared = outputs.get(name, {})
        has_events = "rows" in declared and not file.time  # its rows are a list in JSON without a time
        keys = {**_keys_of(file, second, open_files, has_events=has_events), **declared}
        if pattern or keys:
            outputs[name] = {"file": pattern or file.path, **keys}
    return replace(guess, outputs=outputs)


def _keys_of(file: TriedFile, second: Trial | None, patterns: Mapping[str, str], *, has_events: bool) -> dict[str, Key]:
    """Return the keys of a table that rows show: the time if no rule finds it, and rates, and another number of rows.

    `has_events`: each element of a list is an event, so that their number differs between runs.
    """
    from sierra.store.time_axis import names_time

    keys: dict[str, Key] = {}
    if file.time and not (names_time(file.time) and file.time == next(iter(file.columns))):
        keys |= {TIME: file.time}
    other = _other(file, second, patterns)
    if other is not None:
        rates = [name for name, value in other.flags.items() if file.flags.get(name) == 1 - value]
        keys |= {RATES: rates} if rates else {}
        has_events |= (file.rows, list(file.columns)) != (other.rows, list(other.columns))
    return keys | ({RAGGED: "ragged"} if has_events else {})


def _other(file: TriedFile, second: Trial | None, patterns: Mapping[str, str]) -> TriedFile | None:
    """Return the table of the second run that belongs to one of the first."""
    own = patterns.get(file.path, file.path)
    others = second.files if second is not None and second.status is Status.OK else ()
    same = [other for other in others if other.table and patterns.get(other.path, other.path) == own]
    return next((other for other in same if other.table == file.table or file.path in patterns), None)


def _patterns(first: Trial, second: Trial | None) -> dict[str, str]:
    """Return the patterns for tables of rotated files, and of files with another name in each run, by path."""
    runs = [[file.path for file in trial.files if file.table] for trial in (first, second) if trial is not None]
    found = {path: with_rotation(path, (file.path for file in first.files)) for path in runs[0]}
    found |= {path: open_names.with_date(path) or found[path] for path in runs[0] if second is None}
    found |= open_names.patterns(runs)
    return {path: pattern for path, pattern in found.items() if pattern != path}


def _end(log: Path) -> str:
    """Return the last words that a program printed."""
    try:
        with log.open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - LAST))
            return file.read().decode("utf-8", "replace")
    except OSError:
        return ""


def guess_arguments(root: Path, options: Options, ask: Ask | None) -> Guess:
    """Return the guess for a program that reads only its arguments."""
    line = command.choose(root, None, options.command, ask) or ""
    words = shlex.split(line)
    own = arguments.find(words)
    if not own and not arguments.placeholders(words) and (reads := environment.read_by(root, words)):
        return of_environment.guess(root, options, ask, line, reads)
    numbers = arguments.numbers(own)
    by_key = {each.key: each for each in own}
    seeds = [by_key[key].name for key in variables.seeds(numbers)]
    if any("{seed}" in word for word in words) and options.seed is None:
        seed = None
    else:
        seed = variables.choose_seed(seeds, options.seed, ask, partial(arguments.check_seed, own), "argument")
    free = {key: value for key, value in numbers.items() if by_key[key].name not in seeds}
    named = {name: by_key[key].name for name, key in variables.named(free, ()).items()}
    used = arguments.placeholders(words)
    likely = {} if used else dict(list(named.items())[:1])
    check = partial(arguments.check_variable, own, seed)
    chosen = variables.choose(named, likely, options.variables, ask, check, "NAME=ARGUMENT")
    by_name = {each.name: each for each in own}
    removed = {name: by_name[argument] for name, argument in chosen.items()}
    started = command.joined(arguments.placed(words, seed, removed.values()))
    values = {name: each.value for name, each in removed.items()}
    places = {name: f"{{{name}}}" for name in used} | {name: each.declared for name, each in removed.items()}
    first = next((variables.around(name, value) for name, value in values.items()), None)
    platform_name, platform = command.platform({}, started)
    wrong = (*command.warnings(platform, root, {}), *command.services(started))
    return Guess(
        template=None,
        format=None,
        platform=platform_name,
        command=started,
        module_path=command.module_path(started, root),
        seed=None,
        variables=places,
        other_variables={
            name: by_name[argument].declared
            for name, argument in named.items()
            if argument not in chosen.values() and (seed is None or argument != seed.name)
        },
        tried=arguments.criteria({**dict.fromkeys(used, environment.SOME), **values}),
        source=source.choose(root, (), options.source, ask),
        next=" ".join(f"{name}=1,2" for name in used) or first,
        unset=tuple(f"{{{name}}}" for name in used),
        given=options.command is not None or ask is not None,
        doubtful=bool(wrong),
        notes=(*wrong, *arguments.warnings(started, seeds, seed), *folder.warnings(root)),
    )


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
        guess = guess_arguments(root, options, ask)
        unused = folder.templates(root)
        why = f"the command has no {{input}}, so that runs do not depend on {few(unused, SHOWN)}"
        return replace(guess, notes=(*guess.notes, why)) if unused else guess
    template = folder.template(root, options.template, options.format, ask, named_files.main)
    return of_template.guess(root, *template, options, ask) if template else guess_arguments(root, options, ask)


def try_run(root: Path, guess: Guess, show: Show, *, seed: int | None = None) -> Trial | str | None:
    """Execute one run with the guessed settings before they are written, with this seed; nothing is recorded.

    Returns the trial; or why no run can be tried; or None if the command is doubtful. Raises KeyboardInterrupt, and the errors
    of `parsed`: such settings cannot be written either.
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
        criteria = list(guess.tried) or [trial.UNCHANGED]
        plan = resolve_plan.plan(project, query_request.request(criteria, runs=1))
        run, files = trial.choose(plan, experiment=0, seed=seed)
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

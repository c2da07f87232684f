"""`sierra init`: make a new project, or copy a bundled example."""

from __future__ import annotations

import json
import os
import shlex
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple, TypeVar

import typer

from sierra.cli.output import note, print_json
from sierra.config import extensions
from sierra.config.extensions import given
from sierra.errors import UsageError
from sierra.util.text import few, one_line

if TYPE_CHECKING:
    from sierra.config.project_file import Project
    from sierra.execution.trial import Trial
    from sierra.setup.init.answers import Question
    from sierra.setup.init.write import Guess

T = TypeVar("T")
INTERRUPTED = "a further run was interrupted: sierra.toml has what the first one has shown"
LONG_S = 60.0
"""If a run takes longer than this, `sierra init` does not try another seed."""


class FromElsewhere(NamedTuple):
    """An option of an extension that makes a project from one of another program."""

    option: str
    write: Callable[[Path, str | None, bool], None]
    """Write the project to a folder, with a template or None, and print what was written, also as JSON."""


def init(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="The project's folder.")] = Path(),
    example: Annotated[
        str | None,
        typer.Option(
            "--example",
            metavar="NAME",
            help="Copy a bundled example to FOLDER: "
            + ", ".join(("swarm", "paper", "mesa", "netlogo", "ngspice", "ns3", "webots", *extensions.examples()))
            + ".",
        ),
    ] = None,
    template: Annotated[str | None, typer.Option("--template", metavar="FILE", help="The simulator's input file.")] = None,
    format: Annotated[
        str | None,
        typer.Option("--format", metavar="NAME", help="Format of that file, if its ending does not say it: text, ini."),
    ] = None,
    command: Annotated[
        str | None,
        typer.Option(
            "--command",
            metavar="TEXT",
            help="Command that starts it: 'python3 sim.py {input}', or './sim --robots 4 --seed 1'.",
        ),
    ] = None,
    variables: Annotated[
        list[str] | None,
        typer.Option(
            "--variable",
            metavar="NAME=XPATH",
            help="An independent variable, or NAME=ARGUMENT of the command. May be repeated.",
        ),
    ] = None,
    seed: Annotated[
        str | None,
        typer.Option("--seed", metavar="XPATH", help="XPath of the random seed, or an argument of the command; - for none."),
    ] = None,
    source: Annotated[
        list[str] | None,
        typer.Option("--source", metavar="PATH", help="Code that results depend on (default: all). May be repeated."),
    ] = None,
    no_try: Annotated[bool, typer.Option("--no-try", help="Do not execute a run before writing.")] = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask; use the detected values.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Do not ask; print the written settings as JSON.")] = False,
) -> None:
    """Write a sierra.toml, or copy a bundled example.

    Settings are detected from the files in the folder; on a terminal, sierra asks for the others. The simulator's input file
    may be XML, JSON, YAML, TOML, INI, or a text with placeholders such as {{speed}}. A program that reads only arguments needs
    no file: give the command with all arguments. Files that the input file names become further templates, or lie beside the
    inputs of runs. One run is tried first, as sierra try does; if its tables need declarations, another one is tried with them.
    Another run shows whether the seed has an effect. An existing sierra.toml is never overwritten.

    \b
    Examples:
      sierra init
      sierra init --example swarm demo
      sierra init -y --template arena.xml --command "./sim {input}" \\
                  --variable "population_size=//swarm/@count"
      sierra init -y --template params.yaml --command "python3 model.py {input}"
      sierra init -y --command "./sim --robots 4 --speed 0.5 --seed 1"
      sierra init -y --template merge.sumocfg
    """
    from sierra.errors import SierraError
    from sierra.setup.init import wizard

    for other in given(FromElsewhere):
        if any((example, command, variables, seed, source, format, no_try)):
            raise UsageError(f"{other.option} can be combined only with --template, --yes and --json")
        other.write(folder, template, as_json)
        return
    if example is not None:
        _say_example(folder, wizard.copy_example(example, folder), as_json=as_json)
        return
    said = wizard.Options(template, format, command, seed, tuple(variables or ()), tuple(source or ()))
    somebody = not yes and not as_json and sys.stdin.isatty() and sys.stdout.isatty()
    guess = wizard.find_out(folder, said, _ask if somebody else None)
    guess, trial = (guess, None) if no_try else _tried(folder, guess, quiet=as_json)
    _say(folder, wizard.write(folder, guess, trial), guess, trial, as_json=as_json)
    if trial is not None and (failure := _failure(guess, trial)):
        raise SierraError(failure)
    if INTERRUPTED in guess.notes:
        raise typer.Exit(130)


def _tried(folder: Path, guess: Guess, *, quiet: bool) -> tuple[Guess, Trial | None]:
    """Execute one run, unless the command is doubtful; print what it did unless `quiet`.

    If the run fails because it lacks files of the project, another run gets them. If its tables need declarations, another run
    has them. Returns the guess with what the runs have shown, and the first run that succeeded, or else the first one.
    Raises typer.Exit if the first run was interrupted; what it has shown is kept if a later one is.
    """
    from sierra.model import Status
    from sierra.setup.init import wizard

    first = _attempt(folder, guess, quiet=quiet)
    if isinstance(first, str):
        return replace(guess, notes=(*guess.notes, first)), None
    if first is None:
        return guess, None
    if first.status is Status.INTERRUPTED:
        raise typer.Exit(130)
    if first.status is Status.FAILED and (more := wizard.with_lacking(folder, guess, first)):
        lacked = few(more.files[len(guess.files) :], 4)
        again = _again(
            folder, more, f"the run lacked {lacked}; trying again with files = {json.dumps(more.files)}", quiet=quiet
        )
        if again is not None and again.status is not Status.FAILED:
            guess, first = more, again
    if first.status in (Status.OK, Status.MISMATCH) and (first.wall_s or 0) <= LONG_S:
        guess, first = _declared(folder, guess, first, quiet=quiet)
    if first.status is not Status.OK:
        return guess, first
    return _tried_again(folder, guess, first, quiet=quiet), first


def _declared(folder: Path, guess: Guess, first: Trial, *, quiet: bool) -> tuple[Guess, Trial]:
    """Return the guess with the declarations that a run's tables need, and a run that has them, if it is successful."""
    from sierra.errors import SierraError
    from sierra.model import Status
    from sierra.setup.init import wizard

    more = wizard.with_outputs(guess, first)
    if more is None:
        return guess, first
    names = few([f"[outputs.{name}]" for name in more.outputs], 4)
    try:
        again = _again(folder, more, f"tables need a declaration; trying again with {names}", quiet=quiet)
    except SierraError as error:  # a name in a file that sierra.toml cannot have
        return replace(guess, notes=(*guess.notes, f"{names} is not written: {error}")), first
    if again is not None and again.status is Status.OK:
        return more, again
    if again is not None and again.status is Status.INTERRUPTED:
        return replace(guess, notes=(*guess.notes, INTERRUPTED)), first
    why = f"{names} is not written: the run failed with it: {again.reason}" if again is not None else ""
    return (replace(guess, notes=(*guess.notes, why)) if why and first.status is Status.OK else guess), first


def _again(folder: Path, guess: Guess, why: str, *, quiet: bool) -> Trial | None:
    """Execute another run, and say why unless `quiet`; None if there is none."""
    if not quiet:
        print(why)
    again = _attempt(folder, guess, quiet=quiet)
    return None if isinstance(again, str) else again


def _tried_again(folder: Path, guess: Guess, first: Trial, *, quiet: bool) -> Guess:
    """Execute a run with another seed; return the guess with what both runs have shown: rates, and a seed without effect."""
    from sierra.execution.trial import SAME_TABLES
    from sierra.model import Status
    from sierra.setup.init import wizard

    if not guess.seeded or (first.wall_s or 0) > LONG_S or INTERRUPTED in guess.notes:
        return wizard.with_findings(guess, first)
    if not quiet:
        print("trying another seed")
    second = wizard.try_run(folder, guess, lambda log, content: None, seed=first.seed + 1)
    if second is None or isinstance(second, str):
        return wizard.with_findings(guess, first)
    if second.status is not Status.OK:
        why = INTERRUPTED if second.status is Status.INTERRUPTED else f"a run with seed {second.seed} failed: {second.reason}"
        return wizard.with_findings(replace(guess, notes=(*guess.notes, why)), first)
    same = tuple(text for text in second.notes if text.startswith(SAME_TABLES))
    return wizard.with_findings(replace(guess, notes=(*guess.notes, *same)), first, second)


def _attempt(folder: Path, guess: Guess, *, quiet: bool) -> Trial | str | None:
    """Execute one run and print what it did unless `quiet`; return the trial, or why there is none."""
    from sierra.cli.try_run import Printer, print_trial
    from sierra.setup.init import wizard

    if guess.can_be_tried and not quiet:
        print(f"trying one run: {_started(guess)} (--no-try does not)")
    printer = Printer(to_stderr=True)
    trial = wizard.try_run(folder, guess, printer.show if not quiet else lambda log, content: None)
    printer.end()
    if trial is None or isinstance(trial, str):
        return trial
    if not quiet:
        for text in trial.notes:
            note(one_line(text))
        print_trial(trial)
    return trial


def _failure(guess: Guess, trial: Trial) -> str | None:
    """Return why the run that was tried has failed; None if it was successful."""
    from sierra.model import Status
    from sierra.store.layout import RUN_STDERR

    if trial.status is Status.OK:
        return None
    kept = f"; its standard error is {os.path.relpath(trial.folder / RUN_STDERR)}" if trial.folder else ""
    values = f" with {' '.join(guess.tried)}" if guess.tried else ""
    return f"a run of {_started(guess)!r}{values} failed: {trial.reason}{kept} (correct sierra.toml, then: sierra try)"


def _started(guess: Guess) -> str:
    return one_line(guess.command or f"platform {guess.platform}")


def _ask(question: Question, check: Callable[[str], T]) -> T:
    """Return the answer to a question, given as text or as a choice's number; ask again until it passes the check."""
    from sierra.errors import SierraError

    text, before, last = question.text.rpartition("\n")
    print(text, end=before)
    for number, choice in enumerate(question.choices if question.choices != (question.default,) else (), 1):
        print(f"  {number}  {one_line(choice)}")
    while True:
        shown = f"{last} [{one_line(question.default)}]" if question.default else last
        answer = typer.prompt(shown, default="", show_default=False).strip() or question.default
        if answer is None:
            continue
        if answer not in question.choices and answer.isdecimal() and 0 < int(answer[:6]) <= len(question.choices):
            answer = question.choices[int(answer) - 1]
        try:
            return check(answer)
        except (SierraError, OSError) as error:
            print(f"  {error}")


def _say(folder: Path, path: Path, guess: Guess, trial: Trial | None, *, as_json: bool) -> None:
    command = f"{there(folder)}sierra run {guess.next} -n" if guess.next else None
    if as_json:
        tried = {"tried": trial} if trial else {}
        print_json(_answer(path, guess) | tried | {"next": command})
        return
    print(f"wrote {path}")
    seed = f"; seed {one_line(guess.seed)}" if guess.seed else ""
    inputs = f"template {one_line(few(guess.template_paths, 4))}" if guess.template_paths else "no template"
    print(f"  {inputs}; {_started(guess)}{seed}")
    if guess.files:
        print(f"  beside the inputs: {one_line(few(guess.files, 4))}")
    for name, declared in guess.variables.items():
        print(f"  {name} = {one_line(declared)}")
    for name, keys in guess.outputs.items():
        print(f"  table {one_line(name)} from {one_line(str(keys['file']))}")
    for text in guess.notes:
        note(one_line(text))
    if command:
        print(f"next: {command}    (this only shows the runs; without -n they execute)")
    else:
        example = '"XPATH"' if guess.template_paths else '{ argument = "--name {value}" }'
        print(f"next: add a variable to {path}, under [variables]: name = {example}")


def _answer(path: Path, guess: Guess) -> dict[str, object]:
    return {
        "written": str(path),
        "template": guess.template,
        **({"templates": dict(guess.templates)} if guess.templates else {}),
        **({"files": list(guess.files)} if guess.files else {}),
        "platform": guess.platform,
        "command": guess.command,
        "seed": {"environment": guess.variable_seed} if guess.variable_seed else guess.seed,
        "variables": dict(guess.variables),
        **({"environment": dict(guess.environment)} if guess.environment else {}),
        **({"outputs": {name: dict(keys) for name, keys in guess.outputs.items()}} if guess.outputs else {}),
        "source": list(guess.source),
        "notes": list(guess.notes),
    }


def _say_example(folder: Path, files: list[str], *, as_json: bool) -> None:
    from sierra.config import project_file

    project = project_file.load(folder).config
    query = next(iter(project.queries.values()))
    command = "sierra paper" if project.numbers else f"sierra run {shlex.join(query.criteria)}"
    command, absent = there(folder) + command, _absent(project)
    if as_json:
        print_json({"written": [str(folder / file) for file in files], "first": absent, "next": command})
        return
    print(f"{folder}: {', '.join(files)}")
    if absent:
        print(f"first: {absent}")
    print(f"next: {command}")


def _absent(project: Project) -> str | None:
    """Return the command that installs the packages that an example needs; None if they are installed."""
    from sierra.provenance import required_packages

    absent = required_packages.missing(project, contained=False)
    return required_packages.remedy(absent) if absent else None


def there(folder: Path) -> str:
    return "" if folder.resolve() == Path.cwd() else f"cd {shlex.quote(str(folder))} && "

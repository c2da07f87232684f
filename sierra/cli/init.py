"""`sierra init`: a project of one's own, or the bundled example."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from sierra.start import Guess


def init(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Where the project is or is to be.")] = Path(),
    example: Annotated[
        str | None, typer.Option("--example", metavar="NAME", help="Copy a bundled example there: swarm.")
    ] = None,
    template: Annotated[str | None, typer.Option("--template", metavar="FILE", help="The XML file of the simulator.")] = None,
    command: Annotated[
        str | None, typer.Option("--command", metavar="TEXT", help="How it is started: 'python3 sim.py {input}'.")
    ] = None,
    variables: Annotated[
        list[str] | None, typer.Option("--variable", metavar="NAME=XPATH", help="An independent variable. May be repeated.")
    ] = None,
    seed: Annotated[str | None, typer.Option("--seed", metavar="XPATH", help="Where the seed goes.")] = None,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Ask nothing; take what was found.")] = False,
) -> None:
    """Write a sierra.toml, or copy the bundled example.

    What the folder shows is found out; the rest is asked for.

    \b
    Examples:
      sierra init
      sierra init --example swarm demo
      sierra init -y --template arena.xml --command "./sim {input}" \\
                  --variable "population_size=//swarm/@count"
    """
    from sierra import start

    if example is not None:
        files = start.copy_example(example, folder)
        print(f"{folder}: {', '.join(files)}")
        print(f"now: cd {folder} && sierra run population_size.Log8")
        return
    guess = start.find_out(folder, template=template, command=command, variables=variables or (), seed=seed)
    if not yes and sys.stdin.isatty():
        guess = _asked(guess)
    path = start.write(folder, guess)
    print(f"wrote {path}")
    for line in start.next_steps(guess):
        print(line)


def _asked(guess: Guess) -> Guess:
    """The same, with what the user says instead."""
    from dataclasses import replace

    from sierra.start import variable

    template = typer.prompt("template (the XML file that runs read)", default=guess.template)
    command = typer.prompt("command ({input} is the generated file, {output} the working directory)", default=guess.command)
    first = next(iter(guess.variables.items()), ("", ""))
    named = typer.prompt("an independent variable, as NAME=XPATH", default="=".join(first))
    where = "where the seed goes (an XPath; empty: nowhere)"
    seed = typer.prompt(where, default=guess.seed or "", show_default=bool(guess.seed))
    variables = dict([variable(named)]) if named.strip("=") else {}
    return replace(guess, template=template, command=command, variables=variables, seed=seed or None)

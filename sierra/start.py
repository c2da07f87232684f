"""The first minute: copying the example, and a first `sierra.toml` from what a folder shows."""

from __future__ import annotations

import json
import os
import re
import shutil
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from sierra import config, inputs
from sierra.errors import Missing, UsageError
from sierra.inputs import Template
from sierra.paths import CONFIG
from sierra.store.tables import RESERVED

TEMPLATES = (".xml", ".argos", ".world", ".sdf", ".launch")
COUNTS = ("quantity", "count", "population", "number", "n", "size", "model_count")
NUMBER = re.compile(r"[+-]?\d+(\.\d+)?")


@dataclass(frozen=True, slots=True)
class Guess:
    """What a first `sierra.toml` will say."""

    template: str
    command: str
    variables: Mapping[str, str]
    seed: str | None


def copy_example(name: str, folder: Path) -> list[str]:
    """Copy a bundled example; the files' names. Raises UsageError where there is none, or the folder is not empty."""
    examples = resources.files("sierra") / "examples"
    known = sorted(entry.name for entry in examples.iterdir() if entry.is_dir() and not entry.name.startswith("_"))
    if name not in known:
        raise UsageError(f"no example {name!r}; there is {', '.join(known)}")
    if folder.exists() and any(folder.iterdir()):
        raise UsageError(f"{folder} is not empty; name a new folder")
    folder.mkdir(parents=True, exist_ok=True)
    names = []
    with resources.as_file(examples / name) as source:
        for file in sorted(source.iterdir()):
            if file.is_file():
                shutil.copyfile(file, folder / file.name)
                names.append(file.name)
    return names


def variable(text: str) -> tuple[str, str]:
    """NAME=XPATH. Raises UsageError."""
    name, equals, path = text.partition("=")
    if not equals or not name.strip().isidentifier() or not path.strip():
        raise UsageError(f'{text!r}: write a variable as NAME=XPATH, as in "population_size=//swarm/@count"')
    return name.strip(), path.strip()


def find_out(folder: Path, *, template: str | None, command: str | None, variables: Sequence[str], seed: str | None) -> Guess:
    """What is given, and for the rest what the folder shows.

    Raises UsageError where there is a `sierra.toml` already, Missing where the folder shows no template or program.
    """
    if (folder / CONFIG).exists():
        raise UsageError(f"{folder / CONFIG} is there already; change it with an editor")
    if not folder.is_dir():
        raise Missing(f"{folder} is no folder; make it, and put template and simulator there")
    template = template or _template(folder)
    read = inputs.read(folder / template)
    command = command or _command(folder, template)
    chosen = dict(map(variable, variables)) or dict(_variables(read))
    for name, path in chosen.items():
        if not read.find(path):
            raise UsageError(f"variable {name!r}: {path!r} matches nothing in {template}")
    if seed is None:
        seed = next((path for path, _ in read.attributes() if "seed" in path.lower()), None)
    elif not read.find(seed):
        raise UsageError(f"seed: {seed!r} matches nothing in {template}")
    return Guess(template, command, chosen, seed)


def write(folder: Path, guess: Guess) -> Path:
    """Write `sierra.toml`; its path."""
    text = "\n".join(_lines(guess)) + "\n"
    config.parse(tomllib.loads(text), str(folder / CONFIG))
    path = folder / CONFIG
    with path.open("x") as file:
        file.write(text)
    return path


def next_steps(guess: Guess) -> Iterator[str]:
    """What to do now."""
    if not guess.variables:
        yield f'now: name a variable in {CONFIG}, under [variables]: name = "XPATH"'
        return
    name = next(iter(guess.variables))
    yield f"now: sierra run {name}.Log8 (or {name}=1,2,3); look first with -n"
    if guess.seed is None and "{seed}" not in guess.command:
        yield 'all runs of an experiment are the same until the seed goes somewhere: seed = "XPATH", or {seed} in the command'


def _lines(guess: Guess) -> Iterator[str]:
    yield "# What SIERRA runs. All that can be said here: sierra schema --toml"
    yield f"template = {_quoted(guess.template)}  # every run's input is made from it"
    yield f"command = {_quoted(guess.command)}"
    yield "# {input} is the generated file; runs write into their working directory, {output}"
    if guess.seed:
        yield f"seed = {_quoted(guess.seed)}  # an XPath: where each run's seed goes"
    else:
        yield '# seed = "//@seed"  # an XPath: where each run\'s seed goes'
    yield "runs = 10  # per experiment"
    yield ""
    yield "[variables]  # what queries vary: a name, and an XPath of what gets the value"
    for name, path in guess.variables.items():
        yield f"{name} = {_quoted(path)}"
    if not guess.variables:
        yield '# population_size = "//swarm/@count"'
    yield ""
    yield "# [source] tells which files are the code that results depend on: all of this folder, unless"
    yield '# paths = ["src", "sim.py"]'


def _quoted(text: str) -> str:
    """A TOML string; a literal one where that reads better."""
    if "'" not in text and ('"' in text or "\\" in text) and text.isprintable():
        return f"'{text}'"
    return json.dumps(text, ensure_ascii=False)


def _template(folder: Path) -> str:
    found = sorted(file.name for file in folder.iterdir() if file.suffix in TEMPLATES and file.is_file())
    if len(found) == 1:
        return found[0]
    if "template.xml" in found:
        return "template.xml"
    what = f"several could be the template ({', '.join(found)})" if found else f"no {', '.join(TEMPLATES)} file"
    raise Missing(f"{folder}: {what}; say which with --template FILE")


def _command(folder: Path, template: str) -> str:
    if template.endswith(".argos"):
        return "argos3 -c {input}"
    files = [file for file in sorted(folder.iterdir()) if file.is_file() and file.name != template]
    scripts = [file.name for file in files if file.suffix == ".py"]
    programs = [file.name for file in files if os.access(file, os.X_OK) and file.suffix not in (".xml", ".py")]
    if len(scripts) == 1 and not programs:
        return f"python3 {scripts[0]} {{input}}"
    if len(programs) == 1:
        return f"./{programs[0]} {{input}}"
    what = "several could be the simulator: " + ", ".join(scripts + programs) if scripts or programs else "no program"
    raise Missing(f"{folder}: {what}; say how it is started with --command 'python3 sim.py {{input}}'")


def _variables(template: Template) -> Iterator[tuple[str, str]]:
    """The attribute that most looks like a population, if there is one."""
    numeric = [(path, _name(path)) for path, value in template.attributes() if NUMBER.fullmatch(value.strip())]
    for wanted in COUNTS:
        for path, name in numeric:
            if name.lower() == wanted:
                yield "population_size", path
                return
    for path, name in numeric:
        if "seed" not in path.lower() and name not in RESERVED:
            yield name, path
            return


def _name(path: str) -> str:
    """What to call the variable that a path names: the attribute, without what SQL could not name."""
    return re.sub(r"\W", "_", path.rpartition("@")[2])

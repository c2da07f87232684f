"""The text of a first `sierra.toml`: chosen values, and alternatives as comments."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from json import dumps
from pathlib import Path

from sierra.config import project_file
from sierra.errors import UsageError
from sierra.setup.init import folder
from sierra.setup.init.answers import SHOWN
from sierra.setup.init.source import found
from sierra.store.layout import CONFIG
from sierra.util.fs import write_whole
from sierra.util.text import few

SOURCE = (
    "By default, results depend on all files of this folder, including new files: a change to any file makes all runs new,\n"
    "# and makes executing runs fail. To limit this to your code, use:"
)
quoted = partial(dumps, ensure_ascii=False)
"""Format texts and lists of them as TOML does."""


@dataclass(frozen=True, slots=True)
class Guess:
    """The content of a first `sierra.toml`, and of its comments."""

    template: str
    platform: str
    command: str | None
    module_path: str | None
    seed: str | None
    variables: Mapping[str, str]
    other_variables: Mapping[str, str]
    source: tuple[str, ...]
    next: str | None
    """The suggested first query."""
    notes: tuple[str, ...]
    """Warnings about values that may be wrong."""


def write(root: Path, guess: Guess) -> Path:
    """Write `sierra.toml` and return its path; never overwrite one. Raises UsageError for names that TOML cannot hold."""
    path = root / CONFIG
    text = "\n".join(_lines(root, guess)) + "\n"
    try:
        data = text.encode()
        project_file.parse(tomllib.loads(text), str(path))
    except (UnicodeEncodeError, tomllib.TOMLDecodeError) as error:
        raise UsageError(
            f"{path} cannot be written: {error}; rename files or attributes whose names are not valid text"
        ) from error
    folder.check(root)  # a file may have appeared while the user answered
    return write_whole(path, data)


def _lines(root: Path, guess: Guess) -> Iterator[str]:
    yield "# The experiments that SIERRA runs. For all keys: sierra schema --toml"
    yield f"template = {quoted(guess.template)}  # SIERRA makes the input of each run from this file"
    if guess.platform != "command":
        yield f"platform = {quoted(guess.platform)}  # starts the simulator and sets the seed"
    if guess.command:
        yield f"command = {quoted(guess.command)}"
        yield "# {input} is the generated file; runs write into their working directory, {output}"
    if guess.seed or guess.platform == "command":
        seed = quoted(guess.seed or "//@seed")
        yield f"{'' if guess.seed else '# '}seed = {seed}  # an XPath: where the seed of each run goes"
    yield "runs = 10  # per experiment\n"
    yield "[variables]  # what queries vary: a name, and an XPath that gets the value"
    yield from (f"{name} = {quoted(path)}" for name, path in guess.variables.items())
    yield from (f"# {name} = {quoted(path)}" for name, path in guess.other_variables.items())
    if not guess.variables and not guess.other_variables:
        yield '# population_size = "//swarm/@count"'
    if guess.module_path:
        yield f"\n[environment]\nset = {{ PYTHONPATH = {quoted(guess.module_path)} }}"
    if guess.source:
        yield "\n[source]  # the code that results depend on; changes to other files make no new runs"
        yield f"paths = {quoted(guess.source)}"
    else:
        code, left_out = found(root, guess.template)
        proposed = code if 0 < len(code) <= SHOWN else ("src", "sim.py")
        without = f"  # not {few(left_out, SHOWN)}" if left_out else ""
        yield f"\n# {SOURCE}\n# [source]\n# paths = {quoted(proposed)}{without}"

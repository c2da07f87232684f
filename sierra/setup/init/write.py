"""The text of a first `sierra.toml`: chosen values, and alternatives as comments."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING

from sierra.config import project_file
from sierra.errors import UsageError
from sierra.setup.init import folder
from sierra.setup.init.answers import SHOWN
from sierra.setup.init.source import found
from sierra.store.layout import CONFIG
from sierra.util.fs import write_whole
from sierra.util.text import few, one_line

if TYPE_CHECKING:
    from sierra.execution.trial import Trial

SOURCE = (
    "By default, results depend on all files of this folder, including new files: a change to any file makes all runs new,\n"
    "# and makes executing runs fail. To limit this to your code, use:"
)
OTHER_FORMATS = (*(ending.lstrip(".") for ending in (*folder.DATA, *folder.TEXTS)), "text")
quoted = partial(dumps, ensure_ascii=False)
"""Format texts and lists of them as TOML does."""


@dataclass(frozen=True, slots=True)
class Guess:
    """The content of a first `sierra.toml`, and of its comments."""

    template: str
    format: str | None
    """The format of the template; None if its ending says it."""
    platform: str
    command: str | None
    module_path: str | None
    seed: str | None
    variables: Mapping[str, str]
    other_variables: Mapping[str, str]
    source: tuple[str, ...]
    next: str | None
    """The suggested first query."""
    unset: tuple[str, ...]
    """The paths of placeholders that have no value unless a query gives one."""
    given: bool
    """True if the user has given a command without doubts, so that a run may be tried."""
    notes: tuple[str, ...]
    """Warnings about values that may be wrong."""


def write(root: Path, guess: Guess, tried: Trial | None = None) -> Path:
    """Write `sierra.toml` and return its path; never overwrite one. `tried`: what a run did, for comments.

    Raises UsageError for names that TOML cannot hold.
    """
    path = root / CONFIG
    data, _ = _checked(root, guess, tried)
    folder.check(root)  # a file may have appeared while the user answered
    return write_whole(path, data)


def parsed(root: Path, guess: Guess) -> project_file.Project:
    """Return the settings that `write` would write. Raises UsageError."""
    return _checked(root, guess, None)[1]


def _checked(root: Path, guess: Guess, tried: Trial | None) -> tuple[bytes, project_file.Project]:
    path = root / CONFIG
    text = "\n".join((*_lines(root, guess), *_outputs(tried))) + "\n"
    try:
        return text.encode(), project_file.parse(tomllib.loads(text), str(path))
    except (UnicodeEncodeError, tomllib.TOMLDecodeError) as error:
        raise UsageError(
            f"{path} cannot be written: {error}; rename files or attributes whose names are not valid text"
        ) from error


def _outputs(tried: Trial | None) -> Iterator[str]:
    """Yield comments on the files of a run, and the declaration of its first table."""
    from sierra.store.samples import TIMES

    if tried is None or not tried.files:
        return
    yield "\n# A run wrote:"
    for one in tried.files[:SHOWN]:
        made = f"table {one.table}, {one.rows} rows of {few(list(one.columns), SHOWN)}" if one.table else "no table"
        yield f"#   {one_line(one.path)}: {one_line(made)}"
    if len(tried.files) > SHOWN:
        yield f"#   and {len(tried.files) - SHOWN} more"
    first = next((one for one in tried.files if one.table), None)
    if first is not None:
        time = next((name for name in first.columns if name.lower() in TIMES), None)
        yield "# Such tables need no declaration. To set a time axis, units or required rows:"
        yield f"# [outputs.{first.table}]"
        yield f"# file = {quoted(one_line(first.path))}"
        yield f"# time = {quoted(time)}" if time else '# units = { distance = "m" }'


def _lines(root: Path, guess: Guess) -> Iterator[str]:
    xml = (guess.format or Path(guess.template).suffix.lstrip(".")) not in OTHER_FORMATS
    yield "# The experiments that SIERRA runs. For all keys: sierra schema --toml"
    yield f"template = {quoted(guess.template)}  # SIERRA makes the input of each run from this file"
    if guess.format:
        yield f"template_format = {quoted(guess.format)}"
    if guess.platform != "command":
        yield f"platform = {quoted(guess.platform)}  # starts the simulator and sets the seed"
    if guess.command:
        yield f"command = {quoted(guess.command)}"
        yield "# {input} is the generated file; runs write into their working directory, {output}"
    if guess.seed or guess.platform == "command":
        seed = quoted(guess.seed or ("//@seed" if xml else "/seed"))
        yield f"{'' if guess.seed else '# '}seed = {seed}  # an XPath: where the seed of each run goes"
    if guess.unset:
        sets = ", ".join(f"{{ set = {quoted(place)}, value = 1 }}" for place in guess.unset)
        yield f"# changes = [{sets}]  # values if a query does not vary them"
    yield "runs = 10  # per experiment\n"
    yield "[variables]  # what queries vary: a name, and an XPath that gets the value"
    yield from (f"{name} = {quoted(path)}" for name, path in guess.variables.items())
    yield from (f"# {name} = {quoted(path)}" for name, path in guess.other_variables.items())
    if not guess.variables and not guess.other_variables:
        yield f'# population_size = "{"//swarm/@count" if xml else "/swarm/count"}"'
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

"""The text of a first `sierra.toml`: chosen values, and alternatives as comments."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import count
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING

from sierra.config import project_file
from sierra.config.change_tables import VALUE
from sierra.config.output_tables import ROTATION
from sierra.errors import UsageError
from sierra.execution.commands import PORT
from sierra.ingest import open_names
from sierra.setup.init import folder
from sierra.setup.init.answers import SHOWN
from sierra.setup.init.source import found
from sierra.store.layout import CONFIG
from sierra.util.fs import write_whole
from sierra.util.lazy_definitions import dataclass, field
from sierra.util.text import counted, few, one_line

if TYPE_CHECKING:
    from sierra.config.output_tables import Keys
    from sierra.execution.trial import Trial, TriedFile

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

    template: str | None
    """The only template; None if there are several, or none."""
    format: str | None
    """The format of the template; None if its ending says it."""
    platform: str
    command: str | None
    module_path: str | None
    seed: str | None
    variables: Mapping[str, str]
    """The variables by name: a path in a template, words of the command with `{value}`, or `{name}` if the command has it."""
    other_variables: Mapping[str, str]
    """Suggestions for further variables."""
    tried: tuple[str, ...]
    """The criteria of the run that is tried."""
    source: tuple[str, ...]
    next: str | None
    """The suggested first query."""
    unset: tuple[str, ...]
    """The placeholders that have no value unless a query gives one."""
    given: bool
    """True if the user has given the command, or has confirmed it."""
    doubtful: bool
    """True if the command is probably wrong, or its program does not exist, so that no run is tried."""
    notes: tuple[str, ...]
    """Warnings about values that may be wrong."""
    ports: Mapping[str, str] = field(default_factory=dict)
    """The paths of ports in the template, with the names of placeholders for them."""
    templates: Mapping[str, str] = field(default_factory=dict)
    """Several templates by name, with their paths."""
    files: tuple[str, ...] = ()
    """Files that lie beside the inputs of runs."""
    outputs: Mapping[str, Keys] = field(default_factory=dict)
    """The keys of tables that are not read without a declaration."""
    rates: Mapping[str, Sequence[str]] = field(default_factory=dict)
    """The columns of 0 and 1 by table, as two runs with different seeds have shown."""

    patterns: Mapping[str, str] = field(default_factory=dict)
    """The patterns for tables of rotated files, and of files with another name in each run, by the path of a file."""

    @property
    def seeded(self) -> bool:
        """Return True if runs get seeds: by a path, by their command, or by the platform."""
        return bool(self.seed) or self.platform != "command" or "{seed}" in (self.command or "")

    @property
    def can_be_tried(self) -> bool:
        """Return True if a run can be tried: its command is not doubtful, and all values are known."""
        return not self.doubtful and not self.unset

    @property
    def template_paths(self) -> tuple[str, ...]:
        return (self.template,) if self.template else tuple(self.templates.values())


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
    text = "\n".join((*_lines(root, guess), *_declared_outputs(guess), *_outputs(tried, guess))) + "\n"
    try:
        return text.encode(), project_file.parse(tomllib.loads(text), str(path))
    except (UnicodeEncodeError, tomllib.TOMLDecodeError) as error:
        raise UsageError(
            f"{path} cannot be written: {error}; rename files or attributes whose names are not valid text"
        ) from error


def _declared_outputs(guess: Guess) -> Iterator[str]:
    for name, keys in guess.outputs.items():
        yield f"\n[outputs.{name}]  # its names are not in its first line"
        yield from (f"{key} = {quoted(value)}" for key, value in keys.items())
        if columns := guess.rates.get(name):
            yield _rates(columns)


def _outputs(tried: Trial | None, guess: Guess) -> Iterator[str]:
    """Yield comments on the files of a run and the declaration of its first table, and declarations that tables need."""
    if tried is None or not tried.files:
        return
    yield "\n# A run wrote:"
    for one in tried.files[:SHOWN]:
        made = (
            f"table {one.table}, {counted(one.rows or 0, 'row')} of {few(list(one.columns), SHOWN)}"
            if one.table
            else "no table"
        )
        yield f"#   {one_line(one.path)}: {one_line(made)}"
    if len(tried.files) > SHOWN:
        yield f"#   and {len(tried.files) - SHOWN} more"
    for unread in tried.unread:
        if unread.keys:
            yield "# These files become a table only if they are declared:"
            yield f"# [outputs.{unread.name}]"
            yield from (f"# {key} = {quoted(value)}" for key, value in unread.keys.items())
    given = {*guess.patterns, *(str(keys["file"]) for keys in guess.outputs.values())}
    first = next((one for one in tried.files if one.table and one.path not in given), None)
    if first is not None:
        time = _time(first)
        yield "# Such tables need no declaration. To set a time axis, units or required rows:"
        yield f"# [outputs.{first.table}]"
        yield f"# file = {quoted(one_line(first.path))}"
        yield f"# time = {quoted(time)}" if time else '# units = { distance = "m" }'
    yield from _declarations(tried, guess)


def _declarations(tried: Trial, guess: Guess) -> Iterator[str]:
    """Yield the declarations of tables of rotated files, of files with another name in each run, and of tables with rates."""
    names: dict[str, str] = {}
    for one in tried.files:
        pattern, columns = guess.patterns.get(one.path), guess.rates.get(one.table or "", ())
        if one.table in (None, *guess.outputs) or not (pattern or columns) or pattern in names:
            continue
        name, why = one.table, ""
        if pattern and pattern.endswith(ROTATION):
            why = "  # all parts of the file, the oldest rows first"
        elif pattern:
            why = "  # each run gives its file another name"
            wanted = open_names.name_of(pattern)
            name = names[pattern] = next(
                free
                for n in count(1)
                if (free := f"{wanted}_{n}" if n > 1 else wanted) not in {*names.values(), *guess.outputs}
            )
        yield f"\n[outputs.{name}]{why}"
        yield f"file = {quoted(pattern or one_line(one.path))}"
        if columns:
            yield _rates(columns)


def _rates(columns: Sequence[str]) -> str:
    return f"rates = {quoted(list(columns))}  # columns of 0 and 1 whose mean is a rate; remove those that are counts"


def _time(table: TriedFile) -> str | None:
    """Return the time axis of a table by the rule of figures: the first column, if it has numbers and the name of a time."""
    from sierra.store.samples import names_time

    name, kind = next(iter(table.columns.items()), ("", ""))
    return name if names_time(name) and kind != "text" else None


def _lines(root: Path, guess: Guess) -> Iterator[str]:
    yield "# The experiments that SIERRA runs. For all keys: sierra schema sierra.toml"
    yield from _inputs(guess)
    if guess.command:
        yield f"command = {quoted(guess.command)}"
        yield f"# {_about_command(guess)}"
    yield from _seed(guess)
    yield "runs = 10  # per experiment\n"
    yield from _variables(guess)
    if guess.module_path:
        yield f"\n[environment]\nset = {{ PYTHONPATH = {quoted(guess.module_path)} }}"
    for name in dict.fromkeys(PORT.findall(guess.command or "")):
        yield f"\n# [services.{name}]  # a program that runs beside each run; declare it before the first run"
        yield f"# command = {quoted('./server --port {port}')}"
        yield f"# ready = {{ port = {quoted('{port}')} }}"
    if guess.source:
        yield "\n[source]  # the code that results depend on; changes to other files make no new runs"
        yield f"paths = {quoted(guess.source)}"
    else:
        code, left_out = found(root, guess.template_paths)
        proposed = code if 0 < len(code) <= SHOWN else ("src", "sim.py")
        without = f"  # not {few(left_out, SHOWN)}" if left_out else ""
        yield f"\n# {SOURCE}\n# [source]\n# paths = {quoted(proposed)}{without}"


def _inputs(guess: Guess) -> Iterator[str]:
    if guess.template:
        yield f"template = {quoted(guess.template)}  # SIERRA makes the input of each run from this file"
    if guess.templates:
        several = ", ".join(f"{name} = {quoted(path)}" for name, path in guess.templates.items())
        yield f"templates = {{ {several} }}  # SIERRA makes the inputs of each run from these files"
    if guess.files:
        yield f"files = {quoted(guess.files)}  # these lie beside the inputs of each run"
    if guess.format:
        yield f"template_format = {quoted(guess.format)}"
    if guess.platform != "command":
        yield f"platform = {quoted(guess.platform)}  # starts the simulator and sets the seed"


def _about_command(guess: Guess) -> str:
    port = "{port} is a free port of each run; " if "{port}" in (guess.command or "") else ""
    where = f"{port}runs write into their working directory, {{output}}"
    if guess.templates:
        names = " and ".join(f"{{input.{name}}}" for name in guess.templates)
        return f"{names} are the generated files; {where}"
    if guess.template:
        return f"{{input}} is the generated file; {where}"
    return f"the arguments of variables are added; {where}"


def _seed(guess: Guess) -> Iterator[str]:
    if guess.seed:
        yield f"seed = {quoted(guess.seed)}  # an XPath: where the seed of each run goes"
    elif guess.platform == "command" and "{seed}" not in (guess.command or ""):
        yield f"# seed = {_example(guess, '//@seed', '/seed', '--seed {value}')}  # where the seed of each run goes"
    if guess.unset and guess.template:
        sets = ", ".join(f"{{ set = {quoted(place)}, value = 1 }}" for place in guess.unset)
        yield f"# changes = [{sets}]  # values if a query does not vary them"
    if guess.ports:
        sets = ", ".join(f"{{ set = {quoted(path)}, value = {quoted(f'{{{name}}}')} }}" for path, name in guess.ports.items())
        yield f"# changes = [{sets}]  # free ports, if each run starts a server"


def _example(guess: Guess, xml: str, other: str, argument: str) -> str:
    """Return the example that fits the inputs: a path in XML, or in another format, or words of the command."""
    if not guess.template_paths:
        return f"{{ argument = {quoted(argument)} }}"
    ending = guess.format or Path(guess.template_paths[0]).suffix.lstrip(".")
    return quoted(other if ending in OTHER_FORMATS else xml)


def _variables(guess: Guess) -> Iterator[str]:
    what = (
        "an XPath that gets the value"
        if guess.template_paths
        else "the words of the command; only queries that vary it add them"
    )
    yield f"[variables]  # what queries vary: a name, and {what}"
    yield from (f"{name} = {_declared(name, place)}" for name, place in guess.variables.items())
    for name, place in guess.other_variables.items():
        instead = "  # then remove these words from the command" if VALUE in place else ""
        yield f"# {name} = {_declared(name, place)}{instead}"
    if not guess.variables and not guess.other_variables:
        yield f"# population_size = {_example(guess, '//swarm/@count', '/swarm/count', '--robots {value}')}"


def _declared(name: str, place: str) -> str:
    """Return a variable as TOML: a path, words of the command, or nothing if the command has the variable."""
    if place == f"{{{name}}}":
        return "{}"
    return f"{{ argument = {quoted(place)} }}" if VALUE in place else quoted(place)

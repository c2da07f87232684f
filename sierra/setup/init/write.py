"""The text of a first `sierra.toml`: chosen values, and alternatives as comments."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from sierra.config import project_file
from sierra.config.change_tables import VALUE
from sierra.config.output_tables import ROTATION
from sierra.errors import UsageError
from sierra.execution.commands import PORT
from sierra.setup.init import folder
from sierra.setup.init.answers import SHOWN
from sierra.setup.init.source import propose
from sierra.store.layout import CONFIG, RUN_STDOUT
from sierra.util.fs import write_whole
from sierra.util.lazy_definitions import dataclass, field
from sierra.util.text import counted, few, one_line, toml_key, toml_value

if TYPE_CHECKING:
    from sierra.config.output_tables import Keys
    from sierra.execution.trial import Trial

SOURCE = (
    "By default, results depend on all files of this folder, including new files: a change to any file makes all runs new,\n"
    "# and makes executing runs fail. To limit this to your code, use:"
)
ENVIRONMENT = "environment:"
REPEAT = "repeat:"
"""The beginnings of the place of a variable that is one of the environment, or the number of copies of an item."""
ABOUT_KEYS = {
    "rates": "  # columns of 0 and 1 whose mean is a rate; remove those that are counts",
    "mismatch": "  # the number of rows or the columns differ between runs",
    "skip": "  # lines above the names of columns",
}
"""Comments on keys of outputs."""
OTHER_FORMATS = (*(ending.lstrip(".") for ending in (*folder.DATA, *folder.TEXTS)), "text")


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
    """The keys of tables that need a declaration, as tried runs have shown."""
    environment: Mapping[str, str] = field(default_factory=dict)
    """Variables of the environment, with placeholders for the inputs."""
    variable_seed: str = ""
    """The variable of the environment that gets the seed of each run; empty if there is none."""

    @property
    def seeded(self) -> bool:
        """Return True if runs get seeds: by a path, by their command, or by the platform."""
        own = bool(self.seed or self.variable_seed)
        return own or self.platform != "command" or "{seed}" in (self.command or "")

    @property
    def can_be_tried(self) -> bool:
        """Return True if a run can be tried: its command is not doubtful, and all variables have values."""
        return not self.doubtful and (not self.unset or bool(self.tried))

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
    text = "\n".join((*_lines(root, guess, tried), *_outputs(tried, guess), *_declared_outputs(guess))) + "\n"
    try:
        return text.encode(), project_file.parse(tomllib.loads(text), str(path))
    except (UnicodeEncodeError, tomllib.TOMLDecodeError) as error:
        raise UsageError(
            f"{path} cannot be written: {error}; rename files or attributes whose names are not valid text"
        ) from error


def _declared_outputs(guess: Guess) -> Iterator[str]:
    for name, keys in guess.outputs.items():
        about = _about_file(str(keys["file"]))
        yield f"\n[outputs.{toml_key(name)}]{about and f'  # {about}'}"
        for key, value in keys.items():
            yield f"{key} = {_toml(value)}{ABOUT_KEYS.get(key, '')}"
        if keys.get("header") is False and "columns" not in keys:
            yield '# columns = ["time", "x"]  # the file has no names; write one for each column'


def _about_file(file: str) -> str:
    """Return a few words about the files of a table; "" for a single file."""
    if file == RUN_STDOUT:
        return "the lines that the program prints"
    if file.endswith(ROTATION):
        return "all parts of the file, the oldest rows first"
    if "{robot}" in file:
        return "a file of each robot; statistics take the mean of a run's robots"
    return "each run gives its file another name" if "*" in file else ""


def _toml(value: object) -> str:
    """Return a value as TOML; a regular expression is not escaped."""
    literal = isinstance(value, str) and "\\" in value and "'" not in value and value.isprintable()
    return f"'{value}'" if literal else toml_value(value)


def _outputs(tried: Trial | None, guess: Guess) -> Iterator[str]:
    """Yield comments on the files of a run and the declaration of its first table, and declarations that tables need."""
    if tried is None or not tried.files:
        return
    yield "\n# A run wrote:"
    for wrote in tried.files[:SHOWN]:
        shown = (
            f"table {wrote.table}, {counted(wrote.rows or 0, 'row')} of {few(list(wrote.columns), SHOWN)}"
            if wrote.table
            else "no table"
        )
        yield f"#   {one_line(wrote.path)}: {one_line(shown)}"
    if len(tried.files) > SHOWN:
        yield f"#   and {len(tried.files) - SHOWN} more"
    for unread in tried.unread:
        if unread.keys and unread.name not in guess.outputs:
            yield "# These files become a table only if they are declared:"
            yield f"# [outputs.{toml_key(unread.name)}]"
            yield from (f"# {key} = {_toml(value)}" for key, value in unread.keys.items())
    first = next((file for file in tried.files if file.table and file.table not in guess.outputs), None)
    if first is not None and not guess.outputs:
        yield "# Such tables need no declaration. To set a time axis, units or required rows:"
        yield f"# [outputs.{toml_key(str(first.table))}]"
        yield f"# file = {toml_value(one_line(first.path))}"
        yield f"# time = {toml_value(first.time)}" if first.time else '# units = { distance = "m" }'


def _lines(root: Path, guess: Guess, tried: Trial | None) -> Iterator[str]:
    yield "# The experiments that SIERRA runs. For all keys: sierra schema sierra.toml"
    yield from _inputs(guess)
    if guess.command:
        yield f"command = {toml_value(guess.command)}"
        yield f"# {_about_command(guess)}"
    yield from _seed(guess)
    yield "runs = 10  # per experiment\n"
    yield from _variables(guess)
    variables = {**({"PYTHONPATH": guess.module_path} if guess.module_path else {}), **guess.environment}
    if variables:
        yield f"\n[environment]\nset = {{ {', '.join(f'{name} = {toml_value(text)}' for name, text in variables.items())} }}"
    for name in dict.fromkeys(PORT.findall(guess.command or "")):
        yield f"\n# [services.{name}]  # a program that runs beside each run; declare it before the first run"
        yield f"# command = {toml_value('./server --port {port}')}"
        yield f"# ready = {{ port = {toml_value('{port}')} }}"
    if guess.source:
        yield "\n[source]  # the code that results depend on; changes to other files make no new runs"
        yield f"paths = {toml_value(guess.source)}"
    else:
        code, left_out = propose(root, guess.template_paths, tried)
        proposed = code if 0 < len(code) <= SHOWN else ("src", "sim.py")
        without = f"  # not {few(left_out, SHOWN)}" if left_out else ""
        yield f"\n# {SOURCE}\n# [source]\n# paths = {toml_value(proposed)}{without}"


def _inputs(guess: Guess) -> Iterator[str]:
    if guess.template:
        yield f"template = {toml_value(guess.template)}  # SIERRA makes the input of each run from this file"
    if guess.templates:
        several = ", ".join(f"{name} = {toml_value(path)}" for name, path in guess.templates.items())
        yield f"templates = {{ {several} }}  # SIERRA makes the inputs of each run from these files"
    if guess.files:
        yield f"files = {toml_value(guess.files)}  # these lie beside the inputs of each run"
    if guess.format:
        yield f"template_format = {toml_value(guess.format)}"
    if guess.platform != "command":
        yield f"platform = {toml_value(guess.platform)}  # starts the simulator and sets the seed"


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
    if guess.variable_seed:
        yield f"seed = {{ environment = {toml_value(guess.variable_seed)} }}  # the variable of the environment that gets it"
    elif guess.seed:
        yield f"seed = {toml_value(guess.seed)}  # an XPath: where the seed of each run goes"
    elif guess.platform == "command" and "{seed}" not in (guess.command or ""):
        yield f"# seed = {_example(guess, '//@seed', '/seed', '--seed {value}')}  # where the seed of each run goes"
    if guess.unset and guess.template:
        sets = ", ".join(f"{{ set = {toml_value(unset)}, value = 1 }}" for unset in guess.unset)
        yield f"# changes = [{sets}]  # values if a query does not vary them"
    if guess.ports:
        sets = ", ".join(
            f"{{ set = {toml_value(path)}, value = {toml_value(f'{{{name}}}')} }}" for path, name in guess.ports.items()
        )
        yield f"# changes = [{sets}]  # free ports, if each run starts a server"


def _example(guess: Guess, xml: str, other: str, argument: str) -> str:
    """Return the example that fits the inputs: a path in XML, or in another format, or words of the command."""
    if not guess.template_paths:
        return f"{{ argument = {toml_value(argument)} }}"
    ending = guess.format or Path(guess.template_paths[0]).suffix.lstrip(".")
    return toml_value(other if ending in OTHER_FORMATS else xml)


def _variables(guess: Guess) -> Iterator[str]:
    what = (
        "an XPath that gets the value"
        if guess.template_paths
        else "the words of the command; only queries that vary it add them"
    )
    yield f"[variables]  # what queries vary: a name, and {what}"
    yield from (f"{name} = {_declared(name, declared)}" for name, declared in guess.variables.items())
    for name, declared in guess.other_variables.items():
        instead = "  # then remove these words from the command" if VALUE in declared else ""
        yield f"# {name} = {_declared(name, declared)}{instead}"
    if not guess.variables and not guess.other_variables:
        yield f"# population_size = {_example(guess, '//swarm/@count', '/swarm/count', '--robots {value}')}"


def _declared(name: str, path: str) -> str:
    """Return a variable as TOML: a path, words, or a variable of the environment; nothing if the command has it."""
    if path == f"{{{name}}}":
        return "{}"
    if path.startswith(REPEAT):
        return f"{{ repeat = {toml_value(path.removeprefix(REPEAT))} }}"
    if path.startswith(ENVIRONMENT):
        return f"{{ environment = {toml_value(path.removeprefix(ENVIRONMENT))} }}"
    return f"{{ argument = {toml_value(path)} }}" if VALUE in path else toml_value(path)

"""The values of variables that the command and the environment of a run get.

They are an input file of the run, `sierra_values.json`, beside those that are made from templates:

    {"environment": {"SPEED": "0.5"}, "values": {"population_size": "8"}}

`values` has the text of each placeholder of a variable in the command (`{population_size}`), and `environment` that of each
environment variable that a value is given in. Thus these values are part of the run's identity, they are recorded, and a replay
uses those that are recorded. Only values that are used are in it. If a project has no template, each run has the file.

A value is one text: it replaces a placeholder within a word, is not split, and is not searched for placeholders.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

from sierra.config.change_tables import VALUE
from sierra.config.project_file import Project
from sierra.errors import Damaged
from sierra.model import Value
from sierra.templates.arithmetic import fill
from sierra.templates.base import Files
from sierra.util.hashing import canonical
from sierra.util.lazy_definitions import dataclass, field

FILE = "sierra_values.json"
"""The name of the input file."""


@dataclass(frozen=True, slots=True)
class Declared:
    """The words and environment variables that the variables of a query, and the seed, give to runs."""

    arguments: tuple[str, ...] | None = None
    """The words that belong into the command, with the names of the variables; None if the project declares no such words."""
    names: tuple[str, ...] = ()
    """The names of all values that the command may use."""
    others: tuple[str, ...] = ()
    """The names of variables that the query does not vary."""
    environment: Mapping[str, str] = field(default_factory=dict)
    """The names of values, by the environment variable that gets them."""


@dataclass(frozen=True, slots=True)
class Used:
    """The names of the values that are given to runs: in the command, and by environment variable."""

    names: tuple[str, ...] = ()
    environment: Mapping[str, str] = field(default_factory=dict)
    always: bool = False
    """True if each run has the file, even an empty one."""

    @property
    def named(self) -> tuple[str, ...]:
        """Return the name of the input file, if there is one."""
        return (FILE,) if self.names or self.environment or self.always else ()

    def files(self, values: Mapping[str, Value]) -> Files:
        """Return the input file with the values of a run, if there is one."""
        if not self.named:
            return ()
        content = {
            "environment": {variable: _text(values, name) for variable, name in self.environment.items()},
            "values": {name: _text(values, name) for name in self.names},
        }
        return ((FILE, canonical(content)),)


@dataclass(frozen=True, slots=True)
class Given:
    """The values that one run gets."""

    values: Mapping[str, str] = field(default_factory=dict)
    environment: Mapping[str, str] = field(default_factory=dict)


def declared(project: Project, varied: Sequence[str] | None = None) -> Declared:
    """Return what the variables with the names in `varied` give to runs; None: all variables, as if a query varied them."""
    names = tuple(dict.fromkeys((*project.variables, "controller", "scenario") if varied is None else varied))
    used = {name: variable for name, variable in project.variables.items() if name in names}
    words = [word.replace(VALUE, f"{{{name}}}") for name, variable in used.items() for word in variable.argument]
    words += [word.replace(VALUE, "{seed}") for word in project.seed.argument]
    environment = {variable.environment: name for name, variable in used.items() if variable.environment}
    if project.seed.environment:
        environment[project.seed.environment] = "seed"
    any_words = project.seed.argument or any(variable.argument for variable in project.variables.values())
    others = tuple(name for name in project.variables if name not in names)
    return Declared(tuple(words) if any_words else None, (*names, *project.per_run), others, environment)


def read(files: Files) -> Given:
    """Return the values in the input files of a run; none if there is no such file. Raises Damaged."""
    content = next((content for name, content in files if name == FILE), None)
    if content is None:
        return Given()
    try:
        table = json.loads(content)
        values, environment = (_texts(table[key]) for key in ("values", "environment"))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise Damaged(f"{FILE}: these are not the values of a run: {content[:60]!r}") from error
    return Given(values, environment)


def _texts(table: Mapping[str, str]) -> Mapping[str, str]:
    if not all(isinstance(text, str) for text in table.values()):
        raise TypeError
    return dict(table)


def _text(values: Mapping[str, Value], name: str) -> str:
    """Return a value as the changes to templates write it."""
    return fill(f"{{{name}}}", values)

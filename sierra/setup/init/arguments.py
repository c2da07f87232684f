"""The arguments of a command that a user gives: `--name VALUE`, `--name=VALUE` and `name=VALUE`.

A program without a template gets its values from them. The seed, the output and ports keep their places in the command, as
`{seed}`, `{output}` and `{port}`. An argument that becomes a variable leaves the command, because the words of variables stand
in the place of `{arguments}`.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path

from sierra.config.change_tables import OWN_PLACEHOLDERS, PORT_NAMES, VALUE, WORKER_NAMES
from sierra.design.query import grammar
from sierra.errors import QueryError, UsageError
from sierra.execution.commands import NAMED, SPLICED
from sierra.setup.init import folder, variables
from sierra.setup.init.answers import NONE
from sierra.util.lazy_definitions import dataclass, regex

JOINED = regex(r"(-{0,2}[A-Za-z_][\w.+/-]*)=(.+)", re.ASCII | re.DOTALL)
OPTION = regex(r"-{1,2}[A-Za-z][\w.-]*", re.ASCII)
NUMBER = regex(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
OUTPUTS = frozenset(["o", "out", "output", "outdir", "outfile", "outputs", "results", "logdir"])
HOSTS = frozenset(["address", "host", "hostname", "ip", "server"])
LOCAL = regex(r"localhost|127\.[0-9.]+|0\.0\.0\.0|::1?|")
OF_FOLDERS = frozenset(["dir", "directory", "folder", "logs", "outdir", "logdir", "results"])
NO_FILES = frozenset(
    ["csv", "json", "xml", "yaml", "text", "txt", "hdf5", "parquet", "stdout", "stderr", "none", "true", "false"]
)
"""Values of such arguments that name formats and the like, not files."""
OF_OUTPUTS = frozenset(["dir", "directory", "file", "folder", "path", "prefix", "to"])


@dataclass(frozen=True, slots=True)
class Argument:
    """One argument with its value: one word, or two."""

    name: str
    """The name as it is written, with its hyphens."""
    value: str
    first: int
    """The index of its first word in the command."""
    words: tuple[str, ...]
    """Its words, with `{value}` in the place of the value."""

    @property
    def declared(self) -> str:
        """Return the value of `argument` in `sierra.toml`."""
        return " ".join(self.words)

    @property
    def key(self) -> str:
        """Return the name in the form of a path, from which variables take their names."""
        return f"/{self.name.lstrip('-')}"

    @property
    def is_number(self) -> bool:
        return NUMBER.fullmatch(self.value) is not None


def find(words: Sequence[str]) -> tuple[Argument, ...]:
    """Return the arguments in the words of a command, in their order; of two with one name, the last one counts."""
    found = {one.key: one for one in _all(words)}
    return tuple(sorted(found.values(), key=lambda one: one.first))


def _all(words: Sequence[str]) -> Iterator[Argument]:
    number = _after_program(words)
    while number < len(words):
        word, following = words[number], words[number + 1] if number + 1 < len(words) else None
        joined = JOINED.fullmatch(word)
        if joined:
            yield Argument(joined[1], joined[2], number, (f"{joined[1]}={VALUE}",))
        elif following is not None and OPTION.fullmatch(word) and not OPTION.match(following):
            yield Argument(word, following, number, (word, VALUE))
            number += 1
        number += 1


def _after_program(words: Sequence[str]) -> int:
    """Return the index of the first word after the program, or after the script or module that an interpreter executes."""
    if not words or re.sub(r"[0-9.]+$", "", Path(words[0]).name) not in {"python", *folder.INTERPRETERS.values(), "{python}"}:
        return 1
    for number, word in enumerate(words[1:], 1):
        if word == "-m":
            return number + 2
        if Path(word).suffix in folder.INTERPRETERS:
            return number + 1
    return 1


def placeholders(words: Sequence[str]) -> tuple[str, ...]:
    """Return the names of variables that the words use as `{name}`."""
    found = (name for word in words for _, name in NAMED.findall(word) if name)
    return tuple(dict.fromkeys(name for name in found if name not in (*OWN_PLACEHOLDERS, *WORKER_NAMES)))


def numbers(found: Sequence[Argument]) -> dict[str, str]:
    """Return the numbers among the values, by key."""
    return {one.key: one.value for one in found if one.is_number}


def by_option(found: Sequence[Argument], text: str) -> Argument:
    """Return the argument that a user names, with or without hyphens. Raises UsageError."""
    for one in found:
        if text in (one.name, one.name.lstrip("-"), one.declared):
            return one
    known = f"it has {', '.join(one.name for one in found)}" if found else "it has no argument with a value"
    raise UsageError(f"the command has no argument {text!r} with a value; {known}")


def check_seed(found: Sequence[Argument], text: str) -> Argument | None:
    """Return the argument that gets the seed; None for none. Raises UsageError."""
    return None if text in ("", NONE) else by_option(found, text)


def check_variable(given: Sequence[Argument], seed: Argument | None, known: Mapping[str, str], text: str) -> tuple[str, str]:
    """Return the names of a variable and of its argument from NAME=ARGUMENT. Raises UsageError."""
    name, option = variables.named_place(text, "NAME=ARGUMENT", "population_size=--robots")
    if refusal := variables.refused(name, known):
        raise UsageError(f"variable {name!r}: {refusal}")
    argument = by_option(given, option)
    if argument == seed:
        raise UsageError(f"variable {name!r}: {option} {variables.IS_SEED}")
    return name, argument.name


def with_outputs(words: Sequence[str], root: Path) -> tuple[str, ...]:
    """Return the words, with `{output}` in those that name a file or a folder that the program writes."""
    new = list(words)
    for one in find(words):
        if _is_output(one, root):
            new[one.first + len(one.words) - 1] = one.words[-1].replace(VALUE, _in_output(one, root))
    return tuple(new)


def with_ports(words: Sequence[str], root: Path) -> tuple[str, ...]:
    """Return the words with `{port}`, `{port2}`, … instead of the numbers of ports, unless another host is named."""
    arguments = find(words)
    if any(variables.words_of(argument.name) & HOSTS and not _is_here(argument, root) for argument in arguments):
        return tuple(words)
    ports = [argument for argument in arguments if variables.is_port(argument.name, argument.value)]
    named = dict(zip(dict.fromkeys(argument.value for argument in ports), PORT_NAMES, strict=False))
    new = list(words)
    for argument in ports:
        if argument.value in named:
            new[argument.first + len(argument.words) - 1] = argument.words[-1].replace(VALUE, f"{{{named[argument.value]}}}")
    for number, name in named.items():
        new = [re.sub(rf"(?<=[\w\].]:){number}(?!\d)", f"{{{name}}}", word) for word in new]
    return tuple(new)


def _is_here(argument: Argument, root: Path) -> bool:
    """Return whether the value is this host, a number, or a program of the project, and so no other host."""
    return argument.is_number or bool(LOCAL.fullmatch(argument.value)) or (root / argument.value).exists()


def _is_output(argument: Argument, root: Path) -> bool:
    words = set(re.split(r"[^a-z]+", argument.name.lower())) - {""}
    named = bool(words & OUTPUTS) and words <= OUTPUTS | OF_OUTPUTS
    value = argument.value
    if not named or argument.is_number or "{" in value:
        return False
    is_path = "/" in value or "." in value or (root / value).exists()
    return is_path or (bool(re.fullmatch(r"[\w-]+", value)) and value.lower() not in NO_FILES)


def _in_output(argument: Argument, root: Path) -> str:
    value = argument.value
    words = set(re.split(r"[^a-z]+", argument.name.lower()))
    is_plain = re.fullmatch(r"[\w-]+", value) and not (words & OF_FOLDERS or value.lower() in OUTPUTS | OF_FOLDERS)
    if value.endswith("/") or (root / value).is_dir() or (not Path(value).suffix and not is_plain):
        return "{output}"
    return f"{{output}}/{Path(value).name}"


def placed(words: Sequence[str], seed: Argument | None, removed: Collection[Argument]) -> tuple[str, ...]:
    """Return the words with `{seed}` as the value of an argument, and with `{arguments}` instead of the removed arguments.

    Without a word after it, `{arguments}` is left out, because the arguments of variables follow the command anyway.
    """
    new = list(words)
    if seed is not None:
        new[seed.first + len(seed.words) - 1] = seed.words[-1].replace(VALUE, "{seed}")
    gone = {number for argument in removed for number in range(argument.first, argument.first + len(argument.words))}
    left = [SPLICED if number == min(gone, default=-1) else word for number, word in enumerate(new)]
    left = [word for number, word in enumerate(left) if word == SPLICED or number not in gone]
    return tuple(left[:-1] if left[-1] == SPLICED and SPLICED not in words else left)


def criteria(values: Mapping[str, str]) -> tuple[str, ...]:
    """Return the criteria that give variables one value each, without those whose value a query cannot contain."""
    return tuple(filter(None, (_criterion(name, value) for name, value in values.items())))


def _criterion(name: str, value: str) -> str | None:
    try:
        return grammar.text(grammar.parse(f"{name}={value}"))
    except QueryError:
        return None


def warnings(command: str, seeds: Sequence[str], seed: Argument | None) -> Iterator[str]:
    """Yield warnings about the seed of a program without a template."""
    if "{seed}" not in command:
        yield (
            "all runs of an experiment are the same until they use the seed: write {seed} in the command, or set "
            'seed = { argument = "--seed {value}" } or seed = { environment = "SEED" }'
        )
    others = [name for name in seeds if seed is None or name != seed.name]
    if seed is not None and others:
        yield f"these seeds keep their value in all runs: {', '.join(others)}"

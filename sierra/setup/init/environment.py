"""The variables of the environment that a program reads, found in its text.

Programs without arguments may take numbers from such variables, or the name of their input file.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterable, Iterator, Mapping
from itertools import takewhile
from pathlib import Path

from sierra.model import IN_PROJECT
from sierra.setup.init import variables
from sierra.util.lazy_definitions import regex
from sierra.util.regular_files import open_regular

READS = regex(
    r"(?:\b(?:environ(?:\.get)?|getenv|env::var|ENV(?:\.fetch)?|process\.env)\s*[\[({.]|\bget\(\s*ENV\s*,)\s*"
    r"[\"']?([A-Za-z_][A-Za-z0-9_]*)[\"']?(?:\s*,\s*[\"']?([^\"',)\]]*))?"
)
"""Reads of a variable in several languages, with a default if there is one: `os.environ.get("N", "4")`, `getenv("N")`."""
OF_SHELL = regex(r"\$\{?([A-Z][A-Z0-9_]+)(?::?[-=]([^}]*))?\}?")
"""Reads of a variable in a shell, with a default if there is one."""
SET_BY_SHELL = regex(
    r"(?:^|[;&]|\b(?:local|declare|readonly|for|read)\b)\s*([A-Z][A-Z0-9_]+)(?:=(?!.*\$\{?\1\b)|\s+in\b|\s*$)",
    re.MULTILINE,
)
"""Variables that a script gives values of its own."""
ASSIGNED = regex(r"([A-Za-z_][A-Za-z0-9_]*)=(.*)", re.DOTALL)
LANGUAGES = (".py", ".jl", ".R", ".lua", ".pl", ".rb", ".js", ".c", ".cc", ".cpp", ".cxx", ".java", ".rs", ".go")
SHELLS = (".sh", ".bash")
SIZE = 1 << 20
"""The largest number of bytes of a program that are looked at."""
OF_SYSTEM = regex(
    r"PATH|HOME|USER|LOGNAME|SHELL|PWD|OLDPWD|TERM|LANG|LANGUAGE|TZ|TMPDIR|TMP|TEMP|DISPLAY|HOSTNAME|EDITOR|IFS|RANDOM|SECONDS"
    r"|BASH\w*|LC_\w+|LD_\w+|XDG_\w+|PYTHON\w*|OMP_\w+|MKL_\w+|CUDA_\w+|SLURM_\w+|SIERRA_\w+|JULIA_\w+|JAVA_\w+|CONDA_\w+|SSH_\w+"
)
"""Variables of the system and of other programs."""
SOME = "1"
"""The value that is tried if no other one is known."""
FILES = frozenset(["config", "cfg", "conf", "file", "input", "params", "parameters", "scenario", "settings", "setup", "world"])
"""Words in names of variables that hold the name of an input file."""


def read_by(root: Path, words: Iterable[str]) -> dict[str, str]:
    """Return the variables that a program reads by its text, each with its default, or "".

    The program is the file of the project that the words of a command name; if it is not a text, all code of the folder is.
    """
    named = [root / word.removeprefix(IN_PROJECT) for word in words if not word.startswith("-")]
    code = [path for path in named if path.is_file() and path.suffix in (*LANGUAGES, *SHELLS)]
    if not code:
        code = [path for path in sorted(root.iterdir()) if path.is_file() and path.suffix in LANGUAGES]
    defaults: dict[str, str] = {}
    for path in code:
        for name, default in _read(path):
            if not OF_SYSTEM.fullmatch(name):
                defaults[name] = defaults.get(name) or default
    return defaults


def split_off(command: str) -> tuple[dict[str, str], str]:
    """Return the variables that are set before a command, as a shell understands them, and the command without them."""
    try:
        words = shlex.split(command)
    except ValueError:
        return {}, command
    count = len(list(takewhile(ASSIGNED.fullmatch, words)))
    assigned = {match[1]: match[2] for word in words[:count] if (match := ASSIGNED.fullmatch(word))}
    return (assigned, shlex.join(words[count:])) if count and words[count:] else ({}, command)


def _read(path: Path) -> Iterator[tuple[str, str]]:
    with open_regular(path) as file:
        text = file.read(SIZE).decode("utf-8", "replace")
    own = {match[1] for match in SET_BY_SHELL.finditer(text)} if path.suffix in SHELLS else set()
    for reads in (READS, *([OF_SHELL] if path.suffix in SHELLS else [])):
        yield from (
            (match[1], (match[2] or "").strip()) for match in reads.finditer(text) if match[1].isupper() and match[1] not in own
        )


def of_file(names: Iterable[str]) -> str | None:
    """Return the only variable that holds the name of an input file; None if there is none."""
    found = [name for name in names if variables.words_of(name.replace("_", " ")) & FILES]
    return found[0] if len(found) == 1 else None


def seeds(names: Iterable[str]) -> list[str]:
    """Return the variables that are called a seed."""
    return [path.lstrip("/") for path in variables.seeds(f"/{name}" for name in names)]


def values(names: Mapping[str, str]) -> dict[str, str]:
    """Return the variables that may hold a number, by key as `variables.named` takes it, each with its default or 1."""
    numbers = {name: default or SOME for name, default in names.items()}
    return {f"/{name.lower()}": value for name, value in numbers.items() if variables.NUMBER.fullmatch(value)}

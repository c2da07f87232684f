"""Patterns for files that have another name in each run: with the time, the number of a process, or random letters in it.

Of `log_2026-11-27_10-11-12.csv`, all numbers that differ between runs are left open, with what belongs to them: `log_*.csv`.
Files of the robots of a run, such as `robot_0.csv` and `robot_1.csv`, have one pattern too: `robot_{robot}.csv`.
"""

from __future__ import annotations

import glob
import json
import re
from collections.abc import Collection, Iterable, Mapping
from itertools import chain, takewhile
from pathlib import PurePosixPath

from sierra.ingest.match_outputs import table_name
from sierra.util.lazy_definitions import regex

NUMBERS = regex(r"([0-9]+(?:[-_.: T]?[0-9]+)*)")
"""Numbers that belong together, such as a date and a time."""
VALUES = regex(r"([0-9]+(?:\.[0-9]+)?)")
"""A value in a name."""
SURE_SEED = 1000
"""The least seed that no name has by chance."""
YEAR = regex(r"(?<![0-9])[0-9]{4,}")
DATE = regex(r"(?<![0-9])20[0-9]{2}([-_.]?)(?:0[1-9]|1[0-2])\1(?:0[1-9]|[12][0-9]|3[01])(?![0-9]{1,3}(?![0-9]))")
WORDS = ("robot", "agent", "drone", "uav", "ugv", "auv", "vehicle", "bot", "boid", "ant", "turtle", "rover")
OF_ROBOT = regex(
    rf"(?:(?:^|[^A-Za-z])(?i:{'|'.join(WORDS)})|(?<=[a-z])(?:{'|'.join(word.capitalize() for word in WORDS)}))[-_.]?$"
)
"""The end of the text before the number of a robot."""
ROBOT = "robot"
FEWEST = 4
"""The fewest letters at random that are left open, so that names such as a.csv and b.csv are two names."""

_Parts = tuple[str, ...]


def patterns(runs: Iterable[Collection[str]]) -> dict[str, str]:
    """Return the patterns for files that have another name in each run, by path. `runs`: the files of each run."""
    sides = [frozenset(names) for names in runs]
    if len(sides) < 2:
        return {}
    everywhere = frozenset.intersection(*sides)
    by_path: dict[str, str] = {}
    shapes: dict[_Parts, list[dict[str, _Parts]]] = {}
    for index, names in enumerate(sides):
        for name in names - everywhere:
            text, numbers = _split(name)
            shapes.setdefault(text, [{} for _ in sides])[index][name] = numbers
    for text, of_runs in shapes.items():
        if all(of_runs):
            by_path |= _of_numbers(text, of_runs)
    if not by_path and all(len(names - everywhere) == 1 for names in sides):
        own = [next(iter(names - everywhere)) for names in sides]
        if pattern := _of_letters(own):
            by_path = dict.fromkeys(own, pattern)
    return by_path


def with_date(path: str) -> str | None:
    """Return the pattern for a file with a date in its name, as one run alone shows it; None for any other file."""
    text, numbers = _split(path)
    dated = [bool(DATE.search(number)) for number in numbers]
    return _pattern(text, numbers, dated, path) if any(dated) else None


def with_values(path: str, seed: int, values: Iterable[object]) -> str | None:
    """Return a pattern for a file whose name has the seed of its run, and perhaps values of it; None for another one."""
    given = {float(value) for value in values if isinstance(value, int | float)} | {float(seed)}
    parts = VALUES.split(path)
    if seed < SURE_SEED or str(seed) not in parts[1::2]:
        return None
    return "".join("*" if index % 2 and float(part) in given else part for index, part in enumerate(parts))


def of_robots(columns: Mapping[str, Collection[str]]) -> dict[str, str]:
    """Return the patterns for tables of single robots, by path. `columns`: the names of the columns of each table, by path.

    The names of the files differ in one number, which follows the word for a robot; their columns are the same.
    """
    alike: dict[tuple[_Parts, int, _Parts], list[str]] = {}
    for path in columns:
        text, numbers = _split(path)
        for position in range(len(numbers)):
            if OF_ROBOT.search(text[position]) and numbers[position].isdecimal():
                others = (*numbers[:position], "", *numbers[position + 1 :])
                alike.setdefault((text, position, others), []).append(path)
    by_path: dict[str, str] = {}
    for (text, position, numbers), paths in alike.items():
        same = {tuple(columns[path]) for path in paths}
        plain = not any(character in paths[0] for character in "*?[{")
        if plain and len(paths) > 1 and len(same) == 1 and ROBOT not in {name.lower() for name in columns[paths[0]]}:
            parts = (f"{{{ROBOT}}}" if nth == position else number for nth, number in enumerate(numbers))
            by_path |= dict.fromkeys(paths, "".join(chain.from_iterable(zip(text, (*parts, text[-1]), strict=False))))
    return by_path


def name_of(pattern: str) -> str:
    """Return a name for the table of a pattern's files."""
    if f"{{{ROBOT}}}" in pattern:
        begin = PurePosixPath(pattern.replace("/", "_")).stem.partition(f"{{{ROBOT}}}")[0]
        return table_name(begin.rstrip("-_.") or ROBOT)
    stem = re.sub(r"[^0-9A-Za-z]*\*[^0-9A-Za-z]*", "_", PurePosixPath(pattern.replace("/", "_")).stem).strip("_")
    return table_name(stem or "log")


def advice(patterns: Iterable[str], name: str | None = None) -> str:
    """Return the declarations that make one table of the files of each pattern; `name` is that of the only one."""
    declarations = [
        f"[outputs.{name or name_of(pattern)}] file = {json.dumps(pattern, ensure_ascii=False)}" for pattern in patterns
    ]
    names, make = (
        ("another name", "makes one table of them") if len(declarations) == 1 else ("other names", "make tables of them")
    )
    return f"if each run gives its files {names}, {' and '.join(declarations)} {make}"


def _split(path: str) -> tuple[_Parts, _Parts]:
    """Return the parts of a path between numbers, with its suffix, and the numbers."""
    suffix = PurePosixPath(path).suffix
    parts = NUMBERS.split(path.removesuffix(suffix))
    return (*parts[::2], suffix), tuple(parts[1::2])


def _of_numbers(text: _Parts, runs: list[dict[str, _Parts]]) -> dict[str, str]:
    """Return the patterns of files with the same text between numbers, if all runs have other numbers somewhere."""
    values = [[{numbers[place] for numbers in names.values()} for names in runs] for place in range(len(text) - 2)]
    differ = [not set.intersection(*of_runs) for of_runs in values]
    if not any(differ):
        return {}
    return {name: _pattern(text, numbers, differ, name) for names in runs for name, numbers in names.items()}


def _pattern(text: _Parts, numbers: _Parts, differ: list[bool], path: str) -> str:
    """Return a path in which numbers that differ are left open: from the year on, if there is one."""
    found = glob.escape(text[0])
    for number, is_open, after in zip(numbers, differ, text[1:-1], strict=True):
        if is_open:
            year = YEAR.search(number)
            number = f"{number[: year.start()] if year else ''}*"
        found += number + glob.escape(after)
    return found + glob.escape(text[-1])


def _of_letters(names: list[str]) -> str | None:
    """Return the pattern of names that begin and end alike, with the same number of other letters between; None if they do not.

    `names` has one of each run; they are not all the same. Letters and digits at the end of their common beginning are left
    open too, because letters at random may be the same by chance.
    """
    suffixes = {PurePosixPath(name).suffix for name in names}
    common = takewhile(lambda characters: len(set(characters)) == 1, zip(*names, strict=False))
    begin = re.sub(r"[0-9A-Za-z]*$", "", "".join(characters[0] for characters in common))
    has_one_length = len(set(map(len, names))) == 1
    if len(suffixes) > 1 or not has_one_length or not begin:
        return None
    [suffix] = suffixes
    random_letters = [name.removeprefix(begin).removesuffix(suffix) for name in names]
    return f"{glob.escape(begin)}*{glob.escape(suffix)}" if min(map(len, random_letters)) >= FEWEST else None

"""The keys of `[outputs.NAME]` that read what a program prints as tables: CSV, JSON lines, or lines with named numbers.

Of `step 3: score=0.5`, the words before the numbers are the names of columns. Lines with the same words between their numbers
become rows of one table.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence

from sierra.ingest import text_headers
from sierra.ingest.delimiters import DELIMITERS
from sierra.ingest.match_outputs import table_name
from sierra.ingest.text_headers import Key
from sierra.store.layout import RUN_STDOUT
from sierra.util.lazy_definitions import regex
from sierra.util.text import numbered

NUMBER = regex(
    r"(?<![\w.])[-+]?(?:(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?(?![0-9]|[.,_][0-9]|[eEx][-+0-9])|(?i:nan|inf(?:inity)?)\b)",
    re.ASCII,
)
NAMED = regex(r"([^\W\d]\w*)(?P<sign>\s*[=:]|\s*->)?\s*[\[(]?\s*$")
"""The end of the text before a number: its name, perhaps with a sign between them."""
THOUSANDS = regex(r"[0-9],[0-9]")
CLOCK = regex(r"[0-9]{1,4}[-:/][0-9]{1,2}[-:/][0-9]{1,4}(?:[T ][0-9:.]+)?|[0-9]{1,2}:[0-9]{2}(?::[0-9.]+)?")
"""Dates and times of day, which are no results."""
PLACE = "\x00"
"""The place of a date or a time of day in a text; lines with control characters are not looked at."""
VALUE = r"[-+.\w]+"
"""Numbers, also such as nan."""
ABOUT_THE_PROGRAM = frozenset(["version", "v", "seed", "port", "pid", "threads"])
MOST_TABLES = 4
"""With lines of more forms than these, somebody has to choose."""
FEWEST = 2
"""The fewest lines of one form, unless each number has a sign before it."""
CONTROL = regex(r"[\x00-\x08\x0b-\x1f\x7f]")

Form = tuple[tuple[str, ...], tuple[str, ...]]
"""The texts between the numbers of a line, and the names of the numbers."""


def keys_of(content: bytes) -> dict[str, dict[str, Key]]:
    """Return the keys of the tables that a program prints, by the name of the table; none if somebody has to choose."""
    try:
        text = content.decode()
    except UnicodeDecodeError:
        return {}
    lines = text.splitlines()
    if not lines or CONTROL.search(text):
        return {}
    if all(_is_object(line) for line in lines if line.strip()):
        return {RUN_STDOUT: {"file": RUN_STDOUT, "format": "jsonl"}}
    keys = text_headers.keys_of(content)
    has_columns = "delimiter" in (keys or {}) or any(delimiter in lines[-1] for delimiter in DELIMITERS)
    if keys is not None and has_columns and keys.get("header", True):
        return {RUN_STDOUT: {"file": RUN_STDOUT, "format": "csv", **keys}}
    return _tables(lines)


def _is_object(line: str) -> bool:
    try:
        return isinstance(json.loads(line), dict)
    except (ValueError, RecursionError):
        return False


def _tables(lines: list[str]) -> dict[str, dict[str, Key]]:
    counts: dict[Form, int] = {}
    for line in lines:
        form = _form(line)
        if form is not None:
            counts[form] = counts.get(form, 0) + 1
    if any(map(THOUSANDS.search, lines)):
        return {}  # are these one number, or two?
    forms = [form for form, count in counts.items() if count >= FEWEST or _has_signs(form)]
    patterns = {form: _pattern(form) for form in forms}
    if len(forms) > MOST_TABLES or any(_matched(pattern, lines) != counts[form] for form, pattern in patterns.items()):
        return {}
    tables: dict[str, dict[str, Key]] = {}
    for form in forms:
        name = next(name for name in _names(form) if name not in tables)
        tables[name] = {"file": RUN_STDOUT, "lines": patterns[form]}
    return tables


def _form(line: str) -> Form | None:
    """Return the form of a line with a named number; None for other lines."""
    clocks = [clock.span() for clock in CLOCK.finditer(line)]
    texts, end = [], 0
    for number in NUMBER.finditer(line):
        if not any(begin <= number.start() < after for begin, after in clocks):
            texts.append(_plain(line[end : number.start()]))
            end = number.end()
    texts.append(_plain(line[end:]).rstrip())
    called = [NAMED.search(text) for text in texts[:-1]]
    if not any(name is not None and name[1].isascii() for name in called):
        return None
    return tuple(texts), tuple(_unique(texts, [name[1] if name and name[1].isascii() else "" for name in called]))


def _plain(text: str) -> str:
    """Return the text between two numbers, without the width of blanks, dates and times of day."""
    return CLOCK.sub(PLACE, re.sub(r"\s+", " ", text))


def _unique(texts: Sequence[str], called: Sequence[str]) -> Iterator[str]:
    """Yield different names for the numbers of a line: the words before them, and for others a number behind the last name."""
    taken: set[str] = set()
    last = "number"
    for text, name in zip(texts, called, strict=False):
        words = re.sub(r"\W+", "_", text).strip("_")
        several = called.count(name) > 1 and words.isascii() and words.isidentifier() and words != name
        last = (words if several else name) if name else last
        own = next(free for free in numbered(last) if free.lower() not in taken)
        taken.add(own.lower())
        yield own


def _has_signs(form: Form) -> bool:
    """Return whether each number of a single line is a result by its form: it has a name and a sign, as in `score=0.5`."""
    texts, names = form
    called = [NAMED.search(text) for text in texts[:-1]]
    of_program = any(name.lower() in ABOUT_THE_PROGRAM for name in names)
    return not of_program and all(name is not None and name["sign"] for name in called)


def _pattern(form: Form) -> str:
    texts, names = form
    parts = [_literal(texts[0])]
    for name, text in zip(names, texts[1:], strict=True):
        parts += [f"(?P<{name}>{VALUE})", _literal(text)]
    return f"^{''.join(parts)}\\s*$"


def _literal(text: str) -> str:
    """Return a regular expression for a text in which blanks may have another width: numbers may be aligned."""
    literal = r"\s+".join(re.sub(r"\\([-=:,;/<>%&'\"#@!~])", r"\1", re.escape(part)) for part in text.split(" "))
    return literal.replace(PLACE, r"[-0-9T:./]+")


def _matched(pattern: str, lines: list[str]) -> int:
    return sum(re.search(pattern, line) is not None for line in lines)


def _names(form: Form) -> Iterator[str]:
    """Yield names for the table of such lines: the first word, unless it is a column."""
    texts, names = form
    word = re.match(r"\W*([A-Za-z_]\w*)", texts[0])
    name = word[1].lower() if word else ""
    own = name if name and name not in {column.lower() for column in names} else "lines"
    yield from map(table_name, numbered(own))

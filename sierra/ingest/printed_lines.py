"""The keys of `[outputs.NAME]` that read what a program prints as tables: CSV, JSON lines, or lines with named numbers.

Of `step 3: score=0.5`, the words before the numbers are the names of columns. Lines with the same words between their numbers
become rows of one table.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator

from sierra.ingest import text_headers
from sierra.ingest.delimiters import DELIMITERS
from sierra.ingest.match_outputs import table_name
from sierra.ingest.text_headers import Key
from sierra.store.layout import RUN_STDOUT
from sierra.util.lazy_definitions import regex

NUMBER = regex(
    r"(?<![\w.])[-+]?(?:(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?(?![0-9]|[.,_][0-9]|[eEx][-+0-9])|(?i:nan|inf(?:inity)?)\b)",
    re.ASCII,
)
NAMED = regex(r"([A-Za-z_]\w*)(?P<sign>\s*[=:]|\s*->)?\s*[\[(]?\s*$", re.ASCII)
"""The end of the text before a number: its name, perhaps with a sign between them."""
VALUE = r"[-+.\w]+"
"""Numbers, also such as nan."""
ABOUT_THE_PROGRAM = frozenset(["version", "v", "seed", "port", "pid", "threads"])
MOST_TABLES = 4
"""With lines of more forms than these, somebody has to choose."""
FEWEST = 2
"""The fewest lines of one form, unless each number has a sign before it."""
CONTROL = regex(r"[\x00-\x08\x0b-\x1f\x7f]")

Form = tuple[tuple[str, ...], tuple[str, ...]]
"""The texts between the numbers of a line, and the names of the numbers; "" for one without a name."""


def keys_of(content: bytes) -> dict[str, dict[str, Key]]:
    """Return the keys of the tables that a program prints, by the name of the table; none if somebody has to choose."""
    try:
        lines = content.decode().splitlines()
    except UnicodeDecodeError:
        return {}
    if not lines or CONTROL.search(content.decode()):
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
        if (form := _form(line)) is not None:
            counts[form] = counts.get(form, 0) + 1
    forms = [form for form, count in counts.items() if count >= FEWEST or _has_signs(form)]
    patterns = {form: _pattern(form) for form in forms}
    if len(forms) > MOST_TABLES or any(_matched(pattern, lines) != counts[form] for form, pattern in patterns.items()):
        return {}
    found: dict[str, dict[str, Key]] = {}
    for form in forms:
        name = next(name for name in _names(form) if name not in found)
        found[name] = {"file": RUN_STDOUT, "lines": patterns[form]}
    return found


def _form(line: str) -> Form | None:
    """Return the form of a line with a named number; None for other lines."""
    texts, names, end = [], [], 0
    for number in NUMBER.finditer(line):
        text, end = line[end : number.start()], number.end()
        called = NAMED.search(text)
        name = called[1] if called else ""
        texts.append(re.sub(r"\s+", " ", text))
        names.append(next(other for other in _numbered(name) if other not in names) if name else "")
    return ((*texts, re.sub(r"\s+", " ", line[end:]).rstrip()), tuple(names)) if any(names) else None


def _numbered(name: str) -> Iterator[str]:
    yield name
    yield from (f"{name}_{number}" for number in range(2, 1000))


def _has_signs(form: Form) -> bool:
    """Return whether each number of a single line is a result by its form: it has a name and a sign, as in `score=0.5`."""
    texts, names = form
    called = [NAMED.search(text) for text in texts[:-1]]
    of_program = any(name.lower() in ABOUT_THE_PROGRAM for name in names)
    return not of_program and all(one is not None and one["sign"] for one in called)


def _pattern(form: Form) -> str:
    texts, names = form
    parts = [_literal(texts[0])]
    for name, text in zip(names, texts[1:], strict=True):
        parts += [f"(?P<{name}>{VALUE})" if name else VALUE, _literal(text)]
    return f"^{''.join(parts)}\\s*$"


def _literal(text: str) -> str:
    """Return a regular expression for a text in which blanks may have another width: numbers may be aligned."""
    return r"\s+".join(re.sub(r"\\([-=:,;/<>%&'\"#@!~])", r"\1", re.escape(part)) for part in text.split(" "))


def _matched(pattern: str, lines: list[str]) -> int:
    return sum(re.search(pattern, line) is not None for line in lines)


def _names(form: Form) -> Iterator[str]:
    """Yield names for the table of such lines: the first word, unless it is a column."""
    texts, names = form
    word = re.match(r"\W*([A-Za-z_]\w*)", texts[0])
    name = word[1].lower() if word else ""
    own = name if name and name not in {column.lower() for column in names} else "lines"
    yield from map(table_name, _numbered(own))

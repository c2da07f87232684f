"""Short texts for lists and numbers, texts on one line, natural sorting, and the structure of paths."""

from __future__ import annotations

import functools
import itertools
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence

STEERING = (
    (0x00, 0x08), (0x0B, 0x0C), (0x0E, 0x1F), (0x7F, 0x9F),  # control characters except tab and the ends of lines
    (0x2028, 0x2029), (0x202A, 0x202E), (0x2066, 0x2069),  # ends of lines that few programs know; the direction of text
    (0x2060, 0x2065), (0x206A, 0x206F), (0xFEFF, 0xFEFF), (0xFFF9, 0xFFFB), (0xE0001, 0xE0001),  # invisible, in no word
    (0xD800, 0xDFFF), (0xFFFE, 0xFFFF),  # bytes that are not UTF-8; no characters, which XML cannot hold
)  # fmt: skip
"""The first and the last of the characters of each kind that control a terminal or a page, or deceive its reader.

Characters that belong to words are not among them: joiners and marks of Arabic, Hebrew and Indic scripts and of emoji,
no-break spaces, and the invisible spaces between words in Thai and Khmer.
"""


@functools.cache
def _steering() -> re.Pattern[str]:
    """Return the pattern of `STEERING`. To compile it takes longer than to print most texts."""
    return re.compile(f"[{''.join(f'{chr(first)}-{chr(last)}' for first, last in STEERING)}]")


def visible(text: str) -> str:
    """Return a text in which escapes replace the characters of `STEERING`; tabs and ends of lines stay.

    Terminal, pages and figures show texts of others in this way: no character is lost, and letters of all scripts stay.
    """
    if text.isprintable() or all(line.isprintable() for line in text.split("\n")):
        return text
    return _steering().sub(lambda found: escape(found[0]), text)


def half_character(text: str) -> str:
    """Return the first surrogate of a text, which UTF-8 cannot hold; "" if it has none."""
    try:
        text.encode()
    except UnicodeEncodeError as error:
        return text[error.start]
    return ""


def escape(text: str) -> str:
    """Return a text with escapes for tabs, ends of lines, and all characters beyond ASCII."""
    return text.encode("unicode_escape").decode()


def few(things: Sequence[str], most: int) -> str:
    """Return at most `most` names on one line, and the number of the others: `a, b and 3 more`."""
    more = f" and {len(things) - most} more" if len(things) > most else ""
    return ", ".join(map(one_line, things[:most])) + more


def counted(count: int, noun: str) -> str:
    """Return a number with its noun: `1 element`, `2 elements`."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def often(times: int) -> str:
    """Return how often something happened: `once`, `2 times`."""
    return "once" if times <= 1 else f"{times} times"


DIGITS = 6
"""The digits of numbers that are shown to people, unless different numbers would look alike."""


def short_number(value: float, digits: int = DIGITS) -> str:
    """Return a number with at most this many significant digits; with 17, all that it takes to read the same number again."""
    return f"{value:.{digits}g}" if digits < 17 else repr(value).removesuffix(".0")


def digits_apart(values: Iterable[object], least: int = DIGITS) -> int:
    """Return the number of digits, at least `least`, with which different fractions among these values look different."""
    numbers = {value for value in values if isinstance(value, float) and value == value}
    return next(
        (digits for digits in range(least, 17) if len({short_number(one, digits) for one in numbers}) == len(numbers)), 17
    )


def verb(count: int, one: str, several: str) -> str:
    """Return the form of a verb for a number of things: `verb(1, "is", "are")` is `is`."""
    return one if count == 1 else several


def n_of(counts: Iterable[int]) -> str:
    """Return the smallest and the largest of some numbers of runs: "n = 5", "n = 3–5"."""
    low, high = min(every := list(counts)), max(every)
    return f"n = {low}–{high}" if low < high else f"n = {low}"


def one_line(text: object) -> str:
    """Return a text for a message, on one line, with escapes for all characters that are not printable.

    Messages also show blanks of other kinds and joiners, because one of them may be what is wrong.
    """
    return "".join(c if c.isprintable() else escape(c) for c in str(text))


def outside(text: str, wanted: str) -> Iterator[int]:
    """Yield the places of a character that are outside of brackets and quotes."""
    depth, quote = 0, ""
    for index, character in enumerate(text):
        if quote or character in "'\"":
            quote = "" if character == quote else quote or character
        elif character in "[(":
            depth += 1
        elif character in ")]":
            depth -= 1
        elif character == wanted and not depth:
            yield index


def toml_key(name: str) -> str:
    """Return a name as a key of TOML, in quotes only if necessary."""
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else toml_value(name)


def toml_value(value: object) -> str:
    """Return a value as TOML, on one line; texts, numbers and lists of them are the same in JSON."""
    import json

    if isinstance(value, Mapping):
        return f"{{ {', '.join(f'{toml_key(name)} = {toml_value(own)}' for name, own in value.items())} }}"
    return json.dumps(value, ensure_ascii=False)


def numbered(name: str) -> Iterator[str]:
    """Yield a name, and then the same name with numbers from 2 on: `log`, `log_2`, `log_3`, …"""
    yield name
    yield from (f"{name}_{number}" for number in itertools.count(2))


def natural(name: str) -> tuple[tuple[str | int, ...], str]:
    """Return a key that sorts names by the numbers in them: floor-9 stands before floor-12."""
    parts = re.split(r"([0-9]+)", name)
    return tuple(int(part) if place % 2 else part for place, part in enumerate(parts)), name


def spans(numbers: Iterable[int]) -> list[tuple[int, int]]:
    """Return the first and last number of each series of consecutive numbers. `numbers` must be ascending."""
    found: list[tuple[int, int]] = []
    for number in numbers:
        if found and found[-1][1] == number - 1:
            found[-1] = (found[-1][0], number)
        else:
            found.append((number, number))
    return found


def ranges(numbers: Iterable[int], between: str = ",") -> str:
    """Return ascending numbers in short form: `0-5,7`."""
    return between.join(f"{first}-{last}" if last > first else f"{first}" for first, last in spans(numbers))


def like(name: str, known: Sequence[str], others: str = "it has") -> str:
    """Return a hint: the known name that is closest to `name`, or a list of the known names after the words `others`."""
    import difflib

    close = difflib.get_close_matches(name, known, 1, cutoff=0.5)
    shown = f"{others} {', '.join(known[:10])}{', …' if len(known) > 10 else ''}"
    return f"did you mean {close[0]!r}?" if close else shown


def size(count: int) -> str:
    """Return a number of bytes in a readable unit: 1.5 MB."""
    amount, unit = float(count), "bytes"
    for larger in ("kB", "MB", "GB", "TB"):
        if amount < 1000:
            break
        amount, unit = amount / 1000, larger
    return f"{amount:.3g} {unit}" if unit != "bytes" else f"{count} bytes"

"""Short texts for lists and numbers, texts on one line, natural sorting, and the structure of paths."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence


def few(things: Sequence[str], most: int) -> str:
    """Return at most `most` names on one line, and the number of the others: `a, b and 3 more`."""
    more = f" and {len(things) - most} more" if len(things) > most else ""
    return ", ".join(map(one_line, things[:most])) + more


def counted(count: int, noun: str) -> str:
    """Return a number with its noun: `1 element`, `2 elements`."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def verb(count: int, one: str, several: str) -> str:
    """Return the form of a verb for a number of things: `verb(1, "is", "are")` is `is`."""
    return one if count == 1 else several


def n_of(counts: Iterable[int]) -> str:
    """Return the smallest and the largest of some numbers of runs: "n = 5", "n = 3–5"."""
    low, high = min(every := list(counts)), max(every)
    return f"n = {low}–{high}" if low < high else f"n = {low}"


def one_line(text: object) -> str:
    """Return a text on one line, with control characters escaped."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in str(text))


def outside(text: str, wanted: str) -> Iterator[int]:
    """Yield the places of a character that are outside of brackets and quotes."""
    depth, quote = 0, ""
    for place, character in enumerate(text):
        if quote or character in "'\"":
            quote = "" if character == quote else quote or character
        elif character in "[(":
            depth += 1
        elif character in ")]":
            depth -= 1
        elif character == wanted and not depth:
            yield place


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

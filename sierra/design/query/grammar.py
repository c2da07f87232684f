"""The grammar of criteria: `parse` reads a criterion, `text` writes its canonical text.

    criterion = name ("=" (list | span) | "." dotted)
    list      = item {"," item}                        all numbers, or all texts, each once
    item      = number | name | quoted                 0.5, low, "exponential(0.2s)": see `sierra.util.quoted_values`
    span      = number ":" number ":" count            noise=0:1:5
    dotted    = "Log" whole                            population_size.Log8
              | "Linear" whole [".C" count]            population_size.Linear100.C10; the default count is 10
              | step "." step ".C" count               max_speed.1.9.C5
              | step ".I" step ".C" count              population_constant_density.5p0.I16.C4
              | "C" count                              montecarlo.C20
              | kind text                              the name of a plug-in and its text: see `sierra.design.query.base`

In lists and spans, numbers have the usual form (`-0.5`, `1e-3`). In a step, `p` is the decimal point, because the dot separates
the steps. Steps with a `p` are a span: `x.0p5.2p5.C5` is `x=0.5:2.5:5`. The name matters in two cases. `montecarlo` takes a
count, and no other name does. The steps of `population_variable_density` are densities. Everything else is the same for all
names, whether the project or a platform defines them.

A text that is almost a number (`0p2` in a list, `1_000`, `007`, `nan`) is neither a number nor a name. It is an error, like
every text that could be mistaken for another range.

In quotes, it is a text. A number in quotes is the same value as without them, if its canonical form is the same text: `"1"` is
1, but `"1.10"` and `"1e3"` are texts, because their digits would get lost. If a list has a text and any quotes, all its values
are texts: `1,"a b"` are the texts 1 and a b.
"""

from __future__ import annotations

import difflib
import math
import re
import unicodedata
from collections.abc import Iterable
from dataclasses import replace
from fractions import Fraction
from typing import assert_never

from sierra.config.plugin_registry import CRITERIA, Tables
from sierra.design.query import ranges
from sierra.design.query.base import Range
from sierra.design.query.numbers import COUNT, DIGITS, NUMBER, almost, decimal, fraction, shown, step, whole
from sierra.errors import QueryError, SierraError, UsageError
from sierra.model import (
    Computed,
    ConstantDensity,
    Criterion,
    Linear,
    Listed,
    Log,
    MonteCarlo,
    Scale,
    Span,
    Steps,
    Value,
    VariableDensity,
)
from sierra.store.schema import RESERVED
from sierra.util.lazy_definitions import regex
from sierra.util.quoted_values import QUOTE, pieces, quoted, split_off, unquoted
from sierra.util.text import outside

"""`RESERVED` has the names of the store's own columns, which axes must not use; SQL ignores case."""
MONTE_CARLO = "montecarlo"
EXAMPLE = '="random walk",low'
_FILLERS = "\u115f\u1160\u3164\uffa0"
"""Letters that cannot be seen."""
LONGEST = 200
"""The largest length of a criterion that a message proposes."""
VARIABLE_DENSITY = "population_variable_density"

_NAME = regex(r"[A-Za-z_][A-Za-z0-9_]*")
_ITEM = regex(r"(?=[.-]*[A-Za-z0-9_])[A-Za-z0-9_.-]+")
_DOTS = regex(r"([+-]?[0-9]+(?:\.[0-9]+)?)\.{2,3}([+-]?[0-9]+(?:\.[0-9]+)?)")
"""A range as other languages write it; as a name, it would be one value."""
_WHOLE = regex(r"[+-]?[0-9]+")
_ALMOST_NUMBER = regex(
    r"[+-]?(?:[0-9][0-9_]*(?:[.p][0-9_]*)?(?:e[+-]?[0-9]*)?|\.[0-9_]+(?:e[+-]?[0-9]*)?|nan|inf|infinity)", re.I
)

_STEP = r"([+-]?[0-9]+(?:p[0-9]+)?)"
_STEPS = regex(rf"{_STEP}\.{_STEP}\.{COUNT}")
_GROWTH = regex(rf"{_STEP}\.I{_STEP}\.{COUNT}")
_ONLY_COUNT = regex(COUNT)


_RANGE_NAME = regex(r"[A-Za-z_]+")
NO_OPTIONS: Tables = {}


def parse(text: str, tables: Tables = NO_OPTIONS) -> Criterion:
    """Return the criterion that a text describes. `tables` are `[criteria]`, with the options of plug-ins.

    Raises QueryError with a one-line message that includes a correction.
    """
    try:
        return _criterion(text, tables)
    except QueryError as error:
        raise QueryError(f"{shown(text)}: {error}") from None


def parse_all(texts: Iterable[str], tables: Tables = NO_OPTIONS) -> tuple[Criterion, ...]:
    """Return the criteria of one query, in their order.

    Raises QueryError for an invalid criterion, for no criteria, for an axis that occurs twice or has the name of a column of
    the store, and for more than a million experiments.
    """
    criteria = tuple(parse(text, tables) for text in texts)
    if not criteria:
        raise QueryError("a query needs at least one criterion; use population_size.Log8")
    first: dict[str, Criterion] = {}
    for criterion in criteria:
        _check_axis(criterion, first.setdefault(criterion.name.lower(), criterion))
    if math.prod(ranges.count(criterion.scale) for criterion in criteria) > ranges.MOST:
        together = " ".join(text(criterion) for criterion in criteria)
        raise QueryError(f"{shown(together)} expand to more than {ranges.MOST} experiments; use fewer values")
    return criteria


def text(criterion: Criterion) -> str:
    """Return the canonical text; `parse` returns the criterion again. Raises QueryError if no text describes it.

    The text of a computed scale is as it was written, because only its plug-in could compute it again.
    """
    ranges.check(criterion.scale)
    written = criterion.name + _written(criterion.scale)
    if not isinstance(criterion.scale, Computed) and parse(written) != criterion:
        raise QueryError(f"{shown(written)} does not mean the same as {shown(criterion)}")
    return written


def _check_axis(criterion: Criterion, first: Criterion) -> None:
    name = criterion.name
    if name.lower() in RESERVED:
        raise QueryError(
            f"{shown(text(criterion))}: {name!r} is a column of the store; use another name, for example my_{name}"
        )
    if first is not criterion:
        raise QueryError(f"{shown(text(criterion))}: {name!r} is already an axis, by {shown(text(first))}; use one of them")


def _criterion(text: str, tables: Tables) -> Criterion:
    if not text:
        raise QueryError("a criterion must not be empty; use population_size.Log8")
    without_quoted, _ = split_off(text)
    if not without_quoted.isprintable() or " " in without_quoted:
        raise QueryError(_with_blanks(text))
    name, separator, rest = (*re.split(r"([.=])", text, maxsplit=1), "", "")[:3]
    if not _NAME.fullmatch(name):
        raise QueryError(f"{shown(name)} is not a name of letters, digits and _; {_right_name(name)}")
    if not rest:
        raise QueryError(f"{name} has no range; {_forms(name)}")
    if (name == MONTE_CARLO) != bool(separator == "." and _ONLY_COUNT.fullmatch(rest)):
        raise QueryError(_monte_carlo_mistaken(name, rest))
    scale = _dotted(name, rest, tables) if separator == "." else _spelled(name, rest)
    ranges.check(scale)
    return Criterion(name, scale)


def _dotted(name: str, rest: str, tables: Tables) -> Scale:
    if found := _ONLY_COUNT.fullmatch(rest):
        return MonteCarlo(whole(found[1]))
    if found := _GROWTH.fullmatch(rest):
        return ConstantDensity(step(found[1]), step(found[2]), whole(found[3]))
    if found := _STEPS.fullmatch(rest):
        return _steps(name, found[1], found[2], whole(found[3]))
    if (word := _RANGE_NAME.match(rest)) and (word[0] in CRITERIA.shipped or word[0] in CRITERIA.names()):
        return _named(word[0], rest, tables)
    raise QueryError(_dotted_mistaken(name, rest))


def _named(kind: str, text: str, tables: Tables) -> Scale:
    """Return the scale that the plug-in `kind` computes from the text after the dot, which begins with its name."""
    made: Range = CRITERIA.make(kind, tables)
    scale = made.scale(text.removeprefix(kind))
    if not isinstance(scale, Computed):
        return scale
    for point in scale.points:
        if isinstance(point.value, str) and (not _ITEM.fullmatch(point.value) or _ALMOST_NUMBER.fullmatch(point.value)):
            raise QueryError(f"{kind} computed the name {shown(point.value)}; names have letters, digits, _ - and .")
    return replace(scale, text=text)


def _steps(name: str, start: str, end: str, count: int) -> Scale:
    if name == VARIABLE_DENSITY:
        return VariableDensity(step(start), step(end), count)
    if "p" in start + end:
        return Span(step(start), step(end), count)
    return Steps(whole(start), whole(end), count)


def _spelled(name: str, rest: str) -> Scale:
    """Parse the text after `=`: a list, or a span."""
    parts = pieces(rest, ":")
    if len(parts) == 1:
        return Listed(_listed(name, pieces(rest, ",")))
    if len(parts) != 3 or not _WHOLE.fullmatch(parts[2]):
        raise QueryError(f"a range needs from, to and a count; use {name}=0:1:5")
    return Span(fraction(parts[0]), fraction(parts[1]), whole(parts[2]))


def _listed(name: str, words: list[str]) -> tuple[Value, ...]:
    """Return the values of a list. If it has a text and any quotes, all are texts."""
    try:
        listed = tuple(map(value, words))
    except _NeedsQuotesError as error:
        raise QueryError(f"{error}; {_as_typed(name, ','.join(words))}") from None
    is_text = [isinstance(each, str) for each in listed]
    if any(is_text) and not all(is_text) and any(word.startswith(QUOTE) for word in words):
        return tuple(unquoted(word) or word for word in words)
    return listed


class _NeedsQuotesError(QueryError):
    """The error that a value must be in quotes."""


def value(word: str) -> Value:
    """Return the value that a word in a list of values means. Raises QueryError."""
    return _quoted(word) if QUOTE in word else _unquoted(word)


def _quoted(word: str) -> Value:
    """Return the text of a word in quotes, or the number whose canonical form it is."""
    content = unquoted(word)
    if content is None:
        raise _NeedsQuotesError(
            f'{shown(word)} should begin and end with quotes, with \\" for a quote and \\\\ for a backslash in it'
        )
    if not content:
        raise QueryError("a value must not be empty; leave it out, or use a name such as none")
    joined = re.sub("(?<=[^\x00-\x7f])[\u200c\u200d](?=[^\x00-\x7f])", "", content)  # scripts and emojis need them
    if wrong := next((each for each in joined if not each.isprintable() or each in _FILLERS), None):
        raise QueryError(f"{shown(word)} contains {wrong!a}, which cannot be seen; use scenarios whose changes set such values")
    if (composed := unicodedata.normalize("NFC", content)) != content:
        raise QueryError(
            f"{shown(word)} has letters with separate accents; use {shown(quoted(composed))}, which looks the same"
        )
    number = _as_number(content)
    return content if number is None else number


def _as_number(content: str) -> Value | None:
    """Return the number whose canonical text this is; None if there is none."""
    try:
        number = _unquoted(content)
        ranges.check(Listed((number,)))
    except QueryError:
        return None
    return number if not isinstance(number, str) and value_text(number) == content else None


def _unquoted(word: str) -> Value:
    if _WHOLE.fullmatch(word):
        return whole(word)
    if NUMBER.fullmatch(word):
        return decimal(word)
    if _ALMOST_NUMBER.fullmatch(word):
        raise QueryError(almost(word))
    if ends := _DOTS.fullmatch(word):
        start, end = ends.groups()
        raise QueryError(f"{shown(word)} is not a range; use {start}:{end}:COUNT, or a list of values: {start},{end}")
    if not _ITEM.fullmatch(word):
        if word.strip(".-"):
            raise _NeedsQuotesError(f"{shown(word)} needs quotes: it is no number, and no name of letters, digits, _ - and .")
        raise QueryError(f"{shown(word)} is not a value; use a number, or a name of letters, digits, _ - and .")
    return word


def value_text(value: Value) -> str:
    """Return the canonical text of a value in a list: in quotes only if it needs them."""
    if isinstance(value, str):
        return value if _is_name(value) else quoted(value)
    if isinstance(value, float):
        return repr(value + 0.0).replace("e+", "e")
    return str(value)


def _written(scale: Scale) -> str:
    match scale:
        case Log(end):
            return f".Log{end}"
        case Linear(end, count):
            return f".Linear{end}.C{count}"
        case Steps(start, end, count):
            return f".{start}.{end}.C{count}"
        case Span(start, end, count):
            return f"={ranges.plain(start)}:{ranges.plain(end)}:{count}"
        case Listed(listed):
            return "=" + ",".join(map(value_text, listed))
        case MonteCarlo(count):
            return f".C{count}"
        case ConstantDensity(density, increment, count):
            return f".{_density(density)}.I{_written_step(increment)}.C{count}"
        case VariableDensity(start, end, count):
            return f".{_density(start)}.{_density(end)}.C{count}"
        case Computed(text=text):
            return f".{text}"
        case _:
            assert_never(scale)


def _is_name(text: str) -> bool:
    """Return True if a text means itself without quotes."""
    try:
        return _unquoted(text) == text
    except QueryError:
        return False


def _written_step(number: Fraction) -> str:
    return ranges.plain(number).replace(".", "p")


def _density(number: Fraction) -> str:
    written = _written_step(number)
    return written if "p" in written else f"{written}p0"


def _dotted_mistaken(name: str, rest: str) -> str:
    """Return a message that `rest` is not a dotted scale, with a proposal."""
    if re.fullmatch(rf"{_STEP}\.{_STEP}", rest):
        return f"the number of values from {rest.replace('.', ' to ')} is missing; use {name}.1.9.C5"
    if re.fullmatch(r"[0-9.+-]+(\.C[0-9]+)?", rest):
        return f"steps need from, to and a count, with p for the decimal point; use {name}.0p5.2p5.C5"
    if (word := re.match(r"[A-Za-z]+", rest)) is None:
        return f"{shown(rest)} is not a range; {_forms(name)}"
    close = difflib.get_close_matches(word[0][:DIGITS].capitalize(), CRITERIA.names(), 1, 0.5)
    if not close:
        return f"unknown range {shown(rest)}; {_forms(name)}"
    meant = close[0] + rest[word.end() :].replace("c", "C")
    try:
        ranges.check(_named(close[0], meant, NO_OPTIONS))
    except SierraError:
        meant = f"{close[0]}{CRITERIA.load(close[0]).example}"
    return f"unknown range {shown(rest)}; did you mean {name}.{meant}?"


def _monte_carlo_mistaken(name: str, rest: str) -> str:
    if name == MONTE_CARLO:
        return f"{MONTE_CARLO} takes only a count; use {MONTE_CARLO}.C20"
    if name.lower() == MONTE_CARLO:
        return f"{name} must be in small letters; use {MONTE_CARLO}.{rest}"
    return f"{name} has a count, but no range; use {name}.1.9.C5, or {MONTE_CARLO}.{rest} to vary seeds only"


def _with_blanks(text: str) -> str:
    """Return a message that a criterion contains blanks, with a proposal if they are within its values and it is short."""
    name, _, values = text.partition("=")
    if _NAME.fullmatch(name) and any(" " in word.strip(" '") for word in _items(values)):
        return f"a value with blanks needs quotes; {_as_typed(name, values)}"
    return "a criterion must not contain blanks; use noise=0,0.5,1"


def _as_typed(name: str, values: str) -> str:
    """Return how values that need quotes are typed in a shell, which removes quotes that are not in others."""
    import shlex

    items = _items(values)
    if any(unquoted(word) is None and QUOTE in word for word in items):
        return f"use {shlex.quote(name + EXAMPLE)}"  # nobody knows which quotes were meant
    listed = [unquoted(word) or word.strip("' ") for word in items]
    proposal = f"{name}={','.join(map(value_text, listed))}"
    return f"use {shlex.quote(proposal if _is_valid(proposal) else name + EXAMPLE)}"


def _items(values: str) -> list[str]:
    """Return the items of a list in which quotes may be missing: a comma in brackets belongs to an item."""
    unclosed = values.count("'") % 2 or any(values.count(pair[0]) != values.count(pair[1]) for pair in ("()", "[]"))
    if QUOTE in values or unclosed:
        return pieces(values, ",")
    ends = [*outside(values, ","), len(values)]
    return [values[start:end] for start, end in zip((0, *(end + 1 for end in ends)), ends, strict=False)]


def _is_valid(text: str) -> bool:
    try:
        return len(text) <= LONGEST and bool(parse(text))
    except QueryError:
        return False


def _right_name(name: str) -> str:
    right = re.sub(r"[^A-Za-z0-9_]", "_", name[:DIGITS]).lstrip("0123456789")
    return f"use {right}" if right.strip("_") else "use population_size.Log8"


def _forms(name: str) -> str:
    return f"use {name}.Log8, {name}.Linear100.C10, {name}.1.9.C5, {name}=0:1:5 or {name}=1,2,4"


def setting(text: str) -> tuple[str, str]:
    """Split XPATH=VALUE at the first `=` that is not within brackets or quotes. Raises UsageError."""
    for place in outside(text, "="):
        if place:
            return text[:place], text[place + 1 :]
    raise UsageError(f"--set {text!r}: use XPATH=VALUE, for example --set \"//numeric[@name='noise']/@data=0.5\"")

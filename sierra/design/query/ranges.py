"""The values of scales: exact if possible, and never a range that silently differs from the text.

A scale is *valid* if its values are distinct, finite, at most a million, and exactly those that its text describes. Whole
numbers must be within 64 bits (together with decimals: within 2**53, up to which a float represents all of them). `check`
raises QueryError for any other scale, and names valid scales that are similar. Ends with decimals have at most 18 places, so
that each has one plain text. Values are not computed by repeated addition: the i-th is computed from the ends, in whole
numbers, and rounded at most once.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from fractions import Fraction
from typing import assert_never

from sierra.errors import QueryError
from sierra.model import Computed, ConstantDensity, Linear, Listed, Log, MonteCarlo, Scale, Span, Steps, Value, VariableDensity

MOST = 1_000_000
"""Maximum number of values of one scale, and of experiments of one query."""
LARGEST = 2**63 - 1
"""The largest whole number, which is that of the store's BIGINT."""
EXACT = 2**53
"""The limit up to which floats, and so a column of decimals, represent all whole numbers exactly."""
PLACES = 18
"""Maximum number of decimals of an end or a density."""


def values(scale: Scale) -> tuple[Value, ...]:
    """Return the values in their order: whole ones as int, others as the float nearest to the exact value.

    Raises QueryError if the scale is invalid, and for densities, because only a platform can convert them to values: see
    `densities` and `growths`.
    """
    check(scale)
    match scale:
        case Log(end):
            return tuple(2**power for power in range(end.bit_length()))
        case Linear(end, count):
            return tuple(range(end // count, end + 1, end // count))
        case Steps(start, end, count):
            return tuple(start + (end - start) // (count - 1) * index for index in range(count))
        case Span(start, end, count):
            return _spread(start, end, count)
        case Listed(listed):
            return listed
        case MonteCarlo(count):
            return tuple(range(1, count + 1))
        case Computed(points):
            return tuple(point.value for point in points)
        case ConstantDensity() | VariableDensity():
            raise QueryError("densities are only valid for a criterion of the platform; use steps, for example =0.5:2:4")
        case _:
            assert_never(scale)


def count(scale: Scale) -> int:
    """Return the number of values of a valid scale, without computing them."""
    match scale:
        case Log(end):
            return end.bit_length()
        case Listed(listed):
            return len(listed)
        case Computed(points):
            return len(points)
        case _:
            return scale.count


def densities(scale: VariableDensity) -> tuple[Fraction, ...]:
    """Return the exact densities, in percent of robots per m². Raises QueryError if the scale is invalid."""
    check(scale)
    gap = (scale.end - scale.start) / (scale.count - 1)
    return tuple(scale.start + gap * index for index in range(scale.count))


def growths(scale: ConstantDensity) -> tuple[Fraction, ...]:
    """Return how much each arena's sides exceed the scenario's, in metres: 0, increment, 2 · increment, … Raises QueryError."""
    check(scale)
    return tuple(scale.increment * index for index in range(scale.count))


def check(scale: Scale) -> None:
    """Raise QueryError if the scale is invalid; the message names valid scales that are similar."""
    match scale:
        case Log(end):
            _check_log(end)
        case Linear(end, count):
            _check_linear(end, count)
        case Steps(start, end, count):
            _check_steps(start, end, count)
        case Span(start, end, count):
            _check_span(start, end, count)
        case Listed(listed):
            _check_listed(listed)
        case Computed(points):
            _check_computed(tuple(point.value for point in points))
        case MonteCarlo(count):
            _check_count(count)
        case ConstantDensity(density, increment, count):
            _check_positive(density, "a density", "5p0")
            _check_positive(increment, "an increment", "I16")
            _check_count(count)
        case VariableDensity(start, end, count):
            _check_positive(start, "a density", "5p0")
            _check_positive(end, "a density", "5p0")
            _check_ends(start, end, count)
        case _:
            assert_never(scale)


def plain(number: Fraction | int) -> str:
    """Return a decimal of at most 18 places, without exponent: 5, -0.25."""
    whole, rest = divmod(abs(int(number * 10**PLACES)), 10**PLACES)
    sign = "-" if number < 0 else ""
    return f"{sign}{whole}" + (f".{rest:0{PLACES}}".rstrip("0") if rest else "")


def _spread(start: Fraction, end: Fraction, count: int) -> tuple[Value, ...]:
    """Return evenly spaced values. All share one denominator, so each value needs one division of whole numbers."""
    shared = math.lcm(start.denominator, end.denominator) * (count - 1)
    first = int(start * shared)
    gap = int((end - start) * shared) // (count - 1)
    return tuple(_value(first + gap * index, shared) for index in range(count))


def _value(numerator: int, denominator: int) -> int | float:
    whole, rest = divmod(numerator, denominator)
    return numerator / denominator if rest else whole


def _check_log(end: int) -> None:
    if end < 1:
        raise QueryError(f"Log must end at 1 or more, not {end}; use Log8")
    _check_size(end)
    if end.bit_count() > 1:
        below = 1 << (end.bit_length() - 1)
        ends = [below, below * 2] if below * 2 <= LARGEST else [below]
        raise QueryError(f"{end} is not a power of two; use {_either(f'Log{end}' for end in ends)}")


def _check_linear(end: int, count: int) -> None:
    if end < 1:
        raise QueryError(f"Linear must end at 1 or more, not {end}; use Linear100.C10")
    _check_size(end)
    _check_count(count)
    if end % count:
        near = [_linear(end, divisor) for divisor in _divisors(end, count) if divisor > 1]
        multiples = (end // count * count, (end // count + 1) * count)
        near += [_linear(multiple, count) for multiple in multiples if 0 < multiple <= LARGEST]
        raise QueryError(f"{end} cannot be divided into {count} equal whole steps; use {_either(near)}")


def _linear(end: int, count: int) -> str:
    return f"Linear{end}" + ("" if count == 10 else f".C{count}")


def _check_steps(start: int, end: int, count: int) -> None:
    _check_ends(start, end, count)
    distance = abs(end - start)
    if distance % (count - 1):
        near = [f".{start}.{end}.C{gaps + 1}" for gaps in _divisors(distance, count - 1) if gaps < MOST]
        if max(abs(start), abs(end)) <= EXACT and _apart(Fraction(start), Fraction(end), count):
            near.insert(0, f"={start}:{end}:{count}")
        raise QueryError(f"{start} to {end} cannot be divided into {count - 1} equal whole steps; use {_either(near)}")


def _check_span(start: Fraction, end: Fraction, count: int) -> None:
    _check_ends(start, end, count)
    if not _apart(start, end, count):
        raise QueryError("its values are too close together to differ as floats; use fewer values, or a wider range")
    _check_mixed(_spread(start, end, count) if max(abs(start), abs(end)) > EXACT else ())


def _apart(start: Fraction, end: Fraction, count: int) -> bool:
    """Return True if all values differ; neighbours with a gap of up to one unit in the last place may be equal."""
    gap = abs(end - start) / (count - 1)
    whole = start.denominator == gap.denominator == 1
    return whole or gap > math.ulp(float(max(abs(start), abs(end))))


def _check_ends(start: Fraction | int, end: Fraction | int, count: int) -> None:
    _check_size(start)
    _check_size(end)
    if start == end:
        raise QueryError(f"its start and end are the same, {plain(start)}; use ={plain(start)} for one value")
    if count == 1:
        raise QueryError("a range needs at least two values; use a count of 2 or more")
    _check_count(count)


def _check_listed(listed: tuple[Value, ...]) -> None:
    if not listed:
        raise QueryError("its list of values is empty; use =1,2,4")
    _check_count(len(listed))
    names = [value for value in listed if isinstance(value, str)]
    if names and len(names) < len(listed):
        raise QueryError(f"{names[0]!r} is a name in a list of numbers; use only numbers, or only names")
    seen: set[Value] = set()
    for value in listed:
        if not isinstance(value, str):
            _check_listed_size(value)
        if value in seen:
            raise QueryError(f"{value!r} is listed twice; use it once")
        seen.add(value)
    _check_mixed(listed)


def _check_computed(values: tuple[Value, ...]) -> None:
    """Raise QueryError for values that a plug-in must not compute: other types, such as NumPy's, would change ids."""
    if not values:
        raise QueryError("it has no value")
    if wrong := next((value for value in values if type(value) not in (int, float, str)), None):
        raise QueryError(f"its value {wrong!r} is of type {type(wrong).__name__}; a plug-in returns int, float or str")
    _check_listed(values)


def _check_mixed(values: tuple[Value, ...]) -> None:
    """Raise QueryError for large whole numbers among decimals: they become floats, which must represent them exactly."""
    large = [value for value in values if isinstance(value, int) and abs(value) > EXACT]
    if large and any(isinstance(value, float) for value in values):
        raise QueryError(
            f"{large[0]} is beyond 2**53, where a float cannot represent all whole numbers; "
            "use only whole numbers, or smaller ones"
        )


def _check_listed_size(number: int | float) -> None:
    if isinstance(number, int):
        _check_size(number)
    elif not math.isfinite(number):
        raise QueryError(f"{number} is not a finite number; use a number up to 1e308")


def _check_positive(number: Fraction, what: str, right: str) -> None:
    _check_size(number)
    if number <= 0:
        raise QueryError(f"{what} must be more than 0, not {plain(number)}; use {right}")


def _check_count(count: int) -> None:
    if count < 1:
        raise QueryError(f"a count must be 1 or more, not {count}; use C5")
    if count > MOST:
        raise QueryError(f"{count} values are too many; use at most {MOST}")


def _check_size(number: Fraction | int) -> None:
    if not -LARGEST <= number <= LARGEST:
        raise QueryError(f"a number is too large; use a number up to {LARGEST}")
    if 10**PLACES % number.denominator:
        raise QueryError(f"{number} has more than {PLACES} decimal places; use fewer")


def _divisors(number: int, near: int) -> list[int]:
    """Return the divisors of `number` next to `near`, which is not a divisor: one below, and one up to twice as large."""
    below = next((n for n in range(min(near, number), 0, -1) if number % n == 0), None)
    above = next((n for n in range(near, min(number, 2 * near) + 1) if number % n == 0), None)
    return sorted({n for n in (below, above) if n is not None})


def _either(choices: Iterable[str]) -> str:
    *first, last = choices
    return f"{', '.join(first)} or {last}" if first else last

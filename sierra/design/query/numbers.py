"""The numbers of queries: exact, and in one form only."""

from __future__ import annotations

from fractions import Fraction

from sierra.errors import QueryError
from sierra.util.float_range import out_of_range
from sierra.util.lazy_definitions import regex

DIGITS = 40
"""Maximum number of characters of a number, so that parsing is always fast."""
COUNT = r"C([+-]?[0-9]+)"
"""The pattern of a count, as in `C5`."""
NUMBER = regex(r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]{1,3})?")
_LEADING_ZERO = regex(r"[+-]?0[0-9]")


def decimal(word: str) -> float:
    """Return the float nearest to a number. Raises QueryError."""
    fraction(word)
    if out_of_range(word):
        raise QueryError(f"{word} is outside the range of floats; use a number from 1e-307 to 1e308")
    return float(word) + 0.0  # -0.0 becomes 0.0


def whole(word: str) -> int:
    """Return a whole number. Raises QueryError."""
    return int(fraction(word))


def step(word: str) -> Fraction:
    """Return a number with `p` as its decimal point. Raises QueryError."""
    if _LEADING_ZERO.match(word):
        raise QueryError(f"{shown(word)} has leading zeros; leave them out, as in 5 or 0p5")
    return fraction(word.replace("p", "."))


def fraction(word: str) -> Fraction:
    """Return the exact number; its digits and exponent are limited, so that a hostile text cannot take long."""
    if len(word) > DIGITS:
        raise QueryError(f"a number of {len(word)} characters is too long; use at most {DIGITS} characters")
    if not NUMBER.fullmatch(word) or _LEADING_ZERO.match(word):
        raise QueryError(almost(word))
    return Fraction(word)


def almost(word: str) -> str:
    """Return a message about a word that should be a number."""
    plain = word.lower().replace("p", ".", 1).replace("_", "")
    if len(word) > DIGITS or not NUMBER.fullmatch(plain):
        return f"{shown(word)} is not a number; use a number such as 5, -0.5 or 1e-3"
    sign, digits = ("-" if plain[0] == "-" else ""), plain.lstrip("+-")
    digits = digits.lstrip("0") if digits.strip("0") else "0"
    right = sign + (digits if digits[0].isdigit() else "0" + digits)
    return f"{word} is not in the number format of queries; use {right}"


def shown(what: object) -> str:
    """Return Python's `repr` of an object, on one line and shortened."""
    written = repr(what)
    return written if len(written) <= 80 else f"{written[:76]}…{written[-1]}"

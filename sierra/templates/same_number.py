"""Comparison of numbers with different spellings, such as `0` and `0.0`.

If a value equals the value in a template, the template's bytes stay unchanged. Otherwise `--set x=0.0` over a `0` would create
new runs of the same experiment. Only texts that are certainly numbers are compared as numbers. `007` may be a name, and `1.10`
may be a version that differs from `1.1`; `-0` differs from `0`.
"""

from __future__ import annotations

from fractions import Fraction

from sierra.util.float_range import out_of_range
from sierra.util.lazy_definitions import regex

LONGEST = 60
"""Maximum number of characters of a text that may be a number."""
_BLANKS = " \t\n\r\f\v"
"""White space that programs skip before a number; they do not skip a no-break space."""
_NUMBER = regex(r"[+-]?(?:(?:0|[1-9][0-9]*)(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]{1,3})?")
_DECIMAL = regex(r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_VERSION = regex(r"\.[0-9]*[1-9]0+(?:[eE]|\Z)")
"""Decimals that end with zeros after other digits."""


def same(one: str, other: str) -> bool:
    """Return whether two texts are the same, or spell the same number."""
    if one == other:
        return True
    one, other = one.strip(_BLANKS), other.strip(_BLANKS)
    if one.isdecimal() and other.isdecimal() and one[0] != "0" != other[0]:
        return one == other
    if not (_is_number(one) and _is_number(other)) or one.startswith("-") != other.startswith("-"):
        return False
    return Fraction(one) == Fraction(other)


def is_lost(was: str, now: str) -> str:
    """Return why programs that read a number would not read the new one as it is written; empty if they do."""
    old, new = was.strip(_BLANKS), now.strip(_BLANKS)
    return out_of_range(new) if _is_number(old) and not out_of_range(old) and _DECIMAL.fullmatch(new) else ""


def _is_number(text: str) -> bool:
    return len(text) <= LONGEST and _NUMBER.fullmatch(text) is not None and _VERSION.search(text) is None

"""The range of floats: programs read a number beyond it as infinity, and one that is too close to 0 as 0."""

from __future__ import annotations

import math

from sierra.util.lazy_definitions import regex

TOO_LARGE = "it is too large"
TOO_SMALL = "it is too close to 0"
_DIGITS = regex(r"[+-]?[0-9_.]*[1-9]")


def out_of_range(number: str) -> str:
    """Return why no float stands for a written number; empty if one does, and for words such as `inf`."""
    if not _DIGITS.match(number):
        return ""
    value = float(number)
    return TOO_LARGE if math.isinf(value) else "" if value else TOO_SMALL

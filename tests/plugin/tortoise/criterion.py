"""The range `Primes`: `herd.Primes5` has the values 2, 3, 5, 7 and 11."""

from __future__ import annotations

from itertools import count, islice
from typing import ClassVar

from pydantic import Field

from sierra.plugin import Computed, QueryError, Table


class PrimesOptions(Table):
    """The options of the range."""

    above: int = Field(1, ge=1, description="the number that all primes exceed")


class Primes:
    """The first prime numbers."""

    contract = 1
    Options: ClassVar[type[Table]] = PrimesOptions
    example = "5"

    def __init__(self, options: PrimesOptions) -> None:
        self._above = options.above

    def scale(self, text: str) -> Computed:
        if not text.isdecimal() or not 1 <= int(text) <= 100:
            raise QueryError(f"Primes needs a number of primes from 1 to 100, not {text!r}; use Primes5")
        primes = (n for n in count(self._above + 1) if all(n % d for d in range(2, int(n**0.5) + 1)))
        return Computed.of(*islice(primes, int(text)))

"""Measurements of a host's clock by round trips."""

from __future__ import annotations

import time
from collections.abc import Callable

from sierra.util.lazy_definitions import dataclass

TRIPS = 15


@dataclass(frozen=True, slots=True)
class Clock:
    """A measurement of a host's clock."""

    offset_ns: int
    """Its clock minus this host's; wrong by half of the round-trip time at most."""
    rtt_ns: int
    at_ns: int
    """Its clock at the measurement, since the epoch."""


def measured(ask: Callable[[], int], now_ns: Callable[[], int]) -> Clock:
    """Return the measurement by the fastest of `TRIPS` round trips.

    `ask` returns the host's clock, and `now_ns` the clock of this host with which it is compared, in ns since the epoch.
    """
    return min((_trip(ask, now_ns) for _ in range(TRIPS)), key=lambda one: one.rtt_ns)


def _trip(ask: Callable[[], int], now_ns: Callable[[], int]) -> Clock:
    began, before = time.monotonic_ns(), now_ns()  # a pause between them only adds to the round-trip time
    there = ask()
    rtt = time.monotonic_ns() - began
    return Clock(there - before - rtt // 2, rtt, there)

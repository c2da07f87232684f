"""Measure computing time independently of the machine: in multiples of a fixed piece of work."""

from __future__ import annotations

import time
from collections.abc import Callable

TRIES = 3


def is_cheap(call: Callable[[], object], units: float) -> bool:
    """Return whether the computing time of a call is below some units; one takes about 0.05 s, more on a slow or busy machine.

    One of several measurements is enough: other processes only increase the time.
    """
    return any(_seconds(call) < units * _seconds(_unit) for _ in range(TRIES))


def _seconds(call: Callable[[], object]) -> float:
    began = time.process_time()
    call()
    return time.process_time() - began


def _unit() -> int:
    total = 0
    for number in range(1_000_000):
        total += number * number
    return total

"""Measure computing time independently of the machine: in multiples of a fixed piece of work."""

from __future__ import annotations

import time
from collections.abc import Callable

TRIES = 3


def effort(call: Callable[[], object]) -> float:
    """Return the computing time of a call in units; one takes about 0.05 s, and more if the machine is slow or busy.

    Return the minimum of several measurements: other processes only increase the time.
    """
    return min(_seconds(call) / _seconds(_unit) for _ in range(TRIES))


def _seconds(call: Callable[[], object]) -> float:
    began = time.process_time()
    call()
    return time.process_time() - began


def _unit() -> int:
    total = 0
    for number in range(1_000_000):
        total += number * number
    return total

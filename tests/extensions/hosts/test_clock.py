"""Tests of measurements of a host's clock."""

from __future__ import annotations

import time

import pytest

from sierra.extensions.hosts.clock import measured

MS = 1_000_000
AHEAD = 137_000 * MS


@pytest.mark.parametrize("pause_ms", [0, 20])
def test_an_offset_is_wrong_by_half_of_the_round_trip_time_at_most(monkeypatch: pytest.MonkeyPatch, pause_ms: int) -> None:
    """Another process may execute between two readings of clocks of this host."""
    now = 0

    def passed(duration: int) -> int:
        nonlocal now
        now += duration
        return now - duration

    monkeypatch.setattr(time, "monotonic_ns", lambda: passed(0))
    clock = measured(lambda: passed(MS) + AHEAD, lambda: passed(pause_ms * MS))
    assert abs(clock.offset_ns - AHEAD) <= clock.rtt_ns / 2

"""The remaining time in the progress line, by the expected durations of runs if they differ, else by their number."""

from __future__ import annotations

import pytest

from sierra.execution.observer import Observer, Progress, Tally
from sierra.execution.progress_display import text
from sierra.model import Status


class Last(Observer):
    shown: Progress

    def progress(self, progress: Progress) -> None:
        self.shown = progress


def test_runs_that_take_longer_count_more() -> None:
    last = Last()
    tally = Tally(last, 4, reused=1)
    tally.expect({"long": 80.0, "short": 10.0, "other": 10.0})
    tally.report(1)
    assert "left" not in text(last.shown, 30.0)
    tally.ended("short", Status.OK)
    tally.ended("short", Status.FAILED)  # recording has found a problem
    tally.report(1)
    assert text(last.shown, 10.0) == "2/4 runs, 1 failed, 1 running, 0.1/s, 1:30 left"
    tally.ended("long", Status.OK)
    tally.ended("other", Status.OK)
    tally.report(0)
    assert text(last.shown, 100.0).endswith("0:00 left")


@pytest.mark.parametrize("reused", [0, 2])
def test_without_expected_durations_all_runs_count_alike(reused: int) -> None:
    last = Last()
    tally = Tally(last, 10 + reused, reused=reused)
    for number in range(5):
        tally.ended(str(number), Status.OK)
    tally.report(2)
    assert text(last.shown, 60.0).endswith("1:00 left")


def test_rounds_and_runs_of_other_sessions_count_by_number() -> None:
    last = Last()
    tally = Tally(last, 100)
    tally.expect({f"a{number}": 20.0 + number % 2 for number in range(90)})
    for number in range(90):
        tally.ended(f"a{number}", Status.OK)
    tally.report(0, elsewhere=10)
    assert text(last.shown, 1800).endswith("3:20 left")
    tally.expect({f"b{number}": 20.0 + number % 2 for number in range(10)})
    tally.ended("b0", Status.OK)
    tally.report(1)
    assert text(last.shown, 1820).endswith("3:00 left")

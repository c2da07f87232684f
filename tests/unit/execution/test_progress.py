"""The remaining time in the progress line, by the expected durations of runs if they differ, else by their number."""

from __future__ import annotations

import pytest

from sierra.execution.observer import Observer, Progress, ProgressCounter
from sierra.execution.progress_display import text
from sierra.model import Status


class Last(Observer):
    shown: Progress

    def progress(self, progress: Progress) -> None:
        self.shown = progress


def test_runs_that_take_longer_count_more() -> None:
    last = Last()
    counter = ProgressCounter(last, 4, reused=1)
    counter.expect({"long": 80.0, "short": 10.0, "other": 10.0})
    counter.report(1)
    assert "left" not in text(last.shown, 30.0)
    counter.ended("short", Status.OK)
    counter.ended("short", Status.FAILED)  # recording has found a problem
    counter.report(1)
    assert text(last.shown, 10.0) == "2/4 runs, 1 failed, 1 running, 0.1/s, 1:30 left"
    counter.ended("long", Status.OK)
    counter.ended("other", Status.OK)
    counter.report(0)
    assert text(last.shown, 100.0).endswith("0:00 left")


@pytest.mark.parametrize("reused", [0, 2])
def test_without_expected_durations_all_runs_count_alike(reused: int) -> None:
    last = Last()
    counter = ProgressCounter(last, 10 + reused, reused=reused)
    for number in range(5):
        counter.ended(str(number), Status.OK)
    counter.report(2)
    assert text(last.shown, 60.0).endswith("1:00 left")


def test_rounds_and_runs_of_other_sessions_count_by_number() -> None:
    last = Last()
    counter = ProgressCounter(last, 100)
    counter.expect({f"a{number}": 20.0 + number % 2 for number in range(90)})
    for number in range(90):
        counter.ended(f"a{number}", Status.OK)
    counter.report(0, elsewhere=10)
    assert text(last.shown, 1800).endswith("3:20 left")
    counter.expect({f"b{number}": 20.0 + number % 2 for number in range(10)})
    counter.ended("b0", Status.OK)
    counter.report(1)
    assert text(last.shown, 1820).endswith("3:00 left")

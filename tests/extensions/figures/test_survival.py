"""Survival curves show the known steps, and refuse data without an event."""

from __future__ import annotations

import math

import pytest

from sierra.deliverables.figures.drawing import Drawing, noted
from sierra.errors import UsageError
from sierra.extensions.figures import survival_drawing
from sierra.testing.figures import Row, Trial
from tests.drawings import plot, refusal

REACH = {"measure": "time_to", "threshold": 1.0}


def reaching(*times: int | None, before: float = 0.0) -> Drawing:
    """Return the drawing of runs that reach the threshold at these times; None: never."""

    def row(experiment: int, run: int, row: int) -> Row:
        at = times[run]
        return {"done": 1.0 if at is not None and row >= at else before}

    return Trial("survival", REACH, row, ()).drawing(runs=lambda experiment: len(times))


def test_runs_that_never_reach_the_threshold_are_censored_and_not_dropped() -> None:
    """S falls by 1/4 at times 2 and 5; two of four runs end at time 7 without the event."""
    drawing = reaching(2, 5, None, None)
    (steps,) = survival_drawing.curves(drawing).values()
    assert [(step.time, step.at_risk, step.remaining) for step in steps] == [(2, 4, 0.75), (5, 3, 0.5), (7, 2, 0.5)]
    assert "2 of 4 runs never reached 1, censored at the last time" in noted(drawing).note
    drawn = plot(drawing)
    assert list(drawn.lines[0].get_ydata()) == [1.0, 0.75, 0.5, 0.5]
    assert list(drawn.lines[1].get_xdata()) == [7.0]
    at_risk = [text.get_text() for text in drawn.texts if text.get_text().isdigit()]
    assert at_risk[:3] == ["4", "4", "3"], "at the times 0, 1.5 and 3"


def test_an_interval_holds_until_the_next_time_also_where_the_curve_reaches_zero() -> None:
    """S is 1/4 from 2 to 3, and 0 from 3 on."""
    (band,) = plot(reaching(2, 2, 2, 3)).collections
    corners = band.get_paths()[0].vertices
    assert {*corners[:, 0]} == {2.0, 3.0}
    assert 0 < min(corners[:, 1]) < 0.25 < max(corners[:, 1]) < 1


def test_survival_without_an_event_a_threshold_or_a_value_is_refused() -> None:
    assert "done reaches the threshold 1 in none of 3 runs; there is no event to draw" in refusal(reaching(None, None, None))
    assert "no row is what the keys of the figure ask for" in refusal(reaching(None, None, before=math.nan))
    with pytest.raises(UsageError, match='needs measure = "time_to" and a threshold'):
        Trial("survival").drawing()

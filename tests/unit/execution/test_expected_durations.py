"""Expected durations of runs, estimated from recorded durations."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import pytest
from hypothesis import given
from hypothesis import strategies as st

import sierra
from sierra.errors import Damaged
from sierra.execution import expected_durations
from sierra.execution.expected_durations import Order, Timed, estimate
from sierra.model import Value
from sierra.store.store import Store
from tests.conftest import Simulated

SLEEPS = """sleep 0.$(sed -n 's/.* {}="\\([0-9]\\).*/\\1/p' "$1"); printf 't,v\\n1,1\\n' > swarm.csv"""


def timed(axis: str, seconds: Mapping[Value, float]) -> list[Timed]:
    return [Timed({axis: value}, took) for value, took in seconds.items()]


@pytest.mark.parametrize(
    ("seconds", "value", "expected"),
    [
        ({1: 2.0, 4: 8.0}, 2, 8.0),  # the slower neighbour
        ({1: 9.0, 4: 8.0, 8: 1.0}, 6, 8.0),
        ({2: 3.0}, 8, 12.0),  # in proportion
        ({2: 3.0}, 1, 3.0),
        ({1: 1.0, 2: 4.0, 4: 16.0}, 8, 64.0),  # a power
        ({1: 1.0, 2: 1.0}, 8, 4.0),  # two values are too few to assume a constant
        ({1: 1.0, 2: 1.0, 4: 1.0}, 64, 1.0),
        ({1: 1.0, 2: 1e9}, 4, 16e9),  # no power above 4
        ({4: 1.0, 2: 2.0}, 1, 4.0),  # decreasing
        ({0: 1.0, 1: 3.0}, 3, 7.0),  # a straight line
        ({-1: 1.0, 1: 1.0}, 5, 1.0),
        ({"low": 1.0, "high": 5.0}, "low", 1.0),
        ({"low": 1.0, "high": 5.0}, "other", 5.0),
    ],
)
def test_durations_of_untimed_values_are_estimated(seconds: Mapping[Value, float], value: Value, expected: float) -> None:
    assert estimate({"axis": value}, timed("axis", seconds)) == pytest.approx(expected)


def test_estimates_combine_several_variables() -> None:
    known = [Timed({"size": size, "speed": speed}, float(size * speed)) for size in (1, 2, 4) for speed in (1, 2, 4)]
    assert estimate({"size": 8, "speed": 8}, known) == pytest.approx(64)
    assert estimate({"size": 3, "speed": 1}, known) == 4
    assert estimate({"size": 8, "speed": 1}, known) == pytest.approx(8)


def test_variables_that_were_not_varied_before_do_not_affect_the_estimate() -> None:
    assert estimate({"size": 1, "speed": 5}, [Timed({"size": 1, "speed": None}, 3.0)]) == 3


@given(
    st.dictionaries(st.integers(-5, 50), st.floats(1e-3, 1e5), min_size=1, max_size=6),
    st.floats(-100, 1000, allow_nan=False),
)
def test_estimates_are_finite_and_at_least_the_quickest_run(seconds: dict[int, float], value: float) -> None:
    found = estimate({"axis": value}, timed("axis", dict(seconds)))
    assert min(seconds.values()) * 0.999 <= found < float("inf")
    if value > max(seconds):
        assert found >= seconds[max(seconds)] * 0.999


@pytest.mark.integration
def test_runs_are_expected_to_take_as_long_as_runs_with_the_same_values(simulate: Callable[..., Simulated]) -> None:
    made = simulate(SLEEPS.format("size"))
    project = sierra.open(made.folder)
    project.run("size=1,9", runs=2, figures=False)
    plan = project.plan("size=1,9,5,18", runs=3)
    order, times = expected_durations.expected(plan, project.store, {run.id for run in plan.batch.runs})
    assert times is not None
    assert [experiment.values["size"] for experiment in order.batch.experiments] == [18, 9, 5, 1]
    assert list(times.each) == sorted(times.each, reverse=True)
    beyond, slow, between, quick = (times.each[3 * place] for place in range(4))
    assert 0.1 < quick < slow == between
    assert slow > 0.9
    assert beyond == pytest.approx(2 * slow) or beyond > 2 * slow
    assert times.new == (0, 1, 2, 6, 7, 8)
    assert times.how == "2 of 4 experiments were timed; the others are estimated from them"
    new = {run.id for run in plan.batch.experiments[0].runs}
    assert expected_durations.expected(plan, project.store, new)[1] is not None
    assert expected_durations.expected(plan, None, new)[1] is None


@pytest.mark.nightly
def test_durations_with_other_settings_count_only_if_there_are_none_with_these(simulate: Callable[..., Simulated]) -> None:
    made = simulate(SLEEPS.format("speed"))
    project = sierra.open(made.folder)
    project.run("size=1", runs=1, sets=[("/swarm/@speed", "9")], figures=False)
    project.run("size=1", runs=1, sets=[("/swarm/@speed", "1")], figures=False)
    found = {}
    for speed in (1, 9, 5):
        plan = project.plan("size=1", runs=1, sets=[("/swarm/@speed", str(speed))])
        _, times = expected_durations.expected(plan, project.store, {run.id for run in plan.batch.runs})
        assert times is not None
        found[speed] = times.mean
    assert found[1] < 0.9 < found[9] == found[5]


def test_runs_that_take_longest_are_executed_first(simulate: Callable[..., Simulated], monkeypatch: pytest.MonkeyPatch) -> None:
    project = sierra.open(simulate("printf 't,v\\n1,1\\n' > swarm.csv").folder)
    known = timed("size", {1: 2.0, 2: 2.0, 8: 12.0, 4: 3.0})
    monkeypatch.setattr(expected_durations, "_timed", lambda plan, store, runner: iter(known))
    project.run("size=1,2,4,8", runs=2, jobs=1, figures=False)
    order = project.sql(
        "SELECT x.size AS size FROM executions e JOIN batch_runs USING (batch, run) "
        "JOIN experiments x USING (batch, ordinal) ORDER BY e.started"
    )
    assert order.column("size").to_pylist() == [8, 8, 4, 4, 1, 1, 2, 2]


def test_durations_that_cannot_be_read_stop_no_run(simulate: Callable[..., Simulated], monkeypatch: pytest.MonkeyPatch) -> None:
    def damaged(*_: object) -> None:
        raise Damaged("a file of another batch has other bytes")

    project = sierra.open(simulate("printf 't,v\\n1,1\\n' > swarm.csv").folder)
    monkeypatch.setattr(expected_durations, "_timed", damaged)
    assert project.run("size=1,2,4", runs=1, jobs=1, figures=False).executed == 3


def test_an_order_that_takes_long_to_find_is_not_looked_for(
    simulate: Callable[..., Simulated], monkeypatch: pytest.MonkeyPatch
) -> None:
    project = sierra.open(simulate("printf 't,v\\n1,1\\n' > swarm.csv").folder)
    monkeypatch.setattr(expected_durations, "_timed", lambda plan, store, runner: iter(timed("size", {1: 1.0, 2: 2.0})))
    plan, store = project.plan("size=1,2", runs=1), Store.create(project.paths.store)
    runs = {run.id for run in plan.batch.runs}
    assert [one.ordinal for one in expected_durations.longest_first(plan, store, runs).batch.experiments] == [1, 0]
    monkeypatch.setattr(expected_durations, "AT_MOST", 3)
    assert expected_durations.longest_first(plan, store, runs) == Order(plan.batch, {})

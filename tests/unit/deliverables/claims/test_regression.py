"""A regression is a change for the worse that is beyond the margin with its whole interval."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy import stats

from sierra.config import project_file
from sierra.deliverables.claims import regression
from sierra.deliverables.claims.baseline import ClaimInBaseline, decision_of
from sierra.deliverables.claims.model import Evaluated, Verdict

MARGIN = 1.0
CONFIG = project_file.parse(
    {
        "template": "x.xml",
        "command": "true",
        "claims": {
            "speed": {
                "says": "It is fast.",
                "paper": "Fig. 1",
                "query": "noise=1",
                "value": {"expected": 1, "margin": 1, "better": "higher", "regression": MARGIN},
            }
        },
    },
    "sierra.toml",
)
DECISION = decision_of(CONFIG, CONFIG.claims["speed"])


def measured(values: npt.NDArray[Any], seeds: range | None = None) -> dict[str, Any]:
    """Return the keys of a result: the mean with its t interval (SciPy's)."""
    low, high = stats.t.interval(0.95, len(values) - 1, np.mean(values), stats.sem(values))
    runs = {str(seed): float(value) for seed, value in zip(seeds, values, strict=True)} if seeds else {}
    return {"value": float(np.mean(values)), "low": float(low), "high": float(high), "n": len(values), "runs": runs}


def verdict(before: dict[str, Any], now: dict[str, Any]) -> str:
    known = ClaimInBaseline(verdict="holds", text="", decision=DECISION, **before)
    [changed] = regression.compare(CONFIG, [Evaluated(Verdict.holds, "", name="speed", **now)], {"speed": known})
    return str(changed.verdict)


@pytest.mark.integration
@pytest.mark.parametrize("paired", [True, False])
def test_noise_seldom_alarms_and_twice_the_margin_mostly_does(paired: bool) -> None:
    """Simulation: 20 runs with a standard deviation of the margin; at the margin itself, at most 2.5 % are regressions."""
    random = np.random.default_rng(1)
    seeds = range(20) if paired else None

    def found(change: float) -> list[str]:
        return [
            verdict(
                measured(random.normal(10, MARGIN, 20), seeds), measured(random.normal(10 - change * MARGIN, MARGIN, 20), seeds)
            )
            for _ in range(400)
        ]

    assert found(0).count("regression") == 0
    assert found(1).count("regression") <= 400 * 0.025 + 3 * (400 * 0.025 * 0.975) ** 0.5
    assert found(2).count("regression") > 0.8 * 400
    assert found(1).count("no regression") <= 400 * 0.025 + 3 * (400 * 0.025 * 0.975) ** 0.5
    assert found(-2).count("no regression") == 400


def test_common_seeds_show_what_noise_would_hide() -> None:
    noise = np.random.default_rng(2).normal(10, 20, 12)
    assert verdict(measured(noise, range(12)), measured(noise - 2, range(12))) == "regression"
    assert verdict(measured(noise), measured(noise - 2)) == "can't tell"
    assert verdict(measured(noise, range(12)), measured(noise, range(12))) == "no regression"


def test_intervals_of_pairs_and_of_rates_are_those_of_other_sources() -> None:
    """The t interval is SciPy's. Newcombe (1998), Table II, example (a), method 10: 56/70 − 48/80 is in [0.0524, 0.3339]."""
    first, second = np.random.default_rng(3).normal(size=(2, 9))
    before, now = (Evaluated(Verdict.holds, "", **measured(values, range(9))) for values in (first, second))
    found = regression.change(before, now, "mean")
    expected = stats.ttest_rel(second, first).confidence_interval(0.95)
    assert found is not None
    assert found[1:] == pytest.approx((expected.low, expected.high))
    rates = []
    for good, n in ((48, 80), (56, 70)):
        wilson = stats.binomtest(good, n).proportion_ci(0.95, method="wilson")
        runs = {str(seed): float(seed < good) for seed in range(n)}
        rates.append(Evaluated(Verdict.holds, "", n, good / n, wilson.low, wilson.high, runs=runs))
    found = regression.change(rates[0], rates[1], "mean")
    assert found == pytest.approx((0.2, 0.0524, 0.3339), abs=5e-5)


def test_rates_of_runs_with_the_same_seeds_are_those_of_pairs() -> None:
    """Newcombe (1998, Stat. Med. 17: 2635-2650), method 10: 36, 12, 2 and 0 pairs differ by 0.2, [0.0569, 0.3404]."""
    values = [1.0] * 36 + [0.0] * 12 + [1.0] * 2, [1.0] * 48 + [0.0] * 2
    before, now = (Evaluated(Verdict.holds, "", **measured(np.array(one), range(50))) for one in values)
    assert regression.change(before, now, "mean") == pytest.approx((0.2, 0.0569, 0.3404), abs=5e-5)


@pytest.mark.parametrize(
    ("before", "now", "expected"),
    [
        ("holds", "does not hold", "regression"),
        ("holds", "can't tell", "can't tell"),
        ("can't tell", "does not hold", "can't tell"),
        ("does not hold", "can't tell", "no regression"),
        ("can't tell", "holds", "no regression"),
    ],
)
def test_verdicts_become_worse_only_if_the_claim_held(before: str, now: str, expected: str) -> None:
    assert str(regression._of_verdicts(before, now)) == expected


def test_a_claim_that_measures_something_else_or_is_new_cannot_be_told() -> None:
    now = measured(np.arange(5.0))
    evaluated = [Evaluated(Verdict.holds, "", name="speed", **now)]
    other = ClaimInBaseline(verdict="holds", text="", decision=DECISION.replace("noise=1", "noise=2"), **now)
    for before, said in (({"speed": other}, "not decided as in the baseline"), ({}, "not in the baseline")):
        [changed] = regression.compare(CONFIG, evaluated, before)
        assert str(changed.verdict) == "can't tell"
        assert said in changed.text
    nothing = now | {"low": None, "high": None}
    assert verdict(nothing, now) == verdict(now, nothing) == "can't tell"

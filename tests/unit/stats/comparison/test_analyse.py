"""A report finds what is there, seldom what is not, and says what it cannot know."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations

import numpy as np
import pytest

from sierra.errors import SierraError, UsageError
from sierra.stats.comparison import rank_tests
from sierra.stats.comparison.analyse import analyse
from sierra.stats.comparison.model import Analysis, Cell, Paired, Question, RunValue, Sample, Verdict
from sierra.stats.comparison.wording import paragraph

ASK = Question()


def sample(group: str, values: Sequence[float], *, first: int = 1, planned: int | None = None) -> Sample:
    """Return a sample whose runs have the seeds first, first + 1, …; a run without a value is None."""
    runs = tuple(RunValue(first + k, float(value)) for k, value in enumerate(values) if value is not None)
    return Sample(group, runs, len(values) if planned is None else planned)


def cell(**groups: Sequence[float]) -> Cell:
    return Cell({}, tuple(sample(name, values) for name, values in groups.items()))


def times(group: str, values: Sequence[float], *, end: float) -> Sample:
    """Return a sample of times that are censored at `end`."""
    runs = tuple(RunValue(k, min(value, end), value < end) for k, value in enumerate(values))
    return Sample(group, runs, len(runs))


def text(result: Analysis) -> str:
    return paragraph(result, "the final coverage")


def common(seed: int, n: int, *effects: float, shared: float = 3.0) -> Cell:
    """Return groups whose runs with the same seed share a part; each group has an effect."""
    rng = np.random.default_rng(seed)
    part = shared * rng.normal(size=n)
    return cell(**{f"g{k}": (part + rng.normal(size=n) + effect).tolist() for k, effect in enumerate(effects)})


def test_pairs_show_a_difference_that_groups_without_pairs_do_not_show() -> None:
    groups = common(1, 30, 0, 1)
    paired, unpaired = (analyse([groups], replace(ASK, paired=paired)) for paired in (True, False))
    assert analyse([groups], ASK).pairs == paired.pairs
    assert paired.pairing.correlation is not None
    assert paired.pairing.correlation > 0.5
    assert paired.pairs[0].verdict is Verdict.different
    assert unpaired.pairs[0].verdict is Verdict.open
    assert paired.pairs[0].test == "Wilcoxon signed-rank test"
    assert unpaired.pairs[0].test == "Mann-Whitney test"
    assert "Runs with the same seed are pairs (common random numbers, mean rank correlation 0." in text(analyse([groups], ASK))


def test_pairs_that_do_not_help_are_not_used() -> None:
    result = analyse([cell(a=[1, 2, 3, 4, 5, 6, 7, 8], b=[3, 7, 1, 5, 8, 2, 4, 6])], ASK)
    assert result.pairing.correlation is not None
    assert abs(result.pairing.correlation) < 0.25
    assert result.pairing.paired is (result.pairing.correlation > 0)
    result = analyse([cell(a=[1, 2, 3, 4, 5, 6, 7, 8], b=[5, 4, 8, 3, 2, 7, 1, 6])], ASK)
    assert not result.pairing.paired
    assert "not correlated, so they are not compared as pairs" in text(result)


def test_a_clearly_negative_correlation_keeps_the_pairs() -> None:
    """Runs with common seeds depend on each other; a test for independent samples would find differences too often."""
    values = np.arange(20.0)
    result = analyse([cell(a=values.tolist(), b=(-values).tolist())], ASK)
    assert result.pairing.paired
    assert "negative correlation" in result.pairing.reason


def test_seeds_that_are_not_common_make_no_pairs() -> None:
    groups = (sample("a", [1, 2, 3, 4]), sample("b", [1, 2, 3, 4], first=100))
    assert not analyse([Cell({}, groups)], ASK).pairing.paired
    with pytest.raises(UsageError, match="no seeds in common"):
        analyse([Cell({}, groups)], replace(ASK, paired=True))


def test_few_common_seeds_do_not_replace_all_other_runs() -> None:
    groups = (sample("a", range(10)), sample("b", range(10), first=8))
    result = analyse([Cell({}, groups)], ASK)
    assert not result.pairing.paired
    assert result.pairs[0].n_first == 10


def test_runs_without_a_value_are_counted_with_their_partners() -> None:
    groups = Cell({}, (sample("a", range(10)), sample("b", [None, *range(2, 10), None])))
    result = analyse([groups], ASK)
    assert result.pairs[0].n_first == result.pairs[0].n_second == 8
    assert "2 of 20 runs have no value, because they failed, are missing or wrote no finite value: 2 of b" in result.notes
    assert "2 runs left out, because another group has no value for the same seed" in result.notes
    unpaired = analyse([groups], replace(ASK, paired=False))
    assert (unpaired.pairs[0].n_first, unpaired.pairs[0].n_second) == (10, 8)
    assert "the groups have unequal numbers of runs: 8 to 10" in unpaired.notes


def test_a_cell_without_values_of_a_group_is_left_out_and_named() -> None:
    empty = Cell({"size": 4}, (sample("a", range(6)), sample("b", [], planned=6)))
    full = replace(common(2, 8, 0, 1), point={"size": 2})
    renamed = replace(full, samples=tuple(replace(one, group=name) for one, name in zip(full.samples, "ab", strict=True)))
    result = analyse([renamed, empty], ASK)
    assert [pair.point for pair in result.pairs] == [{"size": 2}]
    assert "size = 4 left out: no value of b" in result.notes
    with pytest.raises(SierraError, match="no comparison is possible: no value of b"):
        analyse([empty], ASK)


def test_a_group_without_values_is_left_out_and_the_others_are_compared() -> None:
    part = Cell({"size": 2}, (sample("a", range(9)), sample("b", [], planned=9), sample("c", range(5, 14))))
    whole = Cell({"size": 4}, (sample("a", range(9)), sample("b", range(1, 10)), sample("c", range(2, 11))))
    result = analyse([part, whole], replace(ASK, paired=True))
    assert [(pair.point["size"], pair.first, pair.second) for pair in result.pairs] == [
        *[(2, "a", "c")],
        *[(4, "a", "b"), (4, "a", "c"), (4, "b", "c")],
    ]
    assert [one.groups for one in result.omnibus] == [("a", "b", "c")]
    assert "size = 2: no value of b; the other groups are compared" in result.notes
    only = analyse([replace(part, point={})], ASK)
    assert (only.groups, [(pair.first, pair.second) for pair in only.pairs]) == (("a", "c"), [("a", "c")])
    assert "No value of b; the other groups are compared." in text(only)
    with pytest.raises(SierraError, match="no comparison is possible: no value of b"):
        analyse([part], replace(ASK, against="b"))


@pytest.mark.parametrize(
    ("method", "paired", "message"),
    [
        ("rank_sum", True, "the Mann-Whitney test cannot compare runs as pairs"),
        ("signed_rank", False, "the Wilcoxon signed-rank test cannot compare runs that are not pairs"),
        ("aligned_ranks", "auto", "the analysis of variance of aligned ranks needs several variables"),
        ("log_rank", "auto", "the log-rank test cannot test for equivalence within a margin"),
    ],
)
def test_a_method_that_does_not_fit_is_refused(method: str, paired: Paired, message: str) -> None:
    question = replace(ASK, paired=paired, margin=1.0 if method == "log_rank" else None)
    with pytest.raises(UsageError, match=message):
        analyse([common(1, 9, 0, 1)], question, (), method)


def test_a_method_can_be_chosen() -> None:
    groups = common(1, 12, 0, 1, 2)
    names = ("signed_rank", "rank_sum", "friedman", "kruskal")
    found = {name: analyse([groups], ASK, (), name) for name in names}
    assert {name: one.pairs[0].test for name, one in found.items()} == {
        "signed_rank": "Wilcoxon signed-rank test",
        "rank_sum": "Mann-Whitney test",
        "friedman": "Wilcoxon signed-rank test",
        "kruskal": "Dunn's test",
    }
    assert [one.omnibus[0].test.partition(" ")[0] for one in found.values()] == [
        *("Friedman", "Kruskal-Wallis", "Friedman", "Kruskal-Wallis")
    ]
    auto = analyse([groups], ASK)
    assert (auto.method, auto.pairs) == ("signed_rank", found["friedman"].pairs)


def test_five_pairs_are_too_few_for_any_verdict() -> None:
    result = analyse([cell(a=[1, 2, 3, 4, 5], b=[11, 12, 13, 14, 15.5])], replace(ASK, paired=True))
    assert result.pairs[0].p == pytest.approx(0.0625)
    assert result.pairs[0].verdict is Verdict.too_few
    assert "N is too small for any verdict on a and b at alpha = 0.05" in text(result)
    assert "A verdict at alpha = 0.05 over 1 test needs 6 pairs or more" in text(result)


def test_many_tests_need_more_runs_for_a_verdict() -> None:
    cells = [replace(common(k, 7, 0, 9), point={"k": k}) for k in range(5)]
    assert {pair.verdict for pair in analyse(cells[:1], ASK).pairs} == {Verdict.different}
    result = analyse(cells, ASK)
    assert {pair.verdict for pair in result.pairs} == {Verdict.too_few}
    assert result.limits == (
        "no two groups can be found different: the smallest possible p value with n = 7 pairs is 0.0156, and 0.0781 after "
        "correction for 5 tests (Holm)",
        "a verdict at alpha = 0.05 over 5 tests needs 8 pairs or more",
    )


def test_a_difference_that_is_not_shown_is_not_equality() -> None:
    groups = common(4, 12, 0, 0)
    assert analyse([groups], ASK).pairs[0].verdict is Verdict.open
    assert "equivalent" not in text(analyse([groups], ASK))
    assert analyse([groups], replace(ASK, margin=0.01)).pairs[0].verdict is Verdict.open
    assert analyse([groups], replace(ASK, margin=50)).pairs[0].verdict is Verdict.equivalent
    assert "equivalent within ±50" in text(analyse([groups], replace(ASK, margin=50)))


@pytest.mark.parametrize("paired", [True, False])
def test_a_difference_below_the_margin_is_both_different_and_equivalent(paired: bool) -> None:
    result = analyse([common(5, 30, 0, 2, shared=0.1)], replace(ASK, margin=9, paired=paired))
    assert result.pairs[0].verdict is Verdict.both
    assert "g1 is greater than g0, but by less than 9" in text(result)


@pytest.mark.parametrize("paired", [True, False])
def test_equal_runs_are_equivalent_and_not_different(paired: bool) -> None:
    result = analyse([cell(a=[2.5] * 9, b=[2.5] * 9)], replace(ASK, margin=0.1, paired=paired))
    assert (result.pairs[0].difference, result.pairs[0].p, result.pairs[0].verdict) == (0, 1, Verdict.equivalent)


@pytest.mark.parametrize(
    ("paired", "omnibus", "post"), [(True, "Friedman", "Wilcoxon"), (False, "Kruskal-Wallis", "Mann-Whitney")]
)
def test_more_groups_get_an_omnibus_test_and_a_test_of_each_two(paired: bool, omnibus: str, post: str) -> None:
    result = analyse([common(6, 25, 0, 0, 4)], replace(ASK, paired=paired))
    assert result.omnibus[0].test == f"{omnibus} test"
    assert all(pair.test.startswith(post) for pair in result.pairs)
    verdicts = {(pair.first, pair.second): pair.verdict for pair in result.pairs}
    assert verdicts == {
        ("g0", "g1"): Verdict.open,
        ("g0", "g2"): Verdict.different,
        ("g1", "g2"): Verdict.different,
    }
    assert result.tests == 3, "the omnibus test is not among them"
    assert (result.omnibus[0].critical_difference is not None) is paired
    assert result.omnibus[0].mean_ranks[2] > max(result.omnibus[0].mean_ranks[:2])


@pytest.mark.parametrize("paired", [True, False])
def test_the_omnibus_test_decides_about_no_pair(paired: bool) -> None:
    """Two groups differ in each run, but among two others that vary far more, their ranks are the middle ones."""
    wide = [sign * (50.0 + run) for run in range(5) for sign in (-1, 1)]
    groups = {"a": [0.01 * run for run in range(10)], "b": [1 + 0.02 * run for run in range(10)], "c": wide, "d": wide[::-1]}
    result = analyse([cell(**groups)], replace(ASK, paired=paired))
    (different,) = (pair for pair in result.pairs if pair.verdict is Verdict.different)
    two = analyse([cell(a=groups["a"], b=groups["b"])], replace(ASK, paired=paired)).pairs[0]
    assert (different.first, different.second, different.p, different.p_adjusted) == ("a", "b", two.p, 6 * two.p)
    assert (result.omnibus[0].p_adjusted, result.tests) == (result.omnibus[0].p, 6)
    assert result.omnibus[0].p > 0.25
    omnibus = "Friedman" if paired else "Kruskal-Wallis"
    said = (
        f"The p values are corrected for 6 tests (Holm). The {omnibus} test is not among these tests; it decides about no pair."
    )
    assert said in text(result)
    assert "No difference among all groups was shown" in text(result)


def test_neighbours_are_found_different_whatever_other_groups_are_there() -> None:
    """Four groups, 3 standard deviations from each other, with 6 runs each: Dunn's test finds no neighbours different."""
    rng = np.random.default_rng(1)
    groups = cell(**{f"g{k}": rng.normal(3 * k, 0.5, size=6).tolist() for k in range(4)})
    question = replace(ASK, paired=False)
    found = {name: analyse([groups], question, (), name).pairs for name in ("auto", "kruskal")}
    verdicts = {
        name: [one.verdict for one in pairs if int(one.second[1]) - int(one.first[1]) == 1] for name, pairs in found.items()
    }
    assert verdicts == {"auto": [Verdict.different] * 3, "kruskal": [Verdict.open] * 3}


@pytest.mark.parametrize(("n", "alone", "after"), [(3, "0.1", "0.6"), (4, "0.0286", "0.171"), (5, "0.00794", "0.0476")])
def test_a_note_says_the_smallest_p_value_and_where_nothing_can_be_found(n: int, alone: str, after: str) -> None:
    groups = cell(**{f"g{k}": [100.0 * k + run for run in range(n)] for k in range(4)})
    (note, *_) = analyse([groups], replace(ASK, paired=False)).limits
    text = f"the smallest possible p value with n = {n} is {alone}, and {after} after correction for 6 tests (Holm)"
    assert note == (text if n == 5 else f"no two groups can be found different: {text}")


def test_a_note_names_the_pairs_with_too_few_runs() -> None:
    groups = cell(a=range(9), b=range(50, 59), c=range(100, 103))
    result = analyse([groups], replace(ASK, paired=False, alpha=0.004))
    assert (
        "These groups cannot be found different: a and c, b and c; the smallest possible p value with n = 9 and 3 is 0.00909"
        in text(result)
    )
    assert [pair.verdict for pair in result.pairs] == [Verdict.different, Verdict.too_few, Verdict.too_few]


def test_an_interval_without_0_beside_no_difference_is_that_of_its_pair_alone() -> None:
    rng = np.random.default_rng(0)
    for _ in range(200):
        groups = cell(**{f"g{k}": (rng.normal(size=8) + 0.8 * k).tolist() for k in range(4)})
        result = analyse([groups], replace(ASK, paired=False))
        apart = [one for one in result.pairs if one.verdict is Verdict.open and one.low is not None and one.low > 0]
        said = text(result).count("the interval is of this pair alone, not corrected for 6 pairs")
        assert said == sum(one.verdict is Verdict.open and (one.low or 0) * (one.high or 0) > 0 for one in result.pairs)
        assert "Each interval is of one pair alone, not corrected for 6 pairs." in text(result)
        if apart:
            return
    raise AssertionError("no such pair")


def test_groups_can_be_compared_with_one_of_them_only() -> None:
    result = analyse([common(7, 20, 0, 1, 2)], replace(ASK, against="g1"))
    assert [(pair.first, pair.second) for pair in result.pairs] == [("g1", "g0"), ("g1", "g2")]
    assert [np.sign(pair.difference) for pair in result.pairs] == [-1, 1]
    with pytest.raises(UsageError, match="there is no group 'g7' to compare with; the groups are g0, g1, g2"):
        analyse([common(7, 20, 0, 1, 2)], replace(ASK, against="g7"))


def test_censored_times_are_not_dropped() -> None:
    fast, slow = times("fast", [3, 4, 5, 6, 7, 8, 5.5, 4.5], end=10), times("slow", [9, 99, 99, 8, 99, 99, 7.5, 99], end=10)
    result = analyse([Cell({}, (fast, slow))], ASK)
    pair = result.pairs[0]
    assert (pair.test, pair.n_second, pair.never_second, pair.verdict) == ("log-rank test", 8, 5, Verdict.different)
    assert pair.difference is None
    assert "slow reaches the threshold later than fast" in text(result)
    assert "not reached by 0 runs of fast and 5 of slow" in text(result)
    for wrong, reason in ((replace(ASK, margin=1), "equivalence"), (replace(ASK, paired=True), "as pairs")):
        with pytest.raises(UsageError, match=reason):
            analyse([Cell({}, (fast, slow))], wrong)


def test_times_that_all_runs_reached_are_compared_as_other_values() -> None:
    fast, slow = times("fast", range(3, 12), end=99), times("slow", range(4, 13), end=99)
    assert analyse([Cell({}, (fast, slow))], ASK).pairs[0].test == "Wilcoxon signed-rank test"


def test_invalid_options_are_refused() -> None:
    for wrong, reason in (
        (replace(ASK, alpha=0.7), "alpha must be above 0 and below 0.5, not 0.7"),
        (replace(ASK, margin=-1), "the margin must be a number above 0, not -1"),
    ):
        with pytest.raises(UsageError, match=reason):
            analyse([common(1, 5, 0, 1)], wrong)
    with pytest.raises(UsageError, match="two groups or more, not 1"):
        analyse([cell(a=[1, 2])], ASK)


def test_extreme_data_give_p_values_or_one_line() -> None:
    one = analyse([cell(a=[1], b=[2])], ASK)
    assert (one.pairs[0].p, one.pairs[0].verdict, one.pairs[0].low) == (1.0, Verdict.too_few, None)
    ended = Cell({}, (times("a", [3], end=10), times("b", [4], end=10), times("c", [99], end=10)))
    assert all(0 <= pair.p <= 1 for pair in analyse([ended], ASK).pairs)
    with pytest.raises(SierraError, match=r"1e\+200 is too large to be compared"):
        analyse([cell(a=[1, 2], b=[1e200, 3])], ASK)


def factorial(seed: int, n: int, effect: float) -> Cell:
    """Return a design of two factors with two values each, of which only the first has an effect."""
    rng = np.random.default_rng(seed)
    points = [(a, b) for a in (0, 1) for b in (0, 1)]
    part = rng.normal(size=n)
    samples = tuple(sample(str(k), part + rng.normal(size=n) + effect * a) for k, (a, _) in enumerate(points))
    return Cell({}, samples, tuple(points))


@pytest.mark.parametrize("paired", [True, False])
def test_factorial_designs_give_main_effects_and_interactions(paired: bool) -> None:
    result = analyse([factorial(1, 15, 3)], replace(ASK, paired=paired), ("speed", "noise"))
    shown = {effect.name: effect.p_adjusted <= 0.05 for effect in result.effects}
    assert shown == {"speed": True, "noise": False, "speed × noise": False}
    assert result.tests == 3
    assert "The main effect of speed: F(1, " in text(result)


def test_many_pairs_are_counted_in_the_text() -> None:
    cells = [replace(common(k, 20, 0, 5 * (k % 2)), point={"k": k}) for k in range(12)]
    assert "The verdicts of the 12 comparisons of two groups are: different: 6, not shown: 6." in text(analyse(cells, ASK))


def wrong_findings(seed: int, groups: int, n: int, *, shared: float) -> bool:
    """Return whether a report of two cells finds two groups different where there is no difference."""
    cells = [replace(common(2 * seed + k, n, *[0.0] * groups, shared=shared), point={"k": k}) for k in range(2)]
    result = analyse(cells, ASK)
    return any(one.p_adjusted <= 0.05 for one in result.pairs)


def wrong_effects(seed: int, n: int) -> bool:
    result = analyse([factorial(seed, n, 0)], ASK, ("a", "b"))
    return any(effect.p_adjusted <= 0.05 for effect in result.effects)


DESIGNS = {
    "pairs": partial(wrong_findings, groups=2, n=10, shared=2.0),
    "independent seeds": partial(wrong_findings, groups=2, n=10, shared=0.0),
    "three groups of pairs": partial(wrong_findings, groups=3, n=9, shared=2.0),
    "three independent groups": partial(wrong_findings, groups=3, n=8, shared=0.0),
    "factorial": partial(wrong_effects, n=6),
}


@pytest.mark.parametrize(
    "simulations",
    [
        pytest.param(100, marks=pytest.mark.integration, id="quick"),
        pytest.param(2000, marks=pytest.mark.nightly, id="precise"),
    ],
)
@pytest.mark.parametrize("design", DESIGNS)
def test_without_any_difference_at_most_5_percent_of_the_reports_find_one(design: str, simulations: int) -> None:
    """Up to the error of the simulation: three standard deviations."""
    wrong = sum(DESIGNS[design](seed) for seed in range(simulations))
    assert wrong <= simulations * 0.05 + 3 * (simulations * 0.05 * 0.95) ** 0.5


def test_the_order_of_groups_changes_signs_only() -> None:
    groups = common(9, 15, 0, 1)
    there, back = (analyse([replace(groups, samples=order)], ASK).pairs[0] for order in (groups.samples, groups.samples[::-1]))
    assert (there.p, there.difference, there.a12) == pytest.approx((back.p, -(back.difference or 0), 1 - (back.a12 or 0)))
    assert all(a != b for a, b in combinations((there.first, there.second), 2))


def of_rates(*successes: int, n: int = 20, paired: bool = False) -> Analysis:
    """Return the comparison of groups of n runs, of which the first ones succeed."""
    groups = cell(**{f"g{k}": [float(run < count) for run in range(n)] for k, count in enumerate(successes)})
    return analyse([replace(groups, rate=True)], replace(ASK, paired=paired))


def test_rates_without_pairs_are_compared_by_their_difference() -> None:
    (pair,) = of_rates(4, 13).pairs
    assert (pair.test, pair.estimate, pair.verdict) == ("Fisher's exact test", "difference of rates", Verdict.different)
    assert (pair.difference, pair.low, pair.high, pair.p) == pytest.approx((0.45, 0.1437, 0.6567, 0.00953), abs=5e-5)
    assert "difference of rates 0.45, 95 % CI [0.144, 0.657]; Fisher's exact test, n = 20, p = 0.0095)" in text(of_rates(4, 13))


def test_rates_of_pairs_are_compared_by_their_difference() -> None:
    """Of 50 pairs, both succeed in 36, only the first in 12, only the second in 2."""
    first = [1.0] * 48 + [0.0] * 2
    second = [1.0] * 36 + [0.0] * 12 + [1.0] * 2
    groups = replace(cell(second=second, first=first), rate=True)
    (pair,) = analyse([groups], replace(ASK, paired=True)).pairs
    assert (pair.test, pair.n_first, pair.smallest) == ("McNemar's exact test", 50, 2.0**-49)
    assert (pair.difference, pair.low, pair.high, pair.p) == pytest.approx((0.2, 0.0569, 0.3404, 0.01294), abs=5e-5)


def test_few_runs_can_show_that_rates_are_equivalent() -> None:
    groups = replace(cell(a=[1.0, 0.0, 1.0, 0.0], b=[1.0, 0.0, 1.0, 0.0]), rate=True)
    [pair] = analyse([groups], replace(ASK, paired=True, margin=0.95)).pairs
    assert pair.p_equivalent_adjusted is not None
    assert pair.p_equivalent_adjusted < 0.05
    assert pair.verdict is Verdict.equivalent


@pytest.mark.parametrize(("paired", "omnibus"), [(False, "Fisher-Freeman-Halton test"), (True, "Cochran's Q test")])
def test_more_rates_get_an_omnibus_test_beside_their_pairs(paired: bool, omnibus: str) -> None:
    result = of_rates(4, 13, 19, paired=paired)
    assert (result.tests, [one.test for one in result.omnibus]) == (3, [omnibus])
    assert [pair.p_adjusted for pair in result.pairs] == rank_tests.holm([pair.p for pair in result.pairs])
    assert result.pairs[0].p == of_rates(4, 13, paired=paired).pairs[0].p
    assert f"At least one group differs ({omnibus}, " in text(result)


@pytest.mark.parametrize("paired", [True, False])
def test_rates_can_be_equivalent(paired: bool) -> None:
    groups = replace(cell(a=[1.0, 0.0] * 200, b=[1.0, 0.0] * 199 + [1.0, 1.0]), rate=True)
    near, far = (analyse([groups], replace(ASK, paired=paired, margin=margin)).pairs[0] for margin in (0.15, 0.001))
    assert (near.verdict, far.verdict) == (Verdict.equivalent, Verdict.open)


def test_methods_for_rates_refuse_other_values() -> None:
    for name in ("fisher", "mcnemar"):
        with pytest.raises(UsageError, match="exact test needs a rate: a column of false and true, or one in rates of"):
            analyse([cell(a=[0.0, 1.0, 1.0], b=[0.0, 0.0, 1.0])], ASK, (), name)
    counted = analyse([cell(a=[0.0, 1.0] * 4, b=[0.0, 0.0] * 4)], ASK)
    assert counted.pairs[0].estimate == "median difference"


STEPS = {"none": (0, 0, 0, 0), "two pairs": (0, 0, 9, 9)}


@pytest.mark.nightly
@pytest.mark.parametrize(("tied", "paired"), [(False, False), (True, False), (False, True)])
@pytest.mark.parametrize("n", [4, 6, 10])
@pytest.mark.parametrize("means", STEPS)
def test_four_groups_have_the_family_wise_error(means: str, n: int, tied: bool, paired: bool) -> None:
    """At most 5 %, up to two standard errors of 2,000 simulations, of reports find two groups different that are not."""
    rng = np.random.default_rng(7)
    wrong = 0
    for _ in range(2000):
        values = [rng.normal(mean, size=n) for mean in STEPS[means]]
        groups = cell(**{f"g{k}": (np.round(one) if tied else one).tolist() for k, one in enumerate(values)})
        equal = [
            pair
            for pair in analyse([groups], replace(ASK, paired=paired)).pairs
            if STEPS[means][int(pair.first[1])] == STEPS[means][int(pair.second[1])]
        ]
        wrong += any(pair.verdict is Verdict.different for pair in equal)
    assert wrong <= 2000 * 0.05 + 2 * (2000 * 0.05 * 0.95) ** 0.5


@pytest.mark.nightly
@pytest.mark.parametrize("tied", [False, True])
def test_neighbours_3_standard_deviations_apart_are_found(tied: bool) -> None:
    """Six runs of each of four groups: the power is 0.95 or more for each two neighbours."""
    rng = np.random.default_rng(8)
    found = np.zeros(3)
    for _ in range(2000):
        values = [rng.normal(3 * k, size=6) for k in range(4)]
        groups = cell(**{f"g{k}": (np.round(4 * one) / 4 if tied else one).tolist() for k, one in enumerate(values)})
        pairs = {(pair.first, pair.second): pair.verdict for pair in analyse([groups], replace(ASK, paired=False)).pairs}
        found += [pairs[f"g{k}", f"g{k + 1}"] is Verdict.different for k in range(3)]
    assert (found / 2000).min() >= 0.95

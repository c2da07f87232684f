"""Rules that end a study have one form, and are refused with an example."""

from __future__ import annotations

import pytest

from sierra.design.query import until
from sierra.errors import QueryError


@pytest.mark.parametrize(
    ("text", "written"),
    [
        ("ci(coverage)<0.02", "ci(coverage) < 0.02"),
        ("ci( mean( swarm.coverage ) ) < 5 %", "ci(swarm.coverage) < 5%"),
        ('ci("mean energy") < 1e-3  and ci(q90(swarm."a b")) < 2', 'ci("mean energy") < 0.001 and ci(q90(swarm."a b")) < 2'),
    ],
)
def test_a_rule_has_one_form_which_is_read_as_the_same_rule(text: str, written: str) -> None:
    rule = until.parse(text)
    assert str(rule) == written
    assert until.parse(written) == rule


def test_a_relative_limit_is_a_part_of_the_absolute_value() -> None:
    (one,) = until.parse("ci(x) < 5%").conditions
    assert (one.wanted(-2.0), one.wanted(0.0)) == (pytest.approx(0.1), 0.0)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is not a condition"),
        ("coverage < 1", "use, for example, 'ci(coverage) < 0.02'"),
        ("ci(median(x) < 1", "is not a condition"),
        ("ci(x)) < 1", "is not a condition"),
        ("ci(x) < 1 or ci(y) < 1", "is not a condition"),
        ("ci(x) > 1", "so use <"),
        ("ci(x) <= 1", "so use <"),
        ("ci(x) < 0", "a number above 0"),
        ("ci(x) < nan", "a number above 0"),
        ("ci(x) < 1 and ci(mean(x)) < 1", "occurs twice"),
    ],
)
def test_a_text_that_is_no_rule_is_refused_in_one_line(text: str, said: str) -> None:
    with pytest.raises(QueryError, match=r"^--until") as raised:
        until.parse(text)
    assert said in str(raised.value)
    assert "\n" not in str(raised.value)

"""Reasons in words."""

from __future__ import annotations

import pytest

from sierra.cli.render_reasons import BASES, CHANGES, change, new_runs
from sierra.explain.plan_changes import Aspect, Basis, NewRuns, PlanChange


@pytest.mark.parametrize(
    ("found", "line"),
    [
        (PlanChange(Aspect.NO_TEMPLATE, "a.xml"), "the template a.xml is not used any more"),
        (PlanChange(Aspect.NEW_TEMPLATE, "a.xml"), "the template a.xml was added"),
        (PlanChange(Aspect.QUERY, "target", None, "sim"), "target was not set and is 'sim'"),
        (PlanChange(Aspect.AROUND, "before", "'x'", None), "before was \"'x'\" and is not set"),
    ],
)
def test_a_missing_value_has_a_sentence_of_its_own(found: PlanChange, line: str) -> None:
    assert change(found) == line


def test_every_kind_of_difference_has_words() -> None:
    assert set(CHANGES) == set(Aspect)
    assert set(BASES) == set(Basis)


def test_a_line_shows_ten_details_and_counts_the_others() -> None:
    files = tuple(f"f{number}" for number in range(12))
    assert change(PlanChange(Aspect.SOURCE, details=files)).endswith("f8, f9 and 2 more")


def test_a_source_without_recorded_files_has_no_list() -> None:
    assert change(PlanChange(Aspect.SOURCE)) == "the source has changed"


def test_braces_in_values_are_printed_as_they_are() -> None:
    assert change(PlanChange(Aspect.COMMAND, was="sim {input}", now="sim {run}")).endswith("'sim {input}' and is 'sim {run}'")


def test_new_runs_are_compared_with_a_batch() -> None:
    changes = (PlanChange(Aspect.QUERY, "runs", 2, 3),)
    lines = new_runs(NewRuns(Basis.BATCH, "abcdef0123456789", "n=1", changes))
    assert lines == ["compared with batch abcdef0123 (n=1):", "runs was 2 and is 3"]

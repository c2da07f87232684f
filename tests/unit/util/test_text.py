"""Different numbers of a shown table look different."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest

from sierra.cli.output import cell, cells, table
from sierra.explain.diff.model import changed
from sierra.util.html import page
from sierra.util.text import digits_apart, short_number


@pytest.mark.parametrize(
    ("values", "texts"),
    [
        ([868.10001, 868.10002, 1.0], ["868.10001", "868.10002", "1"]),
        ([1000000.0, 1000001.0], ["1000000", "1000001"]),
        ([1500000.0, 1500.0, 0.5], ["1.5e+06", "1500", "0.5"]),
        ([0.1 + 0.2, 0.3, 1e22], ["0.30000000000000004", "0.3", "1e+22"]),
        ([868.1, 868.1, float("nan"), float("nan"), float("inf")], ["868.1", "868.1", "nan", "nan", "inf"]),
    ],
)
def test_different_numbers_of_a_column_have_different_texts(values: list[float], texts: list[str]) -> None:
    digits = digits_apart([*values, None, 7, "text", True])
    assert [short_number(value, digits) for value in values] == texts


def test_each_column_of_a_table_has_its_own_digits(capsys: pytest.CaptureFixture[str]) -> None:
    table(("a", "b"), [(868.10001, 0.123456789), (868.10002, None), (868.10002, 2)])
    assert [line.split() for line in capsys.readouterr().out.splitlines()] == [
        ["a", "b"],
        ["868.10001", "0.123457"],
        ["868.10002"],
        ["868.10002", "2"],
    ]


def test_different_moments_of_a_column_have_different_texts() -> None:
    first, second = (datetime(2020, 1, 1, 0, 0, 0, micro, tzinfo=UTC) for micro in (1, 2))
    assert cells([(first,), (first,)]) == [["2020-01-01 00:00:00+00:00"]] * 2
    assert cells([(first,), (second,)]) == [["2020-01-01 00:00:00.000001+00:00"], ["2020-01-01 00:00:00.000002+00:00"]]


def test_times_of_a_table_have_their_zone_if_they_have_one() -> None:
    assert [cell(datetime(2020, 1, 1, tzinfo=zone)) for zone in (UTC, None)] == [
        "2020-01-01 00:00:00+00:00",
        "2020-01-01 00:00:00",
    ]


def test_pages_and_differences_tell_them_apart_too() -> None:
    shown = page("t", ["v"], [(868.10001,), (868.10002,)])
    assert ("868.10001" in shown, "868.10002" in shown) == (True, True)
    [found] = changed("value", "v", 868.10001, 868.10002)
    assert "868.10001 → 868.10002" in found.line
    [found] = changed("value", "v", {"a": 868.10001}, {"a": 868.10002})
    assert "a 868.10001 → 868.10002" in found.line

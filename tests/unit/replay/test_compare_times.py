"""Times that were recorded as texts are compared with times as times."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sierra.replay.compare_values import Verdict, of_tables

MOMENT = datetime(2026, 11, 30, 12, tzinfo=UTC)


def verdict(texts: list[str | None], times: pa.Array) -> Verdict:
    recorded, found = pa.table({"t": texts}), pa.table({"t": times})
    there, back = of_tables(recorded, found), of_tables(found, recorded)
    assert there.verdict is back.verdict
    return there.verdict


@pytest.mark.parametrize(
    ("text", "verdict_of"),
    [
        ("2026-11-30T12:00Z", Verdict.EQUAL),
        (" 2026-11-30 13:30:00,000+0130", Verdict.EQUAL),
        ("2026-11-30T12:00:00.000000001Z", Verdict.DIFFERENT),
        ("2026-11-30T12:00:00", Verdict.DIFFERENT),
        ("2026-02-30T12:00:00Z", Verdict.DIFFERENT),
        ("n/a", Verdict.DIFFERENT),
    ],
)
def test_texts_mean_times(text: str, verdict_of: Verdict) -> None:
    for unit in ("s", "ms", "us", "ns"):
        assert verdict([text, None], pa.array([MOMENT, None], pa.timestamp(unit, "UTC"))) is verdict_of


@given(st.integers(-(2**62), 2**62))
def test_all_digits_count(nanoseconds: int) -> None:
    moment = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=nanoseconds // 1000)
    text = f"{moment.replace(tzinfo=None).isoformat(timespec='microseconds')}{nanoseconds % 1000:03}"
    assert verdict([text], pa.array([nanoseconds], pa.timestamp("ns"))) is Verdict.EQUAL
    assert verdict([text], pa.array([nanoseconds + 1], pa.timestamp("ns"))) is Verdict.DIFFERENT

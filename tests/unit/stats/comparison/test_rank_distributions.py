"""Ranks are those of SciPy."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from sierra.stats.comparison.rank_distributions import ranked


@given(st.lists(st.floats(allow_nan=False) | st.integers(-3, 3).map(float)))
def test_ranks_are_those_of_scipy(values: list[float]) -> None:
    assert ranked(np.array(values)).tolist() == stats.rankdata(values).tolist()

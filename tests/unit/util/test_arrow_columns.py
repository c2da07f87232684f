"""Columns of Arrow tables become NumPy arrays with the same values, and pandas is not imported for that."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from sierra.util.arrow_columns import filled, numpy_of


@pytest.mark.parametrize(
    "column",
    [
        pa.chunked_array([[1.5, 2.5], [], [float("inf")]], pa.float64()),
        pa.chunked_array([[1, 2], [2**62 + 1]], pa.int64()),
        pa.chunked_array([[None, 1.5], [2.5, None, float("nan")]], pa.float64()),
        pa.chunked_array([[1, None, 3]], pa.int32()),
        pa.chunked_array([], pa.float64()),
        pa.chunked_array([list(range(20))], pa.float64()).slice(3, 9),
        pa.chunked_array([[*range(9), None, *range(9)]], pa.float64()).slice(3, 9),
        pa.chunked_array([[True, False]]),
    ],
)
def test_values_are_those_of_pyarrow(column: Any) -> None:
    found, expected = numpy_of(column), column.to_numpy()
    assert found.dtype == expected.dtype
    np.testing.assert_array_equal(found, expected)


def test_missing_whole_numbers_are_filled_without_rounding_the_others() -> None:
    assert filled(pa.array([2**62 + 1, None]), 0).tolist() == [2**62 + 1, 0]


def test_pandas_is_not_imported() -> None:
    code = (
        "import duckdb, sys; from sierra.util.arrow_columns import numpy_of; "
        "t = duckdb.sql('SELECT unnest([1.5::DOUBLE, NULL]) AS a, 2 AS b').to_arrow_table(); "
        "print(numpy_of(t.column('a')), numpy_of(t.column('b')), 'pandas' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[1.5 nan] [2 2] False\n"

"""A lack of permission names the file."""

from __future__ import annotations

import re

import duckdb
import pytest

from sierra.errors import Missing
from sierra.store.duckdb_messages import check_shortage


@pytest.mark.parametrize("text", ["Permission denied", "Operation not permitted"])
def test_a_lack_of_permission_names_the_file(text: str) -> None:
    error = duckdb.IOException(f'IO Error: Cannot open file "/a/b.parquet": {text}\nmore')
    with pytest.raises(
        Missing, match=re.escape(f'the store cannot be read: {text} (IO Error: Cannot open file "/a/b.parquet"')
    ):
        check_shortage(error)

"""Rows of SQL that are read without Arrow have the same values as with Arrow."""

from __future__ import annotations

import subprocess
import sys
from datetime import UTC, date, datetime
from pathlib import Path

import pytest

from sierra.cli.output import as_json
from sierra.store.store import Store
from tests.projects import quick

VALUES = [
    "1::BIGINT",
    "-7::TINYINT",
    "1.5::DOUBLE",
    "'nan'::DOUBLE",
    "12.34::DECIMAL(10, 2)",
    "true",
    "'a text'",
    "NULL",
    "TIMESTAMPTZ '2024-02-29 12:34:56.123456+02'",
    "TIMESTAMPTZ '1901-01-01 00:00:00+00'",
    "NULL::TIMESTAMPTZ",
    "TIMESTAMP '2024-02-29 12:34:56.123456'",
    "DATE '2024-02-29'",
    "'ab'::BLOB",
    "[1, 2, NULL]",
    "['a', 'b']",
    "{'a': 1, 'b': 'x'}",
    "[TIMESTAMPTZ '2024-02-29 12:34:56+00']",
]


@pytest.mark.parametrize("value", VALUES)
def test_a_row_has_the_same_values_as_with_arrow(recorded: Path, value: str) -> None:
    store, text = Store(recorded / ".sierra"), f"SELECT {value} AS v, {value} AS w ORDER BY 1"
    assert as_json(store.rows(text)) == as_json(store.sql(text).to_pylist())


BEYOND = {
    "'20000-01-01 00:00:00+00'::TIMESTAMPTZ": "20000-01-01 00:00:00+00",
    "'-infinity'::TIMESTAMPTZ": "-infinity",
    "'infinity'::DATE": "infinity",
    "'20000-01-01'::DATE": "20000-01-01",
    "'0044-03-15 (BC)'::DATE": "0044-03-15 (BC)",
    "'infinity'::TIMESTAMP": "infinity",
    "'infinity'::TIMESTAMP_S": "infinity",
    "'infinity'::TIMESTAMP_MS": "infinity",
    "'-infinity'::TIMESTAMP_NS": "-infinity",
    "['infinity'::DATE, '2020-01-01'::DATE]": "[infinity, 2020-01-01]",
    "{'a': '20000-01-01'::TIMESTAMP}": "{'a': '20000-01-01 00:00:00'}",
    "'24:00:00'::TIME": "24:00:00",
    "'12:00:00+02'::TIMETZ": "12:00:00+02",
    "'101'::BIT": "101",
}
"""Values that Python cannot hold, with their texts."""


@pytest.mark.parametrize("value", BEYOND)
@pytest.mark.parametrize("other", ["1", "{'a': 1}", "TIMESTAMPTZ '2024-02-29 12:00:00+00'"])
def test_a_time_that_python_cannot_hold_is_a_text(recorded: Path, value: str, other: str) -> None:
    found = Store(recorded / ".sierra").rows(f"SELECT {other} AS a, unnest([{value}, NULL]) AS v, {other} AS b")
    assert [row["v"] for row in found] == [BEYOND[value], None]
    assert [row["a"] for row in found] == [row["b"] for row in found] != [None, None]


def test_the_first_and_the_last_times_of_python_are_no_texts(recorded: Path) -> None:
    [row] = Store(recorded / ".sierra").rows(
        "SELECT DATE '0001-01-01' AS a, DATE '9999-12-31' AS b, TIMESTAMP '9999-12-31 23:59:59.999999' AS c, "
        "TIMESTAMPTZ '0001-01-01 00:00:00+00' AS d, TIMESTAMPTZ '9999-12-31 23:59:59.999999+00' AS e"
    )
    first, last = datetime.min.replace(tzinfo=UTC), datetime.max.replace(tzinfo=UTC)
    assert [*row.values()] == [date.min, date.max, last.replace(tzinfo=None), first, last]


def test_columns_with_equal_names_are_kept(recorded: Path) -> None:
    text = "SELECT 1 AS a, 2 AS a, now() AS a"
    assert list(Store(recorded / ".sierra").rows(text)[0]) == ["a", "a_1", "a_2"]
    assert quick(recorded, "sql", text, "--format", "csv").stdout.splitlines()[0] == "a,a_1,a_2"


@pytest.mark.integration
@pytest.mark.parametrize("words", [("ls",), ("status",), ("sql", "SELECT run, started FROM executions")])
def test_commands_with_few_rows_load_neither_pyarrow_nor_numpy(recorded: Path, words: tuple[str, ...]) -> None:
    code = (
        "import sys\nfrom sierra.cli.main import main\nsys.argv = ['sierra', *sys.argv[1:]]\n"
        "try:\n    main()\nexcept SystemExit as end:\n    assert not end.code\n"
        "print(*sorted({'pyarrow', 'numpy', 'pandas', 'lxml', 'matplotlib'} & sys.modules.keys()), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code, *words], cwd=recorded, capture_output=True, text=True, check=True)
    assert done.stderr == "\n"

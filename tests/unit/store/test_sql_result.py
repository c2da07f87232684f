"""Rows of SQL that are read without Arrow have the same values as with Arrow."""

from __future__ import annotations

import subprocess
import sys
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


def test_columns_with_equal_names_are_kept(recorded: Path) -> None:
    text = "SELECT 1 AS a, 2 AS a, now() AS a"
    assert list(Store(recorded / ".sierra").rows(text)[0]) == ["a", "a_1", "a_2"]
    assert quick(recorded, "sql", text, "--format", "csv").stdout.splitlines()[0] == "a,a_1,a_2"


@pytest.mark.parametrize("words", [("ls",), ("status",), ("sql", "SELECT run, started FROM executions")])
def test_commands_with_few_rows_load_neither_pyarrow_nor_numpy(recorded: Path, words: tuple[str, ...]) -> None:
    code = (
        "import sys\nfrom sierra.cli.main import main\nsys.argv = ['sierra', *sys.argv[1:]]\n"
        "try:\n    main()\nexcept SystemExit as end:\n    assert not end.code\n"
        "print(*sorted({'pyarrow', 'numpy', 'pandas', 'lxml', 'matplotlib'} & sys.modules.keys()), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code, *words], cwd=recorded, capture_output=True, text=True, check=True)
    assert done.stderr == "\n"

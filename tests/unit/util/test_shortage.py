"""A lack of anything is told from all other errors, whoever reports it."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import duckdb
import pyarrow as pa
import pytest

from sierra.errors import Damaged, Missing
from sierra.util.shortage import REMEDIES, UNSTEADY, lacking, shortage, system_errors


@pytest.mark.parametrize("number", REMEDIES)
def test_each_lack_is_known_from_the_system_and_from_libraries(number: int) -> None:
    text = os.strerror(number)
    for error in (
        OSError(number, text),
        duckdb.IOException(f'IO Error: Cannot open file "x": {text}'),
        OSError(f"Failed: {text}"),
    ):
        assert lacking(error) == number
        assert str(shortage(error)).startswith(text)


@pytest.mark.parametrize("number", UNSTEADY)
def test_errors_of_a_file_system_are_known_behind_others(number: int) -> None:
    text = os.strerror(number)
    for cause in (OSError(number, text), duckdb.IOException(f"IO Error: {text}"), OSError(f"Failed: {text}")):
        error = Damaged("cannot be read")
        error.__cause__ = cause
        assert system_errors(error) == {number}
    assert system_errors(ValueError(text)) == set()


def test_memory_processes_and_causes_are_known() -> None:
    assert (
        lacking(MemoryError()) == lacking(pa.ArrowMemoryError("x")) == lacking(duckdb.OutOfMemoryException("x")) == errno.ENOMEM
    )
    assert lacking(RuntimeError("can't start new thread")) == errno.EAGAIN
    wrapped = Missing("cannot write")
    wrapped.__cause__ = OSError(errno.EMFILE, "Too many open files")
    assert "ulimit -n" in str(shortage(wrapped))


@pytest.mark.parametrize(
    "error",
    [
        *(OSError(errno.ENOENT, "x"), OSError(errno.EIO, "x"), ValueError("Permission denied"), Damaged("Permission denied")),
        duckdb.InvalidInputException("Permission denied"),  # the text of a statement
        *(duckdb.Error("x"), RuntimeError("x"), FileNotFoundError(Path("x"))),
    ],
)
def test_other_errors_are_no_lack(error: Exception) -> None:
    assert shortage(error) is None

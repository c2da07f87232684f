"""Lacks of the system: open files, memory, space, processes, permissions. None of them is ever damage."""

from __future__ import annotations

import errno
import os
from collections.abc import Collection, Iterator

REMEDIES = {
    errno.EMFILE: "allow more (ulimit -n)",
    errno.ENFILE: "close other programs",
    errno.ENOMEM: "free memory, or allow more (ulimit -v)",
    errno.EAGAIN: "allow more processes (ulimit -u), or try again",
    errno.ENOSPC: "",
    errno.EDQUOT: "",
    errno.EROFS: "",
    errno.EACCES: "",
    errno.EPERM: "",
    errno.ESTALE: "try again",
    errno.ETIMEDOUT: "try again",
}
"""The error numbers of a lack, each with what the user can do."""
PASSING = frozenset((errno.EMFILE, errno.ENFILE, errno.EAGAIN, errno.ENOSPC, errno.EDQUOT, errno.ESTALE, errno.ETIMEDOUT))
"""Lacks that have nothing to do with the file that is read: a later attempt to read it succeeds."""
UNSTEADY = (errno.EIO, errno.ESTALE, errno.ETIMEDOUT, errno.ENOLCK, errno.EBUSY, errno.EHOSTDOWN)
"""Errors of a file system that may fail for a moment only."""
FOREIGN = ("duckdb", "_duckdb", "pyarrow")
"""The packages whose errors have the system's message in their text; others of DuckDB's errors are about a statement."""
OF_SYSTEM = ("Error", "IOException", "ArrowException", "ArrowInvalid")


def shortage(error: BaseException) -> str | None:
    """Return what was lacking when an error was raised, and what to do about it; None for any other error."""
    number = lacking(error)
    return None if number is None else "; ".join(filter(None, (os.strerror(number), REMEDIES[number])))


def lacking(error: BaseException) -> int | None:
    """Return the number of the system's error for what was lacking when an error was raised; None for any other error."""
    return next((number for one in _causes(error) if (number := _number(one)) is not None), None)


def system_errors(error: BaseException) -> set[int]:
    """Return the numbers of the system's errors behind an error; of those in the texts of libraries, only `UNSTEADY` ones."""
    numbers = (_system_number(one) or _number(one, UNSTEADY) for one in _causes(error))
    return {number for number in numbers if number is not None}


def _system_number(error: BaseException) -> int | None:
    return error.errno if isinstance(error, OSError) else None


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__


def _length(number: int) -> int:
    """Return the length of the system's message: one message is the beginning of another one."""
    return len(os.strerror(number))


def _number(error: BaseException, numbers: Collection[int] = REMEDIES.keys()) -> int | None:
    """Return the number of the system's error that says what is lacking, if it is one of these."""
    if isinstance(error, OSError) and error.errno in numbers:
        return error.errno
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryException":
        return errno.ENOMEM
    text = str(error)
    if isinstance(error, RuntimeError) and "can't start new thread" in text:
        return errno.EAGAIN
    foreign = type(error).__module__.partition(".")[0] in FOREIGN and type(error).__name__ in OF_SYSTEM
    if foreign or (isinstance(error, OSError) and error.errno is None):
        return max((number for number in numbers if os.strerror(number) in text), key=_length, default=None)
    return None

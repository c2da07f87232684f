"""One tree of errors; each carries the exit code with which the command line ends.

Exit codes: 0 fine, 1 failed or different, 2 usage, 3 something needed is missing, 130 interrupted.
A message is one line that says what is wrong, which one, and what would be right.
"""

from __future__ import annotations


class SierraError(Exception):
    """What SIERRA says to a user instead of a traceback."""

    exit_code = 1


class UsageError(SierraError):
    """What was asked for is not well formed."""

    exit_code = 2


class QueryError(UsageError):
    """A research query that cannot be read, or asks for what does not exist."""


class ConfigError(UsageError):
    """`sierra.toml` is not as it should be."""


class TemplateError(UsageError):
    """A template that cannot be read, or a change that does not fit it."""


class NotFound(UsageError):
    """A hash or a name that names nothing, or more than one thing."""


class SqlError(UsageError):
    """A statement that DuckDB refuses."""


class Missing(SierraError):
    """Something that is needed is not there: a program, a file, a right, room on the disk."""

    exit_code = 3


class Full(Missing):
    """A scheduler takes no more jobs for now."""


class Damaged(SierraError):
    """What is recorded is not what was recorded."""

"""The tree of SIERRA's errors. Each class carries the exit code with which the command line ends.

Exit codes: 0 success, 1 failure or difference, 2 usage error, 3 something needed is missing or in use, 130 interrupted. A
message is one line: what is wrong, which thing is wrong, and what to do.
"""

from __future__ import annotations


class SierraError(Exception):
    """An error that is shown to the user as one line, without a traceback."""

    exit_code = 1


class UsageError(SierraError):
    """Invalid input from the user."""

    exit_code = 2


class QueryError(UsageError):
    """A research query that cannot be parsed, or that refers to something that does not exist."""


class ConfigError(UsageError):
    """An invalid `sierra.toml`."""


class PluginError(ConfigError):
    """A plug-in of another package that cannot be used."""


class PluginRefused(PluginError):
    """A plug-in that may not be imported here: it is code of a package."""


class TemplateError(UsageError):
    """A template that cannot be read, or a change that does not fit it."""


class NotFound(UsageError):
    """An unknown or ambiguous hash or name."""


class Identifying(UsageError):
    """Contents of an anonymous package that name people or machines."""

    def __init__(self, message: str, places: tuple[str, ...]) -> None:
        """`places`: one line for each place."""
        super().__init__(message)
        self.places = places


class SqlError(UsageError):
    """A SQL statement that DuckDB rejects."""


class Missing(SierraError):
    """A missing requirement: a program, a file, a permission, space on the disk."""

    exit_code = 3


class NotInstalled(Missing):
    """A Python package of an extra that is not installed."""


class Full(Missing):
    """A scheduler that accepts no more jobs for now."""


class Busy(SierraError):
    """A store or folder that another process uses; the same command works when that has finished."""

    exit_code = 3


class Damaged(SierraError):
    """A record that differs from what was recorded."""


class DamagedFile(Damaged):
    """A file of the store that is not the one that SIERRA wrote: no answer may leave it out."""

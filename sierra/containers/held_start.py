"""The start of a container before its program begins, so that programs of several hosts begin at the same time.

An engine takes some tenths of a second to start a container. Therefore a shell in the container first waits for a line from a
named pipe in the run's folder, and then becomes the program: it keeps its process id, its environment and its open files. The
worker on the host can open the pipe for writing when the shell waits, writes the line at the common start, and closes the pipe
without a line if there is none (`worker.containers.HeldContainer`). An image without a shell starts its programs at once.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from sierra.containers.engines.base import HERE, RUN
from sierra.model import Result
from sierra.util.lazy_definitions import regex

SHELL = "/bin/sh"
PIPE = ".start"
NAME = "sierra-start"
"""The name under which the shell reports errors."""
WAIT = 'read -r {line} < "$1" && shift && unset {variables} && exec "$@"'
LINE = "SIERRA_START"
ADDED = ("OLDPWD", "PWD")
"""The variables that shells add to the environment of programs. (bash also adds SHLVL, and does not let it be removed.)"""
VALID = regex(r"[A-Za-z_][A-Za-z0-9_]*")
NOT_STARTED = (126, 127)
REASON = regex(rf"{NAME}: (?:(?:line )?\d+: )?(?:exec: )?(?:line \d+: )?(.*)")


def host_pipe() -> str:
    """Return the path of the pipe on the host, with NUL for the run's folder."""
    return f"{HERE}/{PIPE}"


def passes(variables: Mapping[str, str]) -> bool:
    """Return whether a shell passes all variables to the program: some shells drop those whose names are not valid for them."""
    return all(map(VALID.fullmatch, variables))


def waiting(argv: tuple[str, ...], variables: Mapping[str, str]) -> tuple[str, ...]:
    """Return the command that waits in a container and then becomes the program `argv`, with these variables."""
    unset = " ".join((LINE, *(name for name in ADDED if name not in variables)))
    return (SHELL, "-c", WAIT.format(line=LINE, variables=unset), NAME, f"{RUN}/{PIPE}", *argv)


def classify(result: Result, stderr: str) -> Result:
    """Return a result with the error of a shell that could not become the program. `stderr`: its end."""
    last = (stderr.strip().splitlines() or [""])[-1]
    if result.exit_code in NOT_STARTED and (match := REASON.fullmatch(last)):
        return replace(result, exit_code=None, error=f"the command cannot be started in the container: {match[1]}")
    return result

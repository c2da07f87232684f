"""Command lines for hosts, framed so that their output and exit status are exact whatever a login shell prints.

A command is executed by `sh`, which writes a mark before the command begins, and the mark with the exit status after it
ended, to standard output and to standard error. Everything before and after is dropped. So a command ends when the program
ends, even if processes that it left in the background keep the output open; a lost connection is never taken for an end; and
no exit status of the client is taken for one of the command.
"""

from __future__ import annotations

import math
import secrets
import shlex
from collections.abc import Sequence

SCRIPT = (
    'printf %s: "$0"; printf %s: "$0" >&2; "$@"; set -- $?; printf "%s.%d\\n" "$0" $1; printf "%s.%d\\n" "$0" $1 >&2; exit $1'
)
"""The script's name is the mark, and its arguments are the command."""
ALONE = f"exec </dev/null; {SCRIPT}"
"""The script for a command without input."""
GRACE_S = 1
DIGITS = 3
"""The most digits of an exit status."""


def new_mark() -> str:
    """Return a mark that no output contains by chance."""
    return f"sierra-{secrets.token_hex(16)}"


def line(argv: Sequence[str], mark: str, timeout: float | None = None, *, alone: bool = False) -> str:
    """Return the command line of a command.

    `timeout`: seconds after which the host itself ends it. `alone`: its input is empty, so that nobody has to end it. sshd ends
    a connection in which the end of a command's input comes after the end of the command.
    """
    limit = ["timeout", "-k", str(GRACE_S), str(math.ceil(timeout) + GRACE_S)] if timeout is not None else []
    return shlex.join(["exec", "sh", "-c", ALONE if alone else SCRIPT, mark, *limit, *argv])


class Unframed:
    """The payload of one of the two outputs."""

    def __init__(self, mark: str) -> None:
        self._mark = mark.encode()
        self._held = b""
        self.begun = False
        self.status: int | None = None

    @property
    def before(self) -> str:
        """The output that came although the command never began: the words of a login shell."""
        return "" if self.begun else " ".join(self._held.decode(errors="replace").split())

    def feed(self, data: bytes) -> bytes:
        """Return what belongs to the command, as far as that is certain. Raises ValueError for a status that is no number."""
        if self.status is not None:
            return b""
        held = self._held + data
        if not self.begun:
            _, separator, rest = held.partition(self._mark + b":")
            if not separator:
                self._held = held[-(1 << 14) :]
                return b""
            self.begun, held = True, rest
        payload, separator, rest = held.partition(self._mark + b".")
        if separator and (b"\n" in rest or len(rest) > DIGITS):
            self.status = int(rest.split(b"\n")[0])
            return payload
        if not separator:
            kept = _beginning(held, self._mark + b".")
            payload = held[: len(held) - kept]
        self._held = held[len(payload) :]
        return payload


def _beginning(data: bytes, mark: bytes) -> int:
    """Return how many bytes at the end of `data` may be the beginning of the mark."""
    return next((n for n in range(min(len(mark) - 1, len(data)), 0, -1) if data.endswith(mark[:n])), 0)

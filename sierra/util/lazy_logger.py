"""Messages for the logger `sierra`, which the option -v, a session's log file and a program of the user's may listen to.

A module says `log = Log(__name__)`. As long as nothing has imported `logging`, nothing can listen: then a message costs one
look-up, and commands that need no log do not import `logging`. Messages hold no values of environment variables: `shown`
leaves them out of commands.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence

from sierra.util.lazy_definitions import regex

DEBUG, INFO, WARNING = 10, 20, 30
SECRET = regex(r"(?i)(--?[\w-]*(?:pass|token|secret|key|cred|auth)[\w-]*=)(.+)", re.DOTALL)
ASSIGNED = regex(r"((?:--[\w-]+=)?(?:[\w-]+,)*[A-Za-z_]\w*=)(.*)", re.DOTALL)
USER = regex(r"//[^/@\s]*@")


class Log:
    """The messages of one module."""

    __slots__ = ("_name",)

    def __init__(self, name: str) -> None:
        self._name = name

    def debug(self, text: str, *values: object) -> None:
        """Log a detail: a command, the result of one run."""
        self._log(DEBUG, text, values)

    def info(self, text: str, *values: object) -> None:
        """Log an event: the begin and end of a session, a submission, a takeover."""
        self._log(INFO, text, values)

    def warning(self, text: str, *values: object) -> None:
        """Log something that went wrong and that SIERRA handles: a retry, a repair."""
        self._log(WARNING, text, values)

    def command(self, argv: Sequence[str], status: object, output: str = "") -> None:
        """Log a command with its exit status; if that is not 0, also with the end of its error output."""
        if "logging" in sys.modules:
            more = f": {output.strip()[-500:]}" if status and output.strip() else ""
            self._log(DEBUG, "%s: exit %s%s", (shown(argv), status, more))

    def _log(self, level: int, text: str, values: tuple[object, ...]) -> None:
        logging = sys.modules.get("logging")
        if logging is not None and (logger := logging.getLogger(self._name)).hasHandlers():
            logger.log(level, text, *values)


def shown(argv: Sequence[str]) -> str:
    """Return a command as one line that a shell would accept, without values of variables, passwords and users of URLs."""
    import shlex

    return shlex.join(_shown(word) for word in argv)


def _shown(word: str) -> str:
    for pattern in (SECRET, ASSIGNED):
        if (found := pattern.fullmatch(word)) and not _is_option(found[1]):
            return f"{found[1]}…"
    return USER.sub("//…@", word.replace("\0", "RUN"))


def _is_option(text: str) -> bool:
    """Check that a text is an option such as `--time=`, whose value is neither secret nor a variable's."""
    return text.startswith("--") and text.count("=") == 1 and not SECRET.fullmatch(f"{text}x")

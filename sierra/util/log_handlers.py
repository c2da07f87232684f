"""Listeners to the logger `sierra`. Importing this module imports `logging`; see `sierra.util.lazy_logger`."""

from __future__ import annotations

import contextlib
import logging
import sys
import time
from collections.abc import Callable

ROOT = "sierra"
CONTROL = {code: f"\\x{code:02x}" for code in (*range(32), *range(0x7F, 0xA0))} | {10: "\\n", 9: "\t"}
"""Replacements that keep each message on one line."""


class Lines(logging.Formatter):
    """The format of a log file: time in UTC, level, module, message; one line for each message."""

    default_msec_format = "%s.%03dZ"
    default_time_format = "%Y-%m-%dT%H:%M:%S"

    def __init__(self) -> None:
        super().__init__("%(asctime)s %(levelname)-7s %(process)d %(name)s: %(message)s")
        self.converter = time.gmtime

    def format(self, record: logging.LogRecord) -> str:
        return super().format(record).translate(CONTROL)


class Stderr(logging.Handler):
    """Prints messages to standard error, whatever that is when they come."""

    def __init__(self, level: int) -> None:
        super().__init__(level)
        self.setFormatter(logging.Formatter("%(levelname)s %(name)s: %(message)s"))

    def emit(self, record: logging.LogRecord) -> None:
        with contextlib.suppress(OSError, ValueError):
            print(self.format(record), file=sys.stderr, flush=True)


class _Upwards(logging.Handler):
    """Passes messages to the handlers of the program that uses SIERRA, as if nobody else were listening."""

    def __init__(self, logger: logging.Logger) -> None:
        self.before, self.propagate = logger.level, logger.propagate
        super().__init__(logger.getEffectiveLevel())

    def emit(self, record: logging.LogRecord) -> None:
        root = logging.getLogger()
        if self.propagate and root.handlers:
            root.callHandlers(record)


def listen(handler: logging.Handler) -> Callable[[], None]:
    """Send all messages of SIERRA to a handler too; return a function that ends this."""
    logger = logging.getLogger(ROOT)
    upwards = next((existing for existing in logger.handlers if isinstance(existing, _Upwards)), None)
    if upwards is None:
        upwards = _Upwards(logger)
        logger.addHandler(upwards)
        logger.propagate = False
        logger.setLevel(logging.DEBUG)
    logger.addHandler(handler)

    def end() -> None:
        logger.removeHandler(handler)
        if logger.handlers == [upwards]:
            logger.removeHandler(upwards)
            logger.setLevel(upwards.before)
            logger.propagate = upwards.propagate

    return end

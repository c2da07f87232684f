"""The means of all conformance suites: claims, waiting, and the claims about options, which are the same for all plug-ins."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterator

from sierra.config.field_types import Table
from sierra.config.validate import options
from sierra.errors import ConfigError

OPTION_NOBODY_HAS = "no_plugin_has_an_option_of_this_name"


def holds(condition: bool, otherwise: str) -> None:
    """Raise AssertionError if a claim is broken, even if Python runs with `-O`."""
    if not condition:
        raise AssertionError(otherwise)


def is_one_line(text: str) -> None:
    holds(len(text.splitlines()) == 1, f"{text!r} is not one line")


def wait(condition: Callable[[], bool], otherwise: Callable[[], str], seconds: float, pause: float = 0.02) -> None:
    """Wait until a condition is true; `otherwise` makes the message if that takes too long."""
    give_up = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > give_up:
            raise AssertionError(otherwise())
        time.sleep(pause)


@contextlib.contextmanager
def variable(name: str, value: str = "1") -> Iterator[None]:
    """Set a variable of this process for a while."""
    os.environ[name] = value
    try:
        yield
    finally:
        del os.environ[name]


def says_what_its_options_are(plugin: object, base: type[Table] = Table) -> None:
    """Check that `Options` of a class or an object is a table that refuses unknown options in one line."""
    model: object = getattr(plugin, "Options", None)
    if not (isinstance(model, type) and issubclass(model, base)):
        raise AssertionError(f"Options is {model!r}, not a subclass of {base.__name__}")
    try:
        options(model, {OPTION_NOBODY_HAS: 1}, "[…]")
    except ConfigError as error:
        is_one_line(str(error))
        return
    raise AssertionError(f"Options accepts the unknown option {OPTION_NOBODY_HAS!r}")

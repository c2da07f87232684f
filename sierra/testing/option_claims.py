"""The claims of the conformance suites about options, which are the same for all kinds of plug-ins."""

from __future__ import annotations

from typing import Any

from sierra.config.project_file import Table, options
from sierra.errors import ConfigError

OPTION_NOBODY_HAS = "no_plugin_has_an_option_of_this_name"


def says_what_its_options_are(plugin: Any, base: type[Table] = Table) -> None:
    """Check that `Options` of a class or an object is a table that refuses unknown options in one line."""
    model: Any = plugin.Options
    holds(isinstance(model, type) and issubclass(model, base), f"Options is {model!r}, not a subclass of {base.__name__}")
    try:
        options(model, {OPTION_NOBODY_HAS: 1}, "[…]")
    except ConfigError as error:
        is_one_line(str(error))
        return
    raise AssertionError(f"Options accepts the unknown option {OPTION_NOBODY_HAS!r}")


def is_one_line(text: str) -> None:
    holds(len(text.splitlines()) == 1, f"{text!r} is not one line")


def holds(condition: bool, otherwise: str) -> None:
    """Raise AssertionError if a claim is broken, even if Python runs with `-O`."""
    if not condition:
        raise AssertionError(otherwise)

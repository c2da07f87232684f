"""The keys of `[figures.NAME]` that depend on its kind: those of its own, and those shared ones that it uses."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from sierra.config import extensions
from sierra.config.validate import options
from sierra.errors import ConfigError, PluginRefused

if TYPE_CHECKING:
    from sierra.config.deliverable_tables import Figure

CHOSEN = frozenset(
    {"times", "measure", "center", "band", "quantiles", "x", "series", "facet"}
    | {"log_x", "log_y", "xlim", "ylim", "palette", "labels", "legend", "panel_titles"}
)
"""The keys of figures that have an effect on some kinds only: each kind says which in `uses`."""
FOLLOWS = {"palette": "legend", "facet": "panel_titles"}
"""Keys that a kind has because it has another one."""


def check(figures: Mapping[str, Figure]) -> None:
    """Check the keys of all figures. Raises ConfigError, and PluginError if a kind of another package cannot be used.

    A kind in a file of a received package is not checked: only drawing it is an error, so that other figures can be drawn.
    """
    for name, figure in figures.items():
        with suppress(PluginRefused):
            if wrong := complaint(figure):
                raise ConfigError(f"[figures.{name}]: {wrong}")


def complaint(figure: Figure) -> str:
    """Return what is wrong with the keys of a figure for its kind, in one line; empty if nothing is."""
    from sierra.config.plugin_registry import FIGURES

    if figure.kind not in FIGURES.names():
        return FIGURES.unknown(figure.kind)
    kind = FIGURES.load(figure.kind)
    shared = {field.alias or name for name, field in type(figure).model_fields.items()}
    for key in figure.own:
        if key not in kind.Options.model_fields:
            return f"unknown key {key!r}{_nearest(key, sorted(shared | kind.Options.model_fields.keys()), figure.kind)}"
    uses = kind.uses | ({"times"} if figure.measure == "time_mean" else set())
    uses |= {new for old, new in FOLLOWS.items() if old in kind.uses}
    for key in sorted(CHOSEN & figure.model_fields_set - uses):
        return f'"{key}" needs kind {_having(key)}, not {figure.kind!r}'
    try:
        options(kind.Options, figure.own, f"kind {figure.kind!r}")
    except ConfigError as error:
        return str(error)
    return ""


def complaint_if_shipped(figure: Figure) -> str:
    """Return what is wrong with a figure as far as it is known without other packages and absent extensions."""
    from sierra.config.plugin_registry import FIGURES

    if figure.kind in FIGURES.shipped:
        return complaint(figure)
    known = FIGURES.names()
    if figure.kind in (*known, *extensions.every("figures")):
        return ""
    return f"unknown kind {figure.kind!r}{_nearest(figure.kind, list(known), '')}"


def _nearest(name: str, known: list[str], kind: str) -> str:
    close = difflib.get_close_matches(name, known, 1, cutoff=0.6)
    if close:
        return f"; did you mean {close[0]!r}?"
    return f"; {f'keys of kind {kind!r}' if kind else 'known'} are {', '.join(known)}"


def _having(key: str) -> str:
    """Return the shipped kinds that use a key."""
    from sierra.config.plugin_registry import FIGURES

    kinds: dict[str, Any] = {name: FIGURES.load(name) for name in FIGURES.shipped}
    first, *others = [f'"{name}"' for name, kind in kinds.items() if key in kind.uses]
    return " or ".join([", ".join([first, *others[:-1]]), *others[-1:]])

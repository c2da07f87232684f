"""Commands that are made when they are first used.

Making all commands takes a tenth of the time of `sierra ls`, and most calls need one command.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib import import_module
from typing import TYPE_CHECKING

import typer

from sierra.cli import lazy_parameters

if TYPE_CHECKING:
    from typer._click.core import Command


class Commands(Mapping[str, "Command"]):
    """The commands by name, made from functions and groups that are named as `module:attribute`."""

    def __init__(self, places: Mapping[str, str]) -> None:
        self._places = places
        self._made: dict[str, Command] = {}

    def __getitem__(self, name: str) -> Command:
        if name not in self._made:
            self._made[name] = _command(name, self._places[name])
        return self._made[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._places)

    def __len__(self) -> int:
        return len(self._places)


def _command(name: str, place: str) -> Command:
    """Import and return one command or group of commands."""
    module, _, attribute = place.partition(":")
    found = getattr(import_module(module), attribute)
    if isinstance(found, typer.Typer):
        return typer.main.get_group(found)
    alone = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
    alone.command(name, cls=lazy_parameters.Command)(found)
    return typer.main.get_command(alone)

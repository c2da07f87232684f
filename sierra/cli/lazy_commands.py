"""Commands that are made when they are first used.

Making all commands takes a tenth of the time of `sierra ls`, and most calls need one command.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, NamedTuple

import typer

from sierra.cli import lazy_parameters

if TYPE_CHECKING:
    from pathlib import Path

    from typer._click.core import Command

    from sierra.api import Project
    from sierra.store.export_recorded_files import Outcome


class Beside(NamedTuple):
    """An option of an extension that writes more beside the files that `sierra show --to` writes."""

    option: str
    write: Callable[[Project, Sequence[Outcome], Path], None]


class Commands(Mapping[str, "Command"]):
    """The commands by name, made from functions and groups that are named as `module:attribute`.

    Extensions add commands: they are asked when a name is not known, and when all names are wanted. `group` begins the names of
    those that belong here, as in `open video`. `former` are names that work and are listed nowhere, see `app.FORMER`.
    """

    def __init__(self, places: Mapping[str, str], group: str = "", former: Mapping[str, tuple[str, str]] | None = None) -> None:
        self._places = places
        self._former = former or {}
        self._group = group
        self._made: dict[str, Command] = {}

    def __getitem__(self, name: str) -> Command:
        if name not in self._made:
            place = self._places.get(name) or self._former.get(name, ("",))[0] or self._added(former=True)[name]
            self._made[name] = _with_options(_command(name, place), f"{self._group}{name} ")
        return self._made[name]

    def __iter__(self) -> Iterator[str]:
        return iter((*self._places, *sorted(self._added())))

    def __len__(self) -> int:
        return len(self._places) + len(self._added())

    def _added(self, *, former: bool = False) -> Mapping[str, str]:
        from sierra.config.extensions import added

        every = ({**added("commands"), **added("former")} if former else added("commands")).items()
        own = {name.removeprefix(self._group): place for name, place in every if name.startswith(self._group)}
        return {name: place for name, place in own.items() if " " not in name}


def _with_options(command: Command, words: str) -> Command:
    """Add the options that extensions have for a command. Each is a function; `given` returns its values."""
    from sierra.config.extensions import added

    if isinstance(command, lazy_parameters.Command):
        command.more = tuple(partial(_add, name, place) for name, place in added("options").items() if name.startswith(words))
    return command


def _add(name: str, place: str, command: Command) -> None:
    more = _command(name, place)
    more.params = [option for option in more.params if option.name != "help"]
    command.params += more.params
    command.callback = _both(command.callback, more)


def _both(own: Callable[..., object] | None, more: Command) -> Callable[..., object]:
    from sierra.config.extensions import giving

    names = {option.name for option in more.params}

    def both(**values: object) -> object:
        assert own  # noqa: S101
        assert more.callback  # noqa: S101
        result = more.callback(**{name: value for name, value in values.items() if name in names})
        with giving(result):
            return own(**{name: value for name, value in values.items() if name not in names})

    return both


def _command(name: str, place: str) -> Command:
    """Import and return one command or group of commands."""
    module, _, attribute = place.partition(":")
    found = getattr(import_module(module), attribute)
    if isinstance(found, typer.Typer):
        return typer.main.get_group(found)
    alone = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
    alone.command(name, cls=lazy_parameters.Command)(found)
    return typer.main.get_command(alone)

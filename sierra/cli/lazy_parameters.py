"""Commands that start without pydantic if their arguments need no conversion.

Typer makes a pydantic adapter for each parameter, even for one that was not given, and pydantic takes as long to load as
most commands take to run. Here an adapter is made only for a value that needs it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from typer.core import TyperCommand, TyperGroup

from sierra.util.lazy_definitions import regex

if TYPE_CHECKING:
    from typer._click.core import Context, Parameter
    from typer.core import TyperArgument, TyperOption


class _Converter:
    """Converts the values of one parameter; typer calls `coerce`."""

    def coerce(self, value: object, param: TyperArgument | TyperOption, ctx: Context) -> object:
        """Return a value as the command takes it. Raises typer's error for a wrong value."""
        if value is None:
            return () if param.multiple or param.nargs == -1 else None
        if param.type_descriptor.parameter_info.parser is None:
            annotation = param.type_descriptor.annotation
            if _is_plain(value, annotation):
                return value
            if annotation == list[str] and isinstance(value, tuple) and all(_is_plain(item, str) for item in value):
                return list(value)
        param._runtime_param = None
        return param.get_runtime_param().coerce(value, param=param, ctx=ctx)


CONVERTER = _Converter()
SURROGATE = regex("[\ud800-\udfff]")
"""A character that UTF-8 cannot encode: a byte of an argument that is not UTF-8."""


def _is_plain(value: object, annotation: object) -> bool:
    """Check if a value is of its parameter's type already; a text must be encodable too, as pydantic requires."""
    return type(value) is annotation and not (isinstance(value, str) and SURROGATE.search(value))


def _lean(parameters: list[Parameter]) -> list[Parameter]:
    for one in parameters:
        if getattr(one, "_runtime_param", CONVERTER) is None:
            setattr(one, "_runtime_param", CONVERTER)  # noqa: B010 - typer's own attribute, which may go
    return parameters


class Command(TyperCommand):
    more: tuple[Callable[[Command], None], ...] = ()
    """Functions that add options, which are called before the parameters are used; the help of a group needs none."""

    def get_params(self, ctx: Context) -> list[Parameter]:
        more, self.more = self.more, ()
        for add in more:
            add(self)
        return _lean(super().get_params(ctx))


class Group(TyperGroup):
    def get_params(self, ctx: Context) -> list[Parameter]:
        return _lean(super().get_params(ctx))

"""The suggested first query: its values lie around the template's value."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Mapping
from decimal import Decimal

from sierra.errors import QueryError, SierraError
from sierra.platforms.base import Platform
from sierra.query import grammar
from sierra.templates.base import Template

POPULATION = "population_size"
FEW = 16
"""The largest value that doubling from 1 reaches soon enough."""


def first_query(platform: Platform, template: Template, variables: Mapping[str, str]) -> str | None:
    """Return a query over the platform's population, or else over the first variable; None if there is neither."""
    criterion = grammar.parse(f"{POPULATION}.Log8")
    with contextlib.suppress(SierraError):  # the platform finds no population in the template
        if POPULATION not in variables and platform.criterion(criterion, template):
            return grammar.text(criterion)
    return next((_around(name, template.find(path)[0].strip()) for name, path in variables.items()), None)


def _around(name: str, value: str) -> str:
    if not re.fullmatch(r"[+-]?\d{1,6}(\.\d{1,6})?", value, re.ASCII):
        return _word(name, value)
    number = Decimal(value)
    if not number:
        return f"{name}=0:1:5" if "." in value else f"{name}=0,1,2"
    if value.isdigit() and (name == POPULATION or number <= FEW):
        return f"{name}.Log8"
    return f"{name}=" + ",".join(f"{(number * times).normalize():f}" for times in (Decimal("0.5"), 1, 2))


def _word(name: str, value: str) -> str:
    """Return a criterion with the word's own value, as an example; with VALUE if a query cannot contain that value."""
    if value.lower() in ("true", "false"):
        return f"{name}=true,false" if value.islower() else f"{name}=True,False"
    try:
        return grammar.text(grammar.parse(f"{name}={value}"))
    except QueryError:
        return f"{name}=VALUE"

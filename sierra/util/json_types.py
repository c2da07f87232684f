"""The types of JSON values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import TypeAlias

Json: TypeAlias = "bool | int | float | str | list[Json] | dict[str, Json] | None"
"""A value that was read from JSON."""
JsonView: TypeAlias = "bool | int | float | str | Sequence[JsonView] | Mapping[str, JsonView] | None"
"""A value that can be written as JSON, and that is only read."""
RecordValue: TypeAlias = "JsonView | datetime"
"""A value in a row of a table."""


def as_object(value: RecordValue) -> Mapping[str, JsonView]:
    """Return a JSON object; an empty one for any other value."""
    return value if isinstance(value, Mapping) else {}


def as_texts(value: RecordValue) -> tuple[str, ...]:
    """Return the strings in a JSON array; none for any other value."""
    return tuple(one for one in value if isinstance(one, str)) if isinstance(value, list | tuple) else ()

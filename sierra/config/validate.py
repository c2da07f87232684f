"""Validate tables from TOML, with errors of one line in the terms of TOML."""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Iterator, Mapping
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from sierra.config import extensions, group_names
from sierra.config.cluster_table import SETTINGS, ClusterTable
from sierra.config.field_types import NAME, Table
from sierra.config.find_project import TOO_DEEP
from sierra.errors import ConfigError
from sierra.util.lazy_definitions import regex

KEYS_OF_PROJECTS = {"outputs", "figures"}
"""Keys by which a model of a whole `sierra.toml` is known."""
TARGET = regex(r"targets\.[^.]+\.[^.]+")
OptionsT = TypeVar("OptionsT", bound=BaseModel)
KINDS = {
    "int_type": "should be a whole number",
    "float_type": "should be a number",
    "string_type": "should be text",
    "bool_type": "should be true or false",
    "tuple_type": "should be a list",
    "dict_type": "should be a table",
    "mapping_type": "should be a table",
    "model_type": "should be a table",
    "model_attributes_type": "should be a table",
    "too_short": "should not be empty",
    "string_too_short": "should not be empty",
}
"""Messages in the terms of TOML for the error types of pydantic."""
STRICT = {"strict": True}
"""The context of validation, for models that validate a table by another model."""


def options(model: type[OptionsT], table: object, origin: str, within: tuple[str, ...] = ()) -> OptionsT:
    """Validate a table strictly: a text is not a number. Messages name `origin`, and `within` in it. Raises ConfigError."""
    try:
        return model.model_validate(_frozen(table, origin), strict=True, context=STRICT)
    except RecursionError as error:
        raise ConfigError(f"{origin}: {TOO_DEEP}") from error
    except ValidationError as error:
        raise ConfigError(f"{origin}: {_explain(error, model, within)}") from error


def _frozen(value: object, origin: str) -> object:
    """Return lists as tuples. Raises ConfigError for a text with NUL, which no file or argument can contain."""
    match value:
        case str() if "\0" in value:
            raise ConfigError(f"{origin}: {value[:40]!r} contains the character NUL; remove it")
        case dict():
            return {_frozen(name, origin): _frozen(inner, origin) for name, inner in value.items()}
        case list() | tuple():
            return tuple(_frozen(inner, origin) for inner in value)
        case _:
            return value


def _explain(error: ValidationError, model: type[BaseModel], within: tuple[str, ...] = ()) -> str:
    """Return the first error in one line; for an unknown key, with the most similar valid key."""
    complaint = error.errors()[0]
    where = ".".join(str(part) for part in (*within, *complaint["loc"]))
    if complaint["type"] == "extra_forbidden" and model.model_fields.keys() >= KEYS_OF_PROJECTS:
        key = ".".join(map(str, complaint["loc"]))
        if home := extensions.absent("tables", key.rpartition(".")[2] if TARGET.fullmatch(key) else key):
            return f"{extensions.belongs(where, home)}, or remove the key"
    if complaint["type"] == "extra_forbidden":
        return f"unknown key {where!r}{_dotted(complaint['loc'], complaint['input']) or _nearest(model, complaint['loc'])}"
    if complaint["type"] == "missing":
        return f"{where!r} is missing"
    if complaint["type"] == "value_error":
        return f"{where}{where and ': '}{complaint['ctx']['error']}"
    if complaint["loc"][-1:] == ("[key]",):
        table = ".".join(map(str, complaint["loc"][:-2]))
        if complaint.get("ctx", {}).get("pattern") == group_names.GROUP_NAME:
            return f"{table}: {complaint['input']!r} is not a valid name; use letters, digits, _, and . or - between them"
        return f"{table}: {_no_name(complaint['input'])}"
    if complaint.get("ctx", {}).get("pattern") == NAME:
        return f"{where}: {_no_name(complaint['input'])}"
    message = KINDS.get(complaint["type"]) or complaint["msg"].replace("Input", "it").replace("it should", "should", 1)
    return f"{where or 'table'} {message}, not {_written(complaint['input'])}"


def _dotted(location: tuple[int | str, ...], value: object) -> str:
    """Return a hint for a name of a controller or scenario that has dots but no quotes: in TOML, a table in a table."""
    if location[0] not in ("controllers", "scenarios") or len(location) != 3 or not isinstance(value, Mapping):
        return ""
    return f'; write a name with dots in quotes: {location[0]}."{location[1]}.{location[2]}"'


def _no_name(value: object) -> str:
    """Return a message for an invalid name, with a proposal."""
    return f"{value!r} is not a valid name; use letters, digits and _, as in {valid_name(str(value))}"


def valid_name(text: str) -> str:
    """Return a text if it is a valid name, or else a name that is like it."""
    if re.fullmatch(NAME, text):
        return text
    letters = re.sub(r"[^A-Za-z0-9]+", "_", text).strip("_").lstrip("0123456789_")
    return letters or "my_name"


def _written(value: object) -> str:
    """Return a value nearly in the form of TOML, shortened."""
    text = json.dumps(value, ensure_ascii=False, default=str)
    return text if len(text) <= 60 else text[:57] + "..."


def _nearest(model: type[BaseModel], location: tuple[int | str, ...]) -> str:
    """Return a hint with the known keys of the table that contains `location`, or the most similar one."""
    known = sorted(_keys(model, location[:-1]))
    if issubclass(model, ClusterTable) and location[-1] in SETTINGS:
        return f"; use {SETTINGS[location[-1]]!r} instead"
    close = difflib.get_close_matches(str(location[-1]), known, 1, cutoff=0.5)
    if close:
        return f"; did you mean {close[0]!r}?"
    return f"; known are {', '.join(known)}" if known else ""


def _keys(model: type[BaseModel], location: tuple[int | str, ...]) -> set[str]:
    for part in location:
        inner = next((f.annotation for n, f in model.model_fields.items() if part in (n, f.alias)), None)
        model = next((other for other in _tables() if re.search(rf"\b{other.__name__}\b", str(inner))), model)
    models = [model, *(other for other in model.__subclasses__() if location[:1] == ("outputs",))]
    return {field.alias or name for one in models for name, field in one.model_fields.items()}


def _tables() -> Iterator[type[BaseModel]]:
    """Yield the models of tables."""
    pending = Table.__subclasses__()
    while pending:
        pending += (model := pending.pop(0)).__subclasses__()
        yield model

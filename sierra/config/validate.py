"""Validate tables from TOML, with errors of one line in the terms of TOML."""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from operator import itemgetter
from typing import TypeVar

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

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
T = TypeVar("T")
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
    """Validate a table strictly: a text is not a number. Messages name `origin`, and `within` in it. Raises ConfigError.

    The error is that of the first invalid key; those of the others are its notes.
    """
    try:
        table = _frozen(table, origin)
        return model.model_validate(table, strict=True, context=STRICT)
    except RecursionError as error:
        raise ConfigError(f"{origin}: {TOO_DEEP}") from error
    except ValidationError as error:
        first, *others = (f"{origin}: {_explain(each, model, within)}" for each in _independent(error, table))
        raise _with_notes(ConfigError(first), others) from error


def gathered(checks: Iterable[Callable[[], T]]) -> list[T]:
    """Return the results of all checks. Raises the first ConfigError, with the others as its notes."""
    results: list[T] = []
    errors: list[ConfigError] = []
    for check in checks:
        try:
            results.append(check())
        except ConfigError as error:
            errors.append(error)
    if errors:
        first, *others = errors
        raise _with_notes(first, (text for error in others for text in (str(error), *getattr(error, "__notes__", ()))))
    return results


def _with_notes(error: ConfigError, texts: Iterable[str]) -> ConfigError:
    """Add texts to an error as notes; return the error."""
    for text in texts:
        error.add_note(text)
    return error


def _independent(error: ValidationError, table: object) -> Iterator[ErrorDetails]:
    """Yield one error for each invalid key, in the order of the file, without those that follow from an error inside of it.

    A key that may have several types has an error for each of them, with the type as the last part of its place.
    """
    errors: dict[tuple[int | str, ...], tuple[list[int], ErrorDetails]] = {}
    for each in error.errors():
        key, position = _located(table, each)
        errors.setdefault(key, (position, each))
    outer = {key[:length] for key in errors for length in range(len(key))}
    inner = [(position, key, each) for key, (position, each) in errors.items() if key not in outer]
    for _, key, each in sorted(inner, key=itemgetter(0)):
        yield each if each["loc"][-1:] == ("[key]",) else {**each, "loc": key}


def _located(table: object, error: ErrorDetails) -> tuple[tuple[int | str, ...], list[int]]:
    """Return the key in the file that an error is about, and its position: a number for each table that it is in."""
    key: list[int | str] = []
    position: list[int] = []
    for part in error["loc"]:
        names = list(table) if isinstance(table, Mapping) else list(range(len(table))) if isinstance(table, tuple) else []
        if part not in names:
            lacking = [part] if error["type"] == "missing" else []
            return (*key, *lacking), [*position, *(len(names) for _ in lacking)]
        key.append(part)
        position.append(names.index(part))
        table = table[part]  # type: ignore[index]
    return tuple(key), position


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


def _explain(complaint: ErrorDetails, model: type[BaseModel], within: tuple[str, ...] = ()) -> str:
    """Return an error in one line; for an unknown key, with the most similar valid key."""
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
    if complaint["type"] == "too_short" and (least := complaint["ctx"]["min_length"]) > 1:
        message = f"should have at least {least} items"
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

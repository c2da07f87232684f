"""The keys of `sierra.toml`, table by table, in words. They are read from the JSON Schema that is made from the code."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from sierra.setup.published_schemas import Note, json_schema
from sierra.util.lazy_definitions import dataclass

CHANGES, TOLERANCES = "change", "tolerance"
"""The tables whose keys many keys have."""
OF_ALL = {CHANGES: "ChangeTable", TOLERANCES: "Tolerance"}
TYPES = {"string": "text", "integer": "whole number", "number": "number", "boolean": "true or false"}
Schema = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Key:
    """One key: its name, its type in words, its default as TOML or `required`, and its meaning. Code is between backticks."""

    name: str
    type: str
    default: str
    meaning: str


@dataclass(frozen=True, slots=True)
class KeyTable:
    """One table of `sierra.toml`."""

    name: str
    """The path of the table, `change` or `tolerance`; "" for the top level."""
    header: str
    """The header as in the file, such as `[outputs.NAME]`; "" for the top level and for a table that is part of others."""
    sentences: tuple[str, ...]
    keys: tuple[Key, ...]
    kind: str = ""
    """The kind of figure that alone has these keys."""


def key_tables(note: Note | None = None) -> Iterator[KeyTable]:
    """Yield all tables, the top level first. With `note`, plug-ins of other packages are included, as in `json_schema`."""
    schema = json_schema(note)
    properties = schema["properties"]
    models = {name: _model(schema, key) for name, key in properties.items()}
    yield KeyTable("", "", (), _keys(schema, [name for name in properties if models[name] is None and name != "platforms"]))
    for name, headed in models.items():
        if headed is not None:
            yield from _tables(schema, name, properties[name], *headed)
            if name == "figures":
                yield from _of_kinds(schema)
    for kind, name in ((table, name) for table in ("platforms", "runners") for name in properties[table].get("properties", ())):
        yield from _tables(schema, f"{kind}.{name}", {}, "[{}]", _resolve(schema, properties[kind]["properties"][name]))
    for name, title in OF_ALL.items():
        yield KeyTable(name, "", (_sentence(schema["$defs"][title]),), _keys(schema["$defs"][title]))


def _tables(schema: Schema, name: str, key: Schema, header: str, model: Schema) -> Iterator[KeyTable]:
    """Yield the table of a key, and those within it."""
    if model["title"] in OF_ALL.values():
        if "." not in name:
            yield KeyTable(name, header.format(name), (closed(_sentence(key)), closed(_sentence(model))), ())
        return
    properties = model.get("properties", {})
    if properties:
        sentences = filter(None, dict.fromkeys((closed(_sentence(key)), closed(_sentence(model)))))
        yield KeyTable(name, header.format(name), tuple(sentences), _keys(model))
    for inside, inner in properties.items():
        if not {"platforms", "runners", "targets"} & {name, inside} and (headed := _model(schema, inner)) is not None:
            yield from _tables(schema, f"{header.format(name).strip('[]')}.{inside}", inner, *headed)


def _of_kinds(schema: Schema) -> Iterator[KeyTable]:
    """Yield the keys that only one kind of figure has, kind by kind."""
    for title, model in schema["$defs"].items():
        if title.startswith("figures."):
            yield KeyTable("figures", "", (_sentence(model),), _keys(model), title.partition(".")[2])


def _model(schema: Schema, key: Schema) -> tuple[str, Schema] | None:
    """Return the header of a key that is a table, with `{}` for the key, and the table's schema; None for a plain value."""
    free: Any = next(iter(key.get("patternProperties", {}).values()), key.get("additionalProperties"))
    forms: tuple[tuple[str, Any], ...] = (("[{}.NAME]", free), ("[{}]", key), ("[[{}]]", key.get("items")))
    for header, inner in forms:
        if isinstance(inner, dict):
            model = _resolve(schema, inner)
            if "properties" in model:
                return header, model
    return None


def _resolve(schema: Schema, value: Schema) -> Schema:
    """Return the table that a schema refers to, directly or beside a short form; else the schema itself."""
    for option in (value, *value.get("anyOf", ())):
        if "$ref" in option:
            found: Schema = schema["$defs"][option["$ref"].rpartition("/")[2]]
            return found
    return value


def _keys(model: Schema, names: Iterable[str] | None = None) -> tuple[Key, ...]:
    found, required = model["properties"], model.get("required", ())
    return tuple(
        Key(name, _type(found[name]), _default(found[name], required=name in required), _sentence(found[name]))
        for name in (found if names is None else names)
    )


def _default(key: Schema, *, required: bool) -> str:
    if required:
        return "required"
    value = key.get("default")
    return "" if value in (None, "", [], {}) else f"`{json.dumps(value, ensure_ascii=False)}`"


def _type(key: Schema) -> str:
    """Return the type of a key in words."""
    if options := key.get("anyOf"):
        return " or ".join(dict.fromkeys(_type(option) for option in options if option.get("type") != "null"))
    if choices := key.get("enum"):
        return " or ".join(f"`{json.dumps(choice)}`" for choice in choices)
    match key.get("type"):
        case "array" if OF_ALL[CHANGES] in str(key.get("items")):
            return "list of changes"
        case "array" if "prefixItems" in key:
            return f"list: {', '.join(map(_type, key['prefixItems']))}"
        case "array":
            return f"list: {_type(key.get('items', {}))}"
        case "object" if OF_ALL[TOLERANCES] in str(key.get("additionalProperties")):
            return "table of tolerances"
        case kind:
            return TYPES.get(str(kind), "table")


def _sentence(schema: Schema) -> str:
    return " ".join(str(schema.get("description", "")).split())


def closed(text: str) -> str:
    """Return a text as a sentence: with a capital letter, and a full stop."""
    return text and text[0].upper() + text[1:].rstrip(".") + "."

"""The published contracts: the keys of `sierra.toml`, and the store's tables as SQL.

All are generated from the code; `make schemas` writes them to `schemas/`, and a test compares them. The keys of `sierra.toml`
are published twice. One form is JSON Schema, for editors. The other is made from that schema: commented TOML for people, with
a description and an example for each key. All examples together are one valid `sierra.toml`.
"""

from __future__ import annotations

import json
import re
import textwrap
import tomllib
from collections.abc import Callable, Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import TypedDict, cast

from pydantic import BaseModel, TypeAdapter

from sierra.config import extensions
from sierra.config.cluster_table import ClusterTable
from sierra.config.field_types import NAME
from sierra.config.plugin_registry import (
    COMPARISONS,
    CRITERIA,
    ENGINES,
    FIGURES,
    KINDS,
    LINKS,
    PLATFORMS,
    READERS,
    RUNNERS,
    SCHEDULERS,
    STATISTICS,
    TEMPLATES,
    Kind,
)
from sierra.config.project_file import model_of
from sierra.config.targets import SHARED
from sierra.errors import PluginError
from sierra.execution.plan_json import PlanPreview
from sierra.query.query_request import QueryRequest, RequestFile
from sierra.store.schema import DERIVED, RECORDED, Table, sql
from sierra.util.json_types import Json

TOML = "sierra.toml.schema.json"
QUERY = "query.schema.json"
PLAN = "plan.schema.json"
PACKAGE = "package.schema.json"
STORE = "store.sql"
WIDTH = 118
INTRODUCTION = """\
All keys of sierra.toml. They may also be in the table [tool.sierra] of pyproject.toml instead.
A line that starts with # and no space is an example: remove the # to use it. The text above it describes the key.
Its type, its default and whether it is required are in brackets. An XPath is XPath 1.0.
In templates other than XML, it selects keys."""

Values = dict[str, Json]
"""An example of a table."""
Schema = TypedDict(
    "Schema",
    {
        "$schema": str,
        "$defs": "dict[str, Schema]",
        "$ref": str,
        "title": str,
        "description": str,
        "type": str,
        "default": Json,
        "examples": list[Json],
        "anyOf": "list[Schema]",
        "enum": list[Json],
        "items": "Schema",
        "minimum": float,
        "exclusiveMinimum": float,
        "properties": "dict[str, Schema]",
        "required": list[str],
        "patternProperties": "dict[str, Schema]",
        "additionalProperties": "Schema | bool",
        "unevaluatedProperties": bool,
        "const": str,
        "allOf": "list[Schema]",
        "if": "Schema",
        "then": "Schema",
    },
    total=False,
)
"""The parts of a JSON Schema that pydantic generates and this module reads."""
Note = Callable[[str], None]
"""A function that receives a line for people."""
BARE = re.compile(r"[A-Za-z0-9_-]+")
"""The pattern of a TOML key that needs no quotes."""
EXAMPLES = Path(__file__).with_name("all_keys.toml")
"""A `sierra.toml` with all keys, for the commented TOML; a key that it lacks is shown with its default."""


def json_schema(note: Note | None = None) -> Schema:
    """Return the JSON Schema of `sierra.toml` (draft 2020-12) with the options of the plug-ins of SIERRA.

    With `note`, those of other packages are included. `note` receives a line for each one that cannot be used.
    """
    schema = _schema(model_of(extensions.added("tables")))
    for kind in (PLATFORMS, RUNNERS, LINKS, TEMPLATES, ENGINES, READERS, STATISTICS, COMPARISONS, CRITERIA):
        table = schema["properties"][kind.table]
        named = {name: _define(schema, f"{kind.table}.{name}", kind.load(name).Options) for name in _with_options(kind, note)}
        if named:
            table["properties"] = named
    _clusters(schema, note)
    _figures(schema, note)
    _targets(schema)
    formats = schema["$defs"]["Output"]["properties"]["format"]["anyOf"][0]["enum"]
    formats.extend(name for name in _usable(READERS, note) if name not in formats)
    schema["$defs"] = dict(sorted(schema["$defs"].items()))
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "sierra.toml", **schema}


def query_schema() -> str:
    """Return the JSON Schema of the file that `sierra run FILE.json` takes: a request, alone or in the JSON of a dry run."""
    return _schema_text("query.json", TypeAdapter(QueryRequest | RequestFile).json_schema())


def plan_schema() -> str:
    """Return the JSON Schema of the JSON of a dry run."""
    return _schema_text("plan.json", PlanPreview.model_json_schema())


def package_schema() -> str:
    """Return the JSON Schema of the file `package.json` in packages."""
    from sierra.packages.manifest import PackageManifest

    return _schema_text("package.json", PackageManifest.model_json_schema())


def _schema_text(title: str, schema: Mapping[str, object]) -> str:
    whole = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": title, **schema}
    return json.dumps(whole, indent=2, ensure_ascii=False) + "\n"


def _with_options(kind: Kind, note: Note | None) -> Iterator[str]:
    """Yield the plug-ins of a kind that can be used; of the shipped ones, those that have options, and all platforms."""
    yield from (name for name in kind.shipped if kind is PLATFORMS or kind.load(name).Options.model_fields)
    yield from _usable(kind, note)


def _usable(kind: Kind, note: Note | None) -> Iterator[str]:
    """Yield the plug-ins of other packages that can be used, if there is a `note`, which gets the others' errors."""
    for name in kind.added() if note else ():
        try:
            kind.load(name)
        except PluginError as error:
            if note:
                note(str(error))
        else:
            yield name


def _schema(model: type[BaseModel]) -> Schema:
    return cast("Schema", model.model_json_schema(by_alias=True))


def _define(schema: Schema, title: str, model: type[BaseModel]) -> Schema:
    """Add the schema of a plug-in's options; return the reference to it."""
    theirs = _schema(model)
    schema["$defs"] |= theirs.pop("$defs", {})
    schema["$defs"][title] = {**theirs, "title": title}
    return {"$ref": f"#/$defs/{title}"}


def _clusters(schema: Schema, note: Note | None) -> None:
    """Add the tables of clusters: those of the shipped schedulers, and those of the installed ones."""
    schema["$defs"]["ClusterTable"] = _schema(ClusterTable)
    runners = schema["properties"]["runners"]
    clusters: list[Schema] = [{"$ref": "#/$defs/ClusterTable"}]
    for name in _usable(SCHEDULERS, note):
        clusters.append(_define(schema, f"schedulers.{name}", SCHEDULERS.load(name).Options))
        runners.setdefault("properties", {}).setdefault(name, clusters[-1])
    runners["additionalProperties"] = clusters[0] if len(clusters) == 1 else {"anyOf": clusters}


def _figures(schema: Schema, note: Note | None) -> None:
    """Add the keys of `[figures.NAME]` that belong to one kind, each under the name of its kind."""
    figure = schema["$defs"]["Figure"]
    figure.pop("additionalProperties")
    figure["properties"]["kind"]["enum"] = [*FIGURES.shipped, *_usable(FIGURES, note)]
    for kind in _with_options(FIGURES, note):
        model = FIGURES.load(kind).Options
        if model.model_fields:
            chosen: Schema = {"properties": {"kind": {"const": kind}}, "required": ["kind"]}
            figure.setdefault("allOf", []).append({"if": chosen, "then": _define(schema, _of_kind(kind), model)})
            schema["$defs"][_of_kind(kind)].pop("additionalProperties")
    figure["unevaluatedProperties"] = False


def _of_kind(kind: object) -> str:
    """Return the name of the definition of a kind's own keys."""
    return f"figures.{kind}"


def _targets(schema: Schema) -> None:
    """Add the table of a target: the keys of `sierra.toml` that are not shared by all targets."""
    own = {name: key for name, key in schema["properties"].items() if name not in SHARED}
    described: Schema = {"description": "A target: other values of keys, for one platform.", "title": schema["title"]}
    schema["$defs"]["Target"] = {**described, "type": "object", "additionalProperties": False, "properties": own}
    schema["properties"]["targets"]["patternProperties"] = {NAME: {"$ref": "#/$defs/Target"}}


def toml_schema(note: Note | None = None) -> str:
    """Return the JSON Schema of `sierra.toml` as text; `note` as in `json_schema`."""
    return json.dumps(json_schema(note), indent=2, ensure_ascii=False) + "\n"


def toml(note: Note | None = None) -> str:
    """Return all keys of `sierra.toml` as TOML that is commented out: `# sentence`, then `#key = value`."""
    return "\n".join([*_prose(INTRODUCTION), "", *_Reference(json_schema(note)).lines()]) + "\n"


def tables() -> Mapping[str, Table]:
    """Return the store's own tables, by name."""
    return {**RECORDED, **DERIVED}


def generated() -> Mapping[str, str]:
    """Return the content of the files of `schemas/`, by name."""
    return {TOML: toml_schema(), QUERY: query_schema(), PLAN: plan_schema(), PACKAGE: package_schema(), STORE: sql()}


def write(folder: Path) -> None:
    """Write the files of `schemas/` to `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in generated().items():
        (folder / name).write_text(text)


class _Reference:
    """The commented TOML of a JSON Schema. The first occurrence of a key carries its explanation."""

    def __init__(self, schema: Schema) -> None:
        self._schema = schema
        self._explained: set[str] = set()

    def lines(self) -> Iterator[str]:
        examples: Values = tomllib.loads(EXAMPLES.read_text()) | _of_extensions()
        figures = cast("Values", examples["figures"])
        shown = {figure.get("kind") for figure in figures.values() if isinstance(figure, dict)}
        for kind in self._schema["$defs"]["Figure"]["properties"]["kind"]["enum"]:
            keys = self._schema["$defs"].get(_of_kind(kind), {}).get("properties", {})
            if keys and kind not in shown:
                figures[str(kind)] = {"kind": kind, **{name: _placeholder(self._plain(key)) for name, key in keys.items()}}
        yield from self._table((), self._schema, [examples])

    def _table(self, path: tuple[str, ...], model: Schema, examples: list[Values]) -> Iterator[str]:
        """Yield the lines of a table's first example; the first table of its kind also shows the keys that no example has."""
        known = model.get("properties", {})
        values = examples[0] | self._lacking(model, examples)
        names = [*(name for name in known if name in values), *(name for name in values if name not in known)]
        below = [name for name in names if _has_header(path, values[name])]
        for name in names:
            if name not in below:
                of_kind = self._schema["$defs"].get(_of_kind(values.get("kind")), model)
                yield from self._sentence(model if name in known else of_kind, name)
                yield f"#{name} = {_written(values[name])}"
        for name in below:
            yield ""
            yield from self._below((*path, name), known.get(name) or _of_any(model), values[name])

    def _lacking(self, model: Schema, examples: list[Values]) -> Values:
        if not self._first(f"{model.get('title')}, completed"):
            return {}
        shown = set(chain.from_iterable(examples))
        known = model.get("properties", {}).items()
        left = ((name, inner) for name, inner in known if name not in shown)
        return {name: _placeholder(inner if inner.get("examples") else self._plain(inner)) for name, inner in left}

    def _sentence(self, model: Schema, name: str) -> Iterator[str]:
        """Yield the meaning of a key, its type, and its default."""
        schema = model.get("properties", {}).get(name)
        if schema is None or not self._first(f"{model.get('title')}.{name}"):
            return
        facts = [self._type(schema)]
        if name in model.get("required", ()):
            facts.append("required")
        elif schema.get("default") not in (None, "", [], {}):
            facts.append(f"default {_written(schema['default'])}")
        yield from _prose(f"{schema.get('description', '')} ({'; '.join(facts)})")

    def _below(self, path: tuple[str, ...], schema: Schema, value: Json) -> Iterator[str]:
        """Yield the lines, with headers, of a table, a list of tables or a mapping of names to tables."""
        model, place = self._plain(schema), ".".join(path)
        named = self._plain(_of_any(model))
        match value:
            case list():
                model = self._plain(model["items"])
                tables = [(f"#[[{place}]]", path, one) for one in value if isinstance(one, dict)]
            case dict() if "properties" in named and "properties" not in model:
                model = named
                tables = [(f"#[{place}.{name}]", (*path, name), one) for name, one in value.items() if isinstance(one, dict)]
            case dict():
                tables = [(f"#[{place}]", path, value)]
            case _:
                tables = []
        yield from _prose("" if schema is model else schema.get("description", ""))
        if self._first(str(model.get("title"))):
            yield from _prose(model.get("description", ""))
        for k, (header, at, one) in enumerate(tables):
            yield header
            yield from self._table(at, model, [one, *(later for _, _, later in tables[k + 1 :])])

    def _first(self, what: str) -> bool:
        first = what not in self._explained
        self._explained.add(what)
        return first

    def _plain(self, schema: Schema) -> Schema:
        """Return the table that a schema refers to, alone or beside a short form; else the schema itself."""
        for option in (schema, *schema.get("anyOf", ())):
            if reference := option.get("$ref"):
                return self._schema["$defs"][reference.rpartition("/")[2]]
        return schema

    def _tables(self, model: str) -> str:
        """Return the type of a list of tables."""
        if model == "ChangeTable":
            return "list of changes, as in [[changes]]"
        return f"list of tables with the keys {', '.join(self._schema['$defs'][model]['properties'])}"

    def _type(self, schema: Schema) -> str:
        if options := schema.get("anyOf"):
            return _either(list(dict.fromkeys(self._type(o) for o in options if o.get("type") != "null")))
        if choices := schema.get("enum"):
            return _either([json.dumps(choice) for choice in choices])
        match schema.get("type"):
            case "array" if "$ref" in schema.get("items", {}):
                return self._tables(schema["items"]["$ref"].rpartition("/")[2])
            case "array":
                return f"list: {self._type(schema.get('items', {}))}"
            case "integer" | "number" as kind:
                return ("whole number" if kind == "integer" else "number") + _bound(schema)
            case kind:
                return {"string": "text", "boolean": "true or false"}.get(str(kind), "table")


def _of_extensions() -> Values:
    """Return the examples of the keys that extensions add."""
    files = extensions.FOLDER.glob("*/all_keys.toml")
    return {key: value for file in sorted(files) for key, value in tomllib.loads(file.read_text()).items()}


def _has_header(path: tuple[str, ...], value: Json) -> bool:
    """Return whether a value has a header of its own; tables within tables are written in one line."""
    tables = isinstance(value, dict) or (isinstance(value, list) and value != [] and isinstance(value[0], dict))
    return tables and path in ((), *((kind.table,) for kind in KINDS))


def _of_any(schema: Schema) -> Schema:
    """Return the schema of the values of a mapping with arbitrary names."""
    for named in schema.get("patternProperties", {}).values():
        return named
    free = schema.get("additionalProperties", False)
    return {} if isinstance(free, bool) else free


def _placeholder(schema: Schema) -> Json:
    """Return a value for a key without an example in a table: that of its field, its default, or one of its type."""
    if schema.get("examples"):
        example: Json = schema["examples"][0]
        return example
    if schema.get("default") is not None:
        return schema["default"]
    options = [schema, *schema.get("anyOf", ())]
    kinds = [option["type"] for option in options if option.get("type", "null") != "null"]
    of_kind: Values = {"integer": 1, "number": 1.0, "boolean": False, "array": [], "object": {}}
    return of_kind.get(kinds[0] if kinds else "", "")


def _either(options: list[str]) -> str:
    return " or ".join([", ".join(options[:-1]), options[-1]]) if len(options) > 1 else options[0]


def _bound(schema: Schema) -> str:
    if "exclusiveMinimum" in schema:
        return f" above {schema['exclusiveMinimum']:g}"
    return f" from {schema['minimum']:g}" if "minimum" in schema else ""


def _prose(text: str) -> list[str]:
    lines = (line for part in text.splitlines() for line in textwrap.wrap(part, WIDTH, break_on_hyphens=False))
    return [f"# {line}" for line in lines]


def _written(value: Json) -> str:
    """Return a value as TOML."""
    match value:
        case str() if '"' in value and "'" not in value:
            return f"'{value}'"
        case dict():
            return "{ " + ", ".join(f"{_key(name)} = {_written(inner)}" for name, inner in value.items()) + " }"
        case list() | tuple():
            return f"[{', '.join(map(_written, value))}]"
        case _:
            return json.dumps(value, ensure_ascii=False)


def _key(name: str) -> str:
    return name if BARE.fullmatch(name) else json.dumps(name)

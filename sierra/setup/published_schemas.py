"""The published contracts: the keys of `sierra.toml`, and the store's tables as SQL.

All are generated from the code; `make schemas` writes them to `schemas/`, and a test compares them. `sierra.setup.key_tables`
has the keys of `sierra.toml` in words.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TypedDict, cast

from pydantic import BaseModel, TypeAdapter

from sierra.config import extensions
from sierra.config.cluster_table import ClusterTable
from sierra.config.field_types import NAME
from sierra.config.output_tables import of_extensions
from sierra.config.plugin_registry import (
    COMPARISONS,
    CRITERIA,
    ENGINES,
    FIGURES,
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
from sierra.design.query.query_request import QueryRequest, RequestFile
from sierra.errors import PluginError
from sierra.execution.plan_json import PlanPreview
from sierra.store.schema import DERIVED, RECORDED, Table, sql
from sierra.util.json_types import Json

TOML = "sierra.toml.schema.json"
QUERY = "query.schema.json"
PLAN = "plan.schema.json"
PACKAGE = "package.schema.json"
STORE = "store.sql"
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
    output = schema["$defs"]["Output"]["properties"]
    for own in of_extensions().values():
        output |= {key: key_schema for key, key_schema in _schema(own)["properties"].items() if key not in output}
    formats = output["format"]["anyOf"][0]["enum"]
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
    """Add the tables of clusters: those of the shipped schedulers, and those of schedulers with keys of their own."""
    schema["$defs"]["ClusterTable"] = _schema(ClusterTable)
    runners = schema["properties"]["runners"]
    clusters: list[Schema] = [{"$ref": "#/$defs/ClusterTable"}]
    shipped = (name for name in SCHEDULERS.shipped if SCHEDULERS.load(name).Options is not ClusterTable)
    for name in (*shipped, *_usable(SCHEDULERS, note)):
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

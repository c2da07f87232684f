"""The published contracts: the JSON Schema of `sierra.toml`, and the store's tables as SQL.

Both are generated from the code; `make schemas` writes them to `schemas/`, and a test compares them.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from sierra.config import Project
from sierra.store.tables import DERIVED, RECORDED, Table, sql

TOML = "sierra.toml.schema.json"
STORE = "store.sql"


def toml() -> str:
    """The JSON Schema of `sierra.toml` (draft 2020-12), for editors."""
    schema = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "sierra.toml",
        **Project.model_json_schema(by_alias=True),
    }
    return json.dumps(schema, indent=2, ensure_ascii=False) + "\n"


def tables() -> Mapping[str, Table]:
    """The store's own tables, by name."""
    return {**RECORDED, **DERIVED}


def generated() -> Mapping[str, str]:
    """The files of `schemas/`, by name."""
    return {TOML: toml(), STORE: sql()}


def write(folder: Path) -> None:
    """Write all of them."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in generated().items():
        (folder / name).write_text(text)

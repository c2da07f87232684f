"""The published contracts in `schemas/` are those that the code has."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import duckdb
import jsonschema
import pytest

import sierra
from sierra import schemas

FOLDER = Path(__file__).parent.parent / "schemas"
EXAMPLE = Path(sierra.__file__).parent / "examples" / "swarm" / "sierra.toml"


@pytest.mark.parametrize("name", [schemas.TOML, schemas.STORE])
def test_what_is_published_is_what_the_code_says(name: str) -> None:
    assert (FOLDER / name).read_text() == schemas.generated()[name], "make schemas writes them anew"


def test_nothing_else_is_published() -> None:
    assert {path.name for path in FOLDER.iterdir()} == set(schemas.generated())


def test_the_example_fits_the_json_schema() -> None:
    schema = json.loads(schemas.toml())
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.validate(tomllib.loads(EXAMPLE.read_text()), schema)


def test_the_json_schema_refuses_unknown_keys() -> None:
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate({"template": "x.xml", "comand": "true"}, json.loads(schemas.toml()))


def test_the_sql_schema_is_sql() -> None:
    connection = duckdb.connect()
    connection.execute(schemas.generated()[schemas.STORE])
    tables = {row[0] for row in connection.execute("SHOW TABLES").fetchall()}
    assert tables == set(schemas.tables())


def test_every_column_has_a_sentence() -> None:
    for table in schemas.tables().values():
        assert table.meaning
        assert all(column.meaning for column in table.columns), table.name

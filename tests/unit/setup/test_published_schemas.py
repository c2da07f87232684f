"""The published schemas in `schemas/` equal those of the code, and describe every key."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import duckdb
import jsonschema
import pytest
from pydantic import BaseModel

import sierra
from sierra.config import extensions, field_types
from sierra.config.plugin_registry import FIGURES, PLATFORMS
from sierra.config.project_file import model_of
from sierra.setup import published_schemas
from sierra.setup.key_tables import key_tables
from tests import projects
from tests.tiers import of_extension

FOLDER = Path(__file__).parents[3] / "schemas"
EXAMPLE = Path(sierra.__file__).parent / "setup" / "examples" / "swarm" / "sierra.toml"


def own(model: type[BaseModel]) -> list[type[BaseModel]]:
    """Return the models of `sierra.toml` that inherit from a model, without those that others inherit from."""
    of_file = re.compile(r"sierra\.(config\.(\w+_tables?|project_file)|extensions\.\w+\.table)")
    found = [one for one in model.__subclasses__() if of_file.fullmatch(one.__module__)]
    return [leaf for one in found for leaf in own(one) or [one]]


model_of(extensions.added("tables"))  # imports them
MODELS = {model.__name__: model for model in own(field_types.Table)}
"""The models of all tables, also of those that extensions add."""
if not extensions.is_there("videos"):
    del MODELS["Capture"]  # a part of the contract for platforms, but no table without this extension
OF_KINDS = {key for name in FIGURES.shipped for key in FIGURES.load(name).Options.model_fields}
"""The keys of `[figures.NAME]` that only one kind of figure has."""


def schema(*options: str) -> str:
    """Return the output of `sierra schema`."""
    done = projects.sierra(Path(), "schema", *options)
    assert done.returncode == 0, done.stderr
    return done.stdout


def keys(model: type[BaseModel]) -> set[str]:
    found = {field.alias or name for name, field in model.model_fields.items()}
    return found | OF_KINDS if model is MODELS["Figure"] else found


def test_the_options_of_all_platforms_of_sierra_are_published() -> None:
    published = json.loads((FOLDER / published_schemas.TOML).read_text())["properties"]["platforms"]["properties"]
    assert set(published) >= {*PLATFORMS.shipped}
    page = (FOLDER.parent / "docs" / "reference" / "sierra-toml.md").read_text()
    assert all(f"\nHeader: `[platforms.{name}]`\n" in page for name in set(published) - {"command"})


@pytest.mark.parametrize("name", [published_schemas.TOML, published_schemas.STORE])
def test_published_schemas_equal_the_generated_ones(name: str) -> None:
    assert (FOLDER / name).read_text() == published_schemas.generated()[name], "make schemas writes them anew"


def test_only_generated_schemas_are_published() -> None:
    assert {path.name for path in FOLDER.iterdir()} == set(published_schemas.generated())


def test_schema_describes_every_key_of_every_table() -> None:
    tables = list(key_tables())
    described = {key.name for one in tables for key in one.keys} | {one.name for one in tables}
    assert not [(name, lacking) for name, model in MODELS.items() if (lacking := keys(model) - described)]
    for name in PLATFORMS.shipped:
        of_platform = {key.name for one in tables if one.name == f"platforms.{name}" for key in one.keys}
        assert keys(PLATFORMS.load(name).Options) == of_platform


def test_schema_prints_a_table_of_sierra_toml_with_the_keys_of_all_formats() -> None:
    text = schema("outputs")
    assert text.startswith("[outputs.NAME]: ")
    lines = {line.split()[0]: " ".join(line.split()) for line in text.splitlines() if line}
    assert lines["min_rows"] == "min_rows whole number 0 minimum number of rows; a run with fewer rows fails"
    assert all(keys(extensions.load("outputs", name)) <= {*lines} for name in extensions.added("outputs"))
    assert "[package.authors]" in schema("package")


def test_schema_prints_a_key_and_a_table_of_the_store_that_have_one_name() -> None:
    text = schema("runs")
    assert text.startswith("runs: ")
    assert "top level of sierra.toml:\n" in text
    assert [one["name"] for one in json.loads(schema("runs", "--json"))] == ["runs"]


def test_schema_prints_all_keys_and_their_json_schema() -> None:
    assert schema("sierra.toml").startswith("top level of sierra.toml:\n")
    jsonschema.validate({"template": "x.xml"}, json.loads(schema("sierra.toml", "--json")))


def test_schema_of_an_unknown_name_is_an_error() -> None:
    done = projects.sierra(Path(), "schema", "nonsense")
    assert (done.returncode, done.stderr.startswith("sierra: unknown name 'nonsense'")) == (2, True)


def described(schema: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield every key in a JSON Schema with its description (or that of its table)."""
    for title, model in [("sierra.toml", schema), *schema["$defs"].items()]:
        for name, key in model.get("properties", {}).items():
            tables = [schema["$defs"][o["$ref"].rpartition("/")[2]] for o in (key, *key.get("anyOf", ())) if "$ref" in o]
            yield f"{title}.{name}", key.get("description") or (tables[0].get("description", "") if tables else "")


def test_every_key_has_a_description() -> None:
    lacking = [name for name, sentence in described(json.loads(published_schemas.toml_schema())) if not sentence]
    assert lacking == []


@pytest.fixture(scope="module")
def validator() -> jsonschema.Draft202012Validator:
    """Return the JSON Schema of `sierra.toml`, which is valid itself; checking that takes longer than using it."""
    schema = json.loads(published_schemas.toml_schema())
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


@pytest.mark.integration
def test_the_example_project_is_valid_by_the_json_schema(validator: jsonschema.Draft202012Validator) -> None:
    validator.validate(tomllib.loads(EXAMPLE.read_text()))


@pytest.mark.parametrize(
    "wrong",
    [
        {"comand": "true"},
        {"targets": {"sim": {"comand": "true"}}},
        {"targets": {"sim": {"runs": 3}}},
        *of_extension("argos", {"platforms": {"argos": {"lenght": 5}}}),
        {"figures": {"f": {"times": "x"}}},
    ],
)
def test_the_json_schema_refuses_unknown_keys_and_values(
    validator: jsonschema.Draft202012Validator, wrong: dict[str, Any]
) -> None:
    with pytest.raises(jsonschema.ValidationError):
        validator.validate({"template": "x.xml", **wrong})


def test_the_json_schema_accepts_any_options_of_other_platforms(validator: jsonschema.Draft202012Validator) -> None:
    validator.validate({"template": "x.xml", "platforms": {"mine": {"any": 1}}})


def test_the_sql_schema_is_valid_sql() -> None:
    connection = duckdb.connect()
    connection.execute(published_schemas.generated()[published_schemas.STORE])
    tables = {row[0] for row in connection.execute("SHOW TABLES").fetchall()}
    assert tables == set(published_schemas.tables())


def test_every_table_and_column_has_a_description() -> None:
    for table in published_schemas.tables().values():
        assert table.meaning
        assert all(column.meaning for column in table.columns), table.name


@pytest.mark.parametrize("words", [(), ("--explain",), ("--on", "slurm")], ids=" ".join)
def test_the_json_of_a_dry_run_is_valid_by_the_published_schema(tmp_path: Path, words: tuple[str, ...]) -> None:
    root = projects.make(tmp_path / "project")
    schema = json.loads((FOLDER / published_schemas.PLAN).read_text())
    printed = json.loads(projects.quick(root, "run", "population_size=1,2", "--runs", "1", "-n", "--json", *words).stdout)
    jsonschema.Draft202012Validator(schema).validate(printed)
    assert set(schema["required"]) <= set(printed) <= set(schema["properties"])

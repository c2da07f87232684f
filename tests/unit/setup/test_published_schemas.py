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
from sierra.config import extensions, field_types, project_file, validate
from sierra.config.plugin_registry import FIGURES
from sierra.config.project_file import model_of
from sierra.extensions.argos.platform import ArgosOptions
from sierra.setup import published_schemas
from tests import projects

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
OF_KINDS = {key for name in FIGURES.shipped for key in FIGURES.load(name).Options.model_fields}
"""The keys of `[figures.NAME]` that only one kind of figure has."""


def schema(*options: str) -> str:
    """Return the output of `sierra schema`."""
    done = projects.sierra(Path(), "schema", *options)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def reference() -> str:
    return schema("--toml")


def uncommented(text: str) -> dict[str, Any]:
    """Parse TOML without the # of all lines that begin with # and no blank."""
    return tomllib.loads(re.sub(r"(?m)^#(?! )", "", text))


def keys(model: type[BaseModel]) -> set[str]:
    found = {field.alias or name for name, field in model.model_fields.items()}
    return found | OF_KINDS if model is MODELS["Figure"] else found


def seen(table: dict[str, Any]) -> dict[str, set[str]]:
    """Return the keys in tables of each kind."""
    found: dict[str, set[str]] = {"Project": set(table)}
    for name, model in {
        "seed": "Seed",
        "success": "Success",
        "limits": "LimitsTable",
        "environment": "Environment",
        "container": "Container",
        "programs": "ProgramsTable",
        "store": "StoreTable",
        "build": "BuildTable",
        "sql": "SqlLimits",
        "package": "Package",
        "robots": "RobotsTable",
        "trials": "Trials",
        "capture": "Capture",
    }.items():
        found[model] = set(table[name])
    for name, model in {"authors": "Author", "related": "Related", "data": "ExternalData"}.items():
        found[model] = set().union(*table["package"][name])
    found["DrawnPoses"] = set(table["trials"]["draw_poses"])
    found["BaseStation"] = set(table["robots"]["base"])
    found["GroupOfPlaces"] = set().union(*table["robots"]["groups"].values())
    found["ClusterTable"] = set().union(*(one for name, one in table["runners"].items() if name != "robots"))
    found["Source"] = set(table["source"])
    found["Determinism"] = set(table["determinism"])
    found["ChangeTable"] = set().union(*table["changes"])
    groups = {
        "variables": "Variable",
        "controllers": "Group",
        "outputs": "Output",
        "equivalence": "Equivalence",
        "queries": "QueryTable",
        "tables": "DerivedTable",
        "figures": "Figure",
        "paper_tables": "TableForPaper",
        "videos": "Video",
        "comparisons": "Comparison",
        "claims": "Claim",
        "models": "Model",
        "services": "ServiceTable",
    }
    for name, model in groups.items():
        found[model] = set().union(*table[name].values())
    for name, model in {"value": "ClaimedValue", "order": "ClaimedOrder", "equivalence": "ClaimedEquivalence"}.items():
        found[model] = set().union(*(claim.get(name, {}) for claim in table["claims"].values()))
    found["Ready"] = set().union(*(service["ready"] for service in table["services"].values()))
    found["Tolerance"] = set().union(*(one for output in table["outputs"].values() for one in output["tolerance"].values()))
    return found


def test_the_options_of_all_platforms_of_sierra_are_published() -> None:
    published = json.loads((FOLDER / published_schemas.TOML).read_text())["properties"]["platforms"]["properties"]
    assert set(published) >= {"argos", "command", "gazebo", "jsbsim", "mujoco", "ros", "sumo"}
    page = (FOLDER.parent / "docs" / "reference" / "sierra-toml.md").read_text()
    assert all(f"\nHeader: `[platforms.{name}]`\n" in page for name in set(published) - {"command"})


@pytest.mark.parametrize("name", [published_schemas.TOML, published_schemas.STORE])
def test_published_schemas_equal_the_generated_ones(name: str) -> None:
    assert (FOLDER / name).read_text() == published_schemas.generated()[name], "make schemas writes them anew"


def test_only_generated_schemas_are_published() -> None:
    assert {path.name for path in FOLDER.iterdir()} == set(published_schemas.generated())


def test_the_commented_toml_contains_only_comments_and_blank_lines(reference: str) -> None:
    assert tomllib.loads(reference) == {}
    assert all(re.match("(?:# |#[^ #]|$)", line) for line in reference.splitlines())


@pytest.mark.integration
def test_the_uncommented_toml_is_a_valid_project(reference: str) -> None:
    whole = uncommented(reference)
    project_file.parse(whole, "sierra.toml")
    validate.options(ArgosOptions, whole["platforms"]["argos"], "[platforms.argos]")
    jsonschema.validate(whole, json.loads(schema("--toml", "--json")))


def test_the_commented_toml_has_every_key_of_every_table(reference: str) -> None:
    whole = uncommented(reference)
    assert seen(whole) == {name: keys(model) for name, model in MODELS.items()}
    assert set(whole["platforms"]["argos"]) == keys(ArgosOptions)
    assert "command" in whole["platforms"]


def test_each_key_has_its_own_line_after_a_description_with_its_type(reference: str) -> None:
    lines = reference.splitlines()
    for needed in (
        ["# runs per experiment (whole number above 0; default 10)", "#runs = 10"],
        ["# the file from which the inputs of all runs are generated; default: none (text)", '#template = "template.xml"'],
        ["# time between SIGTERM and SIGKILL, in seconds (number above 0; default 5.0)", "#grace = 5.0"],
        ["# whether to keep the template's visualization (true or false; default false)", "#visualization = false"],
    ):
        assert lines[lines.index(needed[1]) - 1 : lines.index(needed[1]) + 1] == needed
    flowing = " ".join(line.removeprefix("# ") for line in lines)
    assert '("strict" or "ragged"; default "strict") #mismatch = "strict"' in flowing
    assert '("own", "carry" or "linear") #times = "own"' in flowing


def described(schema: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield every key in a JSON Schema with its description (or that of its table)."""
    for title, model in [("sierra.toml", schema), *schema["$defs"].items()]:
        for name, key in model.get("properties", {}).items():
            tables = [schema["$defs"][o["$ref"].rpartition("/")[2]] for o in (key, *key.get("anyOf", ())) if "$ref" in o]
            yield f"{title}.{name}", key.get("description") or (tables[0].get("description", "") if tables else "")


def test_every_key_has_a_description() -> None:
    lacking = [name for name, sentence in described(json.loads(published_schemas.toml_schema())) if not sentence]
    assert lacking == []


def test_keys_without_an_example_are_listed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    without = re.sub(r"(?m)^(runs|wall|threads|memory|kind) = .*\n", "", published_schemas.EXAMPLES.read_text())
    (tmp_path / "keys.toml").write_text(without)
    monkeypatch.setattr(published_schemas, "EXAMPLES", tmp_path / "keys.toml")
    whole = uncommented(published_schemas.toml())
    assert seen(whole) == {name: keys(model) for name, model in MODELS.items()}
    assert (whole["runs"], whole["platforms"]["argos"]["threads"]) == (10, 0)


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
        {"platforms": {"argos": {"lenght": 5}}},
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

"""A list of objects within JSON is found: one hint names the line that makes a row of each, and `outputs --write` writes it."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import pytest

from tests.projects import CONFIG, make, quick, run, sql

STEPS = [{"t": t, "pose": {"x": t / 2}, "robots": [{"id": i} for i in range(2)]} for t in range(4)]
RESULT = "\nimport json\njson.dump({document!r}, open('result.json', 'w'))\n"


def project(folder: Path, document: object, config: str = CONFIG) -> Path:
    return make(folder, config, simulator="import sys" + RESULT.format(document=document))


@pytest.mark.integration
@pytest.mark.parametrize(
    ("document", "keys"),
    [
        ({"config": {"n": 3}, "results": {"steps": [{"t": 0}, {"t": 1}]}}, 'rows = "results.steps"'),
        ({"steps": STEPS}, 'rows = "steps", unnest = "robots"'),
        (STEPS, 'unnest = "robots"'),
        ({"few": [{"a": 1}], "many": [{"b": 1}, {"b": 2}]}, 'rows = "many"'),
    ],
)
def test_the_rows_of_a_document_are_proposed(tmp_path: Path, document: object, keys: str) -> None:
    folder = project(tmp_path / "project", document)
    place = f'declare [outputs.result] file = "result.json", format = "json", {keys}'
    assert (
        f"not a table: result.json: this ending is read only if its format is named; {place}\n" in quick(folder, "try").stdout
    )


@pytest.mark.nightly
@pytest.mark.parametrize("document", [{"coverage": 0.5, "path": [1, 2, 3]}, {"a.b": [{"c": 1}]}])
def test_no_rows_are_proposed_for_a_document_without_a_list_of_objects(tmp_path: Path, document: object) -> None:
    folder = project(tmp_path / "project", document)
    assert 'declare [outputs.result] file = "result.json", format = "json"\n' in quick(folder, "try").stdout


@pytest.mark.integration
def test_write_declares_the_rows_of_a_document(tmp_path: Path) -> None:
    folder = project(tmp_path / "project", {"results": {"steps": STEPS}})
    run(folder, "population_size=1")
    assert quick(folder, "outputs", "--write").returncode == 0
    declared = {"file": "result.json", "format": "json", "rows": "results.steps", "unnest": "robots"}
    assert tomllib.loads((folder / "sierra.toml").read_text())["outputs"] == {"result": declared}
    summary, _ = run(folder, "population_size=1")
    assert (summary["executed"], summary["failed"]) == (0, 0)
    assert sql(folder, 'SELECT count(*) AS n, sum("robots.id") AS ids FROM result') == [{"n": 16, "ids": 8}]


@pytest.mark.nightly
def test_a_table_with_a_list_of_objects_in_a_text_gets_one_hint(tmp_path: Path) -> None:
    declared = CONFIG + '[outputs.result]\nfile = "result.json"\nformat = "json"\n'
    folder = project(tmp_path / "project", {"n": 1, "results": {"steps": STEPS}}, declared)
    _, said = run(folder, "population_size=1,2")
    hint = 'it is a list of objects ([outputs.result] rows = "results.steps" makes a row of each)'
    assert said.count(hint) == said.count("results.steps' of") == 1


@pytest.mark.nightly
def test_lines_of_json_with_a_list_of_objects_get_one_hint(tmp_path: Path) -> None:
    lines = "".join(json.dumps(step) + "\n" for step in STEPS)
    folder = make(tmp_path / "project", simulator=f"open('steps.jsonl', 'w').write({lines!r})\n")
    keys = 'file = "steps.jsonl", unnest = "robots", flatten = true'
    said = quick(folder, "try").stderr
    assert said.count(f"it is a list of objects ([outputs.steps] {keys} makes a row of each)") == 1

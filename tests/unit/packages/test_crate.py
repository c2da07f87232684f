"""The RO-Crate of a package describes all its members and all executed runs, and says nothing twice."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from sierra.config import project_file
from sierra.config.package_table import Package
from sierra.maintenance.extract import extract
from sierra.packages.crates import actions as crate_actions
from sierra.packages.crates import crate
from sierra.packages.layout import CRATE, PROJECT
from sierra.packages.subject import Member, Subject
from sierra.store.store import Store

PACKAGE = Package.model_validate(
    {
        "title": "Coverage of a swarm",
        "authors": [{"name": "Doe, Jane", "affiliation": "Example University"}, {"name": "Plato"}],
        "license": "MIT OR Apache-2.0",
        "date": "2026-11-23",
    }
)


@pytest.fixture
def subject(recorded: Path, tmp_path: Path) -> Subject:
    """The first two batches of the recorded project, which share runs."""
    project = project_file.load(recorded)
    project = dataclasses.replace(project, config=project.config.model_copy(update={"package": PACKAGE}))
    store = Store(recorded / ".sierra")
    batches = tuple(store.values(str, "SELECT batch FROM batches ORDER BY lamport")[:2])
    return Subject(project, extract(store, batches, tmp_path / "store"), batches, tmp_path, PACKAGE.date)


def written(subject: Subject) -> dict[str, Any]:
    names = (subject.project.file.name, "arena.xml", "a name with spaces é.csv")
    members = [Member(PROJECT + name, name.encode(), "a file") for name in names]
    made = {member.name: member for member in crate.members(subject, {one.name: one for one in members}).members}
    document: dict[str, Any] = json.loads(made[CRATE].open().read())
    entities = {one["@id"]: one for one in document["@graph"]}
    assert len(entities) == len(document["@graph"])
    return entities


def kind(entities: dict[str, Any], name: str) -> list[dict[str, Any]]:
    return [one for one in entities.values() if one["@type"] == name]


def values(value: object) -> Iterator[object]:
    """Yield a value and all values in it."""
    yield value
    for one in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        yield from values(one)


@pytest.mark.integration
def test_everything_is_described_once_and_everything_named_is_there(subject: Subject) -> None:
    entities = written(subject)
    found = list(values(list(entities.values())))
    named = {str(one["@id"]) for one in found if isinstance(one, dict) and len(one) == 1 and "@id" in one}
    assert {name for name in named if name not in entities} <= {"https://w3id.org/ro/crate/1.1"}
    assert [one for one in found[1:] if isinstance(one, list) and len(one) < 2] == []
    assert entities["project/a%20name%20with%20spaces%20%C3%A9.csv"]["contentSize"] == "25"
    assert {"README.md", "project/arena.xml", "project/sierra.toml"} <= {one["@id"] for one in entities["./"]["hasPart"]}
    assert entities["./"]["datePublished"] == "2026-11-23T00:00:00+00:00"
    assert entities["./"]["publisher"]["@id"] == "#organization-Example%20University"


@pytest.mark.integration
def test_each_executed_run_has_an_action_with_its_values_and_times(subject: Subject) -> None:
    entities = written(subject)
    runs = {one["identifier"]: one for one in kind(entities, "CreateAction") if one["@id"].startswith("#run-")}
    rows = subject.store.rows("SELECT run, population_size, execution FROM runs")
    assert runs.keys() == {row["run"] for row in rows}
    for row in rows:
        action = runs[str(row["run"])]
        assert entities[action["object"]["@id"]]["value"] == row["population_size"]
        assert action["@id"] == f"#run-{row['execution']!s}"
        assert action["actionStatus"] == "http://schema.org/CompletedActionStatus"
        assert action["startTime"] <= action["endTime"]
    assert len(kind(entities, "ControlAction")) == len(runs)
    organized = kind(entities, "OrganizeAction")
    assert [one["@id"] for one in organized] == [f"#organize-{batch}" for batch in subject.batches]
    counts = subject.store.values(
        int, "SELECT count(*) FROM batch_runs m JOIN batches b USING (batch) GROUP BY batch, lamport ORDER BY lamport"
    )
    assert [len(one["object"]) for one in organized] == counts


@pytest.mark.integration
def test_many_runs_are_described_by_experiment_and_the_crate_says_so(subject: Subject, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(crate_actions, "MOST", 3)
    entities = written(subject)
    actions = [one for one in kind(entities, "CreateAction") if one["@id"].startswith("#experiment-")]
    assert len(actions) == subject.store.values(int, "SELECT count(DISTINCT experiment) FROM experiments")[0]
    assert "described by experiment" in entities[f"#batch-{subject.batches[0]}"]["description"]
    assert not any(name.startswith("#run-") for name in entities)


@pytest.mark.integration
def test_the_same_records_give_the_same_bytes(subject: Subject) -> None:
    assert json.dumps(written(subject)) == json.dumps(written(subject))


@pytest.mark.parametrize(
    ("name", "registry", "folder", "tag"),
    [
        ("docker.io/library/debian:12", "docker.io", "library/debian", "12"),
        ("localhost:5000/robots", "localhost:5000", "robots", None),
        ("robots:2", "localhost", "robots", "2"),
        ("images/robots.sif", "localhost", "images/robots.sif", None),
    ],
)
def test_an_image_has_registry_name_and_tag(name: str, registry: str, folder: str, tag: str | None) -> None:
    entity = crate.described(crate.Image("sha256:" + "ab" * 32, "oci", name, None))
    assert (entity["registry"], entity["name"], entity["tag"] or None, entity["sha256"]) == (registry, folder, tag, "ab" * 32)

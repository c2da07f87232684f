"""`[package]` is the one source of all metadata files, and a project's own files are compared with it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import get_args

import pytest
import yaml
from pydantic import ValidationError

from sierra.config.package_table import Package, Relation
from sierra.errors import ConfigError
from sierra.packages.parts import metadata
from tests import projects

TABLE = {
    "title": "Coverage of a swarm",
    "description": "All runs of the paper.",
    "authors": [
        {"name": "Jane Mary Doe", "orcid": "0000-0002-1825-0097", "affiliation": "Example University"},
        {"name": "van Rossum, Guido"},
        {"name": "Plato"},
    ],
    "license": "cc-by-4.0",
    "keywords": ["swarm", "robots"],
    "related": [{"identifier": "https://doi.org/10.5555/12345678"}],
}
TOML = """
[package]
title = "Coverage of a swarm"
authors = [{ name = "Jane Doe", orcid = "0000-0002-1825-0097" }]
license = "MIT"
"""
PACKAGE = Package.model_validate(TABLE)
ZENODO = {
    *("title", "upload_type", "description", "creators", "license", "keywords", "publication_date", "related_identifiers"),
    "version",
}
"""Names in Zenodo's schema of deposits (legacyrecord.json, 2023-12-11); `version` is in its documentation of the API only."""
RELATIONS = {
    *(
        "isCitedBy",
        "cites",
        "isSupplementTo",
        "isSupplementedBy",
        "isNewVersionOf",
        "isPreviousVersionOf",
        "isPartOf",
        "hasPart",
    ),
    *("isReferencedBy", "references", "isDocumentedBy", "documents", "isDerivedFrom", "isSourceOf", "requires", "isRequiredBy"),
}
"""Relations in the same schema, as far as they are needed here."""
CODEMETA = {
    *("name", "description", "author", "givenName", "familyName", "affiliation", "license", "keywords", "version"),
    *("datePublished", "identifier", "codeRepository", "referencePublication"),
}
"""Terms in the context of CodeMeta (version 3.1), which also names Person, Organization and the prefix schema."""


def test_all_files_say_the_same() -> None:
    made = metadata.files(PACKAGE, "2026-11-23T10:00:00+00:00")
    citation, zenodo, codemeta = (
        yaml.safe_load(made["CITATION.cff"]),
        json.loads(made[".zenodo.json"]),
        json.loads(made["codemeta.json"]),
    )
    assert {citation["title"], zenodo["title"], codemeta["name"]} == {"Coverage of a swarm"}
    assert [one["name"] for one in zenodo["creators"]] == ["Doe, Jane Mary", "van Rossum, Guido", "Plato"]
    assert citation["authors"][0] == {
        "family-names": "Doe",
        "given-names": "Jane Mary",
        "orcid": "https://orcid.org/0000-0002-1825-0097",
        "affiliation": "Example University",
    }
    assert (citation["license"], zenodo["license"]) == ("CC-BY-4.0", "cc-by-4.0")
    assert codemeta["license"] == "https://spdx.org/licenses/CC-BY-4.0"
    assert {citation["date-released"], zenodo["publication_date"], codemeta["datePublished"]} == {"2026-11-23"}
    assert citation["identifiers"][0]["value"] == "10.5555/12345678"
    assert zenodo["related_identifiers"] == [
        {"relation": "isSupplementTo", "identifier": "10.5555/12345678", "resource_type": "publication-article"}
    ]
    assert metadata.differences(PACKAGE, made) == []


def test_all_names_are_those_of_the_published_schemas() -> None:
    table = {"version": "1.0", "doi": "10.5555/1", "repository": "https://example.org/x.git"}
    related = [{"identifier": "10.5555/12345678", "relation": relation} for relation in get_args(Relation)]
    made = metadata.files(Package.model_validate({**TABLE, **table, "related": related}), "2026-11-23")
    zenodo, codemeta = json.loads(made[".zenodo.json"]), json.loads(made["codemeta.json"])
    assert zenodo.keys() <= ZENODO
    assert {key for creator in zenodo["creators"] for key in creator} <= {"affiliation", "gnd", "name", "orcid"}
    assert {one["relation"] for one in zenodo["related_identifiers"]} <= RELATIONS
    found = list(_pairs(codemeta))
    assert {key for key, _ in found} <= CODEMETA | {"@context", "@type", "@id"}
    types = {str(value) for key, value in found if key == "@type"}
    assert types <= {"Person", "Organization", "SoftwareSourceCode"} | {one for one in types if one.startswith("schema:")}


def _pairs(value: object) -> Iterator[tuple[str, object]]:
    """Yield all keys and values of nested objects."""
    if isinstance(value, dict):
        yield from value.items()
    for one in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        yield from _pairs(one)


@pytest.mark.integration
def test_files_of_the_project_that_say_something_else_are_named() -> None:
    made = metadata.files(PACKAGE, "2026-11-23")
    other = metadata.files(Package.model_validate({**TABLE, "title": "Another", "authors": [{"name": "Plato"}]}), "2026-11-23")
    lines = metadata.differences(PACKAGE, {"CITATION.cff": other["CITATION.cff"], ".zenodo.json": made[".zenodo.json"]})
    assert lines == [
        "CITATION.cff has title 'Another', but [package] says 'Coverage of a swarm'",
        "CITATION.cff names the authors Plato, but [package] Doe, Jane Mary, van Rossum, Guido, Plato",
    ]
    for content in (b"[1]", b"{", b"\xff", b"a: [", b"[" * 5000):
        assert len(metadata.differences(PACKAGE, {"CITATION.cff": content})) == 1
        assert len(metadata.differences(PACKAGE, {"codemeta.json": content})) == 1


def test_a_package_needs_a_title_authors_and_a_licence() -> None:
    with pytest.raises(ConfigError, match="needs title, authors, license"):
        metadata.files(Package(), "2026-11-23")


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"license": "MTI"}, "SPDX"),
        ({"authors": [{"name": "Doe", "orcid": "0000-0002-1825-0098"}]}, "last digit does not fit"),
        ({"authors": [{"name": "Doe", "orcid": "1825"}]}, "should be an ORCID"),
        ({"authors": [{"name": "Doe", "ror": "https://ror.org/example"}]}, "should be a ROR id"),
        ({"authors": [{"name": ""}]}, "at least 1 character"),
        ({"related": [{"identifier": "the paper"}]}, "should be a DOI"),
        ({"date": "yesterday"}, "should be a date"),
        ({"data": [{"name": "map.png", "url": "ftp://x", "sha256": "0" * 64}]}, "url"),
    ],
)
def test_wrong_values_are_refused(wrong: dict[str, object], said: str) -> None:
    with pytest.raises(ValidationError, match=said):
        Package.model_validate({**TABLE, **wrong})


def test_a_project_gets_its_files_once_and_hears_of_what_differs(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "p", projects.CONFIG + TOML)
    done = projects.quick(root, "cite", "--write")
    assert (done.returncode, done.stdout.count(": written")) == (0, 3)
    again = projects.quick(root, "cite")
    assert (again.returncode, again.stdout.count("agrees with [package]")) == (0, 3)
    (root / "sierra.toml").write_text(projects.CONFIG + TOML.replace("Coverage", "Uncovered"))
    other = projects.quick(root, "cite", "--write")
    assert (other.returncode, other.stdout.count("but [package] says 'Uncovered of a swarm'")) == (1, 3)
    assert "Coverage" in (root / "CITATION.cff").read_text()
    (root / "sierra.toml").write_text(projects.CONFIG)
    lacking = projects.quick(root, "cite")
    assert (lacking.returncode, "needs title, authors, license" in lacking.stderr) == (2, True)

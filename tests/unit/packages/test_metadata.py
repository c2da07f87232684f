"""`[package]` is the one source of the citation file, and a project's own file is compared with it."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from pydantic import ValidationError

from sierra.config.package_table import Package
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


def test_the_citation_file_says_what_the_table_says() -> None:
    made = metadata.files(PACKAGE, "2026-11-23T10:00:00+00:00")
    citation = yaml.safe_load(made["CITATION.cff"])
    assert citation["title"] == "Coverage of a swarm"
    assert [one["family-names"] for one in citation["authors"]] == ["Doe", "van Rossum", "Plato"]
    assert citation["authors"][0] == {
        "family-names": "Doe",
        "given-names": "Jane Mary",
        "orcid": "https://orcid.org/0000-0002-1825-0097",
        "affiliation": "Example University",
    }
    assert (citation["license"], citation["date-released"]) == ("CC-BY-4.0", "2026-11-23")
    assert citation["identifiers"][0]["value"] == "10.5555/12345678"
    assert metadata.differences(PACKAGE, made) == []


@pytest.mark.integration
def test_files_of_the_project_that_say_something_else_are_named() -> None:
    other = metadata.files(Package.model_validate({**TABLE, "title": "Another", "authors": [{"name": "Plato"}]}), "2026-11-23")
    lines = metadata.differences(PACKAGE, other)
    assert lines == [
        "CITATION.cff has title 'Another', but [package] says 'Coverage of a swarm'",
        "CITATION.cff names the authors Plato, but [package] Doe, Jane Mary, van Rossum, Guido, Plato",
    ]
    for content in (b"[1]", b"{", b"\xff", b"a: [", b"[" * 5000):
        assert len(metadata.differences(PACKAGE, {"CITATION.cff": content})) == 1


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
    assert (done.returncode, done.stdout.count(": written")) == (0, 1)
    again = projects.quick(root, "cite")
    assert (again.returncode, again.stdout.count("agrees with [package]")) == (0, 1)
    (root / "sierra.toml").write_text(projects.CONFIG + TOML.replace("Coverage", "Uncovered"))
    other = projects.quick(root, "cite", "--write")
    assert (other.returncode, other.stdout.count("but [package] says 'Uncovered of a swarm'")) == (1, 1)
    assert "Coverage" in (root / "CITATION.cff").read_text()
    (root / "sierra.toml").write_text(projects.CONFIG)
    lacking = projects.quick(root, "cite")
    assert (lacking.returncode, "needs title, authors, license" in lacking.stderr) == (2, True)

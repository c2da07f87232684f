"""The files of this repository are valid, complete and consistent with each other."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml

import sierra

ROOT = Path(__file__).parents[2]
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
LOCK = (ROOT / "requirements.lock").read_text("utf-8")
ROS2_LOCK = (ROOT / "tests" / "system" / "ros2.lock").read_text("utf-8")
DEMO_LOCK = (ROOT / "requirements-demo.lock").read_text("utf-8")

NEWER_THAN_3_8 = {"annotationlib", "compression", "graphlib", "string.templatelib", "tomllib", "zoneinfo"}
"""Modules of the standard library that Python 3.8 does not have."""

TEXT = {"type": "string", "minLength": 1}
DATE = {"type": "string", "pattern": r"^\d{4}-\d{2}-\d{2}$"}


def table(required: str, **properties: Any) -> dict[str, Any]:
    return {"type": "object", "required": required.split(), "properties": properties, "additionalProperties": False}


ENTITY = table("name", **{"name": TEXT, "location": TEXT, "date-start": DATE, "date-end": DATE})
PERSON = table("family-names given-names", **{"family-names": TEXT, "given-names": TEXT, "affiliation": TEXT})
AUTHORS = {"type": "array", "minItems": 1, "items": {"anyOf": [ENTITY, PERSON]}}
CITATION_SCHEMA = table(
    "cff-version message title authors version license preferred-citation",
    **{
        "cff-version": {"const": "1.2.0"},
        "message": TEXT,
        "type": {"enum": ["software", "dataset"]},
        "title": TEXT,
        "version": TEXT,
        "date-released": DATE,
        "license": {"const": "MIT"},
        "authors": AUTHORS,
        "abstract": TEXT,
        "keywords": {"type": "array", "items": TEXT, "uniqueItems": True, "minItems": 1},
        "preferred-citation": table(
            "type title authors year",
            **{
                "type": {"const": "conference-paper"},
                "title": TEXT,
                "authors": AUTHORS,
                "year": {"type": "integer"},
                "month": {"type": "integer", "minimum": 1, "maximum": 12},
                "collection-title": TEXT,
                "conference": ENTITY,
                "notes": TEXT,
            },
        ),
    },
)
"""The part of the Citation File Format 1.2.0 that CITATION.cff uses; like the full format, it allows no other keys."""


@pytest.fixture
def citation() -> dict[str, Any]:
    loaded: dict[str, Any] = yaml.load((ROOT / "CITATION.cff").read_text("utf-8"), yaml.BaseLoader)  # noqa: S506
    cited = loaded["preferred-citation"]
    cited["year"], cited["month"] = int(cited["year"]), int(cited["month"])
    return loaded


def requirements(*groups: list[str]) -> set[str]:
    return {normal(re.split(r"[^\w.-]", line)[0]) for group in groups for line in group}


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def imports(code: str) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(code)):
        match node:
            case ast.Import(names=names):
                found |= {alias.name for alias in names}
            case ast.ImportFrom(module=module, level=level):
                found.add("." * level + (module or ""))
    return found


def test_citation_file_is_valid(citation: dict[str, Any]) -> None:
    jsonschema.validate(citation, CITATION_SCHEMA)


def test_citation_file_names_this_version(citation: dict[str, Any]) -> None:
    assert citation["version"] == sierra.__version__


def test_license_is_mit_in_all_files() -> None:
    assert (ROOT / "LICENSE").read_text("utf-8").startswith("MIT License\n\nCopyright (c) 2026 SIERRA contributors\n")
    assert PYPROJECT["project"]["license"] == "MIT"


def test_changelog_has_a_section_for_unreleased_changes() -> None:
    assert "\n## [Unreleased]\n" in (ROOT / "CHANGELOG.md").read_text("utf-8")


def test_lock_file_contains_every_direct_dependency() -> None:
    project, build = PYPROJECT["project"], PYPROJECT["build-system"]
    extras = dict(project["optional-dependencies"])
    ros2 = requirements(extras.pop("ros2"))  # in an environment of its own
    assert ros2 - {normal(project["name"])} <= {normal(name) for name in re.findall(r"^([\w.-]+)==", ROS2_LOCK, re.MULTILINE)}
    wanted = requirements(project["dependencies"], build["requires"], *extras.values())
    locked = {normal(name) for name in re.findall(r"^([\w.-]+)==", LOCK, re.MULTILINE)}
    assert wanted - {normal(project["name"])} <= locked


def test_every_entry_of_the_lock_file_has_a_hash() -> None:
    entries = re.split(r"^(?=[\w.-]+==)", LOCK, flags=re.MULTILINE)[1:]
    assert entries
    assert [entry.split()[0] for entry in entries if "--hash=sha256:" not in entry] == []


def test_the_demo_has_the_locked_versions_of_what_users_need() -> None:
    every, demo = (set(re.findall(r"^[\w.-]+==\S+|--hash=\S+", lock, re.MULTILINE)) for lock in (LOCK, DEMO_LOCK))
    assert demo < every
    project = PYPROJECT["project"]
    wanted = requirements(project["dependencies"], project["optional-dependencies"]["example"])
    assert wanted <= {normal(name) for name in re.findall(r"^([\w.-]+)==", DEMO_LOCK, re.MULTILINE)}
    assert not {"mypy", "pytest", "sphinx", "scikit-learn"} & {
        normal(name) for name in re.findall(r"^([\w.-]+)==", DEMO_LOCK, re.MULTILINE)
    }


def test_a_fork_executes_the_steps_of_ci() -> None:
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text("utf-8"))
    steps = [step.get("run") for job in workflow["jobs"].values() for step in job["steps"]]
    assert ".ci/run" in steps
    assert all("@" in step.get("uses", "@") for job in workflow["jobs"].values() for step in job["steps"])


def test_lock_file_contains_no_host_and_no_path() -> None:
    allowed = re.compile(r"[\w.-]+==\S+( ; .+)? \\|    --hash=sha256:[0-9a-f]{64}( \\)?|    # .*")
    assert [line for line in LOCK.splitlines() if not allowed.fullmatch(line)] == []
    assert not re.search(r"://|(?<!\w)[/~]\w|--(extra-)?index|--find-links", LOCK)


def test_wheel_contains_the_whole_package() -> None:
    from hatchling.builders.wheel import WheelBuilder

    shipped = {Path(file.relative_path) for file in WheelBuilder(str(ROOT)).recurse_included_files()}
    files = {path.relative_to(ROOT) for path in (ROOT / "sierra").rglob("*") if path.is_file()}
    left_out = {path for path in files if {"__pycache__", ".sierra"} & set(path.parts)}
    assert shipped == files - left_out
    assert Path("sierra/py.typed") in shipped


@pytest.mark.parametrize("path", sorted((ROOT / "sierra" / "worker").glob("*.py")), ids=lambda path: path.stem)
def test_programs_of_nodes_import_only_each_other_and_the_standard_library_of_python_3_8(path: Path) -> None:
    text = path.read_text("utf-8")
    found = {name for name in imports(text) if name != "sierra.worker" and not name.startswith("sierra.worker.")} - {"sierra"}
    top = {name.partition(".")[0] for name in found}
    assert top <= sys.stdlib_module_names
    assert not (top | found) & NEWER_THAN_3_8
    ast.parse(text, feature_version=(3, 8))
    assert path.stem not in sys.stdlib_module_names

"""Packages of others are read, and never executed or believed."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import pytest

import sierra
from sierra.packages import archive
from sierra.packages.layout import PROGRAM, PROJECT, STORED
from sierra.packages.members import MANIFEST
from sierra.packages.subject import Member
from tests import projects

TOML = '\n[package]\ntitle = "Coverage of a swarm"\nauthors = [{ name = "Jane Doe" }]\nlicense = "MIT"\n'
pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = projects.make(tmp_path_factory.mktemp("hostile") / "project", projects.CONFIG + TOML)
    batch = sierra.open(root).run("population_size=1", figures=False).batch
    sierra.open(root).package(batch, report=False, path=root.parent / "x.zip")
    return root.parent / "x.zip"


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def changed(package: Path, target: Path, **members: bytes) -> Path:
    """Write a package with other content of some members, and right hashes."""
    with zipfile.ZipFile(package) as file:
        contents = {name: file.read(name) for name in file.namelist() if name != MANIFEST}
    contents |= members
    archive.write(target, {name: Member(name, content, "") for name, content in contents.items()})
    return target


def test_another_reproduce_py_is_named(package: Path, tmp_path: Path) -> None:
    assert PROGRAM not in projects.quick(tmp_path, "open", str(package)).stdout
    changed(package, tmp_path / "bad.zip", **{PROGRAM: b"import os; os.system('touch evil')\n"})
    told = projects.quick(tmp_path, "open", "bad.zip")
    assert told.returncode == 0
    assert f"{PROGRAM} in the package is not that of SIERRA" in told.stdout
    assert not (tmp_path / "evil").exists()


def test_a_store_of_a_newer_format_is_refused_in_one_line(package: Path, tmp_path: Path) -> None:
    root = projects.make(tmp_path / "own")
    changed(package, tmp_path / "bad.zip", **{f"{STORED}format": b"sierra store 99\n"})
    for words in (("open", "../bad.zip", "ls"), ("import", "../bad.zip")):
        ended = projects.quick(root, *words)
        assert (ended.returncode, ended.stdout, ended.stderr.count("\n")) == (1, "", 1), ended.stderr
        assert "'sierra store 99'" in ended.stderr


def test_commands_and_statements_of_a_package_reach_nothing_outside(package: Path, tmp_path: Path) -> None:
    (tmp_path / "secret.csv").write_text("secret\nsesame\n")
    evil = f"touch {tmp_path / 'evil'}"
    with zipfile.ZipFile(package) as file:
        batch = json.loads(file.read("package.json"))["batches"][0]["batch"]
    claims = "".join(
        f'[claims.c{place}]\nsays = "x"\npaper = "1"\nbatches = ["{batch}"]\nsql = "{sql}"\n'
        for place, sql in enumerate(
            (
                f"SELECT count(*) > 0 FROM read_csv('{tmp_path / 'secret.csv'}')",
                f"COPY (SELECT 1) TO '{tmp_path / 'evil'}'",
                f"SELECT count(*) > 0 FROM '{tmp_path / 'secret.csv'}'",
            )
        )
    )
    config = projects.CONFIG.replace("python3 sim.py {input}", f"sh -c '{evil}' {{input}}") + TOML + claims
    config += f'[build]\ncommand = "{evil}"\nproduces = ["x"]\n'
    changed(package, tmp_path / "bad.zip", **{f"{PROJECT}sierra.toml": config.encode()})
    for words in (
        (),
        ("ls",),
        ("sql", "SELECT count(*) AS n FROM runs"),
        ("show", "population_size=1"),
        ("claims",),
        ("fsck",),
    ):
        said = projects.quick(tmp_path, "open", "bad.zip", *words)
        assert "Traceback" not in said.stderr
        assert "sesame" not in said.stdout
    with zipfile.ZipFile(tmp_path / "bad.zip") as file:
        file.extractall(tmp_path / "unpacked")
    for name in ("c0", "c1", "c2"):
        told = projects.quick(tmp_path / "unpacked" / "project", "claims", name)
        assert told.returncode != 0
        assert f"[claims.{name}] sql" in told.stdout + told.stderr
        assert "secret\n" not in told.stdout
    assert not (tmp_path / "evil").exists()

"""Packages of others are read, and never executed or believed."""

from __future__ import annotations

import json
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import sierra
from sierra.packages import archive
from sierra.packages.layout import PROGRAM, PROJECT, STORED
from sierra.packages.members import MANIFEST
from sierra.packages.subject import Member
from sierra.worker import reproduce
from tests import projects
from tests.support.irregular_files import irregular

TOML = '\n[package]\ntitle = "Coverage of a swarm"\nauthors = [{ name = "Jane Doe" }]\nlicense = "MIT"\n'
pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = projects.make(tmp_path_factory.mktemp("hostile") / "project", projects.CONFIG + TOML)
    batch = sierra.open(root).run("population_size=1", figures=False).batch
    sierra.open(root).packages.pack(batch, report=False, path=root.parent / "x.zip")
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


PEAK = """
import resource, subprocess, sys
code = subprocess.run(sys.argv[1:]).returncode
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss, file=sys.stderr)
sys.exit(code)
"""
"""Execute a command and print the largest memory of its processes, in kB. A process inherits that of the one that starts it."""


def test_a_statement_of_a_package_that_takes_all_memory_or_time_is_ended(package: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(package) as file:
        batch = json.loads(file.read("package.json"))["batches"][0]["batch"]
    statements = {
        "endless": "SELECT max(levenshtein(repeat('a', 1000000), repeat(run[1], 1000000))) > 0 FROM swarm",
        "large": "SELECT max(length(repeat(run, 20000000))) > 0 FROM swarm",
        "derived": "SELECT count(*) > 0 FROM huge",
        "holds": "SELECT count(*) > 0 FROM swarm",
    }
    claims = "".join(
        f'[claims.{name}]\nsays = "x"\npaper = "1"\nbatches = ["{batch}"]\nsql = "{sql}"\n' for name, sql in statements.items()
    )
    table = (
        '[tables.huge]\nsql = "SELECT run, list_sum(range(1000000000)) AS n FROM swarm"\n[sql]\nwall = 2\nmemory = "500 MB"\n'
    )
    config = projects.CONFIG + TOML + claims + table
    changed(package, tmp_path / "bad.zip", **{f"{PROJECT}sierra.toml": config.encode()})
    command = [sys.executable, "-c", PEAK, projects.SIERRA, "open", "bad.zip", "claims", "--json"]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    found = {one["name"]: one for one in json.loads(ended.stdout)}
    assert ended.returncode == 1
    assert int(ended.stderr.splitlines()[-1]) * 1024 < 1_500_000_000
    assert found["holds"]["verdict"] == "holds"
    assert "did not end within 2 s" in found["endless"]["text"], found
    for name in ("large", "derived"):
        assert "out of memory" in found[name]["text"]
    said = projects.quick(tmp_path, "open", "bad.zip", "sql", "FROM huge")
    assert (said.returncode, said.stderr.count("\n")) == (1, 1)
    assert "out of memory" in said.stderr


@pytest.mark.parametrize("kind", ["pipe", "socket", "device"])
@pytest.mark.each_case
def test_a_package_that_is_no_regular_file_is_refused(tmp_path: Path, kind: str) -> None:
    path = irregular(tmp_path / "x.zip", kind)
    root = projects.make(tmp_path / "own")
    for words in (("open", "../x.zip"), ("open", "../x.zip", "ls"), ("import", "../x.zip"), ("reproduce", "../x.zip")):
        ended = projects.quick(root, *words)
        assert (ended.returncode, ended.stdout, ended.stderr.count("\n")) == (3, "", 1), ended.stderr
        assert ended.stderr.endswith("and not a regular file\n")
    program = [sys.executable, "-I", str(reproduce.__file__), str(path)]
    refused = subprocess.run(program, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert (refused.returncode, "is no regular file" in refused.stdout) == (1, True), refused

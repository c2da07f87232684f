"""Versions that programs report, and programs that do something else when they are started for their version."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest

import sierra
from sierra.config.execution_tables import ProgramsTable
from sierra.provenance import fingerprint_programs, reported_versions

VARIABLES = {"PATH": "/usr/bin:/bin", "LC_ALL": "C.UTF-8"}


@pytest.fixture(autouse=True)
def no_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.fixture
def script(tmp_path: Path) -> Callable[[str], Path]:
    """Return a function that writes a program from a shell script."""

    def script(text: str) -> Path:
        path = tmp_path / "bin" / "sim"
        path.parent.mkdir(exist_ok=True)
        path.write_text(f"#!/bin/sh\n{text}\n")
        path.chmod(0o755)
        return path

    return script


def said(path: Path, table: ProgramsTable | None = None) -> str | None:
    """Return the recorded version of a script that is configured to report one."""
    table = table or ProgramsTable(versions={"sim": ("--version",)})
    project = path.parent.parent / "project"
    project.mkdir(exist_ok=True)
    found = fingerprint_programs.find((str(path),), VARIABLES, project)
    answered = reported_versions.with_versions(found, table, VARIABLES, project)
    assert answered.id == found.id
    return next(one.version for one in answered.all if one.path == str(path))


def test_the_first_line_that_is_not_empty_is_the_version(script: Callable[[str], Path]) -> None:
    assert said(script('echo; echo "  sim $1 4.0.1  "; echo more')) == "sim --version 4.0.1"
    assert said(script("echo sim 4 >&2")) == "sim 4"


def test_colours_are_removed_from_a_version(script: Callable[[str], Path]) -> None:
    """ARGoS writes the parts of its first line in colour, even into a pipe."""
    text = r"printf '\033[1;32mARGOS_VERSION=3.0.0-beta59\033[0m\n\033[1;32mARGOS_INSTALL_PREFIX=/usr\033[0m\n\033[0m'"
    assert said(script(text)) == "ARGOS_VERSION=3.0.0-beta59"


def test_the_project_sets_the_arguments_that_report_the_version(script: Callable[[str], Path]) -> None:
    assert said(script('echo "$@"'), ProgramsTable(versions={"sim": ("-v", "a b")})) == "-v a b"
    assert said(script("echo 1"), ProgramsTable(versions={"sim": ()})) is None


def test_scripts_and_programs_of_the_project_do_not_report_versions_by_default(
    tmp_path: Path, script: Callable[[str], Path]
) -> None:
    assert said(script(f"touch {tmp_path}/executed; echo 1"), ProgramsTable()) is None
    assert not (tmp_path / "executed").exists()
    own = tmp_path / "project" / "true"
    own.parent.mkdir(exist_ok=True)
    own.write_bytes(Path("/bin/true").read_bytes())
    own.chmod(0o755)
    for path, version in ((own, None), (Path("/bin/true"), "true (GNU coreutils)")):
        found = fingerprint_programs.find((str(path),), VARIABLES, tmp_path / "project")
        first = reported_versions.with_versions(found, ProgramsTable(), VARIABLES, tmp_path / "project").all[0]
        assert (first.version or "none").startswith(version or "none")


@pytest.mark.integration
@pytest.mark.parametrize(
    "text",
    [
        "",
        "echo 1; exit 1",
        "kill -9 $$",
        r"printf '\377\376 1.0\n'",
        r"printf '\033[2J1.0\n'",
        r"printf '1.0\0\n'",
        "sleep 60",
        "trap '' TERM; while :; do :; done",
        "cat",
        "yes 1.0",
        "head -c 1000000000 /dev/zero",
        "echo 1.0; sleep 60 & wait",
        "read line || exit 1",
    ],
)
def test_a_program_that_does_something_else_has_no_version(
    script: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    monkeypatch.setattr(reported_versions, "TIMEOUT_S", 1.0)
    path = script(text)
    began = time.monotonic()
    assert said(path) is None
    assert time.monotonic() - began < 50


@pytest.mark.nightly
def test_a_slow_program_may_report_its_version(script: Callable[[str], Path]) -> None:
    assert said(script("sleep 2; echo 1.0")) == "1.0"


def test_processes_that_the_program_starts_are_ended_even_outside_its_group(
    tmp_path: Path, script: Callable[[str], Path]
) -> None:
    marker = f"0.{time.time_ns()}"
    path = script(f"(setsid sleep 1{marker} &) ; sleep 2{marker} & echo 1.0")
    assert said(path) == "1.0"
    running = subprocess.run(["ps", "-e", "-o", "args="], capture_output=True, text=True, check=True).stdout
    assert marker not in running


def test_the_program_writes_small_files_into_a_temporary_folder(tmp_path: Path, script: Callable[[str], Path]) -> None:
    path = script(f'pwd > {tmp_path}/where; ls -A >> {tmp_path}/where; echo x > left; echo "$HOME $TMPDIR" >> {tmp_path}/where')
    said(path)
    folder, homes = (tmp_path / "where").read_text().splitlines()
    assert homes == f"{folder} {folder}"
    assert not Path(folder).exists()
    limited = "until [ $(ulimit -f) != unlimited ]; do sleep 0.01; done"  # set just after the program has begun
    said(script(f"{limited}; head -c 100000000 /dev/zero > {tmp_path}/large"))
    assert (tmp_path / "large").stat().st_size <= 1 << 20


def test_an_unchanged_program_is_not_started_again_for_its_version(tmp_path: Path, script: Callable[[str], Path]) -> None:
    path = script(f"echo >> {tmp_path}/asked; echo 1.0")
    assert [said(path), said(path)] == ["1.0", "1.0"]
    assert (tmp_path / "asked").read_text() == "\n"
    assert said(script(f"echo >> {tmp_path}/asked; echo 2.0")) == "2.0"


@pytest.mark.integration
def test_a_version_is_recorded_and_does_not_change_runs(tmp_path: Path, script: Callable[[str], Path]) -> None:
    path = script("[ $1 = -v ] && echo 1.0; exit 0")
    root = tmp_path / "p"
    root.mkdir()
    (root / "t.xml").write_text('<e n="0"/>')
    toml = f"template = 't.xml'\ncommand = '{path} x'\nruns = 1\n[variables]\nn = '//e/@n'\n"
    (root / "sierra.toml").write_text(toml)
    sierra.open(root).run("n=1", figures=False)
    (root / "sierra.toml").write_text(f"{toml}[programs]\nversion = ''\nversions = {{ sim = '-v' }}\n")
    project = sierra.open(root)
    assert project.run("n=1", figures=False).executed == 0
    assert project.run("n=1,2", figures=False).executed == 1
    assert project.sql("SELECT version FROM programs WHERE path = $p", p=str(path)).column(0).to_pylist() == ["1.0"]


def test_planning_starts_no_program_for_its_version(tmp_path: Path, script: Callable[[str], Path]) -> None:
    path = script(f"touch {tmp_path}/executed")
    root = tmp_path / "p"
    root.mkdir()
    (root / "t.xml").write_text('<e n="0"/>')
    toml = f"template = 't.xml'\ncommand = '{path} x'\n[variables]\nn = '//e/@n'\n[programs.versions]\nsim = '-v'\n"
    (root / "sierra.toml").write_text(toml)
    sierra.open(root).plan("n=1")
    assert not (tmp_path / "executed").exists()

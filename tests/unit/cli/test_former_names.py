"""Options that have replaced commands do the same, and help and completion list no former name."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from sierra.cli.app import FORMER
from sierra.config import extensions
from tests import projects

MODEL = """
[models.half]
column = "coverage"
expression = "0.1 * population_size"
"""
CLAIM = """
[package]
title = "A swarm"
license = "MIT"
authors = [{ name = "A. Person" }]
[queries.sizes]
criteria = ["population_size=1,2"]
runs = 2
[claims.some]
query = "sizes"
says = "There is coverage."
paper = "Sec. 1"
value = { column = "coverage", expected = 0.5, margin = 0.5 }
"""
PAIRS = {
    "status": ("ls --jobs", "status"),
    "status in JSON": ("ls --jobs --json", "status --json"),
    "files": ("show {run} --files", "files {run}"),
    "files in JSON": ("show {run} --files --json", "files {run} --json"),
    "a file": ("show {run} swarm.csv", "files {run} swarm.csv"),
    "models": ("stats --models", "models"),
    "a model": ("stats --models half -b {batch} -f csv", "models {batch} half -f csv"),
    "baseline": ("claims --keep v1", "baseline set v1"),
    "cite": ("package --cite", "cite --write"),
}


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = projects.make(tmp_path_factory.mktemp("former") / "project")
    with (folder / "sierra.toml").open("a") as file:
        file.write(CLAIM + MODEL)
    assert projects.quick(folder, "run", "sizes", "--no-figures").returncode == 0
    return folder


@pytest.mark.parametrize("words", PAIRS.values(), ids=PAIRS)
def test_an_option_does_what_the_former_command_does(project: Path, words: tuple[str, str]) -> None:
    ids = dict(zip(("batch", "run"), _ids(project), strict=True))
    now, before = (projects.quick(project, *text.format(**ids).split()) for text in words)
    assert now.returncode == 0, now.stderr
    expected = before.stdout.replace("agrees with [package]", "written") if words[0] == "package --cite" else before.stdout
    assert (now.stdout, now.stderr) == (expected, before.stderr)


def _ids(project: Path) -> list[str]:
    answer = projects.quick(project, "sql", "SELECT batch, run FROM batch_runs LIMIT 1", "--format", "csv").stdout
    return answer.splitlines()[1].split(",")


@pytest.mark.parametrize("words", [("show", "--to", "{to}"), ("run", "--inputs", "{to}")])
def test_files_are_written_as_before(project: Path, tmp_path: Path, words: tuple[str, str, str]) -> None:
    batch, _ = _ids(project)
    former = {"show": "files", "run": "inputs"}[words[0]]
    now = projects.quick(project, words[0], batch, words[1], str(tmp_path / "now"))
    before = projects.quick(project, former, batch, "--to", str(tmp_path / "before"))
    assert (now.returncode, before.returncode) == (0, 0)
    assert now.stdout == before.stdout.replace(str(tmp_path / "before"), str(tmp_path / "now"))
    assert _tree(tmp_path / "now") == _tree(tmp_path / "before") != {}


def _tree(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_each_command_of_an_extension_has_a_section() -> None:
    assert extensions.sections().keys() == {name for name in extensions.added("commands") if " " not in name}


def test_help_lists_no_former_name(project: Path) -> None:
    listed = set(re.findall(r"^  ([a-z-]+)  ", projects.quick(project, "--help").stdout.partition("\nRun:")[2], re.MULTILINE))
    assert len(listed) <= 33
    assert not listed & {*FORMER, "capture"}


REFUSED: dict[str, tuple[str, str]] = {
    "an id of ls": ("ls 9e1c", "without --jobs, all batches are listed"),
    "stats without a column": ("stats swarm", "name an OUTPUT and a COLUMN"),
    "models with a column": ("stats --models half coverage", "leave out COLUMN"),
    "models for papers": ("stats --models -f latex", "no table for papers"),
    "inputs with a runner": ("run sizes --inputs x --on slurm", "leave out --on"),
    "keep in JSON": ("claims --keep v1 --json", "leave out"),
    "a package without a file": ("package 9e1c", "name the file to write"),
    "cite with a batch": ("package 9e1c --cite", "--cite packs nothing"),
    "cite with an option of packages": ("package --cite --image oci", "--cite packs nothing"),
    "inputs with 0 looks": ("run sizes --inputs x --max-runs 0", "leave out --max-runs"),
    "long files": ("show 9e1c --files --long", "leave out --long"),
    "a file and all files": ("show 9e1c swarm.csv --files", "leave out --long, PATH and --to"),
}


@pytest.mark.parametrize(("words", "message"), REFUSED.values(), ids=REFUSED)
def test_options_that_do_not_fit_are_refused_in_one_line(project: Path, words: str, message: str) -> None:
    ended = projects.quick(project, *words.split())
    assert ended.returncode == 2
    assert message in ended.stderr
    assert ended.stderr.count("\n") == 1


def test_a_package_is_imported_by_an_option(project: Path, tmp_path: Path) -> None:
    batch, _ = _ids(project)
    file = tmp_path / "results.zip"
    packed = projects.quick(project, "package", batch, "-o", str(file), "--yes", "--no-report")
    assert packed.returncode == 0, packed.stderr
    other = projects.make(tmp_path / "other")
    now = projects.quick(other, "open", str(file), "import")
    assert now.returncode == 0, now.stderr
    assert "4 executions added" in now.stdout
    assert projects.quick(other, "ls").stdout.count("\n") == 2

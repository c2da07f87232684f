"""The folder that a command works on."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.projects import make, quick


@pytest.mark.integration
@pytest.mark.parametrize("text", ["[variables\n", 'unknown = 1\ntemplate = "t"\n'])
def test_recorded_results_can_be_read_while_the_configuration_is_invalid(tmp_path: Path, text: str) -> None:
    project = make(tmp_path / "project")
    assert quick(project, "run", "population_size=1", "--no-figures").returncode == 0
    (project / "sierra.toml").write_text(text)
    assert quick(project, "ls").returncode == 0
    refused = quick(project, "run", "population_size=1")
    assert (refused.returncode, "sierra.toml" in refused.stderr) == (2, True)


def test_settings_that_are_not_a_table_are_refused(tmp_path: Path) -> None:
    (tmp_path / "pyproject.toml").write_text("[tool]\nsierra = 1\n")
    refused = quick(tmp_path, "ls")
    assert (refused.returncode, "tool.sierra must be a table" in refused.stderr) == (2, True)


@pytest.mark.parametrize(
    ("number", "why"),
    [("1e400", "it is too large"), ("-1e-400", "it is too close to 0"), ("1_0.5e-40_0", "it is too close to 0")],
)
def test_a_number_that_floats_cannot_represent_is_refused(tmp_path: Path, number: str, why: str) -> None:
    project = make(tmp_path / "project")
    text = (project / "sierra.toml").read_text()
    (project / "sierra.toml").write_text(f'{text}\n[scenarios.s]\nchanges = [{{ set = "//@n", value = {number} }}]\n')
    refused = quick(project, "run", "population_size=1", "-n")
    [line] = refused.stderr.splitlines()
    assert line.endswith(f"sierra.toml: the number {number} is outside the range of floats: {why}")


@pytest.mark.parametrize(
    "text",
    [f"x = {'[' * 5000}{']' * 5000}", f"x = {'{a = ' * 3000}1{'}' * 3000}", f"{'.'.join(['a'] * 5000)} = 1"],
    ids=["lists", "tables", "keys"],
)
@pytest.mark.parametrize("where", ["", "[runners.slurm]\n", "[template_formats.x]\n"])
def test_settings_that_are_nested_deeply_are_refused_in_one_line(tmp_path: Path, where: str, text: str) -> None:
    (tmp_path / "sierra.toml").write_text(f"{where}{text}\n")
    refused = quick(tmp_path, "run", "population_size=1", "-n")
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)
    assert refused.stderr.endswith("sierra.toml: lists and tables are nested too deeply\n")

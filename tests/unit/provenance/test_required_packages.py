"""Required Python packages are checked before anything executes."""

from __future__ import annotations

from pathlib import Path

import pytest

import sierra
from tests import projects


@pytest.mark.integration
def test_a_missing_package_is_named_before_any_run_executes(tmp_path: Path) -> None:
    config = projects.CONFIG.replace('"python3 ', '"{python} ')
    root = projects.make(tmp_path, 'requires = ["absent-package>=1", "duckdb"]\n' + config)
    ended = projects.quick(root, "run", "population_size=1")
    assert ended.returncode == 3
    assert "absent-package>=1" in ended.stderr
    assert "duckdb" not in ended.stderr
    assert ended.stderr.count("\n") == 1
    assert sierra.open(root).batches == []
    checked = projects.quick(root, "doctor")
    assert "not installed: absent-package>=1" in checked.stdout
    assert projects.quick(root, "run", "population_size=1", "-n").returncode == 0


@pytest.mark.integration
def test_requirements_are_checked_only_in_the_python_of_the_runs(tmp_path: Path) -> None:
    root = projects.make(tmp_path, 'requires = ["absent-package"]\n' + projects.CONFIG)
    assert projects.quick(root, "run", "population_size=1", "--no-figures").returncode == 0

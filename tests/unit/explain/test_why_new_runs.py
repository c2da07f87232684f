"""Reasons for new executions, also of queries that are not recorded themselves."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests import projects


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A project with two recorded experiments, whose program has changed since then."""
    program = tmp_path / "simulator"
    program.write_text("#!/bin/sh\nprintf 'tick,value\\n0,1\\n' > swarm.csv\n")
    program.chmod(0o755)
    folder = projects.make(tmp_path / "project", projects.CONFIG.replace("python3 sim.py", str(program)))
    projects.run(folder, "population_size=1,2", "--runs", "1")
    program.write_text(program.read_text() + "# edited\n")
    return folder


@pytest.mark.integration
@pytest.mark.parametrize("query", ["population_size=1", "population_size=2,3", "population_size=1,2"])
def test_a_query_that_is_new_is_explained_by_the_programs_of_its_recorded_runs(root: Path, query: str) -> None:
    done = projects.quick(root, "run", query, "--runs", "1", "--dry-run", "--explain")
    assert (done.returncode, done.stderr) == (0, "")
    assert "executed with other programs" in done.stdout
    assert "simulator: " in done.stdout

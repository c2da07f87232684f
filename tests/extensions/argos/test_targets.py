"""Runs for two targets of ARGoS are pairs only if both arenas give the same values."""

from __future__ import annotations

from pathlib import Path

from tests import projects
from tests.unit.cli.test_targets import ARENA


def test_runs_that_are_no_pairs_are_refused(tmp_path: Path) -> None:
    config = """
        platform = "argos"
        template = "arena.argos"
        command = "python3 sim.py {input}"
        [targets.small.platforms.argos]
        arena = "10x10"
        length = 10
        [targets.large.platforms.argos]
        arena = "20x20"
        length = 10
    """
    folder = projects.make(tmp_path / "p", config)
    (folder / "arena.argos").write_text(ARENA)
    for target in ("small", "large"):
        done = projects.quick(folder, "run", "population_variable_density.1p0.3p0.C3", "--target", target, "--dry-run")
        assert done.returncode == 0, done.stderr
    done = projects.quick(folder, "run", "population_variable_density.1p0.3p0.C3", "--target", "small,large")
    assert done.returncode == 2
    assert "the runs for targets 'small' and 'large' are no pairs: the values of population_variable_density are" in done.stderr

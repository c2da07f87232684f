"""The scheduler `slurm`, with a real SLURM: see `tests.clusters`."""

from __future__ import annotations

import pytest

from tests import clusters

pytestmark = pytest.mark.real


def test_a_cluster_is_there_for_tests(slurm: clusters.Slurm) -> None:
    assert slurm.nodes() == {"n1": "idle", "n2": "idle", "n3": "idle"}
    job = slurm.command("sbatch", "--parsable", "--output=/dev/null", "--array=0-3", "--wrap", "true")
    slurm.until(job, "COMPLETED")


def test_a_cluster_is_healed_of_what_befell_it(slurm: clusters.Slurm) -> None:
    job = slurm.command("sbatch", "--parsable", "--output=/dev/null", "--array=0-2", "--exclusive", "--wrap", "sleep 60")
    slurm.until(job, "RUNNING")
    slurm.power_cut("n1")
    slurm.kill_slurmd("n2")
    slurm.declare_down("n1")
    slurm.declare_down("n2")
    slurm.kill_controller()
    slurm.heal()
    assert set(slurm.nodes().values()) == {"idle"}
    assert set(slurm.states().values()) == {"CANCELLED"}

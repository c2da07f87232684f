"""Facts about a machine: the cores that a process has for itself."""

from __future__ import annotations

from pathlib import Path

import pytest

from sierra.worker import machine


@pytest.mark.parametrize(
    ("variables", "cores"),
    [
        pytest.param({}, 16, id="no job"),
        pytest.param({"SLURM_JOB_ID": "7", "SLURM_CPUS_ON_NODE": "4"}, 4, id="salloc"),
        pytest.param({"SLURM_JOB_ID": "7", "SLURM_JOB_CPUS_PER_NODE": "3(x2),8"}, 3, id="salloc of several nodes"),
        pytest.param({"SLURM_JOB_ID": "7", "SLURM_CPUS_ON_NODE": "64"}, 16, id="a job has more than this process may use"),
        pytest.param({"PBS_JOBID": "7.server", "NCPUS": "2"}, 2, id="qsub -I"),
        pytest.param({"NCPUS": "2"}, 16, id="a variable that is no scheduler's"),
        pytest.param({"SLURM_JOB_ID": "7", "SLURM_CPUS_ON_NODE": "all"}, 16, id="no number"),
    ],
)
def test_a_job_of_a_scheduler_has_its_own_cores(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, variables: dict[str, str], cores: int
) -> None:
    monkeypatch.setattr(machine, "usable_cores", lambda: 16)
    monkeypatch.setattr(machine, "GROUPS", tmp_path)
    assert machine.granted_cores(variables) == cores


@pytest.mark.parametrize(
    ("inner", "outer", "cores"),
    [
        ("max 100000", "max 100000", 16),
        ("150000 100000", "max 100000", 2),
        ("max 100000", "300000 100000", 3),
        ("1 0", "nonsense", 16),
    ],
)
def test_a_control_group_with_a_quota_has_fewer_cores(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, inner: str, outer: str, cores: int
) -> None:
    group = tmp_path / "outer/inner"
    group.mkdir(parents=True)
    (group / "cpu.max").write_text(f"{inner}\n")
    (group.parent / "cpu.max").write_text(f"{outer}\n")
    read = machine._text
    named = Path("/proc/self/cgroup")
    monkeypatch.setattr(machine, "usable_cores", lambda: 16)
    monkeypatch.setattr(machine, "GROUPS", tmp_path)
    monkeypatch.setattr(machine, "_text", lambda path: "0::/outer/inner\n" if path == named else read(path))
    assert machine.granted_cores({}) == cores

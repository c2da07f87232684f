"""Runs on this machine hold the GPUs that they request, or are refused with one line. The GPUs are files here, not devices."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from sierra import runners
from sierra.config.execution_tables import LimitsTable
from sierra.config.validate import options
from sierra.errors import ConfigError
from sierra.worker import gpus
from tests import projects

OUTPUTS = "CUDA_VISIBLE_DEVICES", "CUDA_DEVICE_ORDER", "XLA_PYTHON_CLIENT_MEM_FRACTION"
SIMULATOR = f"""\
import os
with open("swarm.csv", "w") as file:
    print("devices,counted,part", file=file)
    print(*(os.environ.get(name, "").replace(",", "+") for name in {OUTPUTS}), sep=",", file=file)
"""
SHOWN = "SELECT devices, counted, part, gpus, gpu_limit, gpu_s FROM swarm JOIN executions USING (execution) ORDER BY ALL"


@pytest.fixture(autouse=True)
def two_gpus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let this machine have two GPUs."""
    for name in ("NVIDIA", "AMD", "DEV"):
        monkeypatch.setattr(gpus, name, tmp_path / name)
    monkeypatch.setattr(gpus, "number_by_nvml", lambda: 0)
    for name in ("CUDA_VISIBLE_DEVICES", "CUDA_DEVICE_ORDER"):
        monkeypatch.delenv(name, raising=False)
    for card in ("0000:01:00.0", "0000:02:00.0"):
        (tmp_path / "NVIDIA" / card).mkdir(parents=True)
        (tmp_path / "NVIDIA" / card / "information").touch()


def project(folder: Path, more: str = "") -> Path:
    return projects.make(folder / "a'; echo swarm", projects.CONFIG + more, simulator=SIMULATOR)


def refused(root: Path, status: int) -> str:
    done = projects.quick(root, "run", "population_size=1,2", "--no-figures")
    assert done.returncode == status
    [line] = projects.other_notes(done.stderr).splitlines()
    return line


def test_runs_hold_gpus_and_the_store_says_which(tmp_path: Path) -> None:
    root = project(tmp_path)
    plain, _ = projects.run(root, "population_size=1,2", "--dry-run")
    (root / "sierra.toml").write_text(projects.CONFIG + "[limits]\ngpus = 1\n")
    summary, _ = projects.run(root, "population_size=1,2", "--jobs", "4")
    assert (summary["executed"], summary["batch"]) == (4, plain["batch"])
    rows = projects.sql(root, SHOWN)
    assert {row["devices"] for row in rows} <= {0, 1}
    assert [(row["counted"], row["part"], row["gpu_limit"], row["gpu_s"]) for row in rows] == [
        ("PCI_BUS_ID", None, 1.0, None)
    ] * 4
    assert all(row["gpus"] == [str(row["devices"])] for row in rows)


def test_runs_that_share_a_gpu_reserve_a_part_of_its_memory(tmp_path: Path) -> None:
    root = project(tmp_path, "[limits]\ngpus = 0.5\n[runners.local]\ngpus = [1]\n")
    projects.run(root, "population_size=1", "--jobs", "4")
    shown = {(row["devices"], row["part"], row["gpu_limit"], json.dumps(row["gpus"])) for row in projects.sql(root, SHOWN)}
    assert shown == {(1, 0.45, 0.5, '["1"]')}


def test_runs_without_the_limit_are_given_no_gpus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "1")
    root = project(tmp_path, '[environment]\npass = ["CUDA_VISIBLE_DEVICES"]\n')
    projects.run(root, "population_size=1")
    shown = {(row["devices"], row["gpus"], row["gpu_limit"]) for row in projects.sql(root, SHOWN)}
    assert shown == {(1, None, None)}


@pytest.mark.parametrize(
    ("tables", "status", "refusal"),
    [
        ("[limits]\ngpus = 3", 3, "runs request 3 GPUs each ([limits] gpus), but this machine has 2 GPUs (0, 1)"),
        ("[limits]\ngpus = 1\n[runners.local]\ngpus = 3", 3, "[runners.local] gpus = 3, but this machine has 2 GPUs (0, 1)"),
        (
            '[limits]\ngpus = 1\n[environment]\nset = { CUDA_VISIBLE_DEVICES = "0" }',
            2,
            "[limits] gpus: SIERRA sets CUDA_VISIBLE_DEVICES for each run, but it is also declared; remove one of both",
        ),
    ],
)
def test_gpus_that_runs_cannot_get_are_refused_before_anything_executes(
    tmp_path: Path, tables: str, status: int, refusal: str
) -> None:
    root = project(tmp_path, f"{tables}\n")
    assert refusal in refused(root, status)
    (root / "sierra.toml").write_text(projects.CONFIG)
    assert projects.sql(root, "SELECT session FROM sessions") == []


def test_gpus_of_this_machine_that_no_run_requests_are_noted(tmp_path: Path) -> None:
    root = project(tmp_path, "[runners.local]\ngpus = 1\n")
    done = projects.quick(root, "run", "population_size=1", "--no-figures")
    assert done.returncode == 0, done.stderr
    assert "note: [runners.local] gpus has no effect: runs request no GPUs, such as by [limits] gpus = 1" in done.stderr


def test_a_replay_without_a_gpu_executes_without_and_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = project(tmp_path, "[limits]\ngpus = 1\n")
    summary, _ = projects.run(root, "population_size=1")
    monkeypatch.setattr(gpus, "of_this_machine", lambda environment: gpus.Gpus("CUDA_VISIBLE_DEVICES", ()))
    assert "runs request 1 GPU each ([limits] gpus), but this machine has no GPU" in refused(root, 3)
    replayed = projects.quick(root, "replay", str(summary["batch"]))
    assert "[limits] gpus = 1 is not heeded: this machine has no GPU" in replayed.stdout + replayed.stderr
    again = projects.sql(root, "SELECT status, gpus FROM executions WHERE purpose = 'replay'")
    assert again == [{"status": "ok", "gpus": None}] * 2


def test_a_slot_that_would_wait_for_a_gpu_holds_no_run(tmp_path: Path) -> None:
    root = project(tmp_path, "[limits]\ngpus = 1\n")
    projects.run(root, "population_size=1,2,4", "--jobs", "8")
    assert projects.sql(root, "SELECT max(slot) AS slot FROM executions") == [{"slot": 1}]


@pytest.mark.parametrize("listed", ["0,1", "all", 0, -1, True, 0.5, [], [0, 0], ["../0"], [-1], ["0,1"], [True]])
def test_gpus_that_no_variable_can_list_are_refused(listed: object) -> None:
    with pytest.raises(ConfigError, match=r'\[runners.local\]: gpus.* should be "auto", a number of GPUs, or a list'):
        runners.check({"local": {"gpus": listed}})


@pytest.mark.parametrize(
    ("limit", "refusal"), [(1.5, "1.5 should be a whole number of GPUs, or a share"), (0, "greater than 0")]
)
def test_a_limit_that_is_no_number_of_gpus_is_refused(limit: float, refusal: str) -> None:
    with pytest.raises(ConfigError, match=refusal):
        options(LimitsTable, {"gpus": limit}, "[limits]")


@pytest.mark.parametrize(
    ("limit", "cure"),
    [
        ("", "set [limits] gpus, such as 1 or 0.25, so that fewer runs use one at a time"),
        ("[limits]\ngpus = 0.5\n", "raise [limits] gpus above 0.5, so that fewer runs use one at a time"),
        ("[limits]\ngpus = 1\n", "each run had its own, so that a run must use less, or needs more GPUs"),
    ],
)
def test_a_run_that_fails_for_the_memory_of_a_gpu_gives_a_hint(tmp_path: Path, limit: str, cure: str) -> None:
    fails = "raise SystemExit('RuntimeError: Unable to initialize backend cuda: no supported devices found for platform CUDA')"
    root = projects.make(tmp_path / "swarm", projects.CONFIG + limit, simulator=fails)
    done = projects.quick(root, "run", "population_size=1", "--no-figures")
    assert done.returncode == 1
    assert f"a GPU had too little memory (no supported devices): {cure}" in done.stderr + done.stdout

"""The GPUs of a machine are found by files of their drivers, and variables of CUDA and ROCm restrict them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest

from sierra.worker import gpus
from sierra.worker.devices import NoDevices
from sierra.worker.gpus import of_this_machine, with_gpus


@pytest.fixture(autouse=True)
def no_gpus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let this machine have no GPU."""
    for name in ("NVIDIA", "AMD", "DEV"):
        monkeypatch.setattr(gpus, name, tmp_path / name)
        (tmp_path / name).mkdir()
    monkeypatch.setattr(gpus, "number_by_nvml", lambda: 0)


@pytest.fixture
def nvidia(tmp_path: Path) -> None:
    """Let it have two of NVIDIA's."""
    for card in ("0000:01:00.0", "0000:02:00.0"):
        (tmp_path / "NVIDIA" / card).mkdir()
        (tmp_path / "NVIDIA" / card / "information").touch()


@pytest.fixture
def amd(tmp_path: Path) -> None:
    """Let it have a processor (node 0) and three of AMD's GPUs."""
    for number, count in enumerate((0, 256, 256, 304)):
        folder = tmp_path / "AMD" / str(number)
        folder.mkdir()
        (folder / "properties").write_text(f"cpu_cores_count 8\nsimd_count {count}\nmem_banks_count 1\n")


@pytest.mark.parametrize(
    ("environment", "ids"),
    [
        ({}, ("0", "1")),
        ({"CUDA_VISIBLE_DEVICES": "1"}, ("1",)),
        ({"CUDA_VISIBLE_DEVICES": "1, 0"}, ("1", "0")),
        ({"CUDA_VISIBLE_DEVICES": "1,7,0"}, ("1",)),
        ({"CUDA_VISIBLE_DEVICES": ""}, ()),
        ({"CUDA_VISIBLE_DEVICES": "-1"}, ()),
        ({"CUDA_VISIBLE_DEVICES": "MIG-5a,GPU-1f"}, ("MIG-5a", "GPU-1f")),
    ],
)
@pytest.mark.usefixtures("nvidia")
def test_the_variable_of_cuda_restricts_gpus(environment: Mapping[str, str], ids: tuple[str, ...]) -> None:
    assert of_this_machine(environment) == ("CUDA_VISIBLE_DEVICES", ids)


@pytest.mark.parametrize(
    ("environment", "ids"),
    [
        ({}, ("0", "1", "2")),
        ({"ROCR_VISIBLE_DEVICES": "2,0"}, ("2", "0")),
        ({"ROCR_VISIBLE_DEVICES": "2,0", "HIP_VISIBLE_DEVICES": "1"}, ("0",)),
        ({"HIP_VISIBLE_DEVICES": ""}, ()),
    ],
)
@pytest.mark.usefixtures("amd")
def test_the_variables_of_rocm_restrict_gpus(environment: Mapping[str, str], ids: tuple[str, ...]) -> None:
    assert of_this_machine(environment) == ("ROCR_VISIBLE_DEVICES", ids)


def test_device_files_count_where_the_driver_tells_nothing_else(tmp_path: Path) -> None:
    for name in ("nvidia0", "nvidia1", "nvidia2", "nvidiactl", "nvidia-uvm"):
        (tmp_path / "DEV" / name).touch()
    assert of_this_machine({}).ids == ("0", "1", "2")


@pytest.mark.parametrize(
    ("wanted", "environment", "listed"),
    [
        ("auto", {}, "0,1"),
        (1, {}, "0"),
        (("1",), {}, "1"),
        (("MIG-5a", "MIG-5b"), {}, "MIG-5a,MIG-5b"),
        (1, {"CUDA_VISIBLE_DEVICES": "GPU-1f,GPU-2a"}, "GPU-1f"),
        (("GPU-2a",), {"CUDA_VISIBLE_DEVICES": "GPU-1f,GPU-2a"}, "GPU-2a"),
    ],
)
@pytest.mark.usefixtures("nvidia")
def test_a_worker_sees_only_the_gpus_for_runs(
    wanted: str | int | tuple[str, ...], environment: Mapping[str, str], listed: str
) -> None:
    given = with_gpus({"A": "1", "HIP_VISIBLE_DEVICES": "0", **environment}, 0.5, wanted)
    assert given == {"A": "1", "CUDA_VISIBLE_DEVICES": listed}


@pytest.mark.parametrize(
    ("wanted", "limit", "environment", "refusal"),
    [
        ("auto", 4.0, {}, r"runs request 4 GPUs each \(\[limits\] gpus\), but this machine has 2 GPUs \(0, 1\)"),
        ("auto", 0.5, {"CUDA_VISIBLE_DEVICES": ""}, "runs request 0.5 GPU each .*no GPU in CUDA_VISIBLE_DEVICES"),
        (3, 1.0, {}, r"\[runners.local\] gpus = 3, but this machine has 2 GPUs"),
        (("1", "2"), 1.0, {}, r"\[runners.local\] gpus: there is no 2; this machine has 2 GPUs \(0, 1\)"),
        (("0",), 1.0, {"CUDA_VISIBLE_DEVICES": "1"}, r"there is no 0; this machine has 1 GPU \(1\) in CUDA_VISIBLE"),
        (("GPU-9",), 1.0, {"CUDA_VISIBLE_DEVICES": "1"}, "there is no GPU-9"),
        (("0",), 2.0, {}, r"request 2 GPUs each .*, but \[runners.local\] gpus has 1 GPU \(0\)"),
    ],
)
@pytest.mark.usefixtures("nvidia")
def test_gpus_that_do_not_exist_are_refused(
    wanted: str | int | tuple[str, ...], limit: float, environment: Mapping[str, str], refusal: str
) -> None:
    with pytest.raises(NoDevices, match=refusal):
        with_gpus(environment, limit, wanted)


@pytest.mark.parametrize("wanted", ["auto", ("GPU-1f",), 1])
def test_a_machine_without_gpus_is_refused(wanted: str | int | tuple[str, ...]) -> None:
    with pytest.raises(NoDevices, match="this machine has no GPU"):
        with_gpus({}, 1.0, wanted)

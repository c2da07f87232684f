"""The record of an observed run: its files, and graphics processors."""

from __future__ import annotations

from pathlib import Path

import pytest

from sierra.worker import observed_record
from sierra.worker.file_names import Names
from sierra.worker.file_trace import Trace
from sierra.worker.observed_record import Contents, contents


@pytest.mark.parametrize("seen", [True, False])
def test_a_path_that_came_into_existence_is_missed_unless_the_run_found_it(tmp_path: Path, seen: bool) -> None:
    """A run that waits for a file would otherwise never count."""
    come, absent = tmp_path / "come", tmp_path / "absent"
    come.touch()
    trace = Trace("strace", missed=(str(absent), str(come)), found=(str(come),) if seen else ())
    record = observed_record.as_record(trace, contents(trace, 0), Names({}))
    kinds = (
        [(str(come), "found", observed_record.sha256_of_kind(str(come)), None)] if seen else [(str(come), "missed", None, None)]
    )
    assert record["files"] == [(str(absent), "missed", None, None), *kinds]
    assert record["reason"] == f"{come}: it was made after the run had looked for it"


@pytest.mark.parametrize(
    ("path", "expected"),
    [
        ("/usr/lib/x86_64-linux-gnu/libcuda.so.535.54.03", True),
        ("/opt/rocm/lib/libamdhip64.so.6", True),
        ("/usr/lib/libOpenCL.so.1.0.0", True),
        ("/v/site-packages/nvidia/cudnn/lib/libcudnn_ops.so.9", True),
        ("/dev/nvidia0", True),
        ("/dev/dri/renderD128", True),
        ("/dev/kfd", True),
        ("/usr/lib/libcudaless.so", False),
        ("/usr/lib/libGL.so.1", False),
        ("/dev/null", False),
        ("/home/me/nvidia/notes", False),
    ],
)
def test_the_use_of_a_gpu_is_seen_by_its_libraries_and_devices(path: str, *, expected: bool) -> None:
    assert observed_record.uses_gpu(Trace("strace", read=(path,))) is expected
    assert observed_record.uses_gpu(Trace("strace", written=(path,))) is expected
    assert not observed_record.uses_gpu(Trace("strace", missed=(path,)))


def gpus(root: Path, driver: str = "535.54.03", vendor: str = "0x1002") -> str:
    files = {
        "proc/driver/nvidia/version": f"NVRM version: NVIDIA UNIX x86_64 Kernel Module  {driver}\nGCC version:  gcc 12\n",
        "proc/driver/nvidia/gpus/0000:01:00.0/information": "Model: \t\t NVIDIA A100\nIRQ: 16\n",
        "sys/class/drm/card1/device/vendor": f"{vendor}\n",
        "sys/class/drm/card1/device/device": "0x73bf\n",
        "sys/class/drm/card1-DP-1/status": "connected\n",
    }
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    (root / "sys/drivers/amdgpu/module").mkdir(parents=True, exist_ok=True)
    (root / "sys/drivers/amdgpu/module/version").write_text("6.7.0\n")
    driver_link = root / "sys/class/drm/card1/device/driver"
    driver_link.unlink(missing_ok=True)
    driver_link.symlink_to(root / "sys/drivers/amdgpu")
    return observed_record.graphics_sha256(str(root))


def test_gpus_and_their_drivers_are_part_of_the_set(tmp_path: Path) -> None:
    before = gpus(tmp_path)
    assert observed_record.graphics(str(tmp_path)) == [
        "driver NVRM version: NVIDIA UNIX x86_64 Kernel Module 535.54.03",
        "driver GCC version: gcc 12",
        "Model: NVIDIA A100",
        "0x1002 0x73bf amdgpu 6.7.0",
    ]
    assert len({before, gpus(tmp_path, driver="550.1.2"), gpus(tmp_path, vendor="0x8086")}) == 3
    assert gpus(tmp_path) == before


def test_a_gpu_that_was_used_is_recorded_with_the_files(tmp_path: Path) -> None:
    nothing = Contents({}, {}, {})
    record = observed_record.as_record(Trace("strace"), nothing, Names({}), gpu=True)
    assert record["files"] == [("{gpu}", "read", observed_record.graphics_sha256(), None)]
    assert observed_record.as_record(Trace("strace"), nothing, Names({}))["files"] == []

"""The use of GPUs by runs, as an imitation of NVIDIA's library (NVML) reports it. No real GPU is needed."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from tests import projects

pytestmark = pytest.mark.integration

LIBRARY = r"""
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/* Two GPUs. A file in $IMITATED_GPUS has a line for each process: GPU, process, MiB, percent of the time. */
typedef struct { unsigned pid; unsigned long long memory; unsigned gpu, compute; } Process;
typedef struct { unsigned pid; unsigned long long time; unsigned sm, memory, encoder, decoder; } Sample;

static int read(int gpu, unsigned pids[], unsigned mib[], unsigned percent[]) {
    int count = 0, on;
    FILE *file = fopen(getenv("IMITATED_GPUS"), "r");
    if (!file) return 0;
    while (fscanf(file, "%d %u %u %u", &on, &pids[count], &mib[count], &percent[count]) == 4)
        if (on == gpu) count++;
    fclose(file);
    return count;
}

int nvmlInit_v2(void) { return 0; }
int nvmlDeviceGetCount_v2(unsigned *count) { *count = 2; return 0; }
int nvmlDeviceGetHandleByIndex_v2(unsigned index, void **device) { *device = (void *)(size_t)(index + 1); return 0; }

int nvmlDeviceGetComputeRunningProcesses_v3(void *device, unsigned *count, Process *listed) {
    unsigned pids[99], mib[99], percent[99];
    *count = read((int)(size_t)device - 1, pids, mib, percent);
    for (unsigned i = 0; i < *count; i++) {
        listed[i].pid = pids[i];
        listed[i].memory = (unsigned long long)mib[i] << 20;
    }
    return 0;
}

/* A process that computes and draws is in both lists. */
int nvmlDeviceGetGraphicsRunningProcesses_v3(void *device, unsigned *count, Process *listed) {
    return nvmlDeviceGetComputeRunningProcesses_v3(device, count, listed);
}

int nvmlDeviceGetProcessUtilization(void *device, Sample *samples, unsigned *count, unsigned long long since) {
    unsigned pids[99], mib[99], percent[99];
    if (getenv("IMITATED_MIG")) return 3;
    *count = read((int)(size_t)device - 1, pids, mib, percent);
    for (unsigned i = 0; i < *count; i++) {
        memset(&samples[i], 0, sizeof samples[i]);
        samples[i].pid = pids[i];
        samples[i].time = since + 1;
        samples[i].sm = percent[i];
    }
    return *count ? 0 : 6;
}
"""
SIMULATOR = """\
import os, time
with open(os.environ["IMITATED"], "a") as file:
    print(os.environ["CUDA_VISIBLE_DEVICES"], os.getpid(), 300, 50, file=file)
end = time.monotonic() + 3.5
while time.monotonic() < end:
    time.sleep(0.1)
with open("swarm.csv", "w") as file:
    print("gpu", os.environ["CUDA_VISIBLE_DEVICES"], sep="\\n", file=file)
"""
USED = "SELECT gpus, gpu_s, gpu_memory_bytes, wall_s FROM executions ORDER BY gpus"


@pytest.fixture
def imitated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Compile the imitation where programs find it; return the file with the processes."""
    (tmp_path / "nvml.c").write_text(LIBRARY)
    library = tmp_path / "libnvidia-ml.so.1"
    subprocess.run(("cc", "-shared", "-fPIC", "-o", library, tmp_path / "nvml.c"), check=True)
    monkeypatch.setenv("LD_LIBRARY_PATH", str(tmp_path))
    monkeypatch.setenv("IMITATED_GPUS", str(tmp_path / "processes"))
    for name in ("CUDA_VISIBLE_DEVICES", "CUDA_DEVICE_ORDER"):
        monkeypatch.delenv(name, raising=False)
    return tmp_path / "processes"


def executed(folder: Path, processes: Path) -> list[dict[str, float]]:
    """Execute two runs on the imitated GPUs; return what is recorded about them."""
    config = f'{projects.CONFIG}[environment]\nset = {{ IMITATED = "{processes}" }}\n[limits]\ngpus = 1\n'
    root = projects.make(folder / "swarm", config, simulator=SIMULATOR)
    words = (projects.SIERRA, "run", "population_size=1", "--jobs", "4", "--no-figures")
    done = subprocess.run(words, cwd=root, capture_output=True, text=True, check=False, timeout=200)
    assert done.returncode == 0, done.stderr
    return projects.sql(root, USED)


def test_memory_and_time_on_gpus_are_recorded(tmp_path: Path, imitated: Path) -> None:
    rows = executed(tmp_path, imitated)
    assert [row["gpus"] for row in rows] == [["0"], ["1"]]
    assert [row["gpu_memory_bytes"] for row in rows] == [300 << 20] * 2
    assert all(0 < row["gpu_s"] <= row["wall_s"] / 2 + 1 for row in rows)


def test_time_that_a_gpu_does_not_tell_is_unknown(tmp_path: Path, imitated: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("IMITATED_MIG", "1")
    rows = executed(tmp_path, imitated)
    assert {(row["gpu_memory_bytes"], row["gpu_s"]) for row in rows} == {(300 << 20, None)}

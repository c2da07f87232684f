"""The environment of executions: stable facts without secrets."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import sierra
from sierra.provenance import environment
from sierra.worker import array_task, machine
from tests import projects

X86 = """\
processor\t: 0
model name\t: Some CPU @ 2.80GHz
cpu MHz\t\t: 2793.438
flags\t\t: fpu vme fma avx2 avx512f f16c sse4_2 ssse3 bmi2 nx hypervisor 3dnowprefetch

processor\t: 1
model name\t: Another CPU
flags\t\t: fpu amx_tile
"""
ARM = """\
processor\t: 0
BogoMIPS\t: 243.75
Features\t: fp asimd sve2 atomics
CPU implementer\t: 0x41
CPU part\t: 0xd0c
"""
RISCV = "processor\t: 0\nisa\t\t: rv64imafdc_zicsr\nuarch\t\t: sifive,u74\n"


def test_two_sessions_record_the_same_environment_even_if_the_machine_is_busy() -> None:
    first = environment.capture("1")
    busy = bytearray(50_000_000)
    asked = "from sierra.provenance import environment; print(environment.capture('1')['environment'])"
    other = subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True, check=True).stdout.strip()
    assert environment.capture("1") == first
    assert other == first["environment"]
    assert len(busy) > 0
    assert environment.capture("2")["environment"] != first["environment"]


def test_capturing_the_environment_starts_no_process_and_is_fast() -> None:
    asked = (
        "import sys; from sierra.provenance import environment; from tests.effort import is_cheap; told = []; "
        "sys.addaudithook(lambda event, _: event in ('subprocess.Popen', 'os.fork', 'os.posix_spawn') and told.append(event)); "
        "print(is_cheap(lambda: environment.capture('1'), 4), told)"
    )
    root = Path(projects.__file__).parents[1]
    said = subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True, check=True, cwd=root).stdout
    assert said == "True []\n"


@pytest.mark.parametrize(
    ("cpuinfo", "found"),
    [
        (X86, ("Some CPU @ 2.80GHz", ["avx2", "avx512f", "bmi2", "f16c", "fma", "sse4_2", "ssse3"])),
        (ARM, ("implementer 0x41, part 0xd0c", ["asimd", "atomics", "fp", "sve2"])),
        (RISCV, ("sifive,u74", ["rv64imafdc_zicsr"])),
        ("", ("", [])),
        ("nonsense", ("", [])),
    ],
)
def test_a_processor_is_recorded_as_its_model_and_its_arithmetic_features(cpuinfo: str, found: tuple[str, list[str]]) -> None:
    assert machine.processor(cpuinfo) == found


def test_known_variables_are_recorded_and_secrets_are_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    monkeypatch.setenv("API_TOKEN", "hidden")
    monkeypatch.setenv("MKL_SECRET_TOKEN", "hidden")
    monkeypatch.setenv("SLURM_JOB_ID", "17")
    monkeypatch.setenv("MODEL_ZOO", "/models")
    recorded = environment.capture("1", ["MODEL_*", "API_*"])
    variables = json.loads(recorded["variables"])
    assert (variables["OMP_NUM_THREADS"], variables["MODEL_ZOO"]) == ("3", "/models")
    assert not variables.keys() & {"API_TOKEN", "MKL_SECRET_TOKEN", "SLURM_JOB_ID"}
    assert "hidden" not in str(recorded)
    assert "MODEL_ZOO" not in environment.capture("1")["variables"]


def test_locale_time_zone_and_modules_are_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LC_ALL", "de_DE.UTF-8")
    monkeypatch.setenv("TZ", "Europe/Zurich")
    monkeypatch.setenv("LOADEDMODULES", "gcc/14.2:openmpi/5.0")
    around = environment.capture("1")
    assert (around["locale"], around["timezone"], around["modules"]) == (
        "de_DE.UTF-8",
        "Europe/Zurich",
        ["gcc/14.2", "openmpi/5.0"],
    )


def test_modules_loaded_on_a_node_are_recorded_with_the_search_path_of_runs() -> None:
    here = environment.capture("1")
    node = {"LOADEDMODULES": "gcc/14.2:openmpi/5.0", "LANG": "C.UTF-8", "HOME": "/root", "PATH": "/node/bin"}
    told = {name: value for name, value in node.items() if array_task.is_recorded(name, list(environment.recorded(())))}
    there = environment.elsewhere(here, machine.facts(), told)
    assert there["modules"] == ["gcc/14.2", "openmpi/5.0"]
    assert json.loads(there["variables"]) == {"LANG": "C.UTF-8", "PATH": os.environ["PATH"]}


def test_recorded_limits_equal_those_of_ulimit() -> None:
    shell = subprocess.run(["sh", "-c", "ulimit -n; ulimit -Ss; ulimit -c"], capture_output=True, text=True, check=True)
    files, stack, core = (None if word == "unlimited" else int(word) for word in shell.stdout.split())
    limits = machine.limits()
    assert limits["nofile"][0] == files
    assert limits["stack"][0] == (stack and stack * 1024)
    assert limits["core"][0] == (core and core * 512)


def test_differences_are_reported_by_name_and_the_most_relevant_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OMP_DYNAMIC", raising=False)
    now = {**environment.capture("1"), "host": "here", "cpu_flags": ["avx2"]}
    limits = json.loads(now["limits"])
    limits["core"] = [17, 19]
    before: dict[str, Any] = {
        **now,
        "environment": "another",
        "host": "elsewhere",
        "cpu_flags": [*now["cpu_flags"], "amx_tile"],
        "limits": json.dumps(limits),
        "variables": json.dumps({**json.loads(now["variables"]), "OMP_DYNAMIC": "1"}),
        "distributions": now["distributions"].replace("lxml==", "lxml==0."),
        "memory": None,
    }
    told = list(environment.differing(before, now))
    assert [name for name, _, _ in told] == [
        "cpu_flags",
        "variables.OMP_DYNAMIC",
        "distributions.lxml",
        "limits.core",
        "host",
    ]
    assert told[0] == ("cpu_flags", ["amx_tile"], [])
    assert told[1] == ("variables.OMP_DYNAMIC", "1", None)
    assert list(environment.differing(now, now)) == []


@pytest.mark.integration
def test_the_environment_is_recorded_once_with_columns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MODEL_ZOO", "/models")
    config = projects.CONFIG + '[environment]\nrecord = ["MODEL_ZOO"]\n'
    project = sierra.open(projects.make(tmp_path, config))
    for runs in (1, 2):
        project.run("population_size=1", runs=runs, figures=False)
    [row] = project.sql(
        "SELECT variables->>'MODEL_ZOO' AS zoo, cpu_flags, gpus, modules, lock FROM environments "
        "JOIN (SELECT DISTINCT environment FROM executions) USING (environment)"
    ).to_pylist()
    assert (row["zoo"], row["cpu_flags"]) == ("/models", machine.facts()["cpu_flags"])
    assert len(row["lock"]) == 64

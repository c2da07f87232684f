"""What an observed execution used, in one line."""

from __future__ import annotations

import pytest

from sierra.execution.observation.describe_files import summary
from sierra.execution.observation.file_sets import UsedFile
from sierra.execution.row_queries import RecordedProgram

LIBC = "c" * 64
PROGRAMS = (
    RecordedProgram("argos3", "program", "ARGoS 3.0.0-beta59 (release)", "/usr/bin/argos3", "a" * 64),
    RecordedProgram("python3: interpreter", "program", "Python 3.11.7", "/usr/bin/python3.11", "b" * 64),
    RecordedProgram("libc.so.6", "library", None, "/lib/libc.so.6", LIBC),
)
PYTHON = [("/usr/bin/python3.11", "executed"), ("{prefix}/pyvenv.cfg", "read"), ("/usr/lib/python3.11/os.py", "read")]
CASES = {
    "argos3 3.0.0-beta59, 2 plug-ins, 1 library; 1 model, 1 script": [
        ("/usr/bin/argos3", "executed"),
        ("/usr/lib64/ld-linux-x86-64.so.2", "executed"),
        ("/usr/lib/libc.so.6", "read"),
        ("/usr/lib/argos3/libargos3plugin_simulator_physics.so", "read"),
        ("{project}/build/libcontroller.so", "read"),
        ("{project}/build/libvision.so.1.2", "read"),
        ("{project}/swarm.argos", "read"),
        ("{project}/forage.lua", "read"),
        ("{project}/plugins/later.so", "missed"),
        ("/etc/ld.so.cache", "read"),
        ("/usr/share/locale/x", "read"),
    ],
    "Python 3.11.7 with mujoco 3.2, numpy 2.3.1; 2 meshes, 1 picture": [
        *PYTHON,
        ("{prefix}/lib/python3.11/site-packages/mujoco/libmujoco.so.3", "read"),
        ("{home}/models/a.stl", "read"),
        ("{project}/b.OBJ", "read"),
        ("{project}/map.pgm", "read"),
    ],
    "train, 1 plug-in; a GPU": [("{home}/train", "executed"), ("/usr/lib/libcuda.so", "read"), ("{gpu}", "read")],
    "ngspice; Python 3.11.7 with mujoco 3.2, numpy 2.3.1; dirname, sh; 1 other file": [
        ("/bin/sh", "executed"),
        ("/usr/bin/dirname", "executed"),
        ("{home}/bin/ngspice", "executed"),
        *PYTHON,
        ("{project}/circuit", "read"),
    ],
    "3 plug-ins": [(f"{{home}}/{name}.so", "read") for name in "abc"],
    "": [],
}


@pytest.mark.parametrize("expected", CASES)
def test_programs_come_before_data(expected: str) -> None:
    files = [UsedFile(path, use, LIBC if "libc.so" in path else "f" * 64) for path, use in CASES[expected]]
    assert summary(files, PROGRAMS, ["mujoco==3.2", "numpy==2.3.1"]) == expected


def test_a_long_list_is_cut() -> None:
    files = [UsedFile(f"/usr/bin/tool{number}", "executed", None) for number in range(9)]
    assert summary(files, (), ()) == "tool0, tool1, tool2, tool3 and 5 more"

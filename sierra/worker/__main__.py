"""The programs of SIERRA that run on nodes, on robots and in containers, where SIERRA is not installed:

    python3 -I -S worker.pyz FOLDER SLOTS …     execute runs: see `worker`
    python3 -I -S worker.pyz conductor …        execute what is around a run's command: see `conductor`
    python3 -I -S worker.pyz array_task …       execute the runs of an array task: see `array_task`
    python3 -I -S worker.pyz robot_agent …      execute runs on a robot: see `robot_agent`
    python3 -I worker.pyz execute_runs …        execute the runs of a reproduction package: see `execute_runs`

They need only the standard library of Python 3.8 or newer. `worker.pyz` is a zip of the modules in this folder. This file also
executes those that lie beside it.
"""

# No `from __future__ import annotations`: a Python before 3.7 would fail on it without a line that names the needed version.

import importlib
import os
import sys
import types

PROGRAMS = ("array_task", "conductor", "execute_runs", "robot_agent")


def add_package():
    # type: () -> None
    """Let these modules, and no others, be `sierra.worker`: an installed SIERRA is not loaded."""
    for name, folders in (("sierra", []), ("sierra.worker", [os.path.dirname(os.path.abspath(__file__))])):
        package = types.ModuleType(name)
        package.__path__ = folders
        sys.modules[name] = package


def main():
    # type: () -> int
    name, arguments = (sys.argv[1], sys.argv[2:]) if sys.argv[1] in PROGRAMS else ("worker", sys.argv[1:])
    if sys.version_info < (3, 8):  # noqa: UP036 - this check reports it
        version = ".".join(str(part) for part in sys.version_info[:3])
        about = "%s: Python %s on %s is too old; 3.8 or newer is needed\n"
        os.write(2, (about % (name.replace("_", " "), version, os.uname().nodename)).encode())
        return 3
    add_package()
    return importlib.import_module("sierra.worker." + name).main(arguments)  # type: ignore[no-any-return]


if __name__ == "__main__":
    os._exit(main())

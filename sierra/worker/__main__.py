"""The programs of SIERRA that run on nodes, on other hosts and in containers, where SIERRA is not installed:

    python3 -I -S worker.pyz FOLDER SLOTS …     execute runs: see `worker`
    python3 -I -S worker.pyz conductor …        execute what is around a run's command: see `conductor`
    python3 -I -S worker.pyz array_task …       execute the runs of an array task: see `array_task`
    python3 -I worker.pyz execute_runs …        execute the runs of a reproduction package: see `execute_runs`
    python3 -I -S worker.pyz sierra.MODULE …    execute a program of an extension, by the name of its module

They need only the standard library of Python 3.8 or newer. `worker.pyz` is a zip of the modules in this folder, and of those of
an extension: see `sierra.util.worker_zip`. This file also executes those that lie beside it, but none of an extension. FOLDER
is a path with `/`; other words are names of programs.
"""

# No `from __future__ import annotations`: a Python before 3.7 would fail on it without a line that names the needed version.

import importlib
import os
import sys
import types


def add_package():
    # type: () -> None
    """Let these modules be `sierra.worker`, and packages in the zip all others of `sierra`: no installed SIERRA is loaded."""
    for name in ("sierra", "sierra.worker"):
        package = types.ModuleType(name)
        package.__path__ = [os.path.dirname(os.path.abspath(__file__))]
        sys.modules[name] = package


def main():
    # type: () -> int
    name, arguments = ("worker", sys.argv[1:]) if os.sep in sys.argv[1] else (sys.argv[1], sys.argv[2:])
    if sys.version_info < (3, 8):  # noqa: UP036 - this check reports it
        version = ".".join(str(part) for part in sys.version_info[:3])
        about = "%s: Python %s on %s is too old; 3.8 or newer is needed\n"
        os.write(2, (about % (name.rpartition(".")[2].replace("_", " "), version, os.uname().nodename)).encode())
        return 3
    add_package()
    return importlib.import_module(name if "." in name else "sierra.worker." + name).main(arguments)  # type: ignore[no-any-return]


if __name__ == "__main__":
    os._exit(main())

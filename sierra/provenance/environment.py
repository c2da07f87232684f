"""The environment of executions: the machine, SIERRA's own installation, and variables; stored once, referred to by hash.

Only variables that are known to change results are recorded, and those that `[environment] record` names. Other variables are
not recorded, because some contain secrets. Values that a batch system sets for one job only are left out, because otherwise
each job would have an environment of its own.
"""

from __future__ import annotations

import json
import os
import platform
import sys
from collections.abc import Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path
from typing import Any

from sierra.provenance import dependency_model, pythons
from sierra.provenance.machine import facts, usable_cores
from sierra.util.hashing import digest, sha256

VARIABLES = (
    *("LANG", "LANGUAGE", "LC_*", "TZ", "PATH", "LD_LIBRARY_PATH", "LD_PRELOAD", "GLIBC_TUNABLES", "MALLOC_*"),
    *("PYTHONPATH", "PYTHONHASHSEED", "CONDA_DEFAULT_ENV", "CONDA_PREFIX", "VIRTUAL_ENV"),
    *("OMP_*", "GOMP_*", "KMP_*", "OPENBLAS_*", "MKL_*", "BLIS_*", "VECLIB_*", "NUMEXPR_*", "NPY_*"),
    *("CUDA_VISIBLE_DEVICES", "CUBLAS_WORKSPACE_CONFIG", "XLA_FLAGS", "MUJOCO_GL", "PYOPENGL_PLATFORM", "LIBGL_*", "MESA_*"),
    *("ARGOS_PLUGIN_PATH", "ROS_DISTRO", "ROS_VERSION", "RMW_IMPLEMENTATION", "AMENT_PREFIX_PATH", "GZ_VERSION"),
)
"""Names (or patterns) of the variables that are recorded."""
LOADED = "LOADEDMODULES"
RELEVANT = (
    *("cpu_flags", "machine", "cpu", "libc", "gpus", "container", "os", "kernel", "variables", "modules", "sierra", "python"),
    *("distributions", "locale", "timezone", "cores", "memory", "limits", "host"),
)
"""Names of the facts; those that best explain a different result come first."""
SECRET = ("TOKEN", "SECRET", "PASSWORD", "CREDENTIAL")


def capture(version: str, record: Sequence[str] = ()) -> dict[str, Any]:
    """Return the record of this environment; `version` is SIERRA's, `record` adds names (or patterns) of variables."""
    machine = facts()
    around = {
        **machine,
        "locale": next((os.environ[name] for name in ("LC_ALL", "LC_CTYPE", "LANG") if os.environ.get(name)), "C"),
        "timezone": os.environ.get("TZ") or machine["timezone"],
        "limits": json.dumps(machine["limits"], sort_keys=True),
        "modules": [name for name in os.environ.get(LOADED, "").split(":") if name],
        "variables": json.dumps(_variables((*VARIABLES, *record)), sort_keys=True),
        "python": platform.python_version(),
        "sierra": version,
        "distributions": _distributions(),
        "lock": sha256(_distributions().encode()),
    }
    return {"environment": digest("environment", around), **around}


def elsewhere(around: Mapping[str, Any], machine: Mapping[str, Any], variables: Mapping[str, str]) -> dict[str, Any]:
    """Return the record of the environment on another host.

    `machine` and `variables` are the facts and variables that the host reported; `around` is the record of this host.
    """
    found = {
        **{name: value for name, value in around.items() if name != "environment"},
        **machine,
        "timezone": variables.get("TZ") or machine["timezone"],
        "locale": next((variables[name] for name in ("LC_ALL", "LC_CTYPE", "LANG") if variables.get(name)), "C"),
        "limits": json.dumps(machine["limits"], sort_keys=True),
        "modules": [name for name in variables.get(LOADED, "").split(":") if name],
        "variables": json.dumps({name: variables[name] for name in sorted(variables) if name != LOADED}),
    }
    return {"environment": digest("environment", found), **found}


def recorded(record: Sequence[str]) -> tuple[str, ...]:
    """Return the names (or patterns) of all variables that another host has to report for `elsewhere`.

    `record` adds further names.
    """
    return (*VARIABLES, LOADED, *record)


def _variables(patterns: Sequence[str]) -> dict[str, str]:
    return {
        name: value
        for name, value in sorted(os.environ.items())
        if any(fnmatchcase(name, pattern) for pattern in patterns) and not any(secret in name.upper() for secret in SECRET)
    }


@cache
def _distributions() -> str:
    """Return the distributions that are installed where SIERRA runs, one per line."""
    folders = [Path(folder) for folder in sys.path if folder.endswith(("site-packages", "dist-packages"))]
    return "\n".join(one.line for one in pythons.distributions([folder for folder in folders if folder.is_dir()]))


def differing(before: Mapping[str, Any], now: Mapping[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    """Yield the differences between two rows of `environments` as name, old value, new value; the most relevant come first.

    For lists, the values are the items that only one row has. Variables, limits and distributions are compared one by one, as
    in `variables.TZ`. Columns that an older record does not have are not compared.
    """
    for name in RELEVANT:
        was, found = before.get(name), now.get(name)
        if was == found or name not in before or (was is None and name != "container"):
            continue
        match name:
            case "variables" | "limits" | "distributions":
                yield from _by_key(name, _table(name, was), _table(name, found))
            case "cpu_flags" | "gpus" | "modules":
                old, new = (was or []), (found or [])
                yield name, [one for one in old if one not in new], [one for one in new if one not in old]
            case _:
                yield name, was, found


def _table(name: str, text: str | None) -> dict[str, Any]:
    """Return the facts that a text contains, by name."""
    if name == "distributions":
        return dict(dependency_model.versions(text))
    table: dict[str, Any] = json.loads(text or "{}")
    return table


def _by_key(name: str, was: Mapping[str, Any], found: Mapping[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    for key in sorted(was.keys() | found.keys()):
        if was.get(key) != found.get(key):
            yield f"{name}.{key}", was.get(key), found.get(key)


__all__ = ["capture", "differing", "usable_cores"]

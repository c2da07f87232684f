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

from sierra.config import extensions
from sierra.provenance import dependency_model, pythons
from sierra.util import open_files
from sierra.util.hashing import digest, sha256
from sierra.util.json_types import JsonView, RecordValue, as_object, as_texts
from sierra.worker.machine import Fact, facts

VARIABLES = (
    *("LANG", "LANGUAGE", "LC_*", "TZ", "PATH", "LD_LIBRARY_PATH", "LD_PRELOAD", "GLIBC_TUNABLES", "MALLOC_*"),
    *("PYTHONPATH", "PYTHONHASHSEED", "CONDA_DEFAULT_ENV", "CONDA_PREFIX", "VIRTUAL_ENV"),
    *("OMP_*", "GOMP_*", "KMP_*", "OPENBLAS_*", "MKL_*", "BLIS_*", "VECLIB_*", "NUMEXPR_*", "NPY_*"),
    *("CUDA_VISIBLE_DEVICES", "CUBLAS_WORKSPACE_CONFIG", "XLA_FLAGS", "PYOPENGL_PLATFORM", "LIBGL_*", "MESA_*"),
    *extensions.every("variables"),
)
"""Names (or patterns) of the variables that are recorded."""
LOADED = "LOADEDMODULES"
RELEVANT = (
    *("cpu_flags", "machine", "cpu", "libc", "gpus", "container", "os", "kernel", "variables", "modules", "sierra", "python"),
    *("distributions", "workspaces", "packages", "locale", "timezone", "cores", "memory", "limits", "host"),
)
"""Names of the facts; those that best explain a different result come first."""
LATER = ("packages", "workspaces")
"""Facts that only robots report. They are no part of the ids of environments that lack them."""
ABSENT = ("container", "workspaces")
"""Facts that are None where there is none. For others, None means that an older record does not have them."""
SECRET = ("TOKEN", "SECRET", "PASSWORD", "CREDENTIAL")


def capture(version: str, record: Sequence[str] = ()) -> dict[str, JsonView]:
    """Return the record of this environment; `version` is SIERRA's, `record` adds names (or patterns) of variables."""
    installed = _distributions()
    python = {"python": platform.python_version(), "distributions": installed, "lock": sha256(installed.encode())}
    return _record({"sierra": version, **python}, _facts(), os.environ, _variables((*VARIABLES, *record)))


def _facts() -> dict[str, Fact]:
    """Return the facts of this machine for programs of runs, which do not get the limit that this process has raised."""
    found = facts()
    if (before := open_files.before()) is not None and isinstance(limits := found["limits"], dict):
        limits["nofile"] = [before, *limits["nofile"][1:]]
    return found


def elsewhere(
    around: Mapping[str, JsonView],
    machine: Mapping[str, JsonView],
    variables: Mapping[str, str],
    software: Mapping[str, str | None] | None = None,
) -> dict[str, JsonView]:
    """Return the record of another host, from the facts and variables that it reported, and `around`, this host's record.

    PATH is this host's, because runs search for programs in it wherever they are executed. `software`: that of a host that
    has its own, such as a robot.
    """
    kept = {name: value for name, value in around.items() if name != "environment"}
    if software is not None:
        kept |= {name: str(software[name] or "") for name in ("python", "distributions")}
        kept |= {name: software[name] for name in LATER if software.get(name)}
        kept["lock"] = sha256(str(kept["distributions"]).encode())
    own = _table("variables", str(around.get("variables") or ""))
    search = {name: str(value) for name, value in own.items() if name == "PATH"}
    return _record(kept, machine, variables, {name: value for name, value in {**variables, **search}.items() if name != LOADED})


def _record(
    around: Mapping[str, JsonView], machine: Mapping[str, JsonView], variables: Mapping[str, str], recorded: Mapping[str, str]
) -> dict[str, JsonView]:
    """Return a row of `environments`. `variables` decide about locale, time zone and modules; `recorded` are written down."""
    record = {
        **dict.fromkeys(LATER),
        **around,
        **machine,
        "locale": next((variables[name] for name in ("LC_ALL", "LC_CTYPE", "LANG") if variables.get(name)), "C"),
        "timezone": variables.get("TZ") or machine["timezone"],
        "limits": json.dumps(machine["limits"], sort_keys=True),
        "modules": [name for name in variables.get(LOADED, "").split(":") if name],
        "variables": json.dumps(recorded, sort_keys=True),
    }
    return {"environment": identity(record), **record}


def identity(facts: Mapping[str, JsonView]) -> str:
    """Return the id of an environment with these facts."""
    given = {name: value for name, value in facts.items() if name not in LATER or value is not None}
    return digest("environment", {name: value for name, value in given.items() if name != "environment"})


def recorded(record: Sequence[str]) -> tuple[str, ...]:
    """Return the names (or patterns) of all variables that another host has to report for `elsewhere`; `record` adds names."""
    return (*VARIABLES, LOADED, *record)


def is_recorded(name: str, patterns: Sequence[str]) -> bool:
    """Return whether a variable is recorded: its name fits one of the patterns, and is not that of a secret."""
    return any(fnmatchcase(name, pattern) for pattern in patterns) and not any(secret in name.upper() for secret in SECRET)


def _variables(patterns: Sequence[str]) -> dict[str, str]:
    return {name: value for name, value in sorted(os.environ.items()) if is_recorded(name, patterns)}


@cache
def _distributions() -> str:
    """Return the distributions that are installed where SIERRA runs, one per line."""
    folders = [Path(folder) for folder in sys.path if folder.endswith(("site-packages", "dist-packages"))]
    return "\n".join(one.line for one in pythons.distributions([folder for folder in folders if folder.is_dir()]))


def differing(
    before: Mapping[str, RecordValue], now: Mapping[str, RecordValue]
) -> Iterator[tuple[str, RecordValue, RecordValue]]:
    """Yield the differences between two rows of `environments` as name, old value, new value; the most relevant come first.

    For lists, the values are the items that only one row has. Variables, limits and distributions are compared one by one, as
    in `variables.TZ`. Columns that an older record does not have are not compared.
    """
    for name in RELEVANT:
        was, is_now = before.get(name), now.get(name)
        if was == is_now or name not in before or (was is None and name not in ABSENT):
            continue
        match name:
            case "variables" | "limits" | "distributions" | "packages" | "workspaces":
                old, new = (_table(name, str(value or "")) for value in (was, is_now))
                changed = (key for key in sorted(old.keys() | new.keys()) if old.get(key) != new.get(key))
                yield from ((f"{name}.{key}", old.get(key), new.get(key)) for key in changed)
            case "cpu_flags" | "gpus" | "modules":
                here, there = as_texts(was), as_texts(is_now)
                yield name, [item for item in here if item not in there], [item for item in there if item not in here]
            case _:
                yield name, was, is_now


def _table(name: str, text: str) -> Mapping[str, JsonView]:
    """Return the facts that a text contains, by name."""
    match name:
        case "distributions":
            return dependency_model.versions(text)
        case "packages":
            return {package: version for package, _, version in (line.partition("==") for line in text.splitlines())}
        case "workspaces":
            return {folder: described for folder, _, described in (line.partition(": ") for line in text.splitlines())}
        case _:
            return as_object(json.loads(text or "{}"))

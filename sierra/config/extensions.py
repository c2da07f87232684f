"""The names that extensions add. What a name stands for is imported when the name is used.

An extension is a folder in `sierra/extensions` that can be deleted. `ADDS` gives its names as another package gives entry
points in its `pyproject.toml`: reading them imports nothing, and no other module knows an extension. An extension whose folder
does not exist adds nothing. Its names say where an unknown key of `sierra.toml` belongs, and its data count nevertheless, so
that records do not depend on which extensions exist.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping
from contextvars import ContextVar
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

ADDS: Mapping[str, Mapping[str, Mapping[str, str]]] = {
    "argos": {
        "platforms": {"argos": "platform:Argos"},
        "inputs": {".argos": "xml"},
        "starts": {".argos": "argos"},
        "variables": {"ARGOS_PLUGIN_PATH": "libraries"},
        "examples": {"argos": "examples/argos"},
    },
    "collect": {
        "commands": {"collect": "command:collect"},
        "sections": {"collect": "Run"},
        "runners": {"collected": "runner:Collected"},
    },
    "explorer": {
        "commands": {"explore": "command:explore", "open explore": "command:explore"},
        "sections": {"explore": "Look"},
    },
    "figures": {
        "figures": {
            "ridge": "ridge:Ridge",
            "pareto": "pareto:Pareto",
            "embedding": "embedding:Embedding",
            "survival": "survival:Survival",
            "critical_difference": "ranks:CriticalDifference",
            "network": "network:Network",
            "confusion": "classifiers:Confusion",
            "roc": "classifiers:Roc",
            "pr": "classifiers:Pr",
            "risk_coverage": "classifiers:RiskCoverage",
        },
    },
    "formats": {
        "readers": {
            "graphml": "graphml:GraphMl",
            "npy": "numpy_arrays:NumpyArrays",
            "arrow": "arrow_files:ArrowFiles",
            "sqlite": "sqlite_tables:SqliteTables",
            "hdf5": "hdf5_datasets:Hdf5Datasets",
            "netcdf": "netcdf_variables:NetcdfVariables",
        },
        "outputs": {
            "graphml": "outputs:GraphMlOutput",
            "npy": "outputs:NumpyOutput",
            "arrow": "outputs:ArrowOutput",
            "sqlite": "outputs:SqliteOutput",
            "hdf5": "outputs:Hdf5Output",
            "netcdf": "outputs:NetcdfOutput",
        },
    },
    "gazebo": {
        "platforms": {"gazebo": "platform:Gazebo"},
        "inputs": {".world": "xml", ".sdf": "xml"},
        "variables": {"GZ_VERSION": ""},
        "examples": {"gazebo": "examples/gazebo"},
    },
    "hosts": {
        "links": {"fabric": "fabric:Fabric", "openssh": "openssh:OpenSsh"},
        "options": {"doctor --hosts": "command:checked"},
    },
    "lab": {
        "needs": {"hosts": ""},
        "schedulers": {"lab": "scheduler:Lab"},
        "fleets": {"lab": "host_list:of_labs"},
    },
    "robots": {
        "needs": {"hosts": ""},
        "runners": {"robots": "runner:Robots"},
        "fleets": {"robots": "fleet_checks:of_fleet"},
        "member_lines": {"robots": "report_part:lines"},
        "member_notes": {"robots": "notes:of_batch"},
        "replay_notes": {"robots": "notes:of_replay"},
        "examples": {"robots": "examples/robots"},
    },
    "ros": {
        "platforms": {"ros": "platform:Ros"},
        "readers": {"bag": "bags.bag_topics:BagTopics"},
        "outputs": {"bag": "output:BagOutput"},
        "series": {"bag": "topic"},
        "pictures": {"bag": "bags.camera_pictures:pictures"},
        "options": {f"{name} --recover": "command:recovered" for name in ("show", "open show", "files", "open files")},
        "inputs": {".launch": "xml"},
        "variables": dict.fromkeys(("ROS_DISTRO", "ROS_VERSION", "RMW_IMPLEMENTATION", "AMENT_PREFIX_PATH"), ""),
        "examples": {name: f"examples/{name}" for name in ("ros", "ros2", "turtlebot3", "robots-ros1")},
    },
    "sierra1": {
        "needs": {"argos": ""},
        "options": {"init --from-sierra1": "command:converted"},
    },
    "simulators": {
        "platforms": {"jsbsim": "jsbsim:Jsbsim", "mujoco": "mujoco:Mujoco", "sumo": "sumo:Sumo"},
        "starts": {".sumocfg": "sumo"},
        "variables": {"MUJOCO_GL": ""},
        "examples": {name: f"examples/{name}" for name in ("jsbsim", "mujoco", "sumo")},
    },
    "trials": {
        "commands": {"trial": "command:app"},
        "sections": {"trial": "Run"},
        "options": {"run --operator": "option:of_run"},
        "tables": {"trials": "table:TABLE"},
        "sessions": {"trials": "session:step"},
        "report_sections": {"trials": "report_section:section"},
    },
    "videos": {
        "commands": {
            "video": "command:video",
            "open video": "of_package:video",
        },
        "sections": {"video": "Deliver"},
        "former": {"capture": "capture_command:capture"},
        "options": {"package --no-videos": "command:left_out"},
        "tables": {"videos": "table:TABLE", "capture": "rendered_runs:TABLE"},
        "deliverables": {"video": "deliverable:VIDEOS"},
    },
}
"""By extension and kind (see `sierra.plugin`): names, each with its place in the extension's folder, as `module:attribute`.

`former` are former names of commands. `pictures` are formats of outputs whose files have pictures for videos, each with the
function that writes these. `sessions` are steps of sessions (see `sierra.execution.session_steps`): a function that returns the
step for the content of a `sierra.toml`, or None. `report_sections` are functions that return a section about a batch in
reports, or None. `fleets` are functions that return the hosts of a runner, for `sierra doctor --hosts`. Of members of runs,
`member_lines` yields elements for reports on a batch, `member_notes` notes on it, and `replay_notes` returns one on a replay of
runs. Seven kinds are data.
`sections` are those of `sierra --help`, for commands. `inputs` are endings of input files, with the format of their templates.
`starts` are endings of those whose platform starts the simulator itself, with its name. `variables` are recorded with the
environment; `libraries` are search paths of libraries. `examples` are projects for `sierra init --example`, with their folders.
`needs` names other extensions, without which this one is as if it were not there. `series` are formats of outputs, each with
the column that tells series of rows apart which have times of their own.
"""
GIVEN: ContextVar[tuple[object, ...]] = ContextVar("given", default=())
"""The values that the options of extensions have returned for this call of a command; see `given`."""
T = TypeVar("T")
FOLDER = Path(__file__).parents[1] / "extensions"


@cache
def added(kind: str) -> Mapping[str, str]:
    """Return all names that extensions add to a kind, each with its place, as `module:attribute`."""
    return {name: f"sierra.extensions.{owner}.{place}" for owner, names in _present(kind) for name, place in names.items()}


def load(kind: str, name: str) -> Any:
    """Return what a name stands for."""
    module, _, attribute = added(kind)[name].partition(":")
    return getattr(import_module(module), attribute)


def called(kind: str, *subject: object) -> Iterator[Any]:
    """Yield what the functions of a kind return for a subject, but for None."""
    yield from filter(None, (load(kind, name)(*subject) for name in added(kind)))


@cache
def every(kind: str) -> Mapping[str, str]:
    """Return all names of a kind, each with its text in `ADDS`, also those of extensions that are not there."""
    return {name: text for adds in ADDS.values() for name, text in adds.get(kind, {}).items()}


def given(kind: type[T]) -> list[T]:
    """Return the values of one type that the options of extensions have returned, for this call of the command."""
    return [value for value in GIVEN.get() if isinstance(value, kind)]


@contextlib.contextmanager
def giving(value: object) -> Iterator[None]:
    """Give a value to what extensions do in this block, unless it is None."""
    before = GIVEN.set((*GIVEN.get(), *([] if value is None else [value])))
    try:
        yield
    finally:
        GIVEN.reset(before)


def sections() -> Mapping[str, str]:
    """Return the commands of extensions, each with its section of `sierra --help`."""
    return {name: section for _, names in _present("sections") for name, section in names.items()}


def starts() -> Mapping[str, str]:
    """Return the endings of input files whose platform starts the simulator itself, each with the platform's name."""
    return {ending: name for _, names in _present("starts") for ending, name in names.items()}


def examples() -> Mapping[str, Path]:
    """Return the example projects of extensions, each with its folder."""
    return {name: FOLDER / owner / text for owner, names in _present("examples") for name, text in names.items()}


def home(kind: str, name: str) -> str | None:
    """Return the extension that a name of a kind belongs to, also one that is not there."""
    return next((extension for extension, adds in ADDS.items() if name in adds.get(kind, {})), None)


def belongs(name: str, home: str) -> str:
    """Return the end of a message about a name whose extension, or one that this needs, is not there."""
    lost = next((need for need in ADDS[home].get("needs", ()) if not is_there(need)), home) if _has_folder(home) else home
    needs = "" if lost == home else f"needs {lost!r}, which "
    return f"{name!r} belongs to the extension {home!r}, which {needs}is not installed; install sierra-{lost}"


def lacking(table: Mapping[str, Any]) -> str | None:
    """Return why the runs of a package cannot be executed here; None if they can.

    An extension that is not there would execute them itself, with its table in these settings or in those of a target.
    """
    targets = table.get("targets")
    inner = [target for target in targets.values() if isinstance(target, Mapping)] if isinstance(targets, Mapping) else []
    owners = {key: owner for settings in (table, *inner) for key in settings if (owner := absent("tables", key))}
    return next((belongs(key, owner) for key, owner in owners.items() if "sessions" in ADDS[owner]), None)


def without_absent(table: Mapping[str, Any], where: str = "") -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return the settings of a package without those of extensions that do not exist here, and a note for each of these.

    No id depends on such settings, so the package can be read and executed without them: keys, figures of kinds of extensions,
    options of platforms that are not used, and of links. Without a table of an extension that executes runs itself, the package
    can only be read: see `lacking`.
    """
    kept: dict[str, Any] = {}
    ignored: dict[str, str] = {}
    for key, value in table.items():
        if key in ("figures", "platforms", "links") and isinstance(value, Mapping):
            names = {name: _kind(name, table, ()) if key == "figures" else name for name in value}
            lost = {n: owner for n, used in names.items() if used != table.get("platform") and (owner := absent(key, used))}
            kept[key] = {name: inner for name, inner in value.items() if name not in lost}
            ignored |= {f"{key}.{name}": owner for name, owner in lost.items()}
            if key == "figures" and lost:  # other figures may take keys from these
                defaults = table.get("figure_defaults")
                inherited = {name: value[name] for name in lost}
                kept["figure_defaults"] = {**inherited, **(defaults if isinstance(defaults, Mapping) else {})}
        elif owner := absent("tables", key):
            ignored[key] = owner
        else:
            kept.setdefault(key, value)
    notes = [
        f"sierra.toml: {where}{name} of the package is ignored: the extension {owner!r} is not installed"
        for name, owner in ignored.items()
    ]
    if isinstance(targets := kept.get("targets"), Mapping):
        for name, target in targets.items():
            if isinstance(target, Mapping):
                own, more = without_absent(target, f"{where}targets.{name}.")
                kept["targets"] = {**kept["targets"], name: own}
                notes += more
    return kept, tuple(notes)


def _kind(name: object, table: Mapping[str, Any], children: tuple[object, ...]) -> str:
    """Return the kind of a figure in the settings of a package, which may be another's; "" if it has none."""
    groups = [group for key in ("figures", "figure_defaults") if isinstance(group := table.get(key), Mapping)]
    found: Mapping[str, Any] = next((group[name] for group in groups if isinstance(group.get(name), Mapping)), {})
    if "kind" in found or name in children or not isinstance(found.get("inherit"), str):
        return str(found.get("kind", ""))
    return _kind(found["inherit"], table, (*children, name))


def absent(kind: str, name: str) -> str | None:
    """Return the extension that a name of a kind belongs to, if it does not exist here; else None."""
    return None if name in added(kind) else home(kind, name)


def is_there(extension: str) -> bool:
    """Return whether an extension and those that it needs exist. `Path.is_dir` would take longer."""
    return _has_folder(extension) and all(map(is_there, ADDS[extension].get("needs", ())))


def _has_folder(extension: str) -> bool:
    return os.path.isdir(FOLDER / extension)  # noqa: PTH112


def _present(kind: str) -> Iterator[tuple[str, Mapping[str, str]]]:
    """Yield the extensions that exist, each with its names of a kind."""
    yield from ((name, adds[kind]) for name, adds in ADDS.items() if kind in adds and is_there(name))

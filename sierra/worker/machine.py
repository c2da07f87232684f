"""Facts about a machine that do not change while it runs: operating system, processor, graphics, container, limits.

Values that change by themselves (free memory, load) are not included. No program is executed, because Linux provides all facts
in files. On other systems, unknown facts are empty.

This is a single file that needs only the standard library (Python 3.8 or newer), because it also executes on cluster nodes
without SIERRA.
"""

from __future__ import annotations

import contextlib
import os
import platform
import re
import resource
import shlex
from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Dict, List, Optional, Union

CPUINFO = Path("/proc/cpuinfo")
OS_RELEASE = (Path("/etc/os-release"), Path("/usr/lib/os-release"))
ARITHMETIC = re.compile(
    r"3dnow(ext)?|abm|adx|aes|amx_.*|avx.*|bmi\d|f16c|fma4?|gfni|mmx|movbe|pclmulqdq|pni|popcnt|sha_ni|sse.*|ssse3|tbm|v?aes|"
    r"vpclmulqdq|xop"
)
"""The x86 processor features by which numeric libraries select their code; for other processors, all features are kept."""
ENGINES = ("docker", "podman", "kubepods", "lxc", "containerd", "apptainer", "singularity")
ZONES = "/zoneinfo/"
GROUPS = Path("/sys/fs/cgroup")
ALLOCATED = {
    "SLURM_JOB_ID": ("SLURM_CPUS_ON_NODE", "SLURM_JOB_CPUS_PER_NODE"),
    "PBS_JOBID": ("NCPUS", "PBS_NP", "PBS_NUM_PPN"),
}
"""For each scheduler, the variable that a job has, and those that begin with its number of cores on the node."""
Fact = Union[int, str, List[str], Dict[str, List[Optional[int]]], None]


def facts() -> dict[str, Fact]:
    """Return all facts of this machine, by the column names of `environments`."""
    return {**_fixed(), "cores": usable_cores(), "limits": limits()}


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def granted_cores(environment: Mapping[str, str] = os.environ) -> int:
    """Return the number of usable cores that this process has for itself.

    Within a job of SLURM or PBS (`salloc`, `qsub -I`), these are the job's on this host, also if nothing enforces it. In a
    control group with a quota, as that of a container, they are as many as its time is enough for.
    """
    return max(1, min([usable_cores(), *_quotas(), *_allocated(environment)]))


def _allocated(environment: Mapping[str, str]) -> Iterator[int]:
    """Yield the cores that a scheduler's job has on this host, as the first of its variables says that is set."""
    for job, names in ALLOCATED.items():
        texts = [environment[name] for name in names if environment.get(name)] if environment.get(job) else []
        numbers = re.match(r"[1-9][0-9]{0,8}(?![0-9])", texts[0]) if texts else None
        if numbers:
            yield int(numbers.group())


def _quotas() -> Iterator[int]:
    """Yield the cores whose time the control groups of this process may use, from the inner to the outer ones."""
    named = re.search(r"^0::(/.*)$", _text(Path("/proc/self/cgroup")), re.MULTILINE)
    path = Path("%s%s" % (GROUPS, os.path.normpath(named[1]))) if named else GROUPS
    while path != GROUPS.parent and GROUPS in (path, *path.parents):
        numbers = re.match(r"(\d+) (\d+)\s*$", _text(path / "cpu.max"))
        if numbers and int(numbers[2]):
            yield -(-int(numbers[1]) // int(numbers[2]))
        path = path.parent


def limits() -> dict[str, list[int | None]]:
    """Return the limits of `ulimit -a`: soft and hard limit by name, in bytes, seconds or numbers; None means no limit."""
    names = sorted(name for name in dir(resource) if name.startswith("RLIMIT_") and name != "RLIMIT_OFILE")
    found = {}
    for name in names:
        with contextlib.suppress(ValueError, OSError):
            both = resource.getrlimit(getattr(resource, name))
            found[name[len("RLIMIT_") :].lower()] = [None if one == resource.RLIM_INFINITY else one for one in both]
    return found


@lru_cache(maxsize=None)
def _fixed() -> dict[str, Fact]:
    uname = os.uname()
    model, flags = processor(_text(CPUINFO))
    return {
        "host": uname.nodename,
        "os": _os_release(),
        "kernel": uname.release,
        "machine": uname.machine,
        "cpu": model or uname.machine,
        "cpu_flags": flags,
        "memory": os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"),
        "gpus": sorted(_gpus()),
        "libc": _libc(),
        "container": _container(),
        "timezone": _timezone(),
    }


def _text(path: Path) -> str:
    try:
        return path.read_text("utf-8", "replace")
    except OSError:
        return ""


def _os_release() -> str:
    """Return the name in the os-release file, according to its specification."""
    text = next(filter(None, map(_text, OS_RELEASE)), "")
    named = [line.partition("=")[2] for line in text.splitlines() if line.startswith("PRETTY_NAME=")]
    with contextlib.suppress(ValueError):  # an unclosed quote
        if named and shlex.split(named[-1]):
            return shlex.split(named[-1])[0]
    return os.uname().sysname


def processor(cpuinfo: str) -> tuple[str, list[str]]:
    """Return the first processor's model and features, parsed from /proc/cpuinfo of x86, ARM and others."""
    first = cpuinfo.split("\n\n")[0]
    fields = {
        name.strip(): value.strip() for name, colon, value in (line.partition(":") for line in first.splitlines()) if colon
    }
    model = fields.get("model name") or fields.get("cpu") or fields.get("uarch") or ""
    if not model and "CPU part" in fields:
        model = f"implementer {fields.get('CPU implementer', '?')}, part {fields['CPU part']}"
    if "flags" in fields:
        return model, sorted({flag for flag in fields["flags"].split() if ARITHMETIC.fullmatch(flag)})
    others = fields.get("Features") or fields.get("features") or fields.get("isa") or ""
    return model, sorted(set(others.split()))


def _gpus() -> Iterator[str]:
    """Yield the graphics processors: NVIDIA's by name and driver, others by the ids of vendor and device, and by driver."""
    driver = re.search(r"\b\d{3}\.\d+(\.\d+)*\b", _text(Path("/proc/driver/nvidia/version")))
    for file in Path("/proc/driver/nvidia/gpus").glob("*/information"):
        model = re.search(r"Model:\s*(.+)", _text(file))
        yield f"{model[1] if model else 'NVIDIA'}, driver {driver[0] if driver else '?'}"
    for device in Path("/sys/class/drm").glob("card[0-9]*/device"):
        vendor = _text(device / "vendor").strip()
        if vendor:
            named = os.path.basename(os.path.realpath(device / "driver"))
            yield f"{vendor}:{_text(device / 'device').strip()}, driver {named}"


def _libc() -> str:
    with contextlib.suppress(ValueError, OSError, AttributeError):
        if name := os.confstr("CS_GNU_LIBC_VERSION"):
            return name
    return " ".join(part for part in platform.libc_ver() if part)


def _container() -> str | None:
    """Return the container of this process, with its image if known (podman, apptainer); None outside a container."""
    for name in ("APPTAINER", "SINGULARITY"):
        if image := os.environ.get(f"{name}_NAME") or os.environ.get(f"{name}_CONTAINER"):
            return f"{name.lower()} {Path(image).name}"
    description = Path("/run/.containerenv")
    if description.exists():
        fields = dict(re.findall(r'^(\w+)="(.*)"$', _text(description), re.MULTILINE))
        return " ".join(part for part in ("podman", fields.get("image"), fields.get("imageid")) if part)
    if Path("/.dockerenv").exists():
        return "docker"
    groups = _text(Path("/proc/self/cgroup"))
    return next((engine for engine in ENGINES if f"/{engine}" in groups), None)


def _timezone() -> str:
    """Return the name of the machine's time zone."""
    linked = os.path.realpath("/etc/localtime")
    return linked.partition(ZONES)[2] or _text(Path("/etc/timezone")).strip() or "UTC"

"""The abilities of engines on a host, found by starting a container and cached until something changes.

No image is needed: the container's root is an empty folder in which the host's programs are mounted read-only. The host's own
shell then reports what it sees in the container: its user outside of it, the networks, whether the requested limits are set,
and whether the kernel ends the whole container if one process uses too much memory.

A result is valid for one boot, one user, and the same engine, helpers and configuration (by path, size and time of change). A
failure to start a container is never cached, so that a repair takes effect at once.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from functools import cache

from sierra.containers.engines.base import Capabilities
from sierra.containers.engines.hosts import HERE, Host, OtherHost, completed
from sierra.store.layout import user_engines
from sierra.util.cache import Cache
from sierra.util.json_types import JsonView, as_object, as_texts
from sierra.util.lazy_definitions import dataclass

MAX_ENTRIES = 64
DECIDING = ("PATH", "HOME", "CONTAINERS_CONF", "XDG_CONFIG_HOME", "XDG_CACHE_HOME")
"""The variables whose change within a process requires a new check."""
GROUPS = "/etc/group"
TIMEOUT_S = 20.0
MEMORY, CPUS, PIDS = 64 << 20, 0.5, 90
"""The limits that are requested to test whether they are enforced."""
REPORT = r"""
echo "user $(id -u) $(head -n 1 /proc/self/uid_map)"
while read -r name ids; do test "$name" = Groups: && echo "groups $ids"; done < /proc/self/status
for card in $(cut -s -d : -f 1 /proc/net/dev); do test "$card" = lo || echo "card $card"; done
while IFS=: read -r _ kinds path; do
    case ",$kinds," in
    *,cpu,*) where=cpu ;;
    *,pids,*) where=pids ;;
    ,,) where=. ;;
    *) continue ;;
    esac
    for top in "/sys/fs/cgroup/$where$path" "/sys/fs/cgroup/$where" "/sys/fs/cgroup/$kinds$path"; do
        for name in cpu.max cpu.cfs_quota_us pids.max; do
            test -r "$top/$name" && echo "$name $(cat "$top/$name")"
        done
    done
done < /proc/self/cgroup
echo told
"""
USE_MEMORY = "head -c 192m /dev/zero 2>/dev/null | tail -c 192m >/dev/null 2>&1; echo on"
"""A script in which one part needs more memory than is allowed."""
QUOTAS = {"cpu.max": ("50000 100000", "cpus"), "cpu.cfs_quota_us": ("50000", "cpus"), "pids.max": (f"{PIDS}", "pids")}


@dataclass(frozen=True, slots=True)
class ProbeResult:
    """The result of testing an engine."""

    abilities: Capabilities
    options: tuple[str, ...] = ()
    """The engine's additional options that are needed here."""


_WORKS: dict[str, ProbeResult] = {}
"""The successful results of this process, which are available even if the cache cannot be written."""


@dataclass(frozen=True, slots=True)
class Dependencies:
    """The programs and the files on which the abilities of an engine depend."""

    programs: tuple[str, ...]
    files: tuple[str, ...]


Test = Callable[[Host], ProbeResult]


def cached(name: str, test: Test, depends: Callable[[Host], Dependencies], host: Host = HERE) -> ProbeResult:
    """Return the cached result for an engine if the engine and its dependencies are unchanged; otherwise test it."""
    if isinstance(host, OtherHost):
        if name not in host.known:
            host.known[name] = _cached(name, test, depends, host)
        result: ProbeResult = host.known[name]
        return result
    return _cached(name, test, depends, host)


def _cached(name: str, test: Test, depends: Callable[[Host], Dependencies], host: Host) -> ProbeResult:
    facts = host.facts
    on = depends(host)
    states = host.call("states", on.programs, (*on.files, GROUPS))
    named = [f"on {host.name}"] if host.name else []
    key = json.dumps([name, *named, facts.boot, facts.user, *states, *_variables(host.variables)])
    if key in _WORKS:
        return _WORKS[key]
    file = Cache(user_engines(), MAX_ENTRIES)
    with contextlib.suppress(LookupError):
        return _WORKS.setdefault(key, _unpacked(as_object(file.get(key))))
    try:
        result = test(host)
    except OSError as error:
        trouble = f"{name} cannot be tested: {error.filename or tempfile.gettempdir()}: {error.strerror}"
        return ProbeResult(Capabilities(name, trouble=trouble))
    if not result.abilities.trouble:
        _WORKS[key], able = result, result.abilities
        file.put(key, {"abilities": {**asdict(able), "enforced": sorted(able.enforced)}, "options": result.options})
        file.save()
    return result


def cached_here(name: str, test: Test, depends: Callable[[Host], Dependencies], host: Host = HERE) -> ProbeResult:
    """Return the result of `cached`, cached for this process and its environment, because every run needs it."""
    if host is not HERE:
        return cached(name, test, depends, host)
    return _cached_here(name, test, depends, (os.geteuid(), *map(os.environ.get, DECIDING)))


@cache
def _cached_here(name: str, test: Test, depends: Callable[[Host], Dependencies], _: tuple[object, ...]) -> ProbeResult:
    return cached(name, test, depends)


def _unpacked(fact: Mapping[str, JsonView]) -> ProbeResult:
    """Return a cached result. Raises LookupError for anything else."""
    able = as_object(fact["abilities"])
    limits = frozenset(as_texts(able["enforced"]))
    version, user = str(able["version"]), str(able["user"])
    return ProbeResult(
        Capabilities(version, able["rootless"] is True, limits, able["isolated"] is True, user, able["groups"] is True),
        as_texts(fact["options"]),
    )


def start(
    host: Host,
    words: Callable[[Mapping[str, str]], Sequence[str]],
    environment: Mapping[str, str] | None = None,
    *,
    fill: bool = False,
    squashed: bool = False,
) -> Capabilities | None:
    """Return what a container reports. `words` makes the command from the mounts, with `ROOT` for the path of its files.

    `fill` exceeds the memory limit. `squashed`: start a squashfs; None if none can be made there.
    """
    command = (*words(host.facts.mounts), "/bin/sh", "-c", REPORT + (USE_MEMORY if fill else "echo on"))
    done = host.call("probe", command, environment, TIMEOUT_S, squashed, timeout=2 * TIMEOUT_S)
    return None if done is None else _reported(completed(command, done), host)


def remedy(name: str, output: str) -> str:
    """Return an engine's error in one line, with the remedy if it is known."""
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    return f"{name} cannot start a container: {advice(output) or (lines[-1][:300] if lines else 'it printed no error')}"


def advice(output: str) -> str | None:
    """Return the reason and the remedy of an engine's error; None if they are unknown."""
    return next((known for pattern, known in KNOWN if re.search(pattern, output)), None)


KNOWN = (
    (r"cgroups in hybrid mode not supported", "crun does not work with hybrid cgroups; install runc"),
    (r"RLIMIT_\w+|setrlimit", "its default limits are higher than this user may set; lower default_ulimits in containers.conf"),
    (r"no subuid ranges found|cannot find UID/GID|insufficient UIDs or GIDs", "the user has no range of ids in /etc/subuid; "
     "an administrator can add one (usermod --add-subuids 100000-165535 --add-subgids 100000-165535 NAME; then, as that user, "
     'podman system migrate), or set ignore_chown_errors = "true" in [storage.options.overlay] of storage.conf'),
    (r"newuidmap", "newuidmap is missing or lacks its privileges; install uidmap (shadow-utils)"),
    (r"failed to open /dev/fuse|/dev/fuse: (Permission denied|No such file)", "/dev/fuse cannot be opened"),
    (r"(?i)clone.*operation not permitted|user namespace.*(disabled|not permitted)|unshare.*(denied|not permitted)|"
     r"no user namespaces|CLONE_NEWUSER|max_user_namespaces", "user namespaces are not allowed for this user; an administrator "
     "can allow them (user.max_user_namespaces, kernel.unprivileged_userns_clone), or install apptainer with setuid"),
    (r"netavark", "netavark is missing; podman needs it even without a network; install netavark"),
    (r"conmon", "conmon is missing; install conmon"),
    (r"(?i)(runc|crun)\W+(executable file )?not found|no such runtime|could not find.*runtime",
     "neither runc nor crun is installed; install runc"),
    (r"catatonit|container-init|init binary", "catatonit, which forwards signals, is missing; install catatonit"),
    (r"(?i)no space left on device", "the disk is full"),
    (r"capability set .* while permitted", "its default capabilities exceed those of root here"),
)  # fmt: skip
"""Patterns of errors with which engines fail to start containers or to load images, each with its remedy."""


def _reported(done: subprocess.CompletedProcess[str], host: Host) -> Capabilities:
    if "\ntold\n" not in done.stdout:
        return Capabilities("", trouble=done.stderr.strip() or f"status {done.returncode}")
    lines = [line.partition(" ")[::2] for line in done.stdout.splitlines()]
    enforced = {limit for name, value in lines if name in QUOTAS for wanted, limit in [QUOTAS[name]] if value == wanted}
    if "\non\n" not in done.stdout:
        enforced.add("memory")  # killed as a whole: if only a part is killed, a script may not notice
    user, groups = 0, set[str]()
    for name, value in lines:
        if name == "groups":
            groups = set(value.split()) - {"0"}
        if name == "user":
            inside, first, outside, _ = map(int, value.split())
            user = outside + inside - first
    isolated = not any(name == "card" for name, _ in lines)
    return Capabilities("", host.facts.user != 0, frozenset(enforced), isolated, host.call("user_name", user), bool(groups))


def _variables(environment: Mapping[str, str]) -> Iterator[str]:
    """Yield the variables of the environment that influence engines."""
    for name in sorted(environment):
        if re.match(r"(CONTAINERS|STORAGE|APPTAINER|SINGULARITY|XDG)_|PATH$|HOME$", name):
            yield f"{name}={environment[name]}"

"""What engines can do here, found out by starting something with them, and remembered until something changes.

No image is needed: a container gets a folder with nothing in it, the host's programs are mounted there read-only, and the
host's own shell tells what it sees: who it is outside, which network there is, whether the limits that were asked for are set,
and whether the kernel ends all of it for one.

What was found holds for a boot, a user, and the same engine, helpers and configuration (by path, size and time of change).
That an engine can't start anything is never remembered: whoever has mended it should not have to wait.
"""

from __future__ import annotations

import contextlib
import json
import os
import pwd
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from sierra.containers.engines import podman_config
from sierra.containers.engines.base import Capabilities
from sierra.store.layout import user_engines
from sierra.util.cache import Cache

MOST = 64
DECIDING = ("PATH", "HOME", "CONTAINERS_CONF", "XDG_CONFIG_HOME", "XDG_CACHE_HOME")
"""Variables whose change, within a process, makes another surrounding."""
PATIENCE_S = 20.0
SHARED = ("usr", "bin", "sbin", "lib", "lib32", "lib64")
"""What of the host makes its shell run in a container."""
OWN = ("dev", "etc", "proc", "run", "sys", "tmp", "var")
MEMORY, CPUS, PIDS = 64 << 20, 0.5, 90
"""The limits that are asked for to see whether they hold."""
TELL = r"""
echo "user $(id -u) $(head -n 1 /proc/self/uid_map)"
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
FILL = "head -c 192m /dev/zero 2>/dev/null | tail -c 192m >/dev/null 2>&1; echo on"
"""A script of which a part needs more memory than it may have."""
QUOTAS = {"cpu.max": ("50000 100000", "cpus"), "cpu.cfs_quota_us": ("50000", "cpus"), "pids.max": (f"{PIDS}", "pids")}


@dataclass(frozen=True, slots=True)
class Found:
    """What was found out about an engine."""

    abilities: Capabilities
    options: tuple[str, ...] = ()
    """What it must be told, beyond what it is told always, so that it works here."""


@dataclass(frozen=True, slots=True)
class Told:
    """What a container that was started told, or why it could not be."""

    trouble: str = ""
    rootless: bool = False
    user: str = ""
    isolated: bool = True
    enforced: frozenset[str] = frozenset()


def podman() -> Capabilities:
    """What podman can do here."""
    able = known("podman", _podman, _around_podman()).abilities
    return able if able.trouble else replace(able, trouble=podman_config.trouble())


def podman_options() -> tuple[str, ...]:
    """Podman's own options, before any command, with which it works here."""
    return settled("podman", _podman, _around_podman).options


def podman_enforced() -> frozenset[str]:
    """The limits that hold in podman's containers."""
    return settled("podman", _podman, _around_podman).abilities.enforced


def known(name: str, ask: Callable[[], Found], around: Sequence[str]) -> Found:
    """What is remembered of an engine that is the same as then, in the same surroundings; else what it says now."""
    key = json.dumps([name, _boot(), os.geteuid(), *(_state(path) for path in around), *_variables()])
    found = _WORKS.get(key) or _known(name, ask, key)
    if not found.abilities.trouble:
        _WORKS[key] = found
    return found


def settled(name: str, ask: Callable[[], Found], around: Callable[[], Sequence[str]]) -> Found:
    """The same for as long as this process runs, in the same environment: for what is asked with each run."""
    return _settled(name, ask, around, (os.geteuid(), *map(os.environ.get, DECIDING)))


@cache
def _settled(name: str, ask: Callable[[], Found], around: Callable[[], Sequence[str]], _: tuple[Any, ...]) -> Found:
    return known(name, ask, around())


_WORKS: dict[str, Found] = {}
"""What this process has found to work, also where nothing can be remembered."""


def _known(name: str, ask: Callable[[], Found], key: str) -> Found:
    remembered = Cache(user_engines(), MOST)
    fact = remembered.get(key)
    if fact is not None:
        with contextlib.suppress(TypeError, KeyError):
            return _unpacked(fact)
    try:
        found = ask()
    except OSError as error:
        return Found(
            Capabilities(name, trouble=f"{name} can't be tried: {error.filename or tempfile.gettempdir()}: {error.strerror}")
        )
    if not found.abilities.trouble:
        remembered.put(key, _packed(found))
        remembered.save()
    return found


def _packed(found: Found) -> dict[str, Any]:
    fields = asdict(found.abilities)
    return {"abilities": {**fields, "enforced": sorted(fields["enforced"])}, "options": list(found.options)}


def _unpacked(fact: Mapping[str, Any]) -> Found:
    fields = fact["abilities"]
    return Found(Capabilities(**{**fields, "enforced": frozenset(fields["enforced"])}), tuple(fact["options"]))


def start(
    words: Callable[[Path, Mapping[str, str]], Sequence[str]],
    environment: Mapping[str, str] | None = None,
    *,
    fill: bool = False,
) -> Told:
    """Start a container; `words` makes the command from the folder that is its root and from what is mounted there.

    `fill` is to use more memory than it may have, where that is limited.
    """
    with tempfile.TemporaryDirectory(prefix="sierra-probe-") as made:
        root = Path(made)
        mounts = furnish(root)
        command = (*words(root, mounts), "/bin/sh", "-c", TELL + (FILL if fill else "echo on"))
        said = run(command, environment)
    return _told(said)


def run(command: Sequence[str], environment: Mapping[str, str] | None = None) -> subprocess.CompletedProcess[str]:
    """A command to its end, or to that of our patience: it has failed then."""
    try:
        return subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=PATIENCE_S,
            env=environment,
            cwd="/",
            check=False,
        )
    except subprocess.TimeoutExpired:
        return subprocess.CompletedProcess(command, 1, "", f"it did not answer within {PATIENCE_S:.0f} s")
    except OSError as error:
        return subprocess.CompletedProcess(command, 1, "", str(error.strerror))


def remedy(name: str, said: str) -> str:
    """What an engine complained of, in one line, with what to do about it."""
    lines = [line.strip() for line in said.splitlines() if line.strip()]
    for pattern, advice in KNOWN:
        if re.search(pattern, said):
            return f"{name} can't start a container: {advice}"
    return f"{name} can't start a container: {lines[-1][:300] if lines else 'it said nothing'}"


KNOWN = (
    (r"cgroups in hybrid mode not supported", "crun does not work with hybrid cgroups; install runc"),
    (r"RLIMIT_\w+|setrlimit", "its limits are higher than this user may set; lower default_ulimits in containers.conf"),
    (r"no subuid ranges found|cannot find UID/GID|insufficient UIDs or GIDs", "the user has no range of ids in /etc/subuid; "
     "an administrator gives one (usermod --add-subuids 100000-165535 --add-subgids 100000-165535 NAME), "
     'or ignore_chown_errors = "true" in [storage.options.overlay] of storage.conf does without'),
    (r"newuidmap", "newuidmap is missing or lacks its rights; install uidmap (shadow-utils)"),
    (r"failed to open /dev/fuse|/dev/fuse: (Permission denied|No such file)", "/dev/fuse can't be opened"),
    (r"(?i)clone.*operation not permitted|user namespace.*(disabled|not permitted)|unshare.*(denied|not permitted)|"
     r"no user namespaces|CLONE_NEWUSER|max_user_namespaces", "user namespaces are not allowed to this user; an administrator "
     "allows them (user.max_user_namespaces, kernel.unprivileged_userns_clone), or installs apptainer with setuid"),
    (r"netavark", "netavark is missing, which podman needs even for no network; install netavark"),
    (r"conmon", "conmon is missing; install conmon"),
    (r"(?i)(runc|crun)\W+(executable file )?not found|no such runtime|could not find.*runtime",
     "neither runc nor crun is there; install runc"),
    (r"catatonit|container-init|init binary", "catatonit is missing, which passes signals on; install catatonit"),
    (r"(?i)no space left on device", "there is no room on the disk"),
    (r"capability set .* while permitted", "its default capabilities are more than root has here"),
)  # fmt: skip
"""What engines say that can't start anything, and what helps."""


def _told(said: subprocess.CompletedProcess[str]) -> Told:
    if "\ntold\n" not in said.stdout:
        return Told(said.stderr.strip() or f"status {said.returncode}")
    lines = [line.partition(" ")[::2] for line in said.stdout.splitlines()]
    enforced = {limit for name, value in lines if name in QUOTAS for wanted, limit in [QUOTAS[name]] if value == wanted}
    if "\non\n" not in said.stdout:
        enforced.add("memory")  # it was killed as a whole: where a part of it is, a script may take no notice
    user = 0
    for name, value in lines:
        if name == "user":
            inside, first, outside, _ = map(int, value.split())
            user = outside + inside - first
    return Told("", os.geteuid() != 0, _called(user), not any(name == "card" for name, _ in lines), frozenset(enforced))


def _called(user: int) -> str:
    try:
        return pwd.getpwuid(user).pw_name
    except KeyError:
        return str(user)


def furnish(root: Path) -> dict[str, str]:
    """Make an empty folder the root of a container; what is to be mounted there, by its path inside."""
    root.chmod(0o755)
    for name in OWN:
        (root / name).mkdir()
    mounts = {}
    for name in SHARED:
        there = Path("/", name)
        if there.is_symlink():
            (root / name).symlink_to(there.readlink())
        elif there.is_dir():
            (root / name).mkdir()
            mounts[f"/{name}"] = f"/{name}"
    return mounts


def _podman() -> Found:
    """Start a container with podman, as it is, and with runc where it doesn't work so."""
    if shutil.which("podman") is None:
        return Found(
            Capabilities("podman", trouble="podman is not installed; apt-get install podman, or what your distribution has")
        )
    version = run(("podman", "--version")).stdout.strip().removeprefix("podman version ")
    if (number := version.partition(".")[0]).isdigit() and int(number) < 4:
        return Found(Capabilities(f"podman {version}", trouble=f"podman {version} is too old: 4.0 or newer is needed"))
    limits = (f"--cpus={CPUS}", f"--pids-limit={PIDS}")
    first = ""
    for options in ((), ("--runtime=runc",), ("--cgroup-manager=cgroupfs",), ("--runtime=runc", "--cgroup-manager=cgroupfs")):
        if options and "--runtime=runc" in options and shutil.which("runc") is None:
            continue
        for given in ((*podman_memory(MEMORY), *limits), limits, ()):
            fill = any(option.startswith("--memory") for option in given)
            told = start(lambda root, mounts, o=options, g=given: _podman_words(o, g, root, mounts), fill=fill)  # type: ignore[misc]
            if not told.trouble:
                named = _podman_version(options, version)
                return Found(Capabilities(named, told.rootless, told.enforced, told.isolated, told.user), options)
            first = first or told.trouble
            if not re.search(r"limit|controller|cgroup", told.trouble):
                break
    return Found(Capabilities(f"podman {version}", trouble=remedy("podman", first)))


def podman_memory(size: int) -> tuple[str, ...]:
    """The options by which a container of podman is killed as a whole where it has more memory: control groups of version 2."""
    unified = Path("/sys/fs/cgroup/cgroup.controllers").exists()
    return (f"--memory={size}", f"--memory-swap={size}", "--cgroup-conf=memory.oom.group=1") if unified else ()


def _podman_words(options: Sequence[str], limits: Sequence[str], root: Path, mounts: Mapping[str, str]) -> tuple[str, ...]:
    given = tuple(f"--volume={source}:{target}:ro" for target, source in mounts.items())
    alone = ("--network=none", "--pid=private", "--ipc=private", "--no-hosts", "--read-only")
    weak = ("--cap-drop=all", "--security-opt=no-new-privileges")
    few = ("--ulimit=nofile=1024:1024", "--ulimit=nproc=1024:1024")
    run = ("run", "--rm", "--init", "--pull=never", "--log-driver=none", "--user=0:0")
    return ("podman", *options, *run, *alone, *weak, *few, *limits, *given, "--rootfs", str(root))


def _podman_version(options: Sequence[str], version: str) -> str:
    """Podman, and what it starts containers with, each with its version."""
    asked = (
        "{{.Host.OCIRuntime.Name}}\n{{.Host.OCIRuntime.Version}}\n\n{{.Host.Conmon.Version}}\ncgroups {{.Host.CgroupsVersion}}"
    )
    said = run(("podman", *options, "info", f"--format={asked}")).stdout
    runtime, _, rest = said.partition("\n\n")
    words = runtime.split()
    name = words[0] if words else "an unknown runtime"
    number = next((word for word in words[1:] if word[:1].isdigit()), "")
    conmon = re.search(r"conmon version ([^\s,]+)", rest)
    cgroups = re.search(r"cgroups (\w+)", rest)
    parts = [f"podman {version}", f"{name} {number}".strip()]
    parts += [f"conmon {conmon[1]}"] if conmon else []
    parts += [f"cgroups {cgroups[1]}"] if cgroups else []
    return ", ".join(parts)


def _around_podman() -> tuple[str, ...]:
    programs = ("podman", "runc", "crun", "conmon", "catatonit", "newuidmap", "fuse-overlayfs")
    home = Path(os.environ.get("XDG_CONFIG_HOME") or Path(os.environ.get("HOME", "/"), ".config"), "containers")
    folders = (home, Path("/etc/containers"), Path("/usr/share/containers"))
    files = [str(folder / name) for folder in folders for name in ("containers.conf", "containers.conf.d", "storage.conf")]
    return (*map(found_at, programs), *files, os.environ.get("CONTAINERS_CONF", ""), "/etc/subuid", "/etc/subgid")


def found_at(program: str) -> str:
    """Where a program is; as PATH has it, and also where only root has it on the PATH."""
    return shutil.which(program) or shutil.which(program, path="/usr/sbin:/sbin:/usr/local/sbin:/usr/libexec/podman") or program


def _variables() -> Iterator[str]:
    """What of the environment engines heed."""
    for name in sorted(os.environ):
        if re.match(r"(CONTAINERS|STORAGE|APPTAINER|SINGULARITY|XDG)_|PATH$|HOME$", name):
            yield f"{name}={os.environ[name]}"


def _boot() -> str:
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return ""


def _state(path: str) -> list[Any]:
    try:
        status = os.stat(path)  # noqa: PTH116 - as quick as can be
    except OSError:
        return [path]
    return [path, status.st_ino, status.st_size, status.st_mode, status.st_ctime_ns]

"""The way to start podman on a host, found by trying and cached by `sierra.containers.engines.capabilities`.

Some settings of podman's configuration affect all containers, and no option of a single container can remove them. The files
are read as podman reads them (containers.conf(5)): a later file overrides an earlier one. If a variable names a file, only that
file is used.
"""

from __future__ import annotations

import glob
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from sierra.containers.engines import capabilities
from sierra.containers.engines.base import Capabilities
from sierra.containers.engines.capabilities import CPUS, MEMORY, PIDS, Dependencies, ProbeResult
from sierra.containers.engines.hosts import HERE, Host, run
from sierra.worker.on_host import ROOT

KEYS = ("volumes", "mounts", "devices")
NAME = "containers.conf"
WAYS = ((), ("--runtime=runc",), ("--cgroup-manager=cgroupfs",), ("--runtime=runc", "--cgroup-manager=cgroupfs"))
"""The options before any command to try, one after the other."""


def podman(host: Host = HERE) -> Capabilities:
    """Return the abilities of podman on a host."""
    able = capabilities.cached("podman", _test, _dependencies, host).abilities
    return able if able.trouble else replace(able, trouble=_settings_trouble(host))


def here(host: Host = HERE) -> ProbeResult:
    """Return the abilities of podman, and the options before any command with which it works, as cached for this process."""
    return capabilities.cached_here("podman", _test, _dependencies, host)


def _test(host: Host) -> ProbeResult:
    """Test podman by starting a container: as it is, and otherwise with runc or with cgroupfs."""
    if host.call("which", "podman") is None:
        trouble = "podman is not installed; install it, for example with apt-get install podman"
        return ProbeResult(Capabilities("podman", trouble=trouble))
    version = run(host, ("podman", "--version")).stdout.strip().removeprefix("podman version ")
    if (number := version.partition(".")[0]).isdigit() and int(number) < 4:
        return ProbeResult(Capabilities(f"podman {version}", trouble=f"podman {version} is too old: 4.0 or newer is needed"))
    limits = (f"--cpus={CPUS}", f"--pids-limit={PIDS}")
    first = ""
    for options in WAYS:
        if options and "--runtime=runc" in options and host.call("which", "runc") is None:
            continue
        for given in ((*memory_options(MEMORY, host), *limits), limits, ()):
            fill = any(option.startswith("--memory") for option in given)
            able = capabilities.start(host, partial(_words, options, given), fill=fill) or Capabilities("")
            if not able.trouble:
                return ProbeResult(replace(able, version=_version(host, options, version)), options)
            first = first or able.trouble
            if not re.search(r"limit|controller|cgroup", able.trouble):
                break
    return ProbeResult(Capabilities(f"podman {version}", trouble=capabilities.remedy("podman", first)))


def memory_options(size: int, host: Host = HERE) -> tuple[str, ...]:
    """Return podman's options to kill a whole container that uses more memory. Empty without control groups of version 2."""
    options = (f"--memory={size}", f"--memory-swap={size}", "--cgroup-conf=memory.oom.group=1")
    return options if host.facts.unified else ()


def _words(options: Sequence[str], limits: Sequence[str], mounts: Mapping[str, str]) -> tuple[str, ...]:
    given = tuple(f"--volume={source}:{target}:ro" for target, source in mounts.items())
    alone = ("--network=none", "--pid=private", "--ipc=private", "--no-hosts", "--read-only")
    weak = ("--cap-drop=all", "--security-opt=no-new-privileges")
    few = ("--ulimit=nofile=1024:1024", "--ulimit=nproc=1024:1024")
    run = ("run", "--rm", "--init", "--pull=never", "--log-driver=none", "--user=0:0")
    return ("podman", *options, *run, *alone, *weak, *few, *limits, *given, "--rootfs", ROOT)


def _version(host: Host, options: Sequence[str], version: str) -> str:
    """Return the versions of podman and of the programs with which it starts containers."""
    template = (
        "{{.Host.OCIRuntime.Name}}\n{{.Host.OCIRuntime.Version}}\n\n{{.Host.Conmon.Version}}\ncgroups {{.Host.CgroupsVersion}}"
    )
    output = run(host, ("podman", *options, "info", f"--format={template}")).stdout
    runtime, _, rest = output.partition("\n\n")
    words = runtime.split()
    name = words[0] if words else "an unknown runtime"
    number = next((word for word in words[1:] if word[:1].isdigit()), "")
    conmon = re.search(r"conmon version ([^\s,]+)", rest)
    cgroups = re.search(r"cgroups (\w+)", rest)
    parts = [f"podman {version}", f"{name} {number}".strip()]
    parts += [f"conmon {conmon[1]}"] if conmon else []
    parts += [f"cgroups {cgroups[1]}"] if cgroups else []
    return ", ".join(parts)


def _dependencies(host: Host) -> Dependencies:
    programs = ("podman", "runc", "crun", "conmon", "catatonit", "newuidmap", "fuse-overlayfs")
    folders = (_own(host), Path("/etc/containers"), Path("/usr/share/containers"))
    files = (str(folder / name) for folder in folders for name in ("containers.conf", "containers.conf.d", "storage.conf"))
    only = host.variables.get("CONTAINERS_CONF", "")
    return Dependencies(programs, (*files, only, "/etc/subuid", "/etc/subgid"))


def _own(host: Host) -> Path:
    """Return the folder of the user's own configuration."""
    variables = host.variables
    return Path(variables.get("XDG_CONFIG_HOME") or Path(variables.get("HOME", "/"), ".config"), "containers")


def _settings_trouble(host: Host) -> str:
    """Return why runs would have access to things that are not recorded, and the remedy; empty if they have no such access."""
    files: dict[str, str] = {}
    for file, text in host.call("texts", tuple(_files(host))):
        try:
            settings = tomllib.loads(text).get("containers", {})
        except ValueError:  # podman reports this error itself
            continue
        for key in KEYS:
            if key in settings:
                files.pop(key, None)
                files |= {key: file} if settings[key] else {}
    for key, file in files.items():
        return (
            f"{file} gives {key} to all containers, so runs would have unrecorded host access; list them in [container] of "
            f"sierra.toml instead, and set CONTAINERS_CONF to a file without them"
        )
    return ""


def _files(host: Host) -> Iterator[str]:
    """Yield the patterns of the files that podman reads, in its order."""
    variables = host.variables
    if only := variables.get("CONTAINERS_CONF"):
        yield glob.escape(only)
    else:
        for folder in (Path("/usr/share/containers"), Path("/etc/containers"), *([_own(host)] if host.facts.user else [])):
            plain = glob.escape(str(folder))
            yield from (f"{plain}/{NAME}", f"{plain}/{NAME}.d/*.conf")
    if last := variables.get("CONTAINERS_CONF_OVERRIDE"):
        yield glob.escape(last)

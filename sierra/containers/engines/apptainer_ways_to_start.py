"""The way to start apptainer or singularity-ce on a host, found by trying; `sierra.containers.engines.capabilities` caches it.

Their abilities depend on their installation. As root, they mount squashfs files by the kernel. In a user's namespace, they need
`squashfuse` and a `/dev/fuse` that can be opened, or else the files in a folder. If the kernel allows it (`unshare`), a user is
root in a namespace of their own, as with podman, so that programs see the same user. The administrator's configuration is used,
except for settings that would expose the host to runs: its users, name servers, time zone, file systems and graphics libraries.
Only an installation with setuid does not allow another configuration.
"""

from __future__ import annotations

import contextlib
import glob
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path

from sierra.containers.engines import capabilities
from sierra.containers.engines.base import HOSTNAME, Capabilities, Mount
from sierra.containers.engines.capabilities import CPUS, PIDS, Dependencies, ProbeResult
from sierra.containers.engines.client_errors import mounted
from sierra.containers.engines.hosts import HERE, Host, handed_on, run
from sierra.util.lazy_definitions import dataclass, regex, replace
from sierra.worker.on_host import ROOT

NAMES = ("apptainer", "singularity")
MIN_VERSIONS = {"apptainer": (1, 1), "singularity-ce": (3, 10)}
MAPPED, SQUASHFS = "mapped", "squashfs"
ISOLATED = ("--containall", "--no-home", "--cleanenv", "--no-eval", "--no-privs", "--no-umask", "--no-mount=bind-paths,hostfs")
ALONE = ("--net", "--network=none")
LIMITS = (f"--cpus={CPUS}", f"--pids-limit={PIDS}")
SETTLED = regex(
    r"\s*(bind path|config (passwd|group|resolv_conf)|mount hostfs|always use (nv|rocm)|systemd cgroups)\s*=", re.IGNORECASE
)
"""The settings of the administrator's configuration that are replaced."""
HANDED_ON = regex(
    r"PATH|HOME|USER|LOGNAME|LANG|LC_\w+|TMPDIR|XDG_\w+|DBUS_SESSION_BUS_ADDRESS|(APPTAINER|SINGULARITY)_(TMPDIR|CACHEDIR|CONFIGDIR)"
)
"""The variables of the caller's environment that the engine needs.

Its other variables could add mounts that are not recorded.
"""


@dataclass(frozen=True, slots=True)
class Launcher:
    """One way to start a container, as it works on a host."""

    program: str
    configuration: str
    """The path of the administrator's configuration; empty if no other configuration is allowed."""
    mapped: bool
    squashfs: bool
    """True if an image can be started from a squashfs; otherwise its files must be in a folder."""
    enforced: frozenset[str] = frozenset()
    """The limits that the engine enforces."""
    host: Host = HERE

    def words(self, *, network: bool = False, files: str = "") -> Iterator[str]:
        """Yield the words of the command up to the options that differ between containers. `files`: see `ContainerSpec`."""
        if self.mapped:
            yield from ("unshare", "--map-root-user", "--")
        yield from (self.program, "--silent")
        if self.configuration:
            yield f"--config={_configured(self.host, files or self.host.folder, self.configuration, network)}"
        yield from ("exec", *ISOLATED, f"--hostname={HOSTNAME}", *(() if network else ALONE))

    @property
    def prefix(self) -> str:
        """Return the prefix of the variables whose values the engine passes to containers."""
        return f"{Path(self.program).name.upper()}ENV_"


def apptainer(host: Host = HERE) -> Capabilities:
    """Return the abilities of apptainer or singularity-ce on a host."""
    return capabilities.cached("apptainer", _test, _dependencies, host).abilities


def launcher(host: Host = HERE) -> Launcher:
    """Return the way in which containers can be started on a host. If there is none, return the simplest way."""
    found = capabilities.cached_here("apptainer", _test, _dependencies, host)
    if not found.options:
        return Launcher(NAMES[0], "", mapped=False, squashfs=True, host=host)
    program, configuration, *flags = found.options
    return Launcher(program, configuration, MAPPED in flags, SQUASHFS in flags, found.abilities.enforced, host)


def environment(host: Host = HERE) -> dict[str, str]:
    """Return the environment in which the engine is started."""
    return handed_on(host, HANDED_ON)


def _dependencies(host: Host) -> Dependencies:
    """Return the paths on which the result depends: it is valid as long as they do not change."""
    programs = (*NAMES, "unshare", "squashfuse", "squashfuse_ll", "fusermount", "fusermount3", "mksquashfs")
    configuration = (f"{top}/{name}/{name}.conf" for top in ("/etc", "/usr/local/etc") for name in NAMES)
    return Dependencies(programs, (*configuration, "/dev/fuse", "/etc/subuid"))


def _test(host: Host) -> ProbeResult:
    program = next((name for name in NAMES if host.call("which", name)), None)
    if program is None:
        trouble = "neither apptainer nor singularity-ce is installed; see docs/how-to/containers.md"
        return ProbeResult(Capabilities("apptainer", trouble=trouble))
    version = run(host, (program, "--version")).stdout.strip().replace(" version ", " ")
    name, _, number = version.partition(" ")
    numbers = tuple(int(part) for part in re.findall(r"\d+", number)[:2])
    if numbers < MIN_VERSIONS.get(name, (99,)):
        least = " or ".join(f"{name} {'.'.join(map(str, number))}" for name, number in MIN_VERSIONS.items())
        return ProbeResult(Capabilities(version, trouble=f"{version or program} is too old: {least} or newer is needed"))
    return _first_that_works(host, program, version)


def _first_that_works(host: Host, program: str, version: str) -> ProbeResult:
    complaint = ""
    for launcher in _launchers(host, program):
        able = _start(launcher, LIMITS)
        if able.trouble:
            able = replace(_start(launcher, ()), enforced=frozenset())
        if not able.trouble:
            squashfs = _starts_squashfs(launcher)
            parts = [version, *_helpers(launcher, squashfs=squashfs)]
            flags = [flag for flag, is_set in ((MAPPED, launcher.mapped), (SQUASHFS, squashfs)) if is_set]
            return ProbeResult(replace(able, version=", ".join(parts)), (launcher.program, launcher.configuration, *flags))
        complaint = complaint or able.trouble
    return ProbeResult(Capabilities(version, trouble=capabilities.remedy(program, complaint)))


def _launchers(host: Host, program: str) -> Iterator[Launcher]:
    """Yield the possible ways, the one with the best isolation first."""
    output = run(host, (program, "buildcfg")).stdout
    match = re.search(r"^(?:APPTAINER|SINGULARITY)_CONF_FILE=(.+)$", output, re.MULTILINE)
    configuration = ""
    with contextlib.suppress(OSError):  # it cannot be read, or a changed copy cannot be written
        if match and _configured(host, host.folder, match[1], False):
            configuration = match[1]
    if host.facts.user != 0 and host.call("which", "unshare"):
        yield Launcher(program, configuration, mapped=True, squashfs=True, host=host)
    if configuration:
        yield Launcher(program, configuration, mapped=False, squashfs=True, host=host)
    yield Launcher(program, "", mapped=False, squashfs=True, host=host)


def _start(launcher: Launcher, limits: Sequence[str]) -> Capabilities:
    able = capabilities.start(launcher.host, lambda mounts: _words(launcher, limits, mounts), environment(launcher.host))
    return able or Capabilities("")


def _words(launcher: Launcher, limits: Sequence[str], mounts: Mapping[str, str]) -> tuple[str, ...]:
    given = (mounted(Mount(source, target)) for target, source in mounts.items())
    groups = mounted(Mount("/sys/fs/cgroup", "/sys/fs/cgroup"))
    return (*launcher.words(), *limits, *given, groups, "--pwd=/", ROOT)


def _starts_squashfs(launcher: Launcher) -> bool:
    """Return whether a squashfs can be started directly. If none can be made there, assume yes for root and no for users."""
    host = launcher.host
    able = capabilities.start(host, lambda mounts: _words(launcher, (), mounts), environment(host), squashed=True)
    return host.facts.user == 0 if able is None else not able.trouble


def _helpers(launcher: Launcher, *, squashfs: bool) -> Iterator[str]:
    """Yield the tools and features that it uses besides its own programs."""
    if not squashfs:
        yield "images in folders"
    elif launcher.host.facts.user != 0:
        done = run(launcher.host, ("squashfuse_ll", "--help"))
        match = re.search(r"squashfuse ([\d.]+)", done.stdout + done.stderr)
        yield f"squashfuse {match[1]}" if match else "squashfuse"
    if launcher.mapped:
        yield "root in a namespace"


@cache
def _configured(host: Host, folder: str, configuration: str, network: bool) -> str:
    """Return the path of a copy of the administrator's configuration with SIERRA's settings. Raises OSError."""
    texts = host.call("texts", (glob.escape(configuration),))
    if not texts:
        raise FileNotFoundError(configuration)
    ours = {
        **dict.fromkeys(("config passwd", "config group", "mount hostfs", "always use nv", "always use rocm"), False),
        "config resolv_conf": network,
        "systemd cgroups": host.facts.systemd,
    }
    lines = [line for line in texts[0][1].splitlines() if not SETTLED.match(line)]
    text = "\n".join([*lines, *(f"{name} = {'yes' if value else 'no'}" for name, value in ours.items()), ""])
    return str(host.call("keep", folder, text, "conf"))

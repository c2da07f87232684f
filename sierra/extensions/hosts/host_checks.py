"""Checks of hosts that are reached over SSH: connection, key, Python, disk, clock, battery, and what is installed there.

Extensions whose runners use hosts name these: the kind `fleets` of `sierra.config.extensions` has functions that return them.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from sierra.config import extensions, find_project, project_file
from sierra.config.plugin_registry import LINKS, RUNNERS
from sierra.config.project_file import Project
from sierra.errors import ConfigError, Missing, NotFound, UsageError
from sierra.extensions.hosts.clock import measured
from sierra.runners.links.base import Ended, Link, Unreachable, UntrustedHost
from sierra.setup.doctor import Check, State
from sierra.util.lazy_definitions import dataclass, field, replace

PROGRAMS = ("bash", "git", "podman", "apptainer", "singularity", "roslaunch", "ros2", "gzserver", "sbatch", "qsub", "chronyc")
INSTALL = "install Python 3.8 or newer there"
OLDEST = (3, 8)
ZONE = "time zone"
CLOCK_S = 1.0
"""The offset of a clock from which on a check names a remedy."""
LOOK = r"""
import json, os, platform, shutil, sys, time
asked = json.loads(sys.argv[1])
found = {"python": list(sys.version_info[:3]), "system": platform.platform(), "machine": platform.machine()}
folder = os.path.expanduser(asked["folder"] if asked["folder"].startswith(("~", "/")) else "~/" + asked["folder"])
while not os.path.isdir(folder):
    folder = os.path.dirname(folder)
found["utc_offset"] = time.localtime().tm_gmtoff
found["folder"], found["free"] = folder, shutil.disk_usage(folder).free
found["writable"] = os.access(folder, os.W_OK)
found["programs"] = [name for name in asked["programs"] if shutil.which(name)]
found["battery"] = None
supplies = "/sys/class/power_supply"
for name in sorted(os.listdir(supplies)) if os.path.isdir(supplies) else []:
    try:
        with open(os.path.join(supplies, name, "capacity")) as file:
            found["battery"] = float(file.read()) if name.startswith("BAT") and found["battery"] is None else found["battery"]
    except (OSError, ValueError):
        pass
print(json.dumps(found))
"""
"""The look at a host, as a program for its Python: older ones than 3.8 can execute it, too."""
CLOCK = "import sys, time\nfor line in sys.stdin:\n    print(time.time_ns(), flush=True)"


class _NoPython(Exception):
    """A host on which Python has failed, with its last words."""


@dataclass(frozen=True, slots=True)
class HostToCheck:
    """A host, and what runs need there."""

    name: str
    host: str
    link: str = "fabric"
    link_options: Mapping[str, Any] = field(default_factory=dict)
    python: str = "python3"
    folder: str = "~"
    disk_min: int = 1
    own: Callable[[HostToCheck, Link], Iterator[Check]] | None = None
    """Yields what else is checked: time zone and battery are then among these checks. May raise what a link raises."""


def all_checks(names: Sequence[str], link: str | None = None) -> list[Check]:
    """Return the checks of some hosts, or of the project's fleet and labs, in this order. Hosts are checked at once.

    Names are those of robots of the fleet, or of hosts as in `ssh NAME`. Raises UsageError if there are no hosts.
    """
    hosts = _hosts(_project(), [part for name in names for part in name.split(",") if part], link)
    with ThreadPoolExecutor(min(32, len(hosts))) as pool:
        found = [check for checks in pool.map(lambda host: list(_checks(host)), hosts) for check in checks]
    zones = [check.found for check in found if check.name.endswith(ZONE)]
    return [_of_several_zones(check) if check.name.endswith(ZONE) and len(set(zones)) > 1 else check for check in found]


def _of_several_zones(check: Check) -> Check:
    """Return the check of a host's time zone, if others have another one."""
    return replace(check, state="absent", remedy='robots of a run need one time zone; declare variables = { TZ = "UTC" }')


def _project() -> Project | None:
    """Return the configuration of the project here; None outside of a project."""
    try:
        return project_file.read(find_project.find_store(Path())).config
    except (Missing, NotFound):
        return None


def _hosts(project: Project | None, names: Sequence[str], link: str | None) -> list[HostToCheck]:
    for name, table in project.runners.items() if project else ():
        if extensions.absent("runners", name) and "scheduler" not in table:
            raise ConfigError(RUNNERS.unknown(name))
    fleet: dict[str, HostToCheck] = {}
    for name in extensions.added("fleets") if project else ():
        fleet |= extensions.load("fleets", name)(project, link)
    if not names and not fleet:
        raise UsageError(
            "there is no fleet in [runners.robots] and no lab; name hosts, for example: sierra doctor --hosts pc1 pc2"
        )
    chosen, links = link or "fabric", project.links if project else {}
    return [fleet.get(name) or HostToCheck(name, name, chosen, links.get(chosen, {})) for name in names or fleet]


def _checks(host: HostToCheck) -> Iterator[Check]:
    """Yield the checks of one host. The first problem of the connection ends them."""
    link: Link = LINKS.make(host.link, {host.link: dict(host.link_options)}, host.host)
    try:
        began = time.monotonic()
        link.run(["true"])
        yield Check(f"{host.name}: connection", "ok", f"{host.link}, in {time.monotonic() - began:.2f} s; its key is known")
        fits = yield from _common_checks(host, link)
        if fits and host.own:
            yield from host.own(host, link)
    except UntrustedHost as error:
        yield Check(f"{host.name}: key", "missing", *_split(host, error))
    except Missing as error:
        yield Check(f"{host.name}: connection", "missing", *_split(host, error))
    except _NoPython as error:
        yield Check(f"{host.name}: python", "missing", str(error), INSTALL)
    except (ValueError, LookupError, TypeError):  # of an answer that is none
        yield Check(f"{host.name}: python", "missing", f"{host.python} answers with something else than it was asked", INSTALL)
    finally:
        link.close()


def _common_checks(host: HostToCheck, link: Link) -> Generator[Check, None, bool]:
    """Yield the checks that any host gets; return whether its Python fits."""
    asked = {"folder": host.folder, "programs": PROGRAMS}
    ended = link.run([host.python, "-c", LOOK, json.dumps(asked)])
    if ended.status != 0:
        raise _NoPython(_last_words(ended).removeprefix("timeout: "))
    facts = json.loads(ended.stdout.splitlines()[-1])
    version = ".".join(map(str, facts["python"]))
    fits = tuple(facts["python"]) >= OLDEST
    yield check(host, "python", fits, f"{version}, {facts['system']}", INSTALL)
    yield _disk(host, facts)
    yield _clock(host, link)
    if not host.own:
        yield zone(host, facts)
        yield from battery(host, facts["battery"], 0.0)
    yield Check(f"{host.name}: installed", "ok", ", ".join(facts["programs"]) or "none of the programs that runs may need")
    return fits


def zone(host: HostToCheck, found: Mapping[str, Any]) -> Check:
    """Return the check of a host's time zone, `utc_offset` in seconds."""
    return Check(f"{host.name}: {ZONE}", "ok", f"UTC{found['utc_offset'] / 3600:+g} h now")


def _last_words(ended: Ended) -> str:
    """Return the last line that a failed command wrote to standard error, or its status."""
    return (ended.stderr.decode(errors="replace").strip().splitlines() or [f"exit status {ended.status}"])[-1]


def _disk(host: HostToCheck, found: Mapping[str, Any]) -> Check:
    free = f"{found['free'] / 1e6:.0f} MB free in {found['folder']}"
    if not found["writable"]:
        return check(host, "disk", False, f"{found['folder']} is not writable", "check the disk, and who owns the folder")
    fits = found["free"] >= host.disk_min
    return check(host, "disk", fits, free, f"free some space: {host.disk_min / 1e6:.0f} MB are needed")


def _clock(host: HostToCheck, link: Link) -> Check:
    """Measure the offset of a host's clock."""
    channel = link.channel([host.python, "-c", CLOCK])

    def ask() -> int:
        channel.send("")
        line = channel.receive(10)
        if line is None:
            raise Unreachable(f"{host.host}: the program that tells the time ended: {channel.errors().strip()}")
        return int(line)

    try:
        clock = measured(ask, time.time_ns)
    finally:
        channel.close()
    offset = f"{clock.offset_ns / 1e9:+.3f} s from this machine's, ± {clock.rtt_ns / 2e9:.3f} s"
    remedy = "let the time service of the host (chrony, timesyncd) set it"
    return check(host, "clock", abs(clock.offset_ns) < CLOCK_S * 1e9, offset, remedy, "absent")


def battery(host: HostToCheck, charge: float | None, least: float) -> Iterator[Check]:
    """Yield the check of a battery, if its charge is known."""
    if charge is not None:
        yield check(host, "battery", charge >= least, f"{charge:g} %", f"charge it: {least:g} % are needed")


def check(host: HostToCheck, name: str, fits: bool, found: str, remedy: str, otherwise: State = "missing") -> Check:
    """Return a check of a host; one that does not fit has the state `otherwise`."""
    return Check(f"{host.name}: {name}", "ok" if fits else otherwise, found, "" if fits else remedy)


def _split(host: HostToCheck, error: Missing) -> tuple[str, str]:
    """Return the problem and the remedy of an error, without the host's name."""
    problem, _, remedy = str(error).removeprefix(f"{host.host}: ").partition("; ")
    return problem, remedy

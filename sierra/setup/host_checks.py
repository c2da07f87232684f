"""Checks of hosts that are reached over SSH: connection, key, Python, disk, clock, battery, and what is installed there.

Of a robot of the fleet, the setup line, the firmware and the calibration are checked, too: no run starts if one of them fails.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from sierra.config import find_project, project_file
from sierra.config.field_types import RawTable
from sierra.config.plugin_registry import LINKS, RUNNERS
from sierra.config.project_file import Project
from sierra.errors import Missing, NotFound, UsageError
from sierra.links.base import Ended, Link, Unreachable, UntrustedHost
from sierra.links.clock import measured
from sierra.runners.robots.fleet_table import FleetTable
from sierra.setup.doctor import Check, State
from sierra.worker.clock_watch import ClockWatch

PROGRAMS = ("bash", "git", "podman", "apptainer", "singularity", "roslaunch", "ros2", "gzserver", "sbatch", "qsub", "chronyc")
INSTALL = "install Python 3.8 or newer there"
OLDEST = (3, 8)
ZONE = "time zone"
CLOCK_S = 1.0
"""The offset of a clock from which on a check names a remedy."""
LOOK = r"""
import json, os, platform, shutil, subprocess, sys, time
asked = json.loads(sys.argv[1])
found = {"python": list(sys.version_info[:3]), "system": platform.platform(), "machine": platform.machine()}
folder = os.path.expanduser(asked["folder"] if asked["folder"].startswith(("~", "/")) else "~/" + asked["folder"])
while not os.path.isdir(folder):
    folder = os.path.dirname(folder)
found["utc_offset"] = time.localtime().tm_gmtoff
found["folder"], found["free"] = folder, shutil.disk_usage(folder).free
found["writable"] = os.access(folder, os.W_OK)
found["programs"] = [name for name in asked["programs"] if shutil.which(name)]
battery, found["battery"] = asked["battery"], None
supplies = "/sys/class/power_supply"
supplied = sorted(os.listdir(supplies)) if os.path.isdir(supplies) else []
guessed = [os.path.join(supplies, name, "capacity") for name in supplied if name.startswith("BAT")][:1]
def text_of(source):
    if isinstance(source, list):
        return subprocess.check_output(source, stdin=subprocess.DEVNULL, stderr=subprocess.STDOUT, timeout=10).decode()
    with open(os.path.expanduser(source), "rb") as file:
        return file.read().decode("utf-8", "replace")
errors = found["errors"] = {}
if battery is None and guessed:
    battery = guessed[0]
sources = {"battery": battery, "firmware": asked["firmware"], "calibration": asked["calibration"]}
for name in sorted(name for name in sources if sources[name]):
    try:
        text = text_of(sources[name]).strip()
        if name != "calibration" and not text:
            errors[name] = "it is empty"
        elif name == "battery":
            charge = float(text.split()[0].rstrip("%"))
            if not 0 <= charge <= 100:
                raise ValueError(charge)
            found[name] = charge
    except OSError as error:
        errors[name] = "%s: %s" % (error.filename, error.strerror)
    except ValueError:
        errors[name] = "%r is not a charge from 0 to 100 %%" % text[:60]
    except subprocess.TimeoutExpired:
        errors[name] = "%s did not end within 10 s" % sources[name][0]
    except subprocess.CalledProcessError as error:
        errors[name] = " ".join(error.output.decode("utf-8", "replace").split()) or "status %d" % error.returncode
print(json.dumps(found))
"""
"""The look at a host, as a program for its Python: older ones than 3.8 can execute it, too."""
CLOCK = "import sys, time\nfor line in sys.stdin:\n    print(time.time_ns(), flush=True)"


@dataclass(frozen=True, slots=True)
class HostToCheck:
    """A host, and what runs need there."""

    name: str
    host: str
    link: str = "fabric"
    link_options: Mapping[str, Any] = field(default_factory=dict)
    python: str = "python3"
    variables: Mapping[str, str] = field(default_factory=dict)
    setup: str | None = None
    folder: str = "~"
    battery: str | tuple[str, ...] | None = None
    firmware: tuple[str, ...] | None = None
    calibration: str | None = None
    battery_min: float = 0.0
    disk_min: int = 1


def all_checks(names: Sequence[str], link: str | None = None) -> list[Check]:
    """Return the checks of some hosts, or of all hosts of the project's fleet, in this order. Hosts are checked at once.

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
    links = project.links if project else {}
    fleet = _fleet(links, project.runner_tables if project else {}, link)
    if not names and not fleet:
        raise UsageError("there is no fleet in [runners.robots]; name hosts, for example: sierra doctor --hosts robot1 robot2")
    chosen = link or "fabric"
    return [fleet.get(name) or HostToCheck(name, name, chosen, links.get(chosen, {})) for name in names or fleet]


def _fleet(links: Mapping[str, RawTable], runners: Mapping[str, RawTable], link: str | None) -> dict[str, HostToCheck]:
    """Return the robots that runs use, by name."""
    table = RUNNERS.options("robots", runners["robots"]) if "robots" in runners else None
    if not isinstance(table, FleetTable):  # there is none, or a plug-in has this name
        return {}
    chosen = link or table.link
    return {
        name: HostToCheck(
            name,
            robot.host,
            chosen,
            robot.link_options if chosen == table.link else links.get(chosen, {}),
            python=table.python,
            variables=robot.variables,
            setup=robot.setup,
            folder=table.folder,
            battery=robot.battery,
            firmware=robot.firmware,
            calibration=robot.calibration,
            battery_min=table.battery_min,
            disk_min=table.disk_min,
        )
        for name, robot in table.used().items()
    }


def _checks(host: HostToCheck) -> Iterator[Check]:
    """Yield the checks of one host. The first problem of the connection ends them."""
    link: Link = LINKS.make(host.link, {host.link: dict(host.link_options)}, host.host)
    try:
        began = time.monotonic()
        link.run(["true"])
        yield Check(f"{host.name}: connection", "ok", f"{host.link}, in {time.monotonic() - began:.2f} s; its key is known")
        yield from _look(host, link)
    except UntrustedHost as error:
        yield Check(f"{host.name}: key", "missing", *_split(host, error))
    except Missing as error:
        yield Check(f"{host.name}: connection", "missing", *_split(host, error))
    except (ValueError, LookupError, TypeError):  # of an answer that is none
        yield Check(f"{host.name}: python", "missing", f"{host.python} answers with something else than it was asked", INSTALL)
    finally:
        link.close()


def _look(host: HostToCheck, link: Link) -> Iterator[Check]:
    asked = {name: getattr(host, name) for name in ("folder", "battery", "firmware", "calibration")}
    given = ["env", *(f"{name}={value}" for name, value in host.variables.items())]
    argv = [*given, host.python, "-c", LOOK, json.dumps({**asked, "programs": PROGRAMS})]
    if host.setup:
        ended = link.run([*given, "bash", "-c", host.setup])
        if ended.status != 0:
            yield Check(f"{host.name}: setup", "missing", _last_words(ended), "correct setup in sierra.toml")
            return
        argv = [*given, "bash", "-c", f'{host.setup} > /dev/null\nexec "$@"', "bash", *argv[len(given) :]]
    ended = link.run(argv)
    if ended.status != 0:
        yield Check(f"{host.name}: python", "missing", _last_words(ended).removeprefix("timeout: "), INSTALL)
        return
    if not ended.stdout:
        yield Check(f"{host.name}: setup", "missing", "it ends the shell, by exit or exec", "correct setup in sierra.toml")
        return
    found = json.loads(ended.stdout.splitlines()[-1])
    version = ".".join(map(str, found["python"]))
    fits = tuple(found["python"]) >= OLDEST
    yield _check(host, "python", fits, f"{version}, {found['system']}", INSTALL)
    yield _disk(host, found)
    yield _clock(host, link)
    yield Check(f"{host.name}: {ZONE}", "ok", f"UTC{found['utc_offset'] / 3600:+g} h now")
    yield from _facts(host, found)
    yield Check(f"{host.name}: installed", "ok", ", ".join(found["programs"]) or "none of the programs that runs may need")


def _last_words(ended: Ended) -> str:
    """Return the last line that a failed command wrote to standard error, or its status."""
    return (ended.stderr.decode(errors="replace").strip().splitlines() or [f"exit status {ended.status}"])[-1]


def _disk(host: HostToCheck, found: Mapping[str, Any]) -> Check:
    free = f"{found['free'] / 1e6:.0f} MB free in {found['folder']}"
    if not found["writable"]:
        return _check(host, "disk", False, f"{found['folder']} is not writable", "check the disk, and who owns the folder")
    fits = found["free"] >= host.disk_min
    return _check(host, "disk", fits, free, f"free some space: {host.disk_min / 1e6:.0f} MB are needed")


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
        clock = measured(ask, ClockWatch().now_ns)
    finally:
        channel.close()
    found = f"{clock.offset_ns / 1e9:+.3f} s from this machine's, ± {clock.rtt_ns / 2e9:.3f} s"
    remedy = "let the time service of the host (chrony, timesyncd) set it"
    return _check(host, "clock", abs(clock.offset_ns) < CLOCK_S * 1e9, found, remedy, "absent")


def _facts(host: HostToCheck, found: Mapping[str, Any]) -> Iterator[Check]:
    for name, reason in found["errors"].items():
        yield _check(host, name, False, f"not readable: {reason}", f"correct {name} in sierra.toml")
    if found["battery"] is not None:
        fits = found["battery"] >= host.battery_min
        yield _check(host, "battery", fits, f"{found['battery']:g} %", f"charge it: {host.battery_min:g} % are needed")


def _check(host: HostToCheck, name: str, fits: bool, found: str, remedy: str, otherwise: State = "missing") -> Check:
    return Check(f"{host.name}: {name}", "ok" if fits else otherwise, found, "" if fits else remedy)


def _split(host: HostToCheck, error: Missing) -> tuple[str, str]:
    """Return the problem and the remedy of an error, without the host's name."""
    problem, _, remedy = str(error).removeprefix(f"{host.host}: ").partition("; ")
    return problem, remedy

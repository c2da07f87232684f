"""Checks before a run: each robot can execute the programs of its member, and its robots can take part in the same run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import combinations
from pathlib import Path

from sierra.containers.engines.base import PROJECT
from sierra.errors import Missing
from sierra.extensions.robots.agent_messages import Record
from sierra.model import ARCH_ON_ROBOT, ON_ROBOT, Member
from sierra.runners.links.base import Link
from sierra.util.lazy_definitions import regex
from sierra.util.processors import NAMES, can_execute
from sierra.worker.errors import processor_of

IN_CODE = regex(f"(?:{ON_ROBOT}|{PROJECT})/([^:;,=]+)")
"""A path in the code: on a robot, or in a container there."""
EMULATORS = "/proc/sys/fs/binfmt_misc/qemu-"
"""The beginning of the kernel's names for emulators of other processors, which end with that of qemu."""
OF_QEMU = {"i686": "i386"}


def check_programs(robot: str, arch: str, member: Member, code: Path, link: Link) -> None:
    """Raise Missing if a robot with this processor lacks a file of the code, or cannot execute the member's program.

    `code` is the folder of the code on this machine; the robot has a copy. A robot that emulates other processors can execute
    programs for them.
    """
    for name in _names(member):
        if not (code / name.replace(ARCH_ON_ROBOT, arch)).exists():
            raise Missing(_lacking(robot, arch, name, code))
    program = IN_CODE.fullmatch(member.argv[0])
    if program is None:
        return
    name = program[1].replace(ARCH_ON_ROBOT, arch)
    other = processor_of(str(code / name))
    if other and not can_execute(arch, other) and not _emulates(link, other):
        raise Missing(
            f"{robot} is {arch}, but {name} is a program for {other}; build it for {arch}, and use {{arch}} in its path"
        )


def _names(member: Member) -> Iterator[str]:
    """Yield the paths in the code that depend on the processor, with its mark."""
    for text in (*member.argv, *member.environment.values()):
        yield from (name for name in IN_CODE.findall(text) if ARCH_ON_ROBOT in name)


def _lacking(robot: str, arch: str, name: str, code: Path) -> str:
    there = [other for other in NAMES if (code / name.replace(ARCH_ON_ROBOT, other)).exists()]
    has = f"it is there for {', '.join(there)}" if there else "it is not there for any processor"
    wanted = name.replace(ARCH_ON_ROBOT, arch)
    return f'{robot} is {arch}, but the code has no {wanted}; {has}; add "{arch}" to arch in [build], or add the file'


def _emulates(link: Link, processor: str) -> bool:
    return link.run(("test", "-e", EMULATORS + OF_QEMU.get(processor, processor))).status == 0


def check_addresses(addresses: Mapping[str, str | None]) -> None:
    """Raise Missing if two robots have one address, at which programs would reach only one of them.

    `addresses` are those of the robots of a run, by name; None if one is unknown. Two virtual machines behind forwarded ports,
    for example, may have the same address, each in a network of its own.
    """
    for (name, address), (other, same) in combinations(addresses.items(), 2):
        if address is not None and address == same:
            raise Missing(
                f"{name} and {other} have the same address {address}; give each an address by which the other robots reach it: "
                f'{other} = {{ host = …, address = "…" }} in [runners.robots.fleet]'
            )


def check_time_zones(hellos: Mapping[str, Record]) -> None:
    """Raise Missing if local time differs between two robots, unless both have a TZ of their own.

    `hellos` are the answers of the robots of a run, by name.
    """
    for (robot, first), (other, second) in combinations(hellos.items(), 2):
        zones = {_zone(first), _zone(second)}
        if first["utc_offset"] != second["utc_offset"] and not (len(zones) == 2 and None not in zones):
            raise Missing(
                f"{robot} ({_shown(first)}) and {other} ({_shown(second)}) have different time zones, and local times on them "
                'differ; declare variables = { TZ = "UTC" } in [runners.robots]'
            )


def _zone(hello: Record) -> str | None:
    """Return the time zone that `variables` or the setup line have set; None without one."""
    zone: str | None = hello["variables"].get("TZ")
    return zone


def _shown(hello: Record) -> str:
    minutes = abs(hello["utc_offset"]) // 60
    sign = "-" if hello["utc_offset"] < 0 else "+"
    return f"{_zone(hello) or hello['facts']['timezone']}, UTC{sign}{minutes // 60:02d}:{minutes % 60:02d}"

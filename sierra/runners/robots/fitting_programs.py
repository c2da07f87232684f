"""Check before a run that the code has what the run's commands name for the processor of each robot."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from sierra.containers.engines.base import PROJECT
from sierra.errors import Missing
from sierra.model import ARCH_ON_ROBOT, ON_ROBOT, Member
from sierra.runners.links.base import Link
from sierra.util.processors import NAMES, can_execute
from sierra.worker import worker

IN_CODE = re.compile(f"(?:{ON_ROBOT}|{PROJECT})/([^:;,=]+)")
"""A path in the code: on a robot, or in a container there."""
EMULATORS = "/proc/sys/fs/binfmt_misc/qemu-"
"""The beginning of the kernel's names for emulators of other processors, which end with that of qemu."""
OF_QEMU = {"i686": "i386"}


def check(robot: str, arch: str, member: Member, code: Path, link: Link) -> None:
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
    other = worker.processor_of(str(code / name))
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

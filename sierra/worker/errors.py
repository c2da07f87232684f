"""Reasons why a program could not be started or a file could not be used, each in one line."""

from __future__ import annotations

import errno
import os
import shutil

from sierra.worker.job import Job

PROCESSORS = {  # by their numbers in ELF files (elf.h)
    3: "i686",
    21: "ppc64le",
    22: "s390x",
    40: "arm",
    62: "x86_64",
    183: "aarch64",
    243: "riscv64",
    258: "loongarch64",
}


class NotHeld(Exception):
    """A container cannot be started before its run begins, for the reason given in one line."""


class CannotContinue(Exception):
    """The reason, in one line, why an attempt at an array task cannot continue."""


def explain(error: BaseException) -> str:
    name = getattr(error, "filename", None)
    if isinstance(name, bytes):
        name = os.fsdecode(name)
    if isinstance(error, (NotHeld, CannotContinue)):
        return str(error)
    reason = getattr(error, "strerror", None) or "%s: %s" % (type(error).__name__, error)
    return "%s: %s" % (name, reason) if name else reason


def why_not_started(error: BaseException, job: Job) -> str:
    """Return why a program could not be started, in one line. It may be for another processor, or its loader may be missing."""
    number, name = getattr(error, "errno", None), getattr(error, "filename", None)
    if "client" in job or not isinstance(name, str) or number not in (errno.ENOEXEC, errno.ENOENT):
        return explain(error)
    path = shutil.which(name, path=job["environment"].get("PATH", os.defpath)) or name
    processor, uname = processor_of(path), os.uname()
    if number == errno.ENOEXEC and processor:
        return "%s is a program for %s, but %s is %s" % (path, processor, uname.nodename, uname.machine)
    if number == errno.ENOENT and processor:
        return "%s is a program for %s whose loader is not on %s" % (path, processor, uname.nodename)
    return explain(error)


def processor_of(path: str) -> str | None:
    """Return the processor that a program is for, by its ELF header (elf(5)); None for any other file.

    The names are those of `uname -m`; all 32-bit ARM processors are `arm`.
    """
    try:
        with open(path, "rb") as file:
            head = file.read(20)
    except (OSError, ValueError):
        return None
    if len(head) < 20 or head[:4] != b"\x7fELF":
        return None
    number = int.from_bytes(head[18:20], "big" if head[5] == 2 else "little")
    return PROCESSORS.get(number, "another processor (number %d in ELF)" % number)

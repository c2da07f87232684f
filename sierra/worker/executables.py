"""Programs as the kernel starts them: with the interpreters and loaders that their files name."""

from __future__ import annotations

import os
import struct
from typing import IO

from sierra.worker.files import HEAD_BYTES

SCRIPTS = 5  # scripts whose interpreters are scripts: the kernel allows as many


def starts(path: str, depth: int = 0) -> bool:
    """Return whether the kernel knows how to execute a file, and what it needs for this is there."""
    try:
        interpreter = interpreter_of(path)
    except (OSError, ValueError):
        return False
    if not interpreter:
        return True
    if depth > SCRIPTS or not os.path.isabs(interpreter):
        return False
    return os.access(interpreter, os.X_OK) and starts(interpreter, depth + 1)


def interpreter_of(path: str) -> str | None:
    """Return the path of the program that the kernel executes for a file, as the file names it; None for a static program.

    Raises OSError if the file cannot be read, and ValueError if it is neither ELF nor a script.
    """
    with open(path, "rb") as file:
        head = file.read(HEAD_BYTES)
        if head.startswith(b"#!"):
            words = head[2:].split(b"\n", 1)[0].split()
            if not words or b"\0" in words[0]:
                raise ValueError("a script without an interpreter")
            return os.fsdecode(words[0])
        if not head.startswith(b"\x7fELF"):
            raise ValueError("neither ELF nor a script")
        return loader_of(head, file)


def loader_of(head: bytes, file: IO[bytes]) -> str | None:
    """Return the loader that an ELF file names (PT_INTERP, see elf(5)); None if it needs none."""
    wide, order = head[4:5] == b"\x02", ">" if head[5:6] == b"\x02" else "<"
    try:
        at, size, count = struct.unpack_from(order + ("32xQ14xHH" if wide else "28xI10xHH"), head)
        file.seek(at)
        table = file.read(size * count)
        for number in range(count):
            if wide:
                kind, offset, length = struct.unpack_from(order + "I4xQ16xQ", table, number * size)
            else:
                kind, offset, length = struct.unpack_from(order + "II8xI", table, number * size)
            if kind == 3:
                file.seek(offset)
                return os.fsdecode(file.read(min(length, HEAD_BYTES)).split(b"\0", 1)[0])
    except struct.error:
        raise ValueError("a damaged ELF file") from None
    return None

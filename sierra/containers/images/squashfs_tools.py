"""Squashfs images: `mksquashfs` makes them from an image's files, and `unsquashfs` lists them (both from squashfs-tools).

The same files give the same bytes, because times, owners and the order are fixed. Other versions of squashfs-tools may give
other bytes, so the SHA-256 of the result is recorded but never used as an identity. (`sqfstar` of version 4.5 would also do,
but it refuses to set the compression level; zstd at its default level takes five times as long.)
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import shutil
import struct
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, BinaryIO, cast

from sierra.containers.images.merge_layers import Entry, Type, Wanted
from sierra.containers.images.streams import PIECE, fed
from sierra.errors import Damaged, Missing, SierraError
from sierra.util.hashing import sha256_file
from sierra.util.lazy_definitions import regex
from sierra.util.regular_files import open_regular

MAGIC = b"hsqs"
MAKE = (
    *("-tar", "-noappend", "-all-root", "-all-time", "0", "-mkfs-time", "0", "-reproducible", "-no-xattrs"),
    *("-comp", "zstd", "-Xcompression-level", "6", "-quiet", "-no-progress"),
)
MAX_LINE = 1 << 16
LINE = regex(rb"((?:[^\\ ]|\\.)+) (\w) (.*)", re.DOTALL)
TYPES: dict[bytes, Type] = {b"D": "folder", b"S": "link", b"R": "file", b"L": "file"}
DATA = b"# START OF DATA - DO NOT MODIFY\n"


def make(write: Callable[[BinaryIO], None], target: Path) -> str:
    """Make a squashfs, whole or not at all, from the tar that `write` writes, and return its SHA-256. Raises Missing."""
    program = _program("mksquashfs")
    unfinished = target.with_name(f".{target.name}.{os.getpid()}")
    try:
        environment = {name: value for name, value in os.environ.items() if name != "SOURCE_DATE_EPOCH"}
        status, output = fed([program, "-", str(unfinished), *MAKE], write, environment | {"LC_ALL": "C.UTF-8"})
        if status:
            raise Missing(f"{unfinished}: mksquashfs failed: {_reason(output)}")
        with unfinished.open("rb") as file:
            os.fsync(file.fileno())
        digest = sha256_file(unfinished)
        unfinished.replace(target)
        return digest
    except OSError as error:
        raise Missing(f"{target} cannot be written: {error.strerror or error}") from error
    finally:
        unfinished.unlink(missing_ok=True)


def _reason(output: str) -> str:
    """Return the line of a program's output that gives the reason of its failure, or else its last line."""
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    why = [line for line in lines if "because" in line or "FATAL" in line or "error" in line.lower()]
    return (why or lines[-1:] or ["it printed no error"])[0]


def is_squashfs(path: Path) -> bool:
    with open_regular(path) as file:
        return file.read(4) == MAGIC


def size(path: Path, offset: int = 0) -> int:
    """Return the size of a file system in bytes, from its superblock. Raises Damaged if it is no squashfs or cut short."""
    with open_regular(path) as file:
        file.seek(offset)
        block = file.read(48)
        if len(block) < 48 or not block.startswith(MAGIC):
            raise Damaged(f"{path} contains no squashfs")
        used: int = struct.unpack_from("<Q", block, 40)[0]
    if used > path.stat().st_size - offset:
        there = path.stat().st_size - offset
        raise Damaged(f"{path} is truncated: its file system has {used} bytes, but only {there} are in the file")
    return used


def listing(path: Path, offset: int = 0, wanted: Wanted = lambda path: 0) -> tuple[tuple[Entry, ...], dict[str, bytes]]:
    """Return the entries of a squashfs that begins at byte `offset`, by path, and the beginnings of the wanted files.

    Nothing is unpacked: `unsquashfs` streams a "pseudo file", which has a line for each path and then the bytes of all files.
    """
    command = [_program("unsquashfs"), "-no-progress", "-quiet", "-offset", str(offset), "-pf", "/dev/stdout", str(path)]
    entries = None
    with tempfile.TemporaryFile() as complaints:
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=complaints)
        try:
            with contextlib.suppress(SierraError), cast("IO[bytes]", process.stdout) as stream:
                entries = _listed(path, stream, wanted)
                while stream.read(PIECE):
                    pass
                status = process.wait()
        finally:
            process.kill()
            process.wait()
        complaints.seek(0)
        output = complaints.read(1 << 16).decode("utf-8", "replace")
    if entries is None:
        raise Damaged(f"{path} cannot be listed: {_reason(output) if output.strip() else 'the list of its files is invalid'}")
    if status:
        raise Damaged(f"{path} cannot be read: {_reason(output)}")
    return entries


def _listed(path: Path, stream: IO[bytes], wanted: Wanted) -> tuple[tuple[Entry, ...], dict[str, bytes]]:
    entries: dict[str, Entry] = {}
    order: list[str] = []
    same: dict[str, str] = {}
    for name, kind, rest in _lines(path, stream):
        if kind not in TYPES or not name:
            continue
        if kind == b"L":
            same[name] = _plain(rest)
            continue
        fields = rest.split(b" ", 4)
        mode, tail = int(fields[1], 8), fields[4] if len(fields) > 4 else b""
        if kind == b"R":
            entries[name] = Entry(name, "file", mode, int(tail.split(b" ")[0]))
            order.append(name)
        else:
            entries[name] = Entry(name, TYPES[kind], mode, target=os.fsdecode(tail))
    kept = dict(_hash(path, stream, entries, order, wanted))
    for name, target in same.items():
        if target in entries:
            linked = entries[target]
            entries[name] = Entry(name, linked.type, linked.mode, linked.size, linked.sha256, linked.target)
    return tuple(entries[name] for name in sorted(entries)), kept


def _lines(path: Path, stream: IO[bytes]) -> Iterator[tuple[str, bytes, bytes]]:
    """Yield the name, type and rest of each line. Raises Damaged for an invalid line (a line feed in a name causes one)."""
    while (line := stream.readline(MAX_LINE)) and line != DATA:
        if line.startswith(b"#"):
            continue
        read = LINE.fullmatch(line.rstrip(b"\n"))
        if read is None or (read[2] in b"DRS" and len(read[3].split(b" ", 4)) < 4):
            raise Damaged(f"{path} contains a name that cannot be listed: {line[:80]!r}")
        yield _plain(read[1]).removeprefix("/"), read[2], read[3]
    stream.readline()


def _hash(
    path: Path, stream: IO[bytes], entries: dict[str, Entry], order: list[str], wanted: Wanted
) -> Iterator[tuple[str, bytes]]:
    """Set the SHA-256 of each file, in the order of the data. Yields the kept beginnings of wanted files."""
    for name in order:
        entry, digest, kept, left = entries[name], hashlib.sha256(), bytearray(), entries[name].size
        most = wanted(name)
        while left and (piece := stream.read(min(left, PIECE))):
            digest.update(piece)
            kept += piece[: max(0, most - len(kept))]
            left -= len(piece)
        if left:
            raise Damaged(f"{path} is truncated in {name!r}")
        entries[name] = Entry(name, "file", entry.mode, entry.size, digest.hexdigest())
        if most:
            yield name, bytes(kept)


def _plain(name: bytes) -> str:
    return os.fsdecode(re.sub(rb"\\(.)", rb"\1", name, flags=re.DOTALL))


def _program(name: str) -> str:
    found = shutil.which(name)
    if found is None:
        raise Missing(f"{name} is not installed; it comes with squashfs-tools (apt-get install squashfs-tools)")
    return found

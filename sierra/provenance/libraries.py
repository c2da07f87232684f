"""The shared libraries that the system's loader loads for a program, as listed by the loader itself.

`ld.so --list PROGRAM` prints the libraries that the loader would map, and their paths, without executing the program. But an
ELF file names its own loader, which could be any program. Therefore only loaders in the system's folders are executed.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Mapping
from pathlib import Path

from sierra.util import bounded_program
from sierra.util.lazy_definitions import dataclass, regex

SYSTEM = regex(r"(/usr)?/lib[^/]*/.*|/(nix/store|gnu/store|cvmfs)/.*")
LOADER = regex(r"ld(32|64|-[\w.+-]+)?\.so(\.\d+)*")
FOUND = regex(r"\s*(?:(?P<name>\S.*?) => )?(?P<path>/.*) \(0x[0-9a-f]+\)")
LACKING = regex(
    r".*: error while loading shared libraries: (.+?): cannot open shared object file: .*"  # glibc
    r"|.*: version [`'](.+?)' not found \(required by .*\)"
    r"|Error loading shared library (.+?): No such file.*"  # musl
)
LOADER_VARIABLES = ("LD_LIBRARY_PATH", "LD_PRELOAD")
"""The variables of a run that are passed to the loader."""
LAYOUTS = {True: ("32xQ14xHH", "I4xQ16xQ"), False: ("28xI10xHH", "II8xI")}
"""For 64 and for 32 bits: the offset, entry size and number of the program headers, and a header's type, offset and size."""
TIMEOUT_S = 10.0


@dataclass(frozen=True, slots=True)
class Loaded:
    """The libraries of one program by name, the names of missing ones, and the reason if the libraries are unknown."""

    paths: Mapping[str, str]
    lacking: tuple[str, ...] = ()
    doubt: str | None = None


NONE = Loaded({})


def loaded(program: str, variables: Mapping[str, str]) -> Loaded:
    """Return the libraries that the loader would load for a program; none for a static program, or if it is not an ELF file."""
    resolved = os.path.realpath(program)
    loader = interpreter(resolved)
    if not loader or not Path(loader).exists():
        return NONE
    if not _is_systems(loader):
        return Loaded({}, doubt=f"its loader {loader} does not belong to the system")
    passed = {name: variables[name] for name in LOADER_VARIABLES if name in variables}
    try:
        done = bounded_program.execute([loader, "--list", resolved], cwd="/", env={**passed, "LC_ALL": "C"}, wall=TIMEOUT_S)
    except OSError as error:
        return Loaded({}, doubt=f"the loader {loader} does not answer ({type(error).__name__})")
    if done.status is None:
        return Loaded({}, doubt=f"the loader {loader} does not answer (TimeoutExpired)")
    return _read(os.fsdecode(done.output), os.fsdecode(done.errors))


def _is_systems(loader: str) -> bool:
    """Return True for a path that has a loader's name and lies in the system's folders, before and after resolving links."""
    places = (os.path.normpath(loader), os.path.realpath(loader))
    return LOADER.fullmatch(Path(loader).name) is not None and all(map(SYSTEM.fullmatch, places))


def _read(out: str, err: str) -> Loaded:
    """Parse the output of a loader of glibc or musl."""
    paths = {}
    for line in out.splitlines():
        if match := FOUND.fullmatch(line):
            paths[match["name"] or Path(match["path"]).name] = os.path.normpath(match["path"])
    lacking = [match[match.lastindex or 0] for line in err.splitlines() if (match := LACKING.fullmatch(line))]
    return Loaded({Path(name).name: path for name, path in paths.items()}, tuple(dict.fromkeys(lacking)))


def interpreter(path: str) -> str | None:
    """Return the loader that an ELF file names (PT_INTERP), or None for any other file. (Formats: elf(5).)"""
    try:
        with open(path, "rb") as file:  # noqa: PTH123 - a text
            head = file.read(64)
            if head[:4] != b"\x7fELF":
                return None
            order = "<" if head[5] == 1 else ">"
            table, segment = (order + layout for layout in LAYOUTS[head[4] == 2])
            offset, size, count = struct.unpack_from(table, head)
            file.seek(offset)
            for _ in range(count):
                kind, at, length = struct.unpack_from(segment, file.read(size))
                if kind == 3:
                    file.seek(at)
                    return os.fsdecode(file.read(min(length, 4096)).split(b"\0")[0])
    except (OSError, ValueError, OverflowError, IndexError, struct.error):
        pass
    return None

"""Programs outside the source and outside an image, by fingerprint: a run is only reused where they are the same.

The fingerprint of a program is the SHA-256 of its file. Every word of a command that names a program counts (as in
`nice -n 5 simulator`), and the interpreter that a script names in its first line. For a Python interpreter, the
distributions installed beside it count too, by name and version; and files of the project that git ignores, where the
command or a variable names them or their folder by `{project}/…`. (What an interpreter imports from elsewhere, and the
libraries that a program loads, do not yet count.)
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sierra.errors import Missing
from sierra.hashing import digest, sha256, sha256_file


@dataclass(frozen=True, slots=True)
class Program:
    """A program as a command calls it, where it was found, and what it is."""

    name: str
    path: str
    sha256: str

    @property
    def called(self) -> str:
        """Its name wherever it lies."""
        return called(self.name)


@dataclass(frozen=True, slots=True)
class Programs:
    """All programs of one command; `id` is the same wherever the same programs lie."""

    all: tuple[Program, ...]

    @property
    def id(self) -> str:
        return digest("programs", {"programs": [[p.called, p.sha256] for p in self.all]})

    def rows(self) -> list[dict[str, Any]]:
        return [{"programs": self.id, "name": p.name, "path": p.path, "sha256": p.sha256} for p in self.all]


def called(name: str) -> str:
    """What a program is called wherever it lies: its path's last part, or what stands for a path of the project."""
    return name if "{" in name else Path(name).name


def differing(before: Mapping[str, str], now: Mapping[str, Program]) -> Iterator[tuple[str, str | None, Program | None]]:
    """The programs that are others now, by name: the SHA-256 that was recorded, and what is there; None where there is none."""
    for name in sorted(before.keys() | now.keys()):
        was, program = before.get(name), now.get(name)
        if was is None or program is None or was != program.sha256:
            yield name, was, program


def find(argv: Sequence[str], search: str, root: Path, more: tuple[Program, ...] = ()) -> Programs:
    """The programs that a command starts, and what else counts as one; `search` is the PATH of its runs.

    Raises Missing where the first word is no program.
    """
    first = shutil.which(argv[0], path=search)
    if first is None:
        if Path(argv[0]).is_file():
            raise Missing(f"{argv[0]} is no program; name its interpreter (python3 …), or make it one with chmod +x")
        raise Missing(f"the program {argv[0]!r} is not there; install it, or mend the command of the project in {root}")
    found = {program.path: program for program in _programs(argv[0], first, search)}
    for word in argv[1:]:
        path = None if word.startswith("-") or not word else shutil.which(word, path=search)
        if path is not None and path not in found:
            found |= {program.path: program for program in _programs(word, path, search)}
    return Programs((*found.values(), *more))


def beside(words: Iterable[str], root: Path, source: Container[bytes]) -> tuple[Program, ...]:
    """Files that a command or a variable names by `{project}/…`, and that the source does not hold.

    What git ignores is such: `{project}/build/lib`, say; and what lies outside, be it by a link. A folder counts as all
    files in it.
    """
    found = {}
    for word in words:
        for inside in re.findall(r"\{project\}/([^:;,=]+)", word):
            for path in _files(root / inside):
                relative = path.relative_to(root) if path.is_relative_to(root) else path
                outside = not path.resolve().is_relative_to(root.resolve())
                if outside or os.fsencode(relative.as_posix()) not in source:
                    found[path] = Program(f"{{project}}/{relative}", str(path), _fingerprint(str(path)))
    return tuple(found.values())


def _files(path: Path) -> Iterator[Path]:
    if path.is_file():
        yield path
    elif path.is_dir():
        yield from sorted(below for below in path.rglob("*") if below.is_file() and "__pycache__" not in below.parts)


def _programs(name: str, path: str, search: str) -> Iterator[Program]:
    yield Program(name, path, _fingerprint(path))
    if Path(path).name.startswith("python"):
        for folder in _site_packages(Path(path)):
            yield Program(f"{name}: installed distributions", str(folder), _distributions(folder))
    for word in _interpreter(Path(path)):
        interpreter = shutil.which(word, path=search)
        if interpreter is not None and interpreter != path:
            yield from _programs(word, interpreter, search)


def _interpreter(script: Path) -> list[str]:
    """The words of a script's first line, `#!/usr/bin/env python3`; none of a program that is no script."""
    with script.open("rb") as file:
        line = file.readline(256)
    return os.fsdecode(line[2:]).split() if line.startswith(b"#!") else []


def _fingerprint(path: str) -> str:
    try:
        return sha256_file(Path(path))
    except OSError as error:
        raise Missing(f"the program {path} cannot be read: {error.strerror}") from error


def _site_packages(interpreter: Path) -> list[Path]:
    lib = interpreter.parent.parent / "lib"
    return sorted([*lib.glob("python3*/site-packages"), *lib.glob("python3*/dist-packages")])


def _distributions(folder: Path) -> str:
    names = sorted(entry.name for entry in os.scandir(folder) if entry.name.endswith((".dist-info", ".egg-info")))
    return sha256("\n".join(names).encode())

"""Compiled languages: the endings of their files, and the compilers that build tools start if no variable names another."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import PurePosixPath

LANGUAGES: Mapping[tuple[str, str], tuple[str, ...]] = {
    ("CC", "cc"): (".c",),
    ("CXX", "c++"): (".cc", ".cpp", ".cxx", ".c++", ".C"),
    ("FC", "gfortran"): (".f", ".for", ".f90", ".f95", ".f03", ".f08", ".F", ".F90"),
    ("CUDACXX", "nvcc"): (".cu",),
    ("HIPCXX", "hipcc"): (".hip",),
    ("RUSTC", "rustc"): (".rs",),
    ("GO", "go"): (".go",),
    ("ZIG", "zig"): (".zig",),
    ("LDC", "ldc2"): (".d",),
    ("SWIFTC", "swiftc"): (".swift",),
}
"""By language, the variable that names its compiler, and the usual compiler: the endings of its files."""
HEADERS = (".h", ".hh", ".hpp", ".hxx", ".h++", ".H", ".inl", ".ipp", ".tpp", ".cuh", ".inc")
"""Endings of files that are included into others."""
ENDINGS = frozenset((*HEADERS, *(ending for endings in LANGUAGES.values() for ending in endings)))
BINARY = (b"\x7fELF", b"\xcf\xfa\xed\xfe", b"\xca\xfe\xba\xbe", b"!<arch>\n")
"""The first bytes of compiled programs and libraries: ELF, Mach-O, archives."""


def is_code(path: str) -> bool:
    """Check whether a file is written in a compiled language, by its ending."""
    return PurePosixPath(path).suffix in ENDINGS


def compilers(paths: Iterable[bytes], variables: Mapping[str, str]) -> dict[str, str]:
    """Return the compilers of these files by the variables that name them: a variable's value, or else the usual one."""
    endings = {PurePosixPath(os.fsdecode(path)).suffix for path in paths}
    return {
        variable: variables.get(variable) or usual
        for (variable, usual), own in LANGUAGES.items()
        if variables.get(variable) or not endings.isdisjoint(own)
    }


def is_compiled(path: str) -> bool:
    """Check whether a file is a compiled program or library, by its first bytes."""
    try:
        with open(path, "rb") as file:  # noqa: PTH123 - for speed
            return file.read(8).startswith(BINARY)
    except OSError:
        return False

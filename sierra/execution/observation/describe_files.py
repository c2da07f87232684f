"""Description in one line of the files that an observed execution used.

For example: `argos3 3.0, 7 plug-ins; Python 3.11 with numpy 2.3; 2 meshes`. Versions are those that programs have reported,
and those of installed distributions. Libraries that the loader loads for the command are not named
(`sierra.provenance.libraries`). Of the others, those without a version in their file name are called plug-ins, as is usual.
Files of the system and of installed distributions are no data.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import PurePosixPath

from sierra.execution.observation.current_files import GPU
from sierra.execution.observation.file_sets import UsedFile
from sierra.execution.row_queries import RecordedProgram
from sierra.util.lazy_definitions import regex
from sierra.util.text import counted, few

NAMED = 4
PYTHON = regex(r"python(\d(?:\.\d+)?t?)?")
VERSION = regex(r"\d+(?:\.\d+)+[\w.+-]*")
SHARED = regex(r"\.so(?:\.\d+)*$")
PLUGIN, LIBRARY, OTHER = "plug-in", "library", "other file"
LOADER = regex(r"ld(?:32|64|-[\w.+-]+)?\.so(?:\.\d+)*")
OF_PYTHON = regex(r"/lib(?:32|64)?/python3?(?:\.\d+t?)?/|/(?:site|dist)-packages/|/pyvenv\.cfg$")
OF_SYSTEM = ("/usr/", "/lib", "/etc/", "/bin/", "/sbin/", "/opt/", "/var/", "/run/", "/nix/", "/gnu/")
COMMON = frozenset(
    (
        *("sh", "bash", "dash", "busybox", "env", "nice", "timeout", "coreutils", "basename", "cat", "chmod", "cp", "cut"),
        *("date", "dirname", "echo", "expr", "find", "grep", "head", "id", "ln", "ls", "mkdir", "mktemp", "mv", "readlink"),
        *("realpath", "rm", "sed", "sleep", "sort", "tail", "tee", "test", "touch", "tr", "true", "uname", "wc", "which"),
    )
)
"""Programs that scripts use; they are named after all others."""
KINDS = {
    "mesh": ("stl", "obj", "dae", "ply", "msh", "glb", "gltf", "off", "3ds"),
    "picture": ("png", "jpg", "jpeg", "pgm", "ppm", "pbm", "bmp", "tif", "tiff", "gif", "svg"),
    "model": ("xml", "urdf", "xacro", "sdf", "world", "argos", "mjcf", "usd", "onnx", "pt", "pth"),
    "script": ("py", "pyc", "lua", "sh", "js", "rb", "pl", "tcl", "m", "jl", "r"),
}
"""Kinds of data by the end of the name."""
PLURALS = {"mesh": "meshes", LIBRARY: "libraries"}


def summary(files: Iterable[UsedFile], programs: Sequence[RecordedProgram], distributions: Sequence[str]) -> str:
    """Return one line; `distributions` have the form `name==version`."""
    files = list(files)
    executed = [PurePosixPath(file.path).name for file in files if file.use == "executed"]
    started = sorted({name for name in executed if not LOADER.fullmatch(name)}, key=lambda name: (name in COMMON, name))
    pythons = [name for name in started if PYTHON.fullmatch(name)]
    others = [name for name in started if name not in pythons]
    counts = Counter(kind for file in files if (kind := _kind(file, programs)))
    loaded = [_plural(counts[kind], kind) for kind in (PLUGIN, LIBRARY) if counts[kind]]
    named = [_with_version(name, programs) for name in others if name not in COMMON]
    common = [name for name in others if name in COMMON]
    parts = [
        ", ".join([few(named, NAMED), *loaded] if named else loaded),
        *(_python(name, programs, distributions) for name in pythons),
        few(common, NAMED),
        "a GPU" if any(file.path == GPU for file in files) else "",
        ", ".join(_plural(counts[kind], kind) for kind in (*KINDS, OTHER) if counts[kind]),
    ]
    return "; ".join(filter(None, parts))


def _python(name: str, programs: Sequence[RecordedProgram], distributions: Sequence[str]) -> str:
    version = _version(name, programs) or name.removeprefix("python")
    used = [line.replace("==", " ") for line in distributions]
    return f"Python {version}".strip() + (f" with {few(used, NAMED)}" if used else "")


def _with_version(name: str, programs: Sequence[RecordedProgram]) -> str:
    version = _version(name, programs)
    return f"{name} {version}" if version else name


def _version(name: str, programs: Sequence[RecordedProgram]) -> str | None:
    """Return the version that a program has reported."""
    for one in programs:
        if one.kind == "program" and name in _names(one) and (match := VERSION.search(one.version or "")):
            return match[0]
    return None


def _names(one: RecordedProgram) -> Iterator[str]:
    yield from (PurePosixPath(path).name for path in (one.path, one.name))


def _kind(file: UsedFile, programs: Sequence[RecordedProgram]) -> str | None:
    """Return the kind of a file that is data or a plug-in; None for all others."""
    if file.use != "read" or file.path == GPU or OF_PYTHON.search(file.path):
        return None
    if SHARED.search(file.path):
        known = any(program.sha256 == file.sha256 for program in programs)
        return None if known else PLUGIN if file.path.endswith(".so") else LIBRARY
    if file.path.startswith(OF_SYSTEM):
        return None
    suffix = PurePosixPath(file.path).suffix.removeprefix(".").lower()
    return next((kind for kind, suffixes in KINDS.items() if suffix in suffixes), OTHER)


def _plural(count: int, kind: str) -> str:
    return f"{count} {PLURALS[kind]}" if kind in PLURALS and count != 1 else counted(count, kind)

"""Files of Python: what counts of those in virtual environments, compiled modules, and distributions with their files."""

from __future__ import annotations

import hashlib
import os
import re
import struct
from typing import Callable, Iterable, Iterator, Mapping

from sierra.worker.file_trace import nothing
from sierra.worker.files import CHUNK, entries_of

PYTHON_CACHE = "__pycache__"
SMALL = 1 << 16
"""The largest file in a virtual environment in which paths are looked for."""
VENV = "pyvenv.cfg"
COSMETIC = frozenset((b"command", b"executable", b"prompt", b"relocatable", b"uv", b"virtualenv"))
"""Keys of pyvenv.cfg that Python does not read, and that did not count in earlier versions of this program."""
COUNTED = frozenset((b"home", b"include-system-site-packages"))
"""Keys of pyvenv.cfg that Python reads. All others say which tool has made the environment."""
OF_INSTALLER = re.compile(rb"[^/,]+\.dist-info/(?:INSTALLER|REQUESTED|uv_cache\.json|uv_build\.json),")
"""Lines of RECORD about files in which a tool notes its own work."""
PYTHON_LINE = re.compile(rb"\A(#!(?:/bin/sh\n'''exec' )?[\"']?\{prefix\}/bin/python)(?:\d(?:\.\d+)?t?)?(?=[\"'\s])")
CALLER = re.compile(
    rb"(#!.*\n(?:'''exec' .*\n' '''\n)?)(?:# -\*- coding: utf-8 -\*-\n)?(?:import re\n)?import sys\n+"
    rb"from ([\w.]+) import (\w+)\n+if __name__ == ['\"]__main__['\"]:\n"
    rb"(?:    (?:el)?if sys\.argv\[0\]\.endswith\(['\"](?:-script\.pyw|\.exe)['\"]\):\n"
    rb"        sys\.argv\[0\] = sys\.argv\[0\]\[:-\d+\]\n"
    rb"|    sys\.argv\[0\] = sys\.argv\[0\]\.removesuffix\(['\"]\.exe['\"]\)\n"
    rb"|    sys\.argv\[0\] = re\.sub\(r['\"]\(-script\\\.pyw\??\|\\\.exe\)\?\$['\"], ['\"]{2}, sys\.argv\[0\]\)\n)*"
    rb"    sys\.exit\((\3[\w.]*)\(\)\)\n?"
)
"""A script that only calls a function of a package. Each tool has its own words for it."""
CALL_BY_PIP = rb"""\1# -*- coding: utf-8 -*-
import re
import sys
from \2 import \3
if __name__ == '__main__':
    sys.argv[0] = re.sub(r'(-script\\.pyw|\\.exe)?$', '', sys.argv[0])
    sys.exit(\4())
"""
NAME_BYTE = rb"[\w.+~\x80-\xff-]"
INSTALLED = re.compile(r"(.*/(?:site|dist)-packages)/(.*)", re.S)
METADATA = re.compile(r"\.(?:dist|egg)-info(?:/|$)|\.pth$")
"""Files that tools read although nobody imports the distribution."""
TOP = re.compile(rb"^\"?([^/,\"\n]+)", re.M)


class Environments:
    """The virtual environments of Python that files are in, known by their `pyvenv.cfg`. Each folder is looked at once."""

    def __init__(self) -> None:
        self._known: dict[str, str | None] = {"/": None, "": None}

    def of(self, path: str) -> str | None:
        """Return the environment that a file is in; None if it is in none."""
        folder = os.path.dirname(path)
        if folder not in self._known:
            inside = os.path.isfile(os.path.join(folder, VENV))
            self._known[folder] = folder if inside else self.of(folder)
        return self._known[folder]


def sha256_of(path: str, environments: Environments, check_stop: Callable[[], None] = nothing, *, former: bool = False) -> str:
    """Return the SHA-256 of a file's content, or of what counts of it if it is a small file in a virtual environment.

    `former`: what counted of it in earlier versions of this program.
    """
    digest = hashlib.sha256()
    folder = environments.of(path)
    with open(path, "rb", buffering=0) as file:
        size = os.fstat(file.fileno()).st_size
        if folder and (size <= SMALL or is_record(path)):
            return hashlib.sha256(counted(path, file.read(), folder, former=former)).hexdigest()
        for chunk in iter(lambda: file.read(CHUNK), b""):
            check_stop()
            digest.update(chunk)
    return digest.hexdigest()


def counted(path: str, content: bytes, environment: str, *, former: bool = False) -> bytes:
    """Return what counts of the content of a file in a virtual environment: the same wherever and however it was made.

    The path of the environment itself does not count: it is in the first line of each script, for example. Nor does it count
    by which of its names a script calls the environment's Python (`python3.11`), and how a tool writes a script that only calls
    a function. All other words count, and so does the path of another environment. Only what Python reads of `pyvenv.cfg`
    counts. What RECORD says about scripts, about compiled modules and about the tool that has installed it does not count.
    """
    kept = content
    if path == os.path.join(environment, VENV):
        lines = (line.strip() for line in content.splitlines())
        keys = ((line.partition(b"=")[0].strip().lower(), line) for line in lines)
        kept = b"\n".join(sorted(line for key, line in keys if (key not in COSMETIC if former else key in COUNTED)))
        kept = without(kept, os.path.expanduser("~"), b"{home}")
    elif is_record(path):
        lines = (line.rstrip() for line in content.splitlines())
        lines = (line for line in lines if not line.startswith(b"..") and b".pyc," not in line)
        kept = b"\n".join(sorted(line for line in lines if former or not OF_INSTALLER.match(line)))
    elif b"\0" not in content:
        for folder in {environment, os.path.realpath(environment)}:
            kept = without(kept, folder, b"{prefix}")
        kept = kept if former else CALLER.sub(CALL_BY_PIP, PYTHON_LINE.sub(rb"\g<1>3", kept))
    return content if kept == content else b"{prefix}\0" + kept


def is_record(path: str) -> bool:
    """Return whether a file is the list of the files of an installed distribution of Python."""
    return path.endswith(".dist-info/RECORD")


def without(content: bytes, folder: str, name: bytes) -> bytes:
    """Return a text in which a name stands for the path of a folder. Longer names that contain the path stay."""
    path = os.fsencode(folder)
    if path == b"/" or path not in content:
        return content
    return re.sub(b"(?<!" + NAME_BYTE + b")" + re.escape(path) + b"(?!" + NAME_BYTE + b")", lambda _: name, content)


def source_of(path: str) -> str | None:
    """Return the source of a compiled module of Python in a folder `__pycache__`; None if there is none."""
    folder, _, name = path.rpartition("/")
    if not folder.endswith("/" + PYTHON_CACHE):
        return None
    source = "%s/%s.py" % (folder[: -len(PYTHON_CACHE) - 1], name.split(".", 1)[0])
    return source if os.path.isfile(source) else None


def counts_itself(path: str) -> bool:
    """Return whether Python executes a compiled module without a look at its source (see PEP 552), or without one."""
    if source_of(path) is None:
        return True
    try:
        with open(path, "rb") as file:
            head = file.read(8)
    except OSError:
        return False
    return len(head) == 8 and struct.unpack("<I", head[4:])[0] & 3 == 1


class Distributions:
    """Installed distributions of Python by their files, from the RECORD files beside them; each folder is read once."""

    def __init__(self) -> None:
        self._folders: dict[str, Mapping[str, list[str]]] = {}

    def of(self, path: str) -> str | None:
        """Return the distribution of a file, for example `numpy-2.3.1`; None if none has installed it.

        A distribution without a RECORD, as Debian installs them, has the modules of its top_level.txt, or of its own name.
        """
        match = INSTALLED.fullmatch(path)
        if match is None:
            return None
        folder, name = match.groups()
        if folder not in self._folders:
            self._folders[folder] = owners(folder)
        top = name.partition("/")[0]
        candidates = self._folders[folder].get(top, [])
        several = (
            distribution for distribution in candidates if len(candidates) == 1 or name in recorded(folder, distribution)
        )
        unrecorded = self._folders[folder].get("=" + normalized(top.partition(".")[0]), [])[:1]
        return next(iter((*several, *unrecorded)), None)

    def used(self, files: Iterable[tuple[str, int]]) -> list[str]:
        """Return the distributions whose code is in files with these sizes, as `name==version`, those with most bytes first."""
        sizes: dict[str, int] = {}
        for path, size in files:
            distribution = None if METADATA.search(path) else self.of(path)
            if distribution is not None:
                sizes[distribution] = sizes.get(distribution, 0) + size
        named = (distribution.partition("-") for distribution in sorted(sizes, key=lambda name: (-sizes[name], name)))
        return ["%s==%s" % (normalized(name), version) for name, _, version in named]


DISTRIBUTIONS = Distributions()


def normalized(name: str) -> str:
    """Return the name of a distribution as it is compared: `JSBSim` and `jsbsim` are one (see PEP 503)."""
    return re.sub(r"[-_.]+", "-", name).lower()


def owners(folder: str) -> dict[str, list[str]]:
    """Return the distributions that have installed something in a folder, by the first part of its path.

    Modules of a distribution without a RECORD are there by their names, after `=`.
    """
    by_top: dict[str, list[str]] = {}
    for entry in sorted(entries_of(folder)):
        name, _, kind = entry.rpartition(".")
        if kind not in ("dist-info", "egg-info"):
            continue
        tops = {os.fsdecode(top) for top in TOP.findall(content_of(os.path.join(folder, entry, "RECORD")))}
        if not tops:
            modules = os.fsdecode(content_of(os.path.join(folder, entry, "top_level.txt"))).split()
            tops = {"=" + normalized(module) for module in modules or [name.partition("-")[0]]}
        for top in tops:
            by_top.setdefault(top, []).append(re.sub(r"-py\d.*", "", name))
    return by_top


def recorded(folder: str, distribution: str) -> Iterator[str]:
    """Yield the files that a distribution has installed in a folder."""
    for line in os.fsdecode(content_of(os.path.join(folder, distribution + ".dist-info", "RECORD"))).splitlines():
        yield line[1:].partition('"')[0] if line.startswith('"') else line.partition(",")[0]


def content_of(path: str) -> bytes:
    """Return the content of a file; empty if it cannot be read."""
    try:
        with open(path, "rb") as file:
            return file.read()
    except OSError:
        return b""

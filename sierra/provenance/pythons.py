"""What a Python interpreter sees: asked of the interpreter itself, as runs would start it, and read from what is installed.

Distributions are told by name and version, as `importlib.metadata` would; the interpreter's own modules stand for
themselves by its version. Where a name and a version say too little, content counts: of an editable install, and of any other
folder on `sys.path`, the Python files; of what was installed from a folder, what its RECORD says of them; of what was
installed from a repository, the commit.
"""

from __future__ import annotations

import ast
import json
import os
import re
import subprocess
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from sierra.hashing import digest
from sierra.provenance.digests import Digests

NAME = re.compile(r"python(\d(\.\d+)?t?)?")
ASK = "import sys; print('\\n' + ascii([sys.executable, sys.prefix, sys.base_prefix, sys.path]))"
PATIENCE_S = 10.0
CODE = (".py", ".so")
OWN = "sierra_experiments"
"""SIERRA's own distribution: no run is made from it, so that its code, where it is installed editable, does not count."""


@dataclass(frozen=True, slots=True)
class Interpreter:
    """Its executable, and the folders that it imports from: those with distributions, and others outside its own."""

    executable: str
    installed: tuple[Path, ...]
    others: tuple[Path, ...] = ()


@dataclass(frozen=True, slots=True)
class Distribution:
    """One installed distribution, and the folder that says so."""

    name: str
    version: str
    info: Path

    @property
    def line(self) -> str:
        return f"{self.name}=={self.version}"


@dataclass(frozen=True, slots=True)
class Content:
    """What is identified by content: a distribution, or a folder on the path; where it comes from, and its digest."""

    name: str
    origin: str
    digest: str
    version: str | None = None


def is_python(path: str) -> bool:
    """Whether a program is Python by its name."""
    return NAME.fullmatch(Path(path).name) is not None


def ask(path: str, variables: Mapping[str, str], root: Path) -> Interpreter:
    """What an interpreter sees in runs, whose HOME is empty.

    Of one that does not answer, what lies beside it; a file of the project is not asked, since planning executes nothing of it.
    """
    if Path(path).resolve().is_relative_to(root.resolve()):
        return Interpreter(path, tuple(_beside(Path(path))))
    with tempfile.TemporaryDirectory(prefix="sierra-") as home:
        try:
            done = subprocess.run(
                [path, "-c", ASK],
                env={**variables, "HOME": home, "TMPDIR": home},
                cwd=root,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                timeout=PATIENCE_S,
                check=True,
            )
            executable, prefix, base, folders = ast.literal_eval(done.stdout.decode().splitlines()[-1])
        except (OSError, ValueError, SyntaxError, IndexError, subprocess.SubprocessError):
            return Interpreter(path, tuple(_beside(Path(path))))
    seen = [folder for folder in map(Path, dict.fromkeys(folders)) if folder.is_absolute() and folder.is_dir()]
    installed = [folder for folder in seen if folder.name in ("site-packages", "dist-packages")]
    inside = (Path(prefix), Path(base), root)
    others = [f for f in seen if f not in installed and not any(f.resolve().is_relative_to(i.resolve()) for i in inside)]
    return Interpreter(executable, tuple(installed), tuple(others))


def _beside(interpreter: Path) -> list[Path]:
    lib = interpreter.parent.parent / "lib"
    return sorted([*lib.glob("python3*/site-packages"), *lib.glob("python3*/dist-packages")])


def distributions(folders: Sequence[Path]) -> list[Distribution]:
    """What is installed in these folders, by name; of two of a name, the first is seen."""
    found: dict[str, Distribution] = {}
    for folder in folders:
        for entry in sorted(entry.name for entry in os.scandir(folder)):
            if entry.endswith((".dist-info", ".egg-info")):
                one = _distribution(folder / entry)
                found.setdefault(one.name.lower(), one)
    return [found[name] for name in sorted(found)]


def _distribution(info: Path) -> Distribution:
    name, _, version = info.stem.partition("-")
    if not version:
        version = _header(info / "PKG-INFO", "Version") or "?"
    return Distribution(name, re.sub(r"-py\d.*", "", version), info)


def _header(file: Path, name: str) -> str | None:
    try:
        lines = file.read_text("utf-8", "replace").split("\n\n")[0].splitlines()
    except OSError:
        return None
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(f"{name}:")), None)


def contents(interpreter: Interpreter, found: Sequence[Distribution], root: Path, digests: Digests) -> Iterator[Content]:
    """What counts by content. Files of the project itself are the source's matter."""
    told = set()
    for one in found:
        direct = _direct_url(one.info)
        if direct is None:
            continue
        url = re.sub(r"(?<=://)[^/]*@", "", direct["url"])
        folder = Path(unquote(urlsplit(url).path))
        match direct:
            case {"dir_info": {"editable": True}} if folder.is_dir():
                told.add(folder.resolve())
                if one.name != OWN:
                    yield Content(one.name, str(folder), _folder(folder, root, digests), one.line)
            case {"vcs_info": {"commit_id": str(commit)}}:
                yield Content(one.name, url, digest("installed", {"commit": commit}), one.line)
            case _:
                yield Content(one.name, url, digest("installed", {"files": _recorded(one.info)}), one.line)
    for folder in interpreter.others:
        if folder.resolve() not in told:
            yield Content(folder.name, str(folder), _folder(folder, root, digests))


def _direct_url(info: Path) -> dict[str, Any] | None:
    """Where a distribution was installed from, if not from an index (PEP 610)."""
    try:
        direct = json.loads((info / "direct_url.json").read_bytes())
    except (OSError, ValueError, RecursionError):
        return None
    return direct if isinstance(direct, dict) and isinstance(direct.get("url"), str) else None


def _recorded(info: Path) -> list[str]:
    """The lines of a distribution's RECORD on its own files: not on scripts and compiled ones, which name this machine."""
    try:
        lines = (info / "RECORD").read_text("utf-8", "replace").splitlines()
    except OSError:
        return []
    return sorted(line for line in lines if not line.startswith(("..", info.name)) and ".pyc," not in line)


def _folder(folder: Path, root: Path, digests: Digests) -> str:
    files = [[path.relative_to(folder).as_posix(), digests.of(str(path))] for path in _code(folder, root.resolve())]
    return digest("folder", {"files": files})


def _code(folder: Path, root: Path) -> Iterator[Path]:
    """The Python files in a folder, but not in environments and hidden folders inside it, nor in the project."""
    for here, folders, files in os.walk(folder):
        if "pyvenv.cfg" in files or Path(here).resolve() == root:
            folders.clear()
            continue
        folders[:] = sorted(
            name for name in folders if not name.startswith(".") and name not in ("__pycache__", "node_modules")
        )
        yield from (path for name in sorted(files) if name.endswith(CODE) and (path := Path(here, name)).is_file())

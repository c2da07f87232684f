"""The packages that a Python interpreter can import, as reported by the interpreter and by the installed metadata.

The interpreter is started like runs would start it. Distributions are identified by name and version, like in
`importlib.metadata`; the interpreter's version identifies its own modules. In some cases a name and a version are not enough.
For an editable install and any other folder on `sys.path`, the Python files are hashed. For a distribution that was installed
from a folder, the entries in its RECORD are used; for one that was installed from a repository, the commit.
"""

from __future__ import annotations

import ast
import glob
import itertools
import json
import os
import re
import shutil
import tempfile
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from urllib.parse import unquote, urlsplit

from sierra.errors import Missing
from sierra.provenance import libraries
from sierra.provenance.dependency_model import INSTALLED, Programs, normalized
from sierra.provenance.hash_cache import VENV, HashCache
from sierra.util import bounded_program
from sierra.util.hashing import digest
from sierra.util.json_types import as_object
from sierra.util.lazy_definitions import dataclass, regex

NAME = regex(r"python(\d(\.\d+)?t?)?")
ASK = "import sys; print('\\n' + ascii([sys.executable, sys.prefix, sys.base_prefix, sys.path]))"
TIMEOUT_S = 10.0
NAMED = "python3"
"""The name for the Python that a placeholder, or a script of a virtual environment, stands for."""
CODE = (".py", ".so")
OWN = "sierra-experiments"
"""SIERRA's own distribution. Runs do not depend on it, so its code is ignored even if the install is editable."""


@dataclass(frozen=True, slots=True)
class Interpreter:
    """An interpreter's executable, and its import folders: those with distributions, and others outside its own."""

    executable: str
    installed: tuple[Path, ...]
    others: tuple[Path, ...] = ()
    project: tuple[Path, ...] = ()
    """Import folders that belong to the project."""


@dataclass(frozen=True, slots=True)
class Distribution:
    """One installed distribution, and the folder with its metadata."""

    name: str
    version: str
    info: Path

    @property
    def line(self) -> str:
        return f"{normalized(self.name)}=={self.version}"


@dataclass(frozen=True, slots=True)
class HashedPackage:
    """A distribution or folder on the path that is identified by content; its origin and digest."""

    name: str
    origin: str
    digest: str
    version: str | None = None


@dataclass(frozen=True, slots=True)
class Origin:
    """The place from which a distribution was installed, if that was not an index (PEP 610)."""

    url: str
    editable: bool
    commit: str | None

    @property
    def folder(self) -> Path:
        return Path(unquote(urlsplit(self.url).path))


def name_in_environment(path: str) -> str:
    """Return the path of an interpreter in a virtual environment under one name: `python` and `python3.11` are links to it.

    Tools that make environments use different ones in the first lines of scripts. All other paths are returned as they are.
    """
    program = Path(path)
    in_environment = is_python(path) and program.is_absolute() and (program.parent.parent / VENV).is_file()
    return str(program.with_name(NAMED)) if in_environment else path


def is_python(path: str) -> bool:
    """Return True if a program's name is that of a Python interpreter."""
    return NAME.fullmatch(Path(path).name) is not None


def ask(path: str, variables: Mapping[str, str], root: Path, project: Path) -> Interpreter:
    """Return the import folders that an interpreter has in runs, where HOME is empty.

    If the interpreter does not answer, the folders beside it are used. An interpreter that is a file of the project is not
    started, because planning executes nothing of the project.
    """
    if any(Path(path).resolve().is_relative_to(own.resolve()) for own in (root, project)):
        return Interpreter(path, tuple(_beside(Path(path))))
    with tempfile.TemporaryDirectory(prefix="sierra-") as home:
        try:
            own = {"HOME": home, "TMPDIR": home}
            ended = bounded_program.execute([path, "-c", ASK], cwd=root, env={**variables, **own}, wall=TIMEOUT_S)
            answer = ended.output.decode().splitlines()[-1] if ended.status == 0 else ""
            executable, prefix, base, folders = ast.literal_eval(answer)
        except (OSError, ValueError, SyntaxError, IndexError):
            return Interpreter(path, tuple(_beside(Path(path))))
    seen = [folder for folder in map(Path, dict.fromkeys(folders)) if folder.is_absolute() and folder.is_dir()]
    installed = [folder for folder in seen if folder.name in ("site-packages", "dist-packages")]
    beside = [f for f in seen if f not in installed and not _is_in(f, Path(prefix), Path(base))]
    others = [folder for folder in beside if not _is_in(folder, root, project)]
    return Interpreter(executable, tuple(installed), tuple(others), tuple(f for f in beside if _is_in(f, project)))


def programs_of_script(script: Path) -> list[Path]:
    """Return the compiled programs with the name of a script, in the packages beside it: `site-packages/*/bin/NAME`.

    Packages with compiled programs have such scripts, for example `sumo`.
    """
    if libraries.interpreter(str(script)) is not None:
        return []
    programs = (path for site in _beside(script) for path in site.glob(f"*/bin/{glob.escape(script.name)}"))
    return sorted(path for path in programs if libraries.interpreter(str(path)) is not None)


def environment(programs: Programs, search: str) -> Path | None:
    """Return the virtual environment that runs use: that of their command's Python, or else of the first Python in `search`.

    `search` is the PATH of runs: a command that is no Python may start one. None if that Python is in no such environment.
    """
    lists = (program.path.split(os.pathsep) for program in programs.all if program.name.endswith(INSTALLED))
    folders = [Path(folder) for paths in itertools.islice(lists, 1) for folder in paths]
    if not folders:
        beside = (shutil.which(name, path=search) for name in ("python3", "python"))
        folders = [Path(python) for python in itertools.islice(filter(None, beside), 1)]
    above = (parent for folder in folders for parent in folder.parents)
    return next((parent for parent in above if (parent / VENV).is_file()), None)


def _is_in(folder: Path, *above: Path) -> bool:
    return any(folder.resolve().is_relative_to(one.resolve()) for one in above)


def _beside(interpreter: Path) -> list[Path]:
    lib = interpreter.parent.parent / "lib"
    return sorted([*lib.glob("python3*/site-packages"), *lib.glob("python3*/dist-packages")])


def distributions(folders: Sequence[Path]) -> list[Distribution]:
    """Return the distributions in these folders, ordered by name; of several with the same name, Python imports the first."""
    by_name: dict[str, Distribution] = {}
    for folder in folders:
        for entry in sorted(entry.name for entry in os.scandir(folder)):
            if entry.endswith((".dist-info", ".egg-info")):
                package = _distribution(folder / entry)
                by_name.setdefault(normalized(package.name), package)
    return [by_name[name] for name in sorted(by_name)]


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


def imported(interpreter: Interpreter, found: Sequence[Distribution], project: Path) -> Iterator[Path]:
    """Yield the folders in the project that an interpreter imports from, by its path or by editable installs."""
    yield from interpreter.project
    for origin in (_origin(one.info) for one in found):
        if origin is not None and origin.editable and _is_in(origin.folder, project):
            yield from (one for one in (origin.folder, origin.folder / "src") if one.is_dir())


def check(name: str, folders: Iterable[Path], root: Path, project: Path, scripts: Container[Path]) -> None:
    """Raise Missing if a folder in the project has other code than the same folder in `root`: that code would be executed.

    Code beside a script in `root` is exempt, because Python imports it before the code in the project.
    """
    for folder in folders:
        restored = root / folder.resolve().relative_to(project.resolve())
        for file in _code(restored, ()) if restored not in scripts else ():
            there = folder / file.relative_to(restored)
            if not there.is_file() or there.read_bytes() != file.read_bytes():
                raise Missing(
                    f"{name} imports from {folder} (an editable install, or its path), where {there.name} differs from the "
                    "recorded file, so other code would execute; check out the recorded code there, or install it differently"
                )


def contents(
    interpreter: Interpreter, packages: Sequence[Distribution], own: Sequence[Path], digests: HashCache
) -> Iterator[HashedPackage]:
    """Yield the distributions and folders that are identified by content, without the project's own files (in `own`)."""
    editable = set()
    for package in packages:
        origin = _origin(package.info)
        if origin is None:
            continue
        if origin.editable and origin.folder.is_dir():
            editable.add(origin.folder.resolve())
            if normalized(package.name) != OWN:
                hashed = _folder(origin.folder, own, digests)
                yield HashedPackage(normalized(package.name), str(origin.folder), hashed, package.line)
            continue
        identity = {"commit": origin.commit} if origin.commit is not None else {"files": _recorded(package.info)}
        url = re.sub(r"(?<=://)[^/]*@", "", origin.url)
        yield HashedPackage(normalized(package.name), url, digest("installed", identity), package.line)
    for folder in interpreter.others:
        if folder.resolve() not in editable:
            yield HashedPackage(folder.name, str(folder), _folder(folder, own, digests))


def _origin(info: Path) -> Origin | None:
    """Return the origin of a distribution, or None for an index."""
    try:
        direct = as_object(json.loads((info / "direct_url.json").read_bytes()))
    except (OSError, ValueError, RecursionError):
        return None
    url, commit = direct.get("url"), as_object(direct.get("vcs_info")).get("commit_id")
    editable = as_object(direct.get("dir_info")).get("editable") is True
    return Origin(url, editable, commit if isinstance(commit, str) else None) if isinstance(url, str) else None


def _recorded(info: Path) -> list[str]:
    """Return the lines of a RECORD without scripts and compiled files, because these contain paths of this machine."""
    try:
        lines = (info / "RECORD").read_text("utf-8", "replace").splitlines()
    except OSError:
        return []
    return sorted(line for line in lines if not line.startswith(("..", info.name)) and ".pyc," not in line)


def _folder(folder: Path, own: Sequence[Path], digests: HashCache) -> str:
    files = [[path.relative_to(folder).as_posix(), digests.of(str(path))] for path in _code(folder, own)]
    return digest("folder", {"files": files})


def _code(folder: Path, own: Sequence[Path]) -> Iterator[Path]:
    """Yield the Python files in a folder, except those in nested environments, in hidden folders, and in the project."""
    left = {root.resolve() for root in own}
    for here, folders, files in os.walk(folder):
        if VENV in files or Path(here).resolve() in left:
            folders.clear()
            continue
        folders[:] = sorted(
            name for name in folders if not name.startswith(".") and name not in ("__pycache__", "node_modules")
        )
        yield from (path for name in sorted(files) if name.endswith(CODE) and (path := Path(here, name)).is_file())

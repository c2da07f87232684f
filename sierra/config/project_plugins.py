"""Plug-ins beside the project: classes in Python files of the project, which `[plugins]` names.

They are code of the project. What is imported is exactly what the source of runs has:

- The files are read once. The modules are compiled from these bytes: no byte code is read or written.
- A file may import other files of the project by relative imports (`from . import helper`), as if the project were a package.
  These files are found before anything is imported, and belong to the source too. Other imports of files of the project are
  refused, because nothing would record which file they find.
- Modules have names that begin with the hash of the project's folder and of all these files. So two projects, and two states
  of one project, never share a module.

Names count within `sierra.config.current_project` only, as in all methods of a project of the Python interface. Files of a
package are never imported.

A reader is recorded with its files, in the rules by which executions are evaluated: these are imported wherever executions of
the project's own are read by these rules, as in a replay.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from functools import cached_property
from importlib.machinery import ModuleSpec
from importlib.util import find_spec, spec_from_loader
from pathlib import Path, PurePosixPath
from types import CodeType, FunctionType, ModuleType
from typing import Any

from sierra.config import extensions, plugin_registry
from sierra.config.current_project import Plugins
from sierra.config.plugin_registry import KINDS, Kind, Offer, Offers
from sierra.errors import ConfigError, PluginError, PluginRefused
from sierra.util.hashing import digest, sha256
from sierra.util.lazy_definitions import dataclass
from sierra.util.regular_files import read_regular

PREFIX = "sierra_plugins_"
"""The beginning of the names of modules."""
PACKAGE = "__init__.py"
INSTALLED = ("site-packages", "dist-packages")
"""Folders of installed packages, which may be in a virtual environment in the project."""
_modules: dict[str, _Module] = {}
"""All modules that may be imported, by their names."""


@dataclass(frozen=True, slots=True)
class _Module:
    """One module: its file, the bytes of the file as they were read, and whether it is a package."""

    file: Path
    content: bytes
    is_package: bool


class Declared(Plugins):
    """The plug-ins that `[plugins]` of a project declares. The files are read when they are needed, and once."""

    def __init__(self, root: Path, declared: Mapping[str, Iterable[str]], refused: str = "") -> None:
        """`declared`: the classes by kind."""
        super().__init__(root, refused)
        self._declared = declared

    @cached_property
    def offers(self) -> Offers:
        offers: dict[str, dict[str, tuple[Offer, ...]]] = {}
        for kind in KINDS:
            places = self._declared.get(kind.key, ())
            _check_names(kind, places)
            offers[kind.group] = {place.partition(":")[2]: (self._offer(place),) for place in places}
        return offers

    def files(self, kinds: Iterable[str] = ()) -> dict[str, bytes]:
        wanted = [place for key, places in self._declared.items() if not kinds or key in kinds for place in places]
        return dict(sorted((path, data) for place in wanted for path, data in self.files_of[place].items()))

    @cached_property
    def files_of(self) -> dict[str, dict[str, bytes]]:
        """The file of each class and those that it imports, by path."""
        known: dict[str, bytes] = {}
        places = [(f"[plugins] {key}: {place}", place) for key, places in self._declared.items() for place in places]
        return {place: _closure(self.root, place.partition(":")[0], origin, known) for origin, place in places}

    def _offer(self, place: str) -> Offer:
        path, _, name = place.partition(":")
        return Offer(name, _Point(place, self), path, lambda: self.files_of[place])


class Recorded(Plugins):
    """A plug-in as it was recorded, with its files."""

    def __init__(self, project: Plugins, kind: Kind, name: str, path: str, files: Mapping[str, bytes]) -> None:
        """`project` is the one that recorded it; `path` is the file of the class."""
        super().__init__(project.root, project.refused)
        self._offer = Offer(name, _Point(f"{path}:{name}", self), path, lambda: files)
        self._kind, self._files = kind, files

    @property
    def offers(self) -> Offers:
        return {self._kind.group: {self._offer.name: (self._offer,)}}

    def files(self, kinds: Iterable[str] = ()) -> Mapping[str, bytes]:
        return self._files


@dataclass(frozen=True, slots=True)
class _Point:
    """The place of a class, with the methods that the registry uses of an entry point."""

    value: str
    """The class as `[plugins]` names it: `robosim.py:RoboSim`."""
    plugins: Plugins

    def load(self) -> Any:
        """Import the class. Raises PluginError if there is none, or if it may not be imported here."""
        path, _, name = self.value.partition(":")
        root, refused = self.plugins.root, self.plugins.refused
        if refused:
            raise PluginRefused(f"[plugins]: {self.value} is not imported: {refused}")
        module = _imported(f"{_register(root, self.plugins.files())}.{_dotted(path)}", root, path)
        try:
            return getattr(module, name)
        except AttributeError:
            raise PluginError(f"[plugins]: {path} has no class {name}; correct {path} or sierra.toml") from None


def _check_names(kind: Kind, places: Iterable[str]) -> None:
    """Raise ConfigError for a name that something else has."""
    for path in places:
        name = path.partition(":")[2]
        shipped = name in kind.shipped or extensions.home(kind.key, name) is not None
        installed = [offer.package for offer in kind.installed().get(name, ())]
        if shipped or installed:
            owner = "SIERRA itself" if shipped else " and ".join(installed)
            raise ConfigError(f"[plugins] {kind.key}: {owner} has a {kind.word} {name!r} already; give {path} another name")


# The files


def _closure(root: Path, path: str, origin: str, known: dict[str, bytes]) -> dict[str, bytes]:
    """Return a file and those that it imports, by path; `known` are files that were read already. Nothing is imported."""
    files: dict[str, bytes] = {}
    pending = [(origin, path)]
    while pending:
        origin, path = pending.pop()
        if path in files:
            continue
        files[path] = known[path] = known[path] if path in known else _read(root, path, origin)
        pending += ((path, package) for package in _packages_above(root, path))
        pending += ((path, other) for other in _imports(root, path, files[path], origin))
    return dict(sorted(files.items()))


def _read(root: Path, path: str, origin: str) -> bytes:
    parts = PurePosixPath(path).parts
    steps = [root.joinpath(*parts[: end + 1]) for end in range(len(parts))]
    try:
        if link := next((step for step in steps if step.is_symlink()), None):
            raise ConfigError(f"{origin}: {link} is a symbolic link; name a file of the project itself")
        return read_regular(steps[-1])
    except FileNotFoundError:
        raise ConfigError(f"{origin}: {steps[-1]} does not exist") from None
    except OSError as error:
        raise ConfigError(f"{origin}: cannot read {steps[-1]}: {error.strerror}") from error


def _packages_above(root: Path, path: str) -> Iterator[str]:
    """Yield the files that make packages of the folders of a file, except that of the project's own folder."""
    for folder in PurePosixPath(path).parents:
        if folder.parts and (root / folder / PACKAGE).exists():
            yield str(folder / PACKAGE)


def _imports(root: Path, path: str, content: bytes, origin: str) -> Iterator[str]:
    """Yield the files of the project that a file imports. Raises ConfigError if it imports others than by relative imports."""
    try:
        tree = ast.parse(content, path)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise PluginError(f"{origin}: {path} is not Python: {_in_words(error)}") from error
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for name in node.names:
                _refuse_own(root, path, name.name, node.lineno)
        elif isinstance(node, ast.ImportFrom):
            if node.level == 0:
                _refuse_own(root, path, node.module or "", node.lineno)
            else:
                yield from _relative(root, path, node)


def _relative(root: Path, path: str, node: ast.ImportFrom) -> Iterator[str]:
    """Yield the files that a relative import may load: the module, and those of its names that are modules."""
    above = PurePosixPath(path).parents
    if node.level > len(above):
        raise ConfigError(f"{path}, line {node.lineno}: a relative import leads out of the project; import files in it")
    module = above[node.level - 1].joinpath(*(node.module or "").split("."))
    if node.module:
        yield from _file_of(root, module)
    for name in node.names:
        files = list(_file_of(root, module / name.name))
        if not files and not module.parts and not (root / PACKAGE).exists():
            raise ConfigError(f"{path}, line {node.lineno}: there is no {name.name}.py in {root}; correct the import")
        yield from files


def _file_of(root: Path, module: PurePosixPath) -> Iterator[str]:
    """Yield the file of a module, if there is one: a package takes precedence, as in Python."""
    for name in (module / PACKAGE, module.with_name(f"{module.name}.py")):
        if (root / name).exists() or (root / name).is_symlink():
            yield str(name)
            return


def _refuse_own(root: Path, path: str, module: str, line: int) -> None:
    """Raise ConfigError if an absolute import finds, or seems to mean, a file of the project."""
    top = module.partition(".")[0]
    if top in sys.stdlib_module_names or top == plugin_registry.SIERRA:
        return
    try:
        spec = find_spec(top)
    except (ImportError, ValueError):
        spec = None
    places = [Path(file) for file in (spec.origin, *(spec.submodule_search_locations or ())) if file] if spec else []
    own = [file for file in places if _is_own(root, file)]
    if not own and not any(set(INSTALLED).intersection(file.parts) for file in places):
        folders = dict.fromkeys((PurePosixPath(path).parent, PurePosixPath()))
        own = [root / name for folder in folders for name in _file_of(root, folder / top)]
    if own:
        shown = own[0].relative_to(root) if own[0].is_relative_to(root) else own[0]
        raise ConfigError(
            f"{path}, line {line}: imports {module!r}, which is {shown} of the project; only relative imports of its files are "
            f"recorded with the plug-in: write it as in `from . import {top}`"
        )


def _is_own(root: Path, file: Path) -> bool:
    """Check whether a module's file belongs to the project, and not to a virtual environment in it."""
    file = file.resolve()
    return file.is_relative_to(root) and not set(INSTALLED).intersection(file.relative_to(root).parts)


# The modules


def _register(root: Path, content: Mapping[str, bytes]) -> str:
    """Make the modules of these files importable; return the name of the package that stands for the project's folder."""
    hashes = {path: sha256(data) for path, data in content.items()}
    package = PREFIX + digest("plugins", {"root": str(root), "files": hashes})[:32]
    if content and package not in _modules:
        if _finder not in sys.meta_path:
            sys.meta_path.append(_finder)
        _modules[package] = _Module(root / PACKAGE, b"", is_package=True)
        for path, data in content.items():
            for folder in PurePosixPath(path).parents:
                if folder.parts:
                    name = f"{package}.{'.'.join(folder.parts)}"
                    _modules.setdefault(name, _Module(root / folder / PACKAGE, b"", is_package=True))
            _modules[f"{package}.{_dotted(path)}"] = _Module(root / path, data, PurePosixPath(path).name == PACKAGE)
    return package


def _dotted(path: str) -> str:
    """Return the name of a file's module in the package of the project."""
    pure = PurePosixPath(path)
    return ".".join(pure.parent.parts if pure.name == PACKAGE else pure.with_suffix("").parts)


def _imported(name: str, root: Path, path: str) -> ModuleType:
    """Import a module. Raises PluginError if that fails, or if it loads other files of the project."""
    before = set(sys.modules)
    try:
        __import__(name)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # a plug-in may raise what it likes, such as SystemExit
        raise PluginError(f"[plugins]: {path} cannot be imported: {_in_words(error)}; correct it") from error
    finally:
        loaded = {added: _file(added) for added in sys.modules.keys() - before if _is_foreign(root, added)}
        for added in loaded:
            del sys.modules[added]
    loaded |= {known: _file(known) for known in _modules_in(sys.modules[name]) if _is_foreign(root, known)}
    if loaded:
        for added in [added for added in sys.modules if added.startswith(name.partition(".")[0])]:
            del sys.modules[added]  # so that the next use fails too
        first = min(loaded)
        raise PluginError(
            f"[plugins]: {path} has loaded {loaded[first]} by other means than relative imports, so that it is not recorded "
            f"with the plug-in; write it as in `from . import {first.rpartition('.')[2]}`"
        )
    return sys.modules[name]


def _modules_in(module: ModuleType) -> set[str]:
    """Return the names of the modules in a module, and of those that its classes and functions come from."""
    values = list(vars(module).values())
    modules = {value.__name__ for value in values if isinstance(value, ModuleType)}
    return modules | {str(value.__module__) for value in values if isinstance(value, type | FunctionType)}


def _file(name: str) -> str:
    return str(getattr(sys.modules.get(name), "__file__", ""))


def _is_foreign(root: Path, name: str) -> bool:
    """Check whether a module is of a file of the project, and was not made here."""
    file = _file(name)
    return bool(file) and not name.startswith((PREFIX, f"{plugin_registry.SIERRA}.")) and _is_own(root, Path(file))


def _in_words(error: BaseException) -> str:
    """Return an error in one line, without the names that modules have here."""
    text = " ".join(f"{type(error).__name__}: {error}".split())
    return re.sub(rf"{PREFIX}[0-9a-f]+\.?", "", text)


class _Finder:
    """The importer of these modules: an object of `sys.meta_path`, and the loader."""

    def find_spec(self, name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        module = _modules.get(name) if name.startswith(PREFIX) else None
        if module is None:
            return None
        spec = spec_from_loader(name, self, origin=str(module.file), is_package=module.is_package)  # type: ignore[arg-type]
        if spec is not None:
            spec.has_location = bool(module.content)
        return spec

    def create_module(self, spec: ModuleSpec) -> None:
        """Let Python create the module."""

    def exec_module(self, module: ModuleType) -> None:
        exec(self.get_code(module.__name__), vars(module))  # noqa: S102 - the project's own code, as with any import

    def get_code(self, name: str) -> CodeType:
        module = _modules[name]
        return compile(module.content, str(module.file), "exec", dont_inherit=True)


_finder = _Finder()

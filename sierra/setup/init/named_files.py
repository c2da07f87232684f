"""The files of a project that a template names: further templates, and files that lie beside the inputs of runs.

Simulators resolve names in a configuration from its own folder, and so do names here. A named file is a further template if it
is a small document with numbers that SIERRA can change. Names of outputs are left out.
"""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from sierra.errors import SierraError
from sierra.model import IN_PROJECT
from sierra.provenance import referenced_files
from sierra.setup.init import variables
from sierra.setup.init.folder import TEMPLATES
from sierra.store.layout import CONFIG, RUN_NAMES
from sierra.templates.base import read
from sierra.util.lazy_definitions import dataclass, field, regex

AT_MOST = 12
"""The largest number of further templates; the files after them lie beside the inputs."""
MAX_SIZE = 1 << 16
"""The largest size in bytes of a further template; larger documents are data, such as maps."""
TREES = (
    *TEMPLATES,
    ".urdf",
    ".json",
    ".yaml",
    ".yml",
    ".toml",
    ".ini",
    ".properties",
)
"""The endings of documents that can be further templates, and that can name files themselves."""
DATA = regex(r".*\.(net|poly|taz|geo)\.\w+", re.I)
"""Documents that are data: networks and shapes."""
WRITTEN = regex(r"output|[/@_-](log|save|write|record)(?![a-z])|results?", re.I)
"""Paths in a document whose values name files that the program writes."""
LACKING = regex(r"no such file|not found|not exist|cannot (find|open|read|load)|could ?n.t|could not|unable to|fail", re.I)
"""Words of programs that lack a file."""
WALKED = 5_000
"""The largest number of files of a project that are compared with what a program says."""


@dataclass(frozen=True, slots=True)
class Inputs:
    """The files that runs read: one template, or several by name, and the files beside them."""

    template: str
    """The template that names the others, as a path relative to the project."""
    several: Mapping[str, str] = field(default_factory=dict)
    """All templates by name; empty if there is only one."""
    files: tuple[str, ...] = ()

    @property
    def paths(self) -> tuple[str, ...]:
        return tuple(self.several.values()) or (self.template,)

    @property
    def settings(self) -> dict[str, object]:
        """Return the settings in `sierra.toml`."""
        found: dict[str, object] = {"templates": dict(self.several)} if self.several else {"template": self.template}
        return found | ({"files": list(self.files)} if self.files else {})

    def placeholder(self, path: str) -> str:
        """Return what stands for a template in the command."""
        return next((f"{{input.{name}}}" for name, one in self.several.items() if one == path), "{input}")


def find(root: Path, template: str, others: Sequence[str] = (), *, alone: bool = False) -> Inputs:
    """Return a template and `others` together with the files that they name. `alone`: no named file is a further template."""
    further = list(others)
    files: list[str] = []
    for name in dict.fromkeys(name for path in (template, *others) for name in _reached(root, path)):
        is_template = not alone and len(further) < AT_MOST and can_change(root / name)
        if name not in (template, *others):
            (further if is_template else files).append(name)
    return Inputs(template, _names(root, (template, *further)) if further else {}, tuple(files))


def main(root: Path, candidates: Sequence[str]) -> str | None:
    """Return the only file that names others of these and that none of them names; None if there is no such file."""
    if len(candidates) > AT_MOST:
        return None
    named = {one: set(_reached(root, one)) & set(candidates) for one in candidates}
    tops = [one for one in candidates if not any(one in others for name, others in named.items() if name != one)]
    return tops[0] if len(tops) == 1 and named[tops[0]] else None


def by_command(root: Path, words: Sequence[str]) -> dict[int, str]:
    """Return the templates that the words of a command name as files, by the indices of the words."""
    templates: dict[int, str] = {}
    for number, word in enumerate(words[1:], 1):
        name = word.rpartition("=")[2].removeprefix(IN_PROJECT)
        inside = not name.startswith("/") and (root / name).is_file() and not os.path.normpath(name).startswith(os.pardir)
        if inside and name.endswith(TREES) and can_change(root / name):
            templates[number] = os.path.normpath(name)
    return templates


def _reached(root: Path, template: str) -> list[str]:
    """Return all files that a template names, and those that they name."""
    reached: dict[str, None] = {template: None}
    pending = [template]
    while pending:
        for name in _named(root, pending.pop(0)):
            if name not in reached:
                reached[name] = None
                pending += [name] if name.endswith(TREES) else []
    return [name for name in reached if name != template]


def _named(root: Path, name: str) -> Iterator[str]:
    """Yield the files of the project that one file names, relative to the project."""
    root = root.resolve()
    file = root / name
    values = _values(file)
    words = dict.fromkeys(
        (*referenced_files.relative_names(file, (), root), *(word for words in values.values() for word in words))
    )
    written = {word for path, words in values.items() if WRITTEN.search(path) for word in words}
    for word in words:
        path = os.path.normpath(os.path.relpath(file.parent / word, root))
        first = path.split("/")[0]
        usual = not first.startswith(".") and first not in RUN_NAMES and path != CONFIG
        if usual and word not in written and _is_file(root / path) and (root / path).resolve() == root / path:
            yield path


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # a text that cannot be a name
        return False


def _values(file: Path) -> Mapping[str, list[str]]:
    """Return the words in the values of a document that may be names of files, by the path of the value."""
    try:
        found = read(file).attributes()
    except SierraError:
        return {}
    return {path: [word for word in re.split(r"[,;\s]+", value) if "." in word or "/" in word] for path, value in found}


def can_change(file: Path) -> bool:
    """Check if a file is a small document with numbers."""
    if not file.name.endswith(TREES) or DATA.fullmatch(file.name) or file.stat().st_size > MAX_SIZE:
        return False
    try:
        return bool(variables.numbers(read(file)))
    except SierraError:
        return False


def _names(root: Path, paths: Sequence[str]) -> Mapping[str, str]:
    """Return the paths of templates by names that changes can use: the part of the file's name that tells them apart."""
    stems = [Path(path).name.split(".")[0] for path in paths]
    by_name: dict[str, str] = {}
    for path, stem in zip(paths, stems, strict=True):
        parts = Path(path).name.split(".")
        likely = (*([stem] if stems.count(stem) == 1 else []), *parts[1:], stem)
        by_name[next(name for name in _usable(root / path, likely) if name not in by_name)] = path
    return by_name


def _usable(file: Path, likely: Iterable[str]) -> Iterator[str]:
    """Yield names for a template that are no prefixes of names in it; the likely ones first, then numbered ones."""
    content = referenced_files.text(file)
    plain = [re.sub(r"\W", "_", name, flags=re.ASCII) for name in likely]
    usable = [name for name in plain if variables.NAME.fullmatch(name) and not re.search(rf"xmlns:{name}\s*=", content)]
    yield from usable
    number = 1
    while True:
        yield f"template_{number}"
        number += 1


def lacking(root: Path, log: str, known: Collection[str], code: Collection[str]) -> tuple[str, ...]:
    """Return the files of the project that a program's last words name, if they say that a file is missing.

    `known` are files that runs have already. Files with an ending in `code` are programs, which error messages name anyway.
    """
    lines = [line for line in log.splitlines() if LACKING.search(line)]
    names = {word.strip(".,:;()[]'\"`") for line in lines for word in re.split(r"[\s'\"`<>=]+", line)}
    bases = {os.path.basename(name) for name in names if "." in name or "/" in name}  # noqa: PTH119
    files = [path for path in _files(root) if os.path.basename(path) in bases and path not in known]  # noqa: PTH119
    return tuple(path for path in files if Path(path).suffix not in code)


def _files(root: Path) -> Iterator[str]:
    """Yield the files of the project that could lie beside the inputs, as paths relative to it."""
    number = 0
    for folder, folders, files in os.walk(root):
        here = Path(folder)
        top = here == root
        folders[:] = sorted(n for n in folders if not n.startswith(".") and n != "__pycache__" and not (top and n in RUN_NAMES))
        for name in sorted(files):
            number += 1
            if number > WALKED:
                return
            path = here / name
            if not name.startswith(".") and not path.is_symlink() and not (top and name == CONFIG):
                yield str(path.relative_to(root))

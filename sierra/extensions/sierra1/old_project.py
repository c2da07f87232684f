"""The files of a project of SIERRA 1.x, read as data: nothing of it is executed or imported.

YAML is read by a safe reader with limits. Of Python files and scripts, only texts that match fixed patterns are taken: names of
scenarios, attributes that criteria change, and options on command lines. Links are not followed out of the folder.
"""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path

from sierra.errors import Missing, UsageError
from sierra.extensions.sierra1.yaml_values import Plain, values
from sierra.util.lazy_definitions import dataclass, regex
from sierra.util.regular_files import open_regular

CONTROLLERS = "config/controllers.yaml"
MOST_FILES = 5000
LARGEST = 1_000_000
"""Maximum number of files that are looked at, and of bytes of a file that is read."""
LEFT_OUT = {".git", ".sierra", "build", "node_modules", "__pycache__", ".venv", "venv"}
SCRIPTS = (".sh", ".rc", ".bash", "rc")
_SCENARIO = regex(r"""["']([A-Z][A-Za-z0-9_]{0,60})["']\s*:|^class\s+(?!Base)([A-Z][A-Za-z0-9_]{0,60}?)Generator\b""", re.M)
_CHANGE = regex(r"""\bAttrChange\(\s*(["'])([^"'\n\\]{1,200})\1\s*,\s*(["'])([\w:.-]{1,80})\3""")
_CALL = regex(r"(?:^|[\s;&|(])sierra(?:-cli)?[ \t]+(?=[-\\])(.*)$", re.M)


@dataclass(frozen=True, slots=True)
class Call:
    """The options of one call of the old program, in a script or a file of settings, each with its values."""

    origin: str
    options: Mapping[str, tuple[str, ...]]

    def first(self, *names: str) -> str | None:
        """Return the first value of the first of these options that is given."""
        return next((self.options[name][0] for name in names if self.options.get(name)), None)


@dataclass(frozen=True, slots=True)
class OldProject:
    """The parts of an old project that are read."""

    root: Path
    """The folder that was given."""
    folder: Path
    """The folder with `config`."""
    settings: Mapping[str, Plain]
    """The content of the YAML files in `config`, by the files' names."""
    scenarios: tuple[str, ...]
    variables: Mapping[str, tuple[tuple[str, str], ...]]
    """By name of a criterion of the project: path and attribute of each change that its file writes literally."""
    calls: tuple[Call, ...]
    templates: tuple[Path, ...]
    """Files that may be the template."""

    def section(self, file: str) -> Mapping[str, Plain]:
        found = self.settings.get(file, {})
        return found if isinstance(found, dict) else {}


def read(root: Path) -> OldProject:
    """Return an old project. Raises Missing if there is none in the folder, UsageError if there are several."""
    if not root.is_dir():
        raise Missing(f"{root} is not a folder; give the folder of a project of SIERRA 1.x")
    files = tuple(_files(root))
    folders = sorted({file.parent.parent for file in files if file.parent.name == "config" and file.suffix == ".yaml"})
    if not folders:
        raise Missing(f"{root}: there is no config/*.yaml; give the folder of a project of SIERRA 1.x, which has {CONTROLLERS}")
    if len(folders) > 1:
        named = ", ".join(str(folder) for folder in folders[:8])
        raise UsageError(f"{root} has several projects; give one of {named}")
    own = [file for file in files if folders[0] in file.parents]
    return OldProject(
        root=root,
        folder=folders[0],
        settings={file.name: _yaml(file) for file in own if file.suffix == ".yaml" and file.parent.name == "config"},
        scenarios=tuple(_scenarios(own)),
        variables=dict(_variables(own)),
        calls=tuple(_calls(files)),
        templates=tuple(file for file in files if file.suffix == ".argos" and _is_template(file)),
    )


def _files(root: Path) -> Iterator[Path]:
    """Yield the regular files below a folder, in the order of their names. Raises UsageError if there are too many."""
    count = 0
    for folder, below, names in os.walk(root):
        below[:] = sorted(name for name in below if name not in LEFT_OUT)
        for name in sorted(names):
            count += 1
            if count > MOST_FILES:
                raise UsageError(f"{root} has more than {MOST_FILES} files; give the folder of the project alone")
            path = Path(folder, name)
            if path.is_file() and not path.is_symlink():
                yield path


def _content(path: Path) -> bytes:
    """Return a file's content. Raises Missing if it cannot be read, UsageError if it is too large."""
    try:
        with open_regular(path) as file:
            content = file.read(LARGEST + 1)
    except OSError as error:
        raise Missing(f"{path}: cannot be read: {error.strerror}") from error
    if len(content) > LARGEST:
        raise UsageError(f"{path}: more than {LARGEST} bytes, which is too large for settings")
    return content


def _yaml(path: Path) -> Plain:
    return values(_content(path), str(path))


def _text(path: Path) -> str:
    return _content(path).decode(errors="replace")


def _is_template(path: Path) -> bool:
    return path.stat().st_size <= LARGEST and b"__CONTROLLER__" in _content(path)


def _scenarios(files: list[Path]) -> Iterator[str]:
    seen: set[str] = set()
    for file in files:
        if file.parent.name == "generators" and file.suffix == ".py" and file.name.startswith("scenario"):
            for match in _SCENARIO.finditer(_text(file)):
                name = match[1] or match[2]
                if name not in seen:
                    seen.add(name)
                    yield name


def _variables(files: list[Path]) -> Iterator[tuple[str, tuple[tuple[str, str], ...]]]:
    for file in files:
        if file.parent.name == "variables" and file.suffix == ".py" and not file.name.startswith("_"):
            found = {(match[2], match[4]): None for match in _CHANGE.finditer(_text(file))}
            yield file.stem, tuple(found)


def _calls(files: tuple[Path, ...]) -> Iterator[Call]:
    for file in files:
        if not file.name.endswith(SCRIPTS) or file.stat().st_size > LARGEST:
            continue
        text = _text(file).replace("\\\n", " ")
        if file.suffix not in (".sh", ".bash"):
            lines = [line.strip() for line in text.splitlines() if line.strip().startswith("--")]
            yield from _call(file.name, " ".join(lines))
        for match in _CALL.finditer(text):
            yield from _call(file.name, match[1])


def _call(origin: str, line: str) -> Iterator[Call]:
    """Yield the options of a command line, if a shell could read it; variables of the shell are not values."""
    try:
        words = shlex.split(line, comments=True)
    except ValueError:
        return
    options: dict[str, list[str]] = {}
    current: list[str] = []
    for word in words:
        if re.fullmatch(r"[;&|<>].*", word):
            break
        if word.startswith("--"):
            name, separator, value = word[2:].partition("=")
            current = options.setdefault(name, [])
            if separator:
                current.append(value)
        elif "$" not in word:
            current.append(word)
    if options:
        yield Call(origin, {name: tuple(given) for name, given in options.items()})

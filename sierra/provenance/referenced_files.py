"""Files outside the source that a command, a variable or a template names; they are fingerprinted like programs.

Such files are ignored by git, or lie outside the project, possibly through a link. A command or a variable names a file or a
folder by `{project}/…`, and a file by its absolute path. Of a folder, all files are included; but if a variable is a search
path of libraries, only libraries are, because a build leaves logs and caches beside them. A template names a file if
one of its attributes or texts is the file's path. The path may be absolute, or relative to the project's root, to the
template's folder, or to a folder that the template also names (`meshdir`). A named file that is itself a model or a
configuration is searched in the same way.
"""

from __future__ import annotations

import html
import itertools
import os
import re
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from sierra.config import extensions
from sierra.errors import Missing
from sierra.model import IN_PROJECT
from sierra.provenance.dependency_model import NOTHING, Kind, Program, Programs
from sierra.provenance.hash_cache import HashCache
from sierra.util.lazy_definitions import regex
from sierra.util.regular_files import open_regular

LIBRARY = regex(r".*\.so(?:\.\d\w*)*")
"""The names of shared libraries, such as `libssl.so.1.0.2k`."""
LIBRARY_PATHS = tuple(name for name, use in extensions.every("variables").items() if use == "libraries")
"""Variables of runs that are search paths: programs use only libraries in the folders that they name."""
MAX_LENGTH = 4096
MAX_SIZE = 10**9
"""Maximum size in bytes of a file that a template names; larger files are not hashed."""
SEARCHED = (".xml", ".urdf", ".xacro", ".mjcf", ".json", ".yaml", ".yml", ".toml", *extensions.every("inputs"))
MAX_SEARCHED = 1 << 24
"""Maximum number of bytes of the template, or of such a file, that are searched for names."""
LETTER = regex(r"[^\W\d_]")
TAG = regex(r"""<[/?!]?[^\s<>"'/=]+""")
"""The beginning of a tag in XML, with its name."""


def files(
    words: Iterable[str],
    root: Path,
    source: Container[bytes],
    texts: Programs = NOTHING,
    project: Path | None = None,
    *,
    searched: Iterable[str] = (),
) -> Programs:
    """Return the files that the words of a command and the values of variables name, and those in `texts`.

    `texts` has the files that were already found in the template. The code lies in `root`. Paths outside it
    (`{project}/../data`) are relative to the user's `project`. `searched` are the values of search paths of libraries.
    """
    by_path, digests = {}, HashCache()
    named = _files_of(words, root, project or root)
    libraries = (path for path in _files_of(searched, root, project or root) if LIBRARY.fullmatch(path.name))
    for path in itertools.chain(named, libraries):
        if not _holds(source, path, root):
            by_path[str(path)] = _file(path, root, digests)
    digests.save()
    return Programs((*by_path.values(), *(file for file in texts.all if file.path not in by_path)), texts.notes)


def _files_of(words: Iterable[str], root: Path, project: Path) -> Iterator[Path]:
    for word in words:
        yield from _named(word.replace(f"{root}/", IN_PROJECT), root, project.resolve())


def is_in_library_folder(name: str, variables: Mapping[str, str]) -> bool:
    """Check whether a file (`{project}/…`) is below a folder of the project that a search path of libraries names."""
    searched = (folder for variable in LIBRARY_PATHS for folder in re.split("[:;,=]", variables.get(variable, "")))
    return any(name.startswith(f"{folder.rstrip('/')}/") for folder in searched if folder.startswith(IN_PROJECT))


def _named(word: str, root: Path, project: Path) -> Iterator[Path]:
    for inside in re.findall(r"\{project\}/([^:;,=]+)", word):
        yield from _files(Path(os.path.normpath(project / inside)) if inside.split("/")[0] == ".." else root / inside)
    for absolute in re.findall(r"(?:^|[:;,=])(/[^:;,=]+)", word):
        if Path(absolute).is_file():
            yield Path(absolute)


def _files(path: Path) -> Iterator[Path]:
    if path.is_file():
        yield path
    elif path.is_dir():
        yield from sorted(below for below in path.rglob("*") if below.is_file() and "__pycache__" not in below.parts)


def data(
    templates: Sequence[Path], texts: Iterable[str], root: Path, source: Container[bytes], without: Iterable[str]
) -> Programs:
    """Return the files that templates or their inserted `texts` name, except those in `without`, relative to the root."""
    left = [root / path for path in without]
    digests = HashCache()
    programs: dict[Path, Program] = {}
    notes: dict[Path, str] = {}
    inserted = "\n".join(texts)
    for path in itertools.chain.from_iterable(_all_named(template, inserted, root, left) for template in templates):
        if path in programs or path in notes or _holds(source, path, root):
            continue
        try:
            if path.stat().st_size > MAX_SIZE:
                raise Missing(f"{path} is larger than 1 GB")
            programs[path] = _file(path, root, digests)
        except (Missing, OSError) as error:
            notes[path] = f"{error}: the template names it, but changes to it are not detected"
    digests.save()
    return Programs(tuple(programs[path] for path in sorted(programs)), tuple(notes.values()))


def named_by_values(
    values: Iterable[str], templates: Sequence[Path], root: Path, source: Container[bytes], used: Programs
) -> list[Path]:
    """Return the files that values of a query name, and that are neither in the source nor among the used files.

    They are not part of the fingerprint. Otherwise a batch with one more value would execute again all runs that it has in
    common with another batch.
    """
    known = {program.path for program in used.all}
    paths = dict.fromkeys(_existing(values, dict.fromkeys((root, *(template.parent for template in templates)))))
    return [path for path in paths if str(path) not in known and not _holds(source, path, root)]


def relative_names(template: Path, texts: Iterable[str], root: Path) -> list[str]:
    """Return the relative paths by which a template, or a text inserted into it, names files of the project."""
    words = list(_words("\n".join((text(template), *texts))))
    folders = [folder for word in words if _is(Path.is_dir, folder := template.parent / word)]
    relative = [word for word in words if not word.startswith("/")]
    return [word for word in relative if any(_existing([word], (template.parent, root, *folders)))]


def existing(names: Iterable[str], root: Path) -> Programs:
    """Return the recorded files with these names that exist now: below `{project}/…`, or at their old paths."""
    digests = HashCache()
    paths = (Path(name.replace("{project}", str(root), 1)) for name in names)
    found = [_file(path, root, digests) for path in paths if path.is_absolute() and path.is_file()]
    digests.save()
    return Programs(tuple(found))


def _all_named(template: Path, texts: str, root: Path, without: Sequence[Path]) -> Iterator[Path]:
    """Yield all existing files that a template names, or files that it includes name, except those in `without`."""
    pending, read = [(template, text(template).replace("{{project}}/", "") + "\n" + texts)], {template}
    while pending:
        origin, content = pending.pop()
        words = list(_words(content))
        folders = [folder for word in words if _is(Path.is_dir, folder := origin.parent / word)]
        for path in _existing(words, (root, origin.parent, *folders)):
            if any(path.is_relative_to(left) for left in without):
                continue
            yield path
            if path.suffix.lower() in SEARCHED and path not in read:
                read.add(path)
                pending.append((path, text(path)))


def text(path: Path) -> str:
    """Return the beginning of a file's text; its length is bounded, because the file may be hostile."""
    try:
        with open_regular(path) as file:
            return file.read(MAX_SEARCHED).decode("utf-8", "replace")
    except OSError:
        return ""


def _existing(words: Iterable[str], folders: Iterable[Path]) -> Iterator[Path]:
    """Yield the files with these names in one of the folders. A file name must contain a dot or a slash."""
    for word in words:
        for folder in folders if "." in word or "/" in word else ():
            path = Path(os.path.normpath(folder / word))
            if _is(Path.is_file, path) and path.parts[1] not in ("proc", "sys", "dev"):
                yield path


def _is(kind: Callable[[Path], bool], path: Path) -> bool:
    """Return True if the path exists with this kind; names that are too long or forbidden do not exist."""
    try:
        return kind(path)
    except (OSError, ValueError):
        return False


def _words(text: str) -> Iterator[str]:
    """Yield each text with a letter that may be a path: attributes, texts and their parts, but no tags (`</x>`)."""
    tagless = TAG.sub("<", re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL))
    pieces = (html.unescape(piece).strip() for piece in dict.fromkeys(re.split(r"[\"'<>\n]", tagless)))
    for word in dict.fromkeys(part for piece in pieces for part in (piece, *piece.split())):
        if len(word) <= MAX_LENGTH and "\0" not in word and LETTER.search(word):
            yield word.removeprefix("file://")


def _holds(source: Container[bytes], path: Path, root: Path) -> bool:
    relative = path.relative_to(root) if path.is_relative_to(root) else path
    outside = not path.resolve().is_relative_to(root.resolve())
    return not outside and os.fsencode(relative.as_posix()) in source


def _file(path: Path, root: Path, digests: HashCache) -> Program:
    name = f"{{project}}/{path.relative_to(root)}" if path.is_relative_to(root) else str(path)
    return Program(name, str(path), digests.of(str(path)), Kind.FILE)

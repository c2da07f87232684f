"""Definitions of messages in files of a project: `PACKAGE/msg/NAME.msg`, as packages of ROS have them.

Their texts are part of the rules by which a bag is read, and are recorded with these, so that a changed file never leaves a
table as it was. The name of a package is that in its `package.xml`, or else that of its folder.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from sierra.errors import SierraError
from sierra.util.lazy_definitions import regex
from sierra.util.regular_files import read_regular_text

TYPE = regex(r"[A-Za-z][A-Za-z0-9_]*/msg/[A-Za-z][A-Za-z0-9_]*")
FILES, BYTES, ALL = 2_000, 1 << 16, 1 << 20
"""The limits on the files of an output, on the bytes of one, and on those of all."""


def texts(root: Path, folders: Iterable[str]) -> Mapping[str, str]:
    """Return the definitions in the packages in these folders of the project, by the names of their types.

    Raises ValueError, in one line, if a folder has none, or if a file cannot be read.
    """
    known: dict[str, tuple[str, str]] = {}
    size = 0
    for folder in folders:
        paths = sorted((root / folder).glob("*/msg/*.msg"))
        if not paths:
            raise ValueError(f"messages: the folder {folder!r} has no files PACKAGE/msg/NAME.msg")
        packages = {path.parents[1]: _package(path.parents[1], root) for path in paths[:FILES]}
        for path in paths:
            text, file = _text(path, root), str(path.relative_to(root))
            size += len(text)
            if len(known) >= FILES or size > ALL:
                raise ValueError(
                    f"messages: the folders have more than {FILES} files, or {ALL} bytes; name one with fewer packages"
                )
            name = f"{packages[path.parents[1]]}/msg/{path.stem}"
            if not TYPE.fullmatch(name):
                raise ValueError(f"messages: {file}: {name!r} is not the name of a type, such as my_msgs/msg/State")
            first, other = known.setdefault(name, (text, file))
            if first != text:
                raise ValueError(f"messages: {other} and {file} define the type {name!r} differently")
    return {name: text for name, (text, _) in known.items()}


def _package(folder: Path, root: Path) -> str:
    """Return the name of the package in a folder."""
    file = folder / "package.xml"
    if not file.exists():
        return folder.name
    from sierra.templates import xml_view

    text = _text(file, root)
    try:
        name: str | None = xml_view.parse(text.encode(), str(file.relative_to(root))).getroot().findtext("name")
    except SierraError as error:
        raise ValueError(f"messages: {error}") from error
    if not name or not name.strip():
        raise ValueError(f"messages: {file.relative_to(root)} does not name its package; write <name>PACKAGE</name>")
    return name.strip()


def _text(path: Path, root: Path) -> str:
    try:
        if path.stat().st_size > BYTES:
            raise ValueError(f"messages: {path.relative_to(root)} has more than {BYTES} bytes")
        return read_regular_text(path)
    except (OSError, UnicodeDecodeError) as error:
        why = (error.strerror or str(error)) if isinstance(error, OSError) else "it is not UTF-8 text"
        raise ValueError(f"messages: cannot read {path.relative_to(root)}: {why}") from error

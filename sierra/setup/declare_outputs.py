"""Declarations of outputs that are added to a project's file; all else in the file stays as it is, byte for byte."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from sierra.config import project_file
from sierra.config.find_project import ProjectFolder
from sierra.config.project_file_changes import replace_content
from sierra.errors import Missing, UsageError
from sierra.store.layout import PYPROJECT
from sierra.util.regular_files import read_regular

if TYPE_CHECKING:
    from tomlkit import TOMLDocument
    from tomlkit.items import Item, Table

Keys = Mapping[str, str | bool | int | Sequence[str] | Mapping[str, str]]


def write(folder: ProjectFolder, outputs: Mapping[str, Keys], comments: Mapping[str, str], target: str | None = None) -> None:
    """Add `[outputs.NAME]` for each of these outputs, with its comment, to the project's file, or to a target there.

    Raises Missing if there is no such file, or if it cannot be written; UsageError if its form does not allow the addition.
    """
    if not outputs:
        return
    if not folder.written:
        raise Missing(f"no {folder.file.name} in {folder.root}; create one with: sierra init")
    settings = ("tool", "sierra") if folder.file.name == PYPROJECT else ()
    within = ("targets", target) if target else ()
    try:
        before = read_regular(folder.file)
    except OSError as error:
        raise Missing(f"{folder.file}: {error.strerror}") from error
    after = _added(before.decode(), outputs, comments, (*settings, *within))
    if not _only_added(before.decode(), after, outputs, settings, within):
        lines = "; ".join(_lines(outputs, within))
        raise UsageError(f"{folder.file}: outputs cannot be added to it as it is; add these lines: {lines}")
    replace_content(folder.file, before, after.encode())


def _added(before: str, outputs: Mapping[str, Keys], comments: Mapping[str, str], names: tuple[str, ...]) -> str:
    """Return the file's text with the outputs; `names` are those of the tables that they are in."""
    import tomlkit
    from tomlkit.exceptions import TOMLKitError

    document = tomlkit.parse(before)
    try:
        section = _section(document, names)
        if "outputs" not in section:
            section.add("outputs", tomlkit.table(is_super_table=True))
        for name, keys in outputs.items():
            section["outputs"].add(name, _table(keys, comments[name]))
    except (TOMLKitError, AttributeError, LookupError, TypeError, ValueError):
        return before
    return tomlkit.dumps(document)


def _section(document: TOMLDocument, names: tuple[str, ...]) -> TOMLDocument | Table:
    place: TOMLDocument | Table = document
    for name in names:
        place = place[name]
    return place


def _table(keys: Keys, comment: str) -> Table:
    import tomlkit

    table = tomlkit.table()
    table.add(tomlkit.comment(" ".join(comment.split())))
    for key, value in keys.items():
        table.add(key, _item(value))
    return table


def _item(value: object) -> Item:
    """Return a value as TOML, in one line."""
    import tomlkit

    if not isinstance(value, Mapping):
        return tomlkit.item(value)
    table = tomlkit.inline_table()
    table.update(value)
    return table


def _only_added(
    before: str, after: str, outputs: Mapping[str, Keys], settings: tuple[str, ...], within: tuple[str, ...]
) -> bool:
    """Check that all lines are still there in their order, and that the settings differ only by these outputs."""
    rest = iter(after.splitlines())
    if not all(line in rest for line in before.splitlines()):
        return False
    try:
        old, new = ({**tomllib.loads(text)} for text in (before, after))
        for name in settings:
            old, new = old[name], new[name]
        project_file.parse(new, "sierra.toml")
        section = old
        for name in within:
            section = section[name]
        section["outputs"] = {**section.get("outputs", {}), **outputs}
    except (ValueError, LookupError, TypeError):
        return False
    return bool(new == old)


def _lines(outputs: Mapping[str, Keys], within: tuple[str, ...]) -> Iterator[str]:
    import tomlkit

    before = "".join(f"{name}." for name in within)
    for name, keys in outputs.items():
        values = ", ".join(f"{key} = {_item(value).as_string()}" for key, value in keys.items())
        yield f"[{before}outputs.{tomlkit.key(name).as_string()}] {values}"

"""The claim about a value that is written into a template, for readers that share no code with SIERRA."""

from __future__ import annotations

import re
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass

from sierra.config.plugin_registry import TEMPLATES
from sierra.errors import TemplateError
from sierra.model import Set
from sierra.templates.base import Template

Values = Mapping[Hashable, object]
"""The values that a reader reads, by their places."""
Reader = Callable[[bytes], Values]


@dataclass(frozen=True, slots=True)
class Document:
    """A file of a format."""

    format: str
    data: bytes
    paths: tuple[str, ...] = ()
    """Paths to set besides those that SIERRA proposes; each selects at most one value."""

    @property
    def template(self) -> Template:
        template: Template = TEMPLATES.make(self.format, {}, self.data, "template")
        return template


def check(document: Document, choice: int, value: str, readers: Mapping[str, Reader], refused: str) -> None:
    """Set one of the values of a document, and compare what readers read before and after.

    A reader that cannot read the document is left out. `refused` is the pattern of messages that may refuse the document, or
    the value, before anything executes.
    """
    try:
        template = document.template
    except TemplateError as error:
        _check_message(error, refused)
        return
    found = [*template.attributes(), *((path, *template.find(path)) for path in document.paths if template.find(path))]
    if not found:
        return
    path, was = found[choice % len(found)]
    try:
        kept = template.changed([Set(path, _literal(was))], {}).render()
        assert kept == document.data, f"{path} set to itself, {was!r}, changes the file"
        made = template.changed([Set(path, _literal(value))], {}).render()
    except TemplateError as error:
        _check_message(error, refused)
        return
    assert template.changed((), {}).per_run([Set(path, "{v}")])({"v": value}) == made, "other bytes per run"
    assert isinstance(made, bytes)
    for name, read in readers.items():
        compare(name, read, document.data, made, was, value)


def compare(name: str, read: Reader, data: bytes, made: bytes, was: str, value: str) -> None:
    """Check that a reader reads the new value in one place, and in all others what it read before."""
    try:
        before = read(data)
    except Exception:  # the reader does not know this notation
        return
    after = read(made)
    assert list(before) == list(after), f"{name}: other places: {made!r}"
    different = [place for place in before if not _same(before[place], after[place])]
    if not different:
        equal = any(is_read_as(one, was) and is_read_as(one, value) for one in after.values())
        assert made == data or equal, f"{name} reads nothing new: {made!r}"
        return
    [place] = different
    old = before[place]
    old = old.replace("\r\n", "\n").rstrip(" \t\f") if isinstance(old, str) else old
    assert is_read_as(old, was.replace("\r\n", "\n").rstrip(" \t\f")), f"{name}: {old!r} was changed, not {was!r}"
    assert is_read_as(after[place], value), f"{name}: {after[place]!r} is read, not {value!r}"


def is_read_as(read: object, written: str) -> bool:
    """Return True if a value of a reader is the value that SIERRA wrote."""
    if isinstance(read, bool):
        return str(read).lower() == written.lower()
    if isinstance(read, str):
        return read == written
    try:
        return read == int(written) if isinstance(read, int) else read == float(written)
    except ValueError:
        return str(read) == re.sub("[Tt ]", " ", written).replace("Z", "+00:00").replace("z", "+00:00")


def _same(one: object, other: object) -> bool:
    return type(one) is type(other) and (one == other or one != one)


def _literal(text: str) -> str:
    return text.replace("{", "{{").replace("}", "}}")


def _check_message(error: TemplateError, refused: str) -> None:
    """Check that a refusal is one line, for one of the known reasons."""
    if "\n" in str(error) or not re.search(refused, str(error)):
        raise AssertionError(f"refused: {error}") from error

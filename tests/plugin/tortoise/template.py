"""The template format `conf`: lines such as `speed = 2.5`. A path is a name."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from typing import ClassVar

from pydantic import Field

from sierra.plugin import Change, ConfigError, Rendered, Renderer, Set, Table, TemplateError, Value, fill

LINE = re.compile(r"\s*([A-Za-z_][A-Za-z0-9_.]*)\s*=(.*)")


class ConfOptions(Table):
    """The options of `conf` files."""

    comment: str = Field("#", min_length=1, max_length=1, description="the character that begins a line that is a comment")


class Conf:
    """A `conf` file as a template, and as a document after changes: it is both."""

    contract = 1
    Options: ClassVar[type[Table]] = ConfOptions

    def __init__(self, data: bytes, name: str, options: ConfOptions) -> None:
        self.sha256 = hashlib.sha256(data).hexdigest()
        self._name = name
        self._options = options
        try:
            self._lines = data.decode("utf-8").split("\n")
        except UnicodeDecodeError as error:
            raise TemplateError(f"{name}: not UTF-8: {error}") from error
        self._places: dict[str, int] = {}
        for place, line in enumerate(self._lines):
            if line.strip() and not line.lstrip().startswith(options.comment):
                self._places[self._key(line, place)] = place

    def _key(self, line: str, place: int) -> str:
        found = LINE.fullmatch(line)
        if found is None:
            raise TemplateError(f"{self._name}: line {place + 1} is not NAME = VALUE")
        if found[1] in self._places:
            raise TemplateError(f"{self._name}: line {place + 1}: {found[1]} is there twice")
        return found[1]

    def reread(self, rendered: Rendered, name: str) -> Conf:
        if not isinstance(rendered, bytes):
            raise TemplateError(f"{name}: a conf file is one file, not {len(rendered)}")
        return Conf(rendered, name, self._options)

    def find(self, path: str) -> tuple[str, ...]:
        place = self._places.get(path)
        return () if place is None else (self._lines[place].partition("=")[2].strip(),)

    def attributes(self) -> tuple[tuple[str, str], ...]:
        return tuple((name, self.find(name)[0]) for name in self._places)

    def changed(self, changes: Sequence[Change], values: Mapping[str, Value]) -> Conf:
        lines = list(self._lines)
        for change in changes:
            place = self._place(change)
            lines[place] = f"{change.path} = {self._value(change, values)}"
        return Conf("\n".join(lines).encode(), self._name, self._options)

    def render(self) -> bytes:
        return "\n".join(self._lines).encode()

    def per_run(self, changes: Sequence[Change]) -> Renderer:
        for change in changes:
            self._place(change)
        return lambda values: self.changed(changes, values).render()

    def _place(self, change: Change) -> int:
        """Return the number of the line that a change sets."""
        if not isinstance(change, Set) or change.attribute is not None:
            raise TemplateError(f"{self._name}: {change.why}: {change.path!r}: values of a conf file can only be set")
        if change.path not in self._places:
            raise TemplateError(f"{self._name}: {change.why}: there is no {change.path!r}")
        if change.expect not in (None, 1):
            raise TemplateError(f"{self._name}: {change.why}: there is one {change.path!r}, not {change.expect} as expected")
        return self._places[change.path]

    def _value(self, change: Change, values: Mapping[str, Value]) -> str:
        """Return the text that a change sets, with its expressions filled in."""
        try:
            text = fill(change.value, values) if isinstance(change, Set) else ""
        except ConfigError as error:
            raise ConfigError(f"{change.why}: {error}") from error
        if text != text.strip() or not text.isprintable():
            raise TemplateError(
                f"{self._name}: {change.why}: {text!r} cannot stand in a conf file; use one line without blanks"
            )
        return text

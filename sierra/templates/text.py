"""Text templates: any text with placeholders `{{name}}`, each of which gets a value.

A path names a placeholder: `/name` (or `//name`, `name`). `set` is the only change. A value stands in the text as it is. Every
placeholder must get a value in the input of a run. `{{project}}` and `{{output}}` have one: the folder's path at execution.
There are no conditions or loops.

If the text has other double braces, other placeholders can be declared: `[template_formats.text] placeholder = "<<name>>"`.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, ClassVar

from pydantic import AfterValidator, Field

from sierra.config.field_types import Table
from sierra.errors import ConfigError, TemplateError
from sierra.model import Change, Set, Value
from sierra.templates.arithmetic import fill, names
from sierra.templates.base import FOLDERS, Rendered
from sierra.templates.notation import decoded, failure
from sierra.templates.same_number import same
from sierra.util.hashing import sha256
from sierra.util.lazy_definitions import regex
from sierra.util.text import few, one_line

_PATH = regex(r"/{0,2}([A-Za-z_]\w*)")
_NAME = regex(r"[A-Za-z_]\w*")


def _delimited(placeholder: str) -> str:
    """Check that a declared placeholder is the word `name` between two signs."""
    begin, name, end = placeholder.partition("name")
    if not (begin.strip() and name and end.strip()) or begin == end or not placeholder.isprintable():
        raise ValueError(f"{placeholder!r} should be the word name between two different signs, as in {{{{name}}}}")
    return placeholder


class TextOptions(Table):
    """`[template_formats.text]`: how placeholders are written."""

    placeholder: Annotated[str, AfterValidator(_delimited)] = Field(
        "{{name}}", description="how placeholders are written, with the word `name` between two signs"
    )


class Filled(bytes):
    """A rendered text that knows the values of its placeholders, because nobody can read them from the text."""

    template: TextTemplate
    values: Mapping[str, str]


class TextTemplate:
    """The template format `text`; see `sierra.templates.base.Template`."""

    Options: ClassVar[type[Table]] = TextOptions

    def __init__(self, data: bytes, name: str, options: Table | None = None) -> None:
        self.sha256 = sha256(data)
        self._options = options if isinstance(options, TextOptions) else TextOptions()
        mark, text = decoded(data, name)
        begin, _, end = self._options.placeholder.partition("name")
        pieces, found = _split(text, name, begin, end)
        pieces[0] = mark.decode() + pieces[0]
        folders = {name: FOLDERS[name] for name in FOLDERS if name in found}
        self._document = TextDocument(_Text(name, tuple(pieces), tuple(found), (begin, end)), self, folders)

    def reread(self, rendered: Rendered, name: str) -> TextTemplate:
        if not isinstance(rendered, bytes):
            raise TemplateError(f"{name}: a text template must be one file, not {len(rendered)}")
        if not isinstance(rendered, Filled):
            return TextTemplate(rendered, name, self._options)
        again = object.__new__(TextTemplate)
        again.sha256, again._options = sha256(rendered), self._options
        again._document = TextDocument(rendered.template._document.text.called(name), rendered.template, rendered.values)
        return again

    def find(self, path: str) -> tuple[str, ...]:
        """Return the value of a placeholder, or the placeholder itself if it has none."""
        match = _PATH.fullmatch(path.strip())
        if match is None:
            raise TemplateError(
                f"{one_line(path) or 'an empty path'} in {self._document.text.name} is not a path such as /name"
            )
        return (self._document.value(match[1]),) if match[1] in self._document.text.unique else ()

    def attributes(self) -> tuple[tuple[str, str], ...]:
        names = (name for name in self._document.text.unique if name not in FOLDERS)
        return tuple((f"/{name}", self._document.value(name)) for name in names)

    def changed(self, changes: Sequence[Change], values: Mapping[str, Value]) -> TextDocument:
        return self._document.changed(changes, lambda text: fill(text, values))


@dataclass(frozen=True)
class _Text:
    """A text in pieces, with placeholders between them."""

    name: str
    pieces: tuple[str, ...]
    placeholders: tuple[str, ...]
    signs: tuple[str, str]

    @cached_property
    def unique(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(self.placeholders))

    def called(self, name: str) -> _Text:
        return _Text(name, self.pieces, self.placeholders, self.signs)

    def shown(self, name: str) -> str:
        return f"{self.signs[0]}{name}{self.signs[1]}"


class TextDocument:
    """A text with values for some placeholders; see `sierra.templates.base.Document`."""

    def __init__(self, text: _Text, template: TextTemplate, values: Mapping[str, str]) -> None:
        self.text = text
        self._template = template
        self._values = values

    def value(self, name: str) -> str:
        return self._values.get(name, self.text.shown(name))

    def render(self) -> bytes:
        """Return the text; placeholders without a value stay."""
        return self._filled(self._values)

    def per_run(self, changes: Sequence[Change]) -> Callable[[Mapping[str, Value]], bytes]:
        places = [(change, self._placeholder(change)) for change in changes]
        for change, _ in places:
            names(change.value if isinstance(change, Set) else "")
        given = self._values.keys() | {name for _, name in places}
        if missing := [self.text.shown(name) for name in self.text.unique if name not in given]:
            verb = "have no values; set them" if len(missing) > 1 else "has no value; set it"
            raise TemplateError(f"{self.text.name}: {few(missing, 5)} {verb} by variables, changes, or the seed")
        return lambda values: self.changed(changes, lambda text: fill(text, values)).render()

    def changed(self, changes: Sequence[Change], filled: Callable[[str], str]) -> TextDocument:
        values = dict(self._values)
        for change in changes:
            name = self._placeholder(change)
            try:
                text = filled(change.value if isinstance(change, Set) else "")
            except ConfigError as error:
                raise ConfigError(f"{_who(change)}{error}") from error
            values[name] = values[name] if name in values and same(values[name], text) else text
        return TextDocument(self.text, self._template, values)

    def _placeholder(self, change: Change) -> str:
        """Return the placeholder that a change sets. Raises TemplateError."""
        text = self.text
        where = f"{_who(change)}{one_line(change.path)} in {text.name}"
        match = _PATH.fullmatch(change.path.strip())
        if match is None:
            raise TemplateError(f"{where} is not a path such as /name")
        if not isinstance(change, Set) or change.attribute is not None:
            raise TemplateError(f"{where} is a placeholder; a text can only be set")
        if match[1] not in text.unique:
            close = difflib.get_close_matches(match[1], text.unique, 1)
            known = f"; nearest is /{close[0]}" if close else f"; there are {few(text.unique, 8)}" if text.unique else ""
            raise TemplateError(f"{where} matches nothing{known}")
        if change.expect not in (None, 1):
            raise TemplateError(f"{where} matches 1, not {change.expect} as expected")
        return match[1]

    def _filled(self, values: Mapping[str, str]) -> Filled:
        pieces = [self.text.pieces[0]]
        for name, piece in zip(self.text.placeholders, self.text.pieces[1:], strict=True):
            pieces += (values.get(name) if name in values else self.text.shown(name)) or "", piece
        made = Filled("".join(pieces).encode())
        made.template, made.values = self._template, values
        return made


def _split(text: str, name: str, begin: str, end: str) -> tuple[list[str], list[str]]:
    """Return the pieces of a text and the placeholders between them. Raises TemplateError for one that is no name."""
    pieces: list[str] = []
    placeholders: list[str] = []
    after = 0
    signs = f"{re.escape(begin)}|{re.escape(end)}"
    for match in re.finditer(f"{re.escape(begin)}((?:(?!{signs}).)*+){re.escape(end)}", text):
        inner = match[1].strip()
        if not _NAME.fullmatch(inner):
            right = f"use a name of letters, digits and _, or another [template_formats.text] placeholder than {begin}name{end}"
            raise failure(name, text, match.start(), f"{match[0][:40]} is not a placeholder; {right}")
        pieces.append(text[after : match.start()])
        placeholders.append(inner)
        after = match.end()
    pieces.append(text[after:])
    if not placeholders:
        raise failure(name, text, 0, f"a text without placeholders; write {begin}name{end} where values belong")
    return pieces, placeholders


def _who(change: Change) -> str:
    return f"{one_line(change.why)}: " if change.why else ""

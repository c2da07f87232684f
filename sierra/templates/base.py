"""The Template contract: one template becomes each run's input. Includes the functions to read one.

The shipped format is `xml`. Others are entry points of the group `sierra.templates`; each names a class that implements
`Template`. The ending of a file selects its format (`.json` selects an entry point `json`). Any other ending, such as
`.argos`, `.world` or `.launch`, means XML.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from sierra.errors import Missing, TemplateError
from sierra.model import Change, Value
from sierra.util import entry_points

SHIPPED = {"xml": "sierra.templates.xml:XmlTemplate"}

Renderer = Callable[[Mapping[str, Value]], bytes]
"""A function that makes one run's input from the values of that run; the result does not depend on earlier calls."""


class Template(Protocol):
    """A file from which every run's input is made. It is immutable.

    It must be safe for hostile content: nothing outside `data` is read, and time and memory stay in proportion to it. The same
    template, changes and values must give the same bytes on every machine, because a run's identity includes their hash. All
    messages are one line and name the template.
    """

    sha256: str
    """The SHA-256 of the file's bytes, as 64 hexadecimal digits."""

    def __init__(self, data: bytes, name: str) -> None:
        """Read a file's bytes; messages call it `name`. Raises TemplateError if it does not have this format."""
        ...

    def find(self, path: str) -> tuple[str, ...]:
        """Return the text of each attribute, text or element that a path of this format (XPath 1.0 for XML) selects.

        The order is that of the document; the result is empty if the path selects nothing. Raises TemplateError for an invalid
        path. This method makes every template a `sierra.platforms.base.Reader`.
        """
        ...

    def attributes(self) -> tuple[tuple[str, str], ...]:
        """Return pairs of a short path that selects exactly one value, and that value.

        They are proposed to users as variables.
        """
        ...

    def changed(self, changes: Sequence[Change], values: Mapping[str, Value]) -> Document:
        """Return a copy with the changes made in order; each change sees the results of those before it.

        `{expressions}` in `Set.value`, and in the attributes and texts of `Add.xml`, are filled with `values`. Raises
        TemplateError if a change selects nothing, selects another number than it expects, or does not fit. Raises ConfigError
        for an expression. Both messages name `change.why`.
        """
        ...


class Document(Protocol):
    """A template after an experiment's changes. It is immutable."""

    def render(self) -> bytes:
        """Return the document as a file's content."""
        ...

    def per_run(self, changes: Sequence[Change]) -> Renderer:
        """Return a function that makes a run's input: it applies `changes` with the values of that run.

        All paths are checked here once, and raise the same errors as `Template.changed`. They must not depend on values that
        other per-run changes write. The returned function raises errors only for values.
        """
        ...


def read(path: Path) -> Template:
    """Return the template in a file. Raises Missing if the file cannot be read, TemplateError if it is not a template."""
    name = _one_line(str(path))
    try:
        if path.exists() and not path.is_file():
            raise TemplateError(f"{name}: not a file; a template is one")
        data = path.read_bytes()
    except (OSError, ValueError) as error:
        raise Missing(f"{name}: {getattr(error, 'strerror', None) or error}; the template cannot be read") from error
    made: Template = _load(path.suffix.removeprefix(".").lower())(data, name)
    return made


def formats() -> tuple[str, ...]:
    """Return the names of all available template formats, the shipped ones first."""
    return entry_points.names("template", SHIPPED)


def _load(ending: str) -> Any:
    return entry_points.find("template", SHIPPED, ending if ending in formats() else "xml")


def _one_line(text: str) -> str:
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)

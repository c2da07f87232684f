"""One template becomes each run's input: the Template contract, and the door to read one.

Shipped: `xml`. Others come as entry points of the group `sierra.templates`, each naming a class that fulfils
`Template`. A file is read in the format that its ending names (`.json` by an entry point `json`); any other
ending, such as `.argos`, `.world` or `.launch`, is XML.
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
"""Makes one run's input from the values of that run; gives the same bytes whatever it was called with before."""


class Template(Protocol):
    """A file that every run's input is made from. Never changes once it is made.

    Safe for hostile content: nothing outside `data` is read, and time and memory stay in proportion to it.
    The same template, changes and values give the same bytes on every machine: a run's identity hashes them.
    All messages are one line, and name the template.
    """

    sha256: str
    """Of the file's bytes, as 64 hexadecimal digits."""

    def __init__(self, data: bytes, name: str) -> None:
        """From a file's bytes; `name` is what messages call it. Raises TemplateError where it is not this format."""
        ...

    def find(self, path: str) -> tuple[str, ...]:
        """The text of each attribute, text or element that a path of this format (XPath 1.0 for XML) selects, in
        document order; empty where it selects none. Raises TemplateError for what is no such path.

        It makes every template a `sierra.platforms.base.Reader`.
        """
        ...

    def attributes(self) -> tuple[tuple[str, str], ...]:
        """A short path to each value that it alone selects, and the value; for proposing variables to people."""
        ...

    def changed(self, changes: Sequence[Change], values: Mapping[str, Value]) -> Document:
        """A copy with the changes made in order, each seeing what those before it did.

        `{expressions}` in `Set.value`, and in the attributes and texts of `Add.xml`, are filled with `values`.
        Raises TemplateError where a change selects nothing, or not what it expects, or does not fit; ConfigError
        for an expression. Either names `change.why`.
        """
        ...


class Document(Protocol):
    """A template with an experiment's changes made. Never changes once it is made."""

    def render(self) -> bytes:
        """The document as a file's content."""
        ...

    def per_run(self, changes: Sequence[Change]) -> Renderer:
        """Makes runs' inputs, of which each has `changes` made to this document with the values of its run.

        All paths are checked here, once, and raise here as in `Template.changed`; they must not depend on the
        values that other per-run changes write. The renderer raises for values only.
        """
        ...


def read(path: Path) -> Template:
    """The template in a file. Raises Missing where there is none to read, TemplateError where it is not one."""
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
    """All formats that a template can have here, the shipped ones first."""
    return entry_points.names("template", SHIPPED)


def _load(ending: str) -> Any:
    return entry_points.find("template", SHIPPED, ending if ending in formats() else "xml")


def _one_line(text: str) -> str:
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)

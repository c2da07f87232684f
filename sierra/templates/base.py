"""The Template contract: one template becomes each run's input. Includes the function to read one.

Others than the shipped formats are entry points of the group `sierra.templates` (see `sierra.plugin`). `template_format` in
`sierra.toml` or the ending of a file selects its format (`.json` selects `json`). With any other ending, a file that begins
with `<` is XML. `sierra.testing.templates` has the conformance suite.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import ClassVar, Protocol

from sierra.config import extensions
from sierra.config.change_tables import CHECKPOINT, PORT_NAMES
from sierra.config.field_types import Table
from sierra.config.plugin_registry import TEMPLATES, Tables
from sierra.errors import Missing, TemplateError
from sierra.model import FOLDER, Change, Value
from sierra.util.regular_files import read_regular
from sierra.util.text import one_line
from sierra.worker.ports import PORT_MARK

Files = tuple[tuple[str, bytes], ...]
"""Names and contents of files."""
Rendered = bytes | Files
"""A document as input of a run: the content of one file, which the platform names, or several files.

If there are several files, the platform names the one whose name is empty; it is `{input}`. The others keep their names,
which are the same for all runs of a template. If no name is empty, the first file is `{input}`.
"""
ARGUMENTS = "arguments.json"
"""The name of a file with arguments: a list of texts, as JSON. In a command, they take the place of the word `{arguments}`."""
PORTS: Mapping[str, str] = {name: f"{PORT_MARK}{number:02}" for number, name in enumerate(PORT_NAMES, 1)}
"""The names that stand for free ports of a run, and the mark of each: a number, so that it fits where a format has numbers."""
OF_WORKER: Mapping[str, str] = {**PORTS, CHECKPOINT: FOLDER + "Checkpoint"}
"""Those names, and the one of the folder of a run's checkpoint, with the mark of each."""
FOLDERS: Mapping[str, str] = {"project": FOLDER + "Project", "output": FOLDER + "Output", **OF_WORKER}
"""The names that stand for a folder or a port in values of changes, and the mark of each in generated files.

The marks are part of the identity of a run. When it is executed, the paths of the folders, and the ports, take their place.
"""
Renderer = Callable[[Mapping[str, Value]], Rendered]
"""A function that makes one run's input from the values of that run; the result does not depend on earlier calls."""


class Template(Protocol):
    """A file from which every run's input is made. It is immutable.

    It must be safe for hostile content: nothing outside `data` is read, and time and memory stay in proportion to it. The same
    template, changes and values must give the same bytes on every machine, because a run's identity includes their hash. All
    messages are one line and name the template. A value that is a plain word stands in the rendered bytes as it is.

    Paths are texts in a notation of the format: XPath 1.0 for the shipped formats. So are the pieces that `Add` adds
    (`Add.xml`): XML, or JSON for other trees. A format may refuse kinds of changes that it does not support, by TemplateError.
    A format with types keeps them: it refuses values of other types, and may spell a number in another way (`1` as `1.0`).
    """

    Options: ClassVar[type[Table]]
    """The model of `[template_formats.NAME]`. Options may change the rendered bytes, and so the identities of runs."""
    sha256: str
    """The SHA-256 of the file's bytes, as 64 hexadecimal digits."""

    def __init__(self, data: bytes, name: str, options: Table) -> None:
        """Read a file's bytes; messages call it `name`. `options` is an object of `Options`. Raises TemplateError."""

    def reread(self, rendered: Rendered, name: str) -> Template:
        """Return the template that a rendered document would be, as if its files were read. Messages call it `name`."""

    def find(self, path: str) -> tuple[str, ...]:
        """Return the text of each attribute, text or element that a path of this format (XPath 1.0 for XML) selects.

        The order is that of the document; the result is empty if the path selects nothing. Raises TemplateError for an invalid
        path. This method makes every template a `sierra.design.platforms.base.Reader`.
        """

    def attributes(self) -> tuple[tuple[str, str], ...]:
        """Return pairs of a short path that selects exactly one value, and that value, to propose as variables."""

    def changed(self, changes: Sequence[Change], values: Mapping[str, Value]) -> Document:
        """Return a copy with the changes made in order; each change sees the results of those before it.

        `{expressions}` in `Set.value`, and in the attributes and texts of `Add.xml`, are filled with `values`. Raises
        TemplateError if a change selects nothing, selects another number than it expects, or does not fit. Raises ConfigError
        for an expression. Both messages name `change.why`.
        """


class Document(Protocol):
    """A template after an experiment's changes. It is immutable."""

    def render(self) -> Rendered:
        """Return the document as the input of a run."""

    def per_run(self, changes: Sequence[Change]) -> Renderer:
        """Return a function that makes a run's input: it applies `changes` with the values of that run.

        All paths are checked here once, and raise the same errors as `Template.changed`. They must not depend on values that
        other per-run changes write. The returned function raises errors only for values.
        """


ENDINGS = {".yml": "yaml", ".txt": "text", ".urdf": "xml", **extensions.every("inputs")}
"""The formats of files whose ending is not the name of a format."""
_BLANKS = b"\xef\xbb\xbf\xff\xfe \t\r\n\0"


def read(path: Path, tables: Tables | None = None, format: str | None = None) -> Template:
    """Return the template in a file; `tables` are `[template_formats.…]`. Raises Missing, TemplateError, ConfigError."""
    name = one_line(str(path))
    try:
        if path.exists() and not path.is_file():
            raise TemplateError(f"{name}: not a file; a template must be a file")
        data = read_regular(path)
    except (OSError, ValueError) as error:
        raise Missing(f"{name}: {getattr(error, 'strerror', None) or error}; cannot read the template") from error
    return of_bytes(path, data, tables, format)


def of_bytes(path: Path, data: bytes, tables: Tables | None = None, format: str | None = None) -> Template:
    """Return the template with this content, as if it were in a file; the file need not exist. Raises like `read`."""
    name = one_line(str(path))
    plain = data.replace(b"\0", b"")
    for mark, marked in ((FOLDER, "folders"), (PORT_MARK, "ports")):
        if mark.encode() in plain:
            raise TemplateError(f"{name}: contains {mark}, which marks {marked} in inputs; use another text")
    template: Template = TEMPLATES.make(format or _format(path, data, name), tables or {}, data, name)
    return template


def _format(path: Path, data: bytes, name: str) -> str:
    """Return the format of a file by its ending, or `xml` by its first character. Raises TemplateError if it is doubtful."""
    ending = path.suffix.lower()
    plain = ending.removeprefix(".")
    known = plain if plain in TEMPLATES.names() else ENDINGS.get(ending)
    looks_like_xml = data.lstrip(_BLANKS).startswith(b"<")
    if known in TEMPLATES.shipped and known != "xml" and looks_like_xml:
        raise TemplateError(f"{name}: its ending means {known}, but it begins as XML; {_choose()}")
    if known is None and not looks_like_xml:
        raise TemplateError(f"{name}: its ending names no format, and it does not begin as XML; {_choose()}")
    return known or "xml"


def _choose() -> str:
    return f"set template_format to one of {', '.join(TEMPLATES.names())}"

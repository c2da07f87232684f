"""The OutputReader contract, and the functions that find readers for the outputs of a project.

A reader makes a table from each file of one format. SIERRA ships `csv`, `parquet` and `jsonl`, which read many files at once
(see `sierra.ingest.shipped_reader_base`), and formats whose files are rewritten as one of these first (see
`sierra.ingest.rewriting`). Others are entry points of the group `sierra.readers` (see `sierra.plugin`). The name of the entry
point is the format: `[outputs.NAME] format` names it, or else the ending of `file` does. Files that are not declared in
`[outputs]` become tables only if they end in .csv, .tsv, .parquet, .jsonl or .ndjson, because the result of an execution must
not depend on what is installed.

The format, the options and the package of a reader decide what is recorded, as the other rules in `[outputs]` do: they are part
of the hash of these rules (`Context.ingest_rules`). If one changes, executions are evaluated again from their recorded files.
A reader in a file of the project is recorded with its code, which reads the files of a replay, or of a session that died.
`sierra.testing.readers` has the conformance suite.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, ClassVar, NotRequired, Protocol, TypedDict

from sierra.config import current_project, extensions
from sierra.config.current_project import Plugins
from sierra.config.field_types import Table
from sierra.config.output_tables import FILE_FORMAT, Output
from sierra.config.plugin_registry import READERS, Tables
from sierra.errors import ConfigError, Missing, PluginError
from sierra.util.json_types import Json

Columns = Mapping[str, Sequence[object]]
"""A table: the values of each column, by its name. All columns have the same length."""


class UnreadableError(ValueError):
    """A file that a reader cannot read. The text is one line that says what is wrong, and in which line or record."""


class LaterError(Exception):
    """There is no space to unpack the archives of an execution until those of others are read."""


class OutputReader(Protocol):
    """A format of output files: one file becomes the rows of a table."""

    Options: ClassVar[type[Table]]
    """The model of `[readers.NAME]`. Options may change tables: they are part of the hash of the project's rules."""

    def __init__(self, options: Any) -> None:
        """Make the reader; `options` is an object of `Options`."""
        ...

    def read(self, path: Path) -> Columns:
        """Return the table in a file.

        Values are None, bool, int, float, str, or what `pyarrow.table` accepts. The order of rows and columns is that of the
        file. The same bytes must always give the same table. Only this file is read, and nothing is written. A column should
        have the same type in all files: files with other types than their siblings are reported.

        Raises UnreadableError for a file that is cut short or damaged. The execution that wrote it has failed then. Any other
        error fails it too, but is reported as a fault of the reader.
        """
        ...


class UsedReader(TypedDict):
    """A reader of another package, as it is recorded in the rules."""

    package: str
    """The name and the version; or the file of the project that has its class."""
    options: dict[str, Json]
    files: NotRequired[dict[str, str]]
    """The text of this file and of those that it imports, by path."""


Used = Mapping[str, UsedReader]
"""The readers of other packages by format."""


def used(outputs: Mapping[str, Output], tables: Tables) -> Used:
    """Return the readers of other packages that these outputs need; `tables` are `[readers.…]`.

    Raises ConfigError if an output names a format that nothing reads, or if options are invalid.
    """
    check_formats(outputs)
    kinds = {output.kind for output in outputs.values() if output.kind != FILE_FORMAT}
    return described((name for name in kinds if name in READERS.added()), tables)


def check_formats(outputs: Mapping[str, Output], recorded: Iterable[str] = ()) -> None:
    """Check that all formats can be read that outputs name; `recorded` are the formats of recorded readers.

    Raises ConfigError, and Missing for a package that is needed.
    """
    known = (*READERS.names(), FILE_FORMAT, *recorded)
    for name, output in outputs.items():
        if output.format is not None and output.format not in known:
            raise ConfigError(f"[outputs.{name}] format: {_unknown(output.format, known)}")
        check_package(output)


def with_files(outputs: Mapping[str, Output], root: Path) -> Mapping[str, Output]:
    """Return outputs with the content of the files of the project that their keys name. Raises ConfigError."""
    found = {}
    for name, output in outputs.items():
        try:
            found[name] = output.with_files(root)
        except ValueError as error:
            raise ConfigError(f"[outputs.{name}]: {error}") from error
    return found


def _unknown(name: str, known: Iterable[str]) -> str:
    if home := extensions.home("outputs", name):
        return extensions.belongs(name, home)
    return f"unknown format {name!r}; known are {', '.join(known)}"


def check_package(output: Output | type[Output]) -> None:
    """Check that the package is installed that reading an output needs. Raises Missing."""
    from importlib.util import find_spec

    if output.needs is None:
        return
    words, package, extra = output.needs
    try:
        installed = find_spec(package) is not None
    except ValueError:
        installed = False
    if not installed:
        raise Missing(f"outputs in {words} need the package {package}: pip install 'sierra-experiments[{extra}]'")


def described(formats: Iterable[str], tables: Tables) -> Used:
    """Return the readers of these formats with their packages and options, as they are now. Raises ConfigError, PluginError."""
    readers: dict[str, UsedReader] = {}
    for name in sorted(set(formats)):
        offer = READERS.offer(name)
        readers[name] = {
            "package": offer.package,
            "options": READERS.options(name, tables.get(name, {})).model_dump(mode="json"),
        }
        if offer.files:
            readers[name]["files"] = {path: _text(path, content) for path, content in offer.files().items()}
    return readers


def _text(path: str, content: bytes) -> str:
    try:
        return content.decode()
    except UnicodeDecodeError:
        raise PluginError(
            f"[plugins]: {path} cannot be recorded with its reader: it is not UTF-8 text; correct {path}"
        ) from None


def restored(readers: Used, *, refused: str = "") -> Used:
    """Return recorded readers with their recorded options: those of files of the project as recorded, others as they are now.

    With `refused`, which is a reason, no recorded code is imported. Raises PluginError if a reader cannot be used.
    """
    usable: dict[str, UsedReader] = {}
    for name, reader in readers.items():
        if "files" not in reader:
            usable |= described((name,), {name: reader["options"]})
            continue
        if refused:
            raise PluginError(f"the reader {name!r} of {reader['package']} is not imported: {refused}")
        with recorded(name, json.dumps(reader)):
            READERS.load(name)
        usable[name] = reader
    return usable


def recorded(name: str, described: str) -> AbstractContextManager[None]:
    """Return a context in which a reader is the recorded one; `described` is its entry of `Used`, as JSON, or empty.

    Only readers in files of a project are recorded; they are imported only within a context of their project.
    """
    reader = json.loads(described or "{}")
    if "files" not in reader:
        return nullcontext()
    from sierra.config.project_plugins import Recorded

    project = current_project.plugins() or Plugins(Path(), "it is recorded code, which only commands in its project import")
    files = {str(path): str(text).encode() for path, text in reader["files"].items()}
    return current_project.within(object(), lambda: Recorded(project, READERS, name, str(reader["package"]), files))


def make(name: str, described: str) -> OutputReader:
    """Return the reader of a format of another package; `described` is its entry of `Used`, as JSON."""
    with recorded(name, described):
        reader: OutputReader = READERS.make(name, {name: json.loads(described)["options"]})
    return reader

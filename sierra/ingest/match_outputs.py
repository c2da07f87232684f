"""Assignment of an execution's files to tables: first the declared ones, then files with a table's suffix.

The table of an undeclared file has the file's name without its suffix, with `_` for all but letters, marks and digits. Two
names that would become one table, such as `a b` and `a_b`, or `A` and `a`, become two: the later one gets a number. Tables
keep the names under which they were recorded, also those of the time when only ASCII letters were kept.
"""

from __future__ import annotations

import json
import re
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import fields
from functools import cached_property
from itertools import chain, count
from pathlib import PurePosixPath
from typing import TYPE_CHECKING

from sierra.config.output_tables import (
    FILE_FORMAT,
    NAMED_FORMATS,
    ROTATED_FORMATS,
    SAME_FORMAT,
    Output,
    newest_of,
)
from sierra.config.plugin_registry import READERS
from sierra.ingest import robot_files
from sierra.ingest.base import Used
from sierra.ingest.messages import shown
from sierra.ingest.model import Form, Shape
from sierra.model import OutputFile, Result
from sierra.store.schema import check_name
from sierra.util.text import natural

if TYPE_CHECKING:
    from sierra.ingest.matching_lines import UnmatchedLines

AUTOMATIC_AT_MOST = 20
"""The limit on undeclared tables of one run; if a run has more such files, all of them are recorded as files."""
NOTED_AT_MOST = 1000
IN_FOLDERS = 'undeclared and in a subfolder ([outputs.NAME] file = "{glob}" makes a table of them)'
TOO_MANY = f'undeclared, and more than {AUTOMATIC_AT_MOST} in a run ([outputs.NAME] file = "{{glob}}" makes a table of them)'
TAKEN = 'undeclared, and another file already makes the table of that name ([outputs.NAME] file = "{file}" makes it a table)'
UNNAMED = 'declared without a format ([outputs.{output}] format = "{format}" makes a table, and format = "file" keeps the file)'
ROTATED = (
    "older than {newest!r}, whose table has only the newest rows "
    '([outputs.{output}] file = "{newest}{{rotation}}" makes one table of all parts, the oldest first)'
)
NOT_UTF8 = "with a name that is not UTF-8"
"""The reasons why files that look like tables are recorded as files."""


class OutputMatcher:
    """The assignment of files to tables; it remembers the files that look like tables but are recorded as files."""

    def __init__(
        self, outputs: Mapping[str, Output], readers: Used, recorded: Callable[[], Iterable[tuple[str, str | None]]] = tuple
    ) -> None:
        """`readers` are the readers of other packages; outputs of any other format that is not shipped are kept as files.

        `recorded` returns the files that were recorded before, each with its table, or None. It is called once, if necessary.
        """
        self._outputs = outputs
        self._recorded = recorded
        self._names: dict[str, str] | None = None
        """The tables of undeclared files, by the stems of their names."""
        self._as_files: set[str] = set()
        """The files that were recorded as files before."""
        self.renamed: dict[str, str] = {}
        """Notes on tables with a number in their names, by the file."""
        self._readers = {name: json.dumps(reader, sort_keys=True) for name, reader in readers.items()}
        self.kept: dict[str, dict[str, None]] = {}
        """The files that are recorded as files although they look like tables, by reason."""

    @cached_property
    def unmatched(self) -> UnmatchedLines:
        """The lines that are in no table."""
        from sierra.ingest.matching_lines import UnmatchedLines

        return UnmatchedLines()

    def on_lines(self) -> Iterator[str]:
        """Yield a note on the lines that are in no table, if lines were looked at."""
        yield from self.unmatched.notes() if "unmatched" in vars(self) else ()

    def of(self, result: Result) -> Iterator[tuple[str, Shape, OutputFile]]:
        """Yield the files of one execution that become tables: first the declared ones, then files with a table's suffix."""
        automatic = []
        of_robots: dict[str, list[OutputFile]] = {}
        for file in sorted(result.outputs, key=lambda file: natural(file.path)):
            owners = claims(self._outputs, file.path)
            declared = next(iter(owners), None)
            kind = self._outputs[declared].kind if declared else automatic_format(file.path)
            if declared is not None and (named := unnamed_format(self._outputs[declared])):
                self._keep(UNNAMED.format(output=declared, format=named), file)
            if declared is None and (base := self._rotated(file, result)):
                self._keep(ROTATED.format(newest=base, output=self._table_of(base)), file)
                continue
            if kind not in READERS.shipped and kind not in self._readers:
                continue
            if shown(file.path) != file.path:
                self._keep(NOT_UTF8, file)
            elif declared is not None:
                several = self._outputs[declared].shares_file or self._outputs[declared].opens(file.path)
                for name in owners if several else owners[:1]:
                    yield name, self._shape(name, self._outputs[name]), file
            elif result.robots and robot_files.place_of(file.path) is not None:
                of_robots.setdefault(file.path.partition("/")[2], []).append(file)
            elif "/" in file.path:
                self._keep(IN_FOLDERS, file)
            else:
                automatic.append(file)
        if len(automatic) + len(of_robots) > AUTOMATIC_AT_MOST:
            for file in (*automatic, *chain.from_iterable(of_robots.values())):
                self._keep(TOO_MANY, file)
            return
        taken = {name.lower() for name in self._outputs}
        for path, files in {**{file.path: [file] for file in automatic}, **of_robots}.items():
            table, kind, several = self._name(path), automatic_format(path) or "", path in of_robots
            if table is None or table.lower() in taken:
                for file in files:
                    self._keep(TAKEN, file)
                continue
            taken.add(table.lower())
            ticks = (robot_files.COLUMN,) if several else ()
            shape = Shape(kind, many=several, ticks=ticks, name=table)
            yield from ((table, shape, file) for file in files)

    def _rotated(self, file: OutputFile, result: Result) -> str | None:
        """Return the newest part of a rotated file of which this is an older one, if it becomes a table; else None."""
        newest = newest_of(file.path)
        if newest is None or all(other.path != newest for other in result.outputs):
            return None
        owners = claims(self._outputs, newest)
        kind = self._outputs[owners[0]].kind if owners else automatic_format(newest)
        return newest if kind in ROTATED_FORMATS and (owners or "/" not in newest) else None

    def _table_of(self, path: str) -> str:
        owners = claims(self._outputs, path)
        return owners[0] if owners else table_name(path)

    def _name(self, path: str) -> str | None:
        """Return the name of the table of an undeclared file; None if it is another file's, and this one was kept as a file."""
        names = self._names if self._names is not None else self._known()
        if (stem := _stem(path)) in names:
            return names[stem]
        name = table_name(path)
        owners = {known.lower(): owner for owner, known in names.items()}
        if (owner := owners.get(name.lower())) is not None:
            if path in self._as_files:
                return None
            taken = {*owners, *(known.lower() for known in self._outputs)}
            first, name = (
                name,
                next(numbered for n in count(2) if (numbered := f"{name}_{n}").lower() not in taken and check_name(numbered)),
            )
            self.renamed[path] = f"{shown(path)!r} makes the table {name!r}, because the table {first!r} is that of {owner!r}"
        names[stem] = name
        return name

    def _known(self) -> dict[str, str]:
        """Return the names of the recorded tables of undeclared files, by the stems of the files' names."""
        self._names = {}
        for path, name in self._recorded():
            own = path if robot_files.place_of(path) is None else path.partition("/")[2]
            if name is None:
                self._as_files.add(own)
            elif name == _former_name(own) or re.fullmatch(rf"{re.escape(table_name(own))}(_[0-9]+)?", name):
                self._names.setdefault(_stem(own), name)
        return self._names

    def _shape(self, name: str, output: Output) -> Shape:
        many = bool(output.ticks) or any(c in output.file for c in "*?[")
        reader = self._readers.get(output.kind, "")
        plain = {field.name: getattr(output, field.name) for field in fields(Form) if field.name != "own"}
        form = Form(**plain, own=tuple(output.own_keys.items()))
        return Shape(
            output.kind,
            output.delimiter,
            output.header,
            output.columns,
            many,
            reader=reader,
            form=form,
            ticks=output.ticks,
            name=name,
            declared=True,
            time=output.time,
            any_order=output.time_order == "any",
            rotated=output.base if output.rotated else "",
            packed=output.base if output.archive else "",
        )

    def _keep(self, why: str, file: OutputFile) -> None:
        """Note that a file is recorded as a file although it looks like a table."""
        kept = self.kept.setdefault(why, {})
        if len(kept) < NOTED_AT_MOST:
            kept[shown(file.path)] = None


def table_name(path: str) -> str:
    """Return the name of the table for an undeclared file, derived from the file's name."""
    return _sound("".join(c if unicodedata.category(c)[0] in "LMN" else "_" for c in _stem(path)))


def _former_name(path: str) -> str:
    """Return the name that such a table had when only ASCII letters were kept."""
    return _sound("".join(c if c.isalnum() and c.isascii() else "_" for c in PurePosixPath(path).stem))


def _sound(stem: str) -> str:
    name = ("_" if stem[:1].isnumeric() else "") + stem or "_"
    return name if check_name(name) else name + "_"


def _stem(path: str) -> str:
    """Return the name of a file without its suffix; different encodings of the same letters are one."""
    return unicodedata.normalize("NFC", PurePosixPath(path).stem)


def claims(outputs: Mapping[str, Output], path: str) -> list[str]:
    """Return the outputs that a file belongs to: those that name it or have files in it, or else those whose pattern fits."""
    claiming = [name for name, output in outputs.items() if output.matches(path)]
    return [name for name in claiming if outputs[name].base == path or outputs[name].opens(path)] or claiming


def claimed_twice(result: Result, outputs: Mapping[str, Output]) -> str | None:
    """Return the message that a file belongs to several outputs, of which at least one is a table; None if there is none."""
    for file in result.outputs if len(outputs) > 1 else ():
        by_pattern = {outputs[name].file.removeprefix("./"): name for name in reversed(claims(outputs, file.path))}
        names = list(reversed(by_pattern.values()))
        in_archive = all(outputs[name].opens(file.path) for name in names)
        if len(names) > 1 and not in_archive and any(outputs[name].kind != FILE_FORMAT for name in names):
            both = " and ".join(f"{name!r} ({outputs[name].file})" for name in names[:2])
            return f"{shown(file.path)}: belongs to the outputs {both}; a file becomes one table: change file in one of them"
    return None


def unnamed_format(output: Output) -> str | None:
    """Return the format that would make a table of an output, if it is only read if it is named."""
    ending = output.file.rpartition(".")[2].lower()
    return ending if output.format is None and ending in NAMED_FORMATS and not output.lines else None


def automatic_format(path: str) -> str | None:
    """Return the format of a file with a table's suffix, or None."""
    ending = PurePosixPath(path).suffix.lower().removeprefix(".")
    name = SAME_FORMAT.get(ending, ending)
    return name if name in READERS.shipped and name not in NAMED_FORMATS else None

"""Conformance suite for readers of output formats, as functions that a plug-in's author calls in tests.

    from sierra.testing import readers as conformance

    def test_it_is_a_reader(tmp_path):
        conformance.check("myformat", {b"...": {"tick": [0, 1], "energy": [0.5, 0.25]}}, [b"cut sho"], tmp_path)

The package must be installed, because readers are found by their name. `tables` maps the bytes of files to their tables.
`damaged` are files that must be refused. The files of one check have the same columns. Each claim is one function of a `Trial`,
and can be called alone. A broken claim raises AssertionError with one line, even if Python runs with `-O`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from sierra.config.field_types import RawTable
from sierra.config.plugin_registry import READERS
from sierra.ingest.base import Columns, described
from sierra.ingest.model import PLAIN, Form, Reading, Shape, Written
from sierra.ingest.read import read
from sierra.model import OutputFile
from sierra.testing.assertions import holds, is_one_line, says_what_its_options_are
from sierra.worker.outputs import describe

if TYPE_CHECKING:
    from sierra.store.connections import Database

GARBAGE = (b"", b"\0", b"\xff\xfe\x00", b"PAR1", b"{", b"[" * 10_000, b"\n\n\n", bytes(range(256)))
CUTS = 8
"""The number of places, spread over a file, at which it is cut."""
Row = Mapping[str, object]

OWN = ("run", "execution")
"""Columns that SIERRA adds to each table."""


@dataclass
class Trial:
    """A format to test, its files, and a folder for them."""

    name: str
    tables: Mapping[bytes, Columns]
    damaged: Sequence[bytes]
    folder: Path
    options: RawTable = field(default_factory=dict)
    form: Form = PLAIN
    """Keys of `[outputs.NAME]` for shipped readers."""
    _count: int = 0

    @cached_property
    def connection(self) -> Database:
        """A connection for all files of the trial; recording also reads many files on one."""
        from sierra.store.connections import connect

        return connect()

    def read(self, contents: Sequence[bytes]) -> tuple[Reading, dict[str, list[Row]]]:
        """Read files as recording does; return the result, and the rows by execution in their order."""
        import pyarrow.parquet as pq

        self._count += 1
        folder = self.folder / str(self._count)
        files = [folder / f"{number}" / f"out.{self.name}" for number in range(len(contents))]
        for path, content in zip(files, contents, strict=True):
            path.parent.mkdir(parents=True)
            path.write_bytes(content)
        target = folder / "read" / "table.parquet"
        target.parent.mkdir(parents=True)
        shape = Shape(self.name, reader=self._described(), form=self.form)
        reading = read(self.connection, [written(path, number) for number, path in enumerate(files)], shape, target)
        for path, content in zip(files, contents, strict=True):
            holds(path.read_bytes() == content, "the reader changes the file")
        rows: dict[str, list[Row]] = {}
        for part in sorted(target.parent.iterdir()):
            for row in pq.ParquetFile(part).read().to_pylist():
                rows.setdefault(row["execution"], []).append({key: row[key] for key in row if key not in OWN})
        return reading, rows

    def _described(self) -> str:
        if self.name in READERS.shipped:
            return ""
        return json.dumps(described([self.name], {self.name: self.options})[self.name], sort_keys=True)


def check(
    name: str,
    tables: Mapping[bytes, Columns],
    damaged: Sequence[bytes],
    folder: Path,
    options: RawTable | None = None,
    form: Form = PLAIN,
) -> None:
    """Check all claims about the reader `name`. `folder` is an empty folder; `options` are those of `[readers.NAME]`.

    `form`: keys of `[outputs.NAME]`, which only shipped readers have.
    """
    trial = Trial(name, tables, damaged, folder, options or {}, form)
    with trial.connection:
        for claim in CLAIMS:
            claim(trial)


def declares_options(trial: Trial) -> None:
    says_what_its_options_are(READERS.load(trial.name))


def reads_each_table(trial: Trial) -> None:
    """Check that a file gives its rows and columns, in their order, and again the same."""
    for content, columns in trial.tables.items():
        reading, rows = trial.read([content])
        holds(not reading.faults, f"a valid file is refused: {list(reading.faults.values())}")
        _are(rows.get("e0", []), columns)
        holds(dict(reading.counted) == dict(reading.rows), "the number of rows differs from the file's")
        again = trial.read([content])[0]
        holds(again.columns == reading.columns, "the columns differ when the file is read again")


def reads_many_as_each_alone(trial: Trial) -> None:
    """Check that files that are read together give what each gives alone."""
    _, rows = trial.read(list(trial.tables))
    for number, columns in enumerate(trial.tables.values()):
        _are(rows.get(f"e{number}", []), columns)


def refuses_damaged_files(trial: Trial) -> None:
    """Check that a damaged file is refused in one line that names it, and that the others are read all the same."""
    for content in trial.damaged:
        reading, rows = trial.read([*trial.tables, content])
        bad = f"e{len(trial.tables)}"
        holds(list(reading.faults) == [bad], f"a damaged file is accepted: {content[:40]!r}")
        is_one_line(reading.faults[bad])
        holds(f"out.{trial.name}" in reading.faults[bad], f"{reading.faults[bad]!r} does not name the file")
        holds("failed: " not in reading.faults[bad], f"the reader itself failed: {reading.faults[bad]}")
        for number, columns in enumerate(trial.tables.values()):
            _are(rows.get(f"e{number}", []), columns)


def never_invents_rows(trial: Trial) -> None:
    """Check that a file that is cut short is refused, or gives its first rows, unchanged."""
    for content, columns in trial.tables.items():
        whole = _rows(columns)
        for size in sorted({len(content) * part // CUTS for part in range(CUTS)} | {len(content) - 1}):
            reading, rows = trial.read([*trial.tables, content[:size]])
            cut = f"e{len(trial.tables)}"
            given = rows.get(cut, [])
            refused = cut in reading.faults
            holds(
                refused or given == whole[: len(given)], f"a file that is cut after {size} bytes has other rows: {given[-1:]}"
            )
            holds(
                refused or set(reading.columns.get((cut, f"out.{trial.name}"), columns)) <= set(columns),
                f"a file that is cut after {size} bytes has other columns",
            )


def survives_garbage(trial: Trial) -> None:
    """Check that any bytes are read, or refused in one line, without a fault of the reader itself."""
    for content in GARBAGE:
        reading, _ = trial.read([content])
        for fault in reading.faults.values():
            is_one_line(fault)
            holds("failed: " not in fault, f"the reader itself failed for {content[:40]!r}: {fault}")


def _rows(columns: Columns) -> list[Row]:
    return [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]


def _are(rows: Sequence[Row], columns: Columns) -> None:
    wanted = _rows(columns)
    holds(len(rows) == len(wanted), f"the file has {len(wanted)} rows, but {len(rows)} were read")
    for row, expected in zip(rows, wanted, strict=True):
        holds(row == expected and list(row) == list(expected), f"the row {expected} became {dict(row)}")


def written(path: Path, number: int) -> Written:
    """Return a file as a worker describes it."""
    seen = OutputFile(**describe(str(path), path.name))
    facts = (seen.path, seen.head, seen.lines, seen.ended, seen.bytes, seen.quotes, seen.blank, seen.alike)
    return Written(str(path), f"r{number}", f"e{number}", *facts)


CLAIMS: tuple[Callable[[Trial], None], ...] = (
    declares_options,
    reads_each_table,
    reads_many_as_each_alone,
    refuses_damaged_files,
    never_invents_rows,
    survives_garbage,
)

"""What runs wrote becomes tables: many files at once, each checked, none averaged away.

All files of one output that have the same columns make a *part*, which is one Parquet file: columns may differ between
experiments, and whether they may differ between two runs is not for here to say (see `sierra.ingest.find_odd`). A part
is read by one statement where all is as it should be. Where it is not, the files at fault are found by halving, and the
fault is said with its line. A file is at fault if a line has too few or too many fields, if its last line is cut short, or
if it cannot be read at all.

What a column holds (numbers, flags, texts) is no fault here, since it would depend on which files are read together: files
that hold other things go into Parquet files of their own, and `sierra.ingest.find_odd` judges. Where most of a file's
siblings have text, its numbers are kept as the texts that they are: 007 and 1e5 are other texts as numbers.

Whole numbers are BIGINT (DECIMAL(38,0) where they are too great), other numbers DOUBLE, `true`/`false` BOOLEAN, all else
VARCHAR; an empty field is NULL, and a column without any value BOOLEAN, which every other type can hold. A type is taken
from a few files, but checked in all: DuckDB would round 1.5 to be a BIGINT and call 1 true. JSON's lists and objects are
kept as JSON. A column called as one of ours, or as another but for case, gets a trailing underscore.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from sierra.ingest.base import Reader
from sierra.ingest.csv import Csv, delimiter_of
from sierra.ingest.jsonl import Jsonl
from sierra.ingest.messages import difference, shown
from sierra.ingest.model import Reading, Shape, Siblings, Written
from sierra.ingest.parquet import Parquet
from sierra.store.column_types import AS_TEXT, is_number, own_kind, right_kind
from sierra.store.scans import Aliases

__all__ = [
    "AS_TEXT",
    "Reading",
    "Shape",
    "Siblings",
    "Written",
    "delimiter_of",
    "difference",
    "is_number",
    "own_kind",
    "read",
    "right_kind",
    "shown",
]


def read(connection: Any, files: Sequence[Written], shape: Shape, target: Path, siblings: Siblings | None = None) -> Reading:
    """Read all files, without those of executions that are at fault, into Parquet files: `target` and, where columns or
    what they hold differ, others beside it (`target~2`, …).

    Raises Missing where what is sound cannot be written.
    """
    connection.execute("SET disabled_optimizers = 'join_order,build_side_probe_side'")  # rows keep their order
    readers: Mapping[str, type[Reader]] = {"csv": Csv, "parquet": Parquet, "jsonl": Jsonl}
    with Aliases() as aliases:
        named = [replace(file, path=aliases.of(file.path)) for file in files]
        return readers[shape.format](connection, shape, target, siblings or Siblings()).read(named)

"""Recovery of bags that were cut off: what can be read, in tables of their own that are marked as partial.

Such a bag fails its run, and its messages are in no table of the store, because a mean over complete and partial recordings
would be wrong. What can be read is written as `BAG.OUTPUT.partial.parquet` beside the bag, with the column `partial`, which is
true in all rows.
"""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path

from sierra.config.output_tables import Output
from sierra.extensions.ros.bags.bag_topics import Keys, TopicTable, batches, opened
from sierra.extensions.ros.bags.containers import Message
from sierra.extensions.ros.output import BagOutput
from sierra.ingest.base import UnreadableError
from sierra.ingest.match_outputs import claims
from sierra.ingest.model import Written
from sierra.ingest.rewriting import OriginalFile
from sierra.util.fs import fitting
from sierra.util.lazy_definitions import dataclass

PARTIAL = "partial"


@dataclass(frozen=True, slots=True)
class Recovered:
    """One table of a bag that was cut off."""

    output: str
    path: Path
    """The file that was written; it is not there if nothing could be read."""
    rows: int
    reason: str
    """The reason why there are no more rows."""


def recover(bag: Path, name: str, outputs: Mapping[str, Output]) -> Iterator[Recovered]:
    """Write what can be read of a bag; yield each table. Yield nothing for a bag that is whole, or that no output declares.

    `name` is the path of the bag in the output folder of its run. Raises OSError.
    """
    source = OriginalFile(Written(str(bag), "", "", name, "", 0, True, bag.stat().st_size))
    declared = {output: table for output in claims(outputs, name) if isinstance(table := outputs[output], BagOutput)}
    declared = {output: table for output, table in declared.items() if not table.archive}
    if not declared or _is_whole(source):
        return
    for output, keys in declared.items():
        path = bag.with_name(f"{fitting(f'{bag.name}.{output}')}.{PARTIAL}.parquet")
        rows, reason = 0, ""
        try:
            rows, reason = _written(source, keys, path)
        except UnreadableError as error:
            reason = str(error)
        yield Recovered(output, path, rows, reason)


def _is_whole(source: OriginalFile) -> bool:
    try:
        with opened(source) as bag:
            bag.index()
    except UnreadableError:
        return False
    return True


def _written(source: OriginalFile, output: BagOutput, path: Path) -> tuple[int, str]:
    """Write the table; return the number of its rows, and why there are no more. Raises UnreadableError without columns."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    keys = Keys(**dict(output.own_keys))._replace(min_rate=0.0)
    rows = 0
    with opened(source, whole=False) as bag:
        known = Counter(channel for channel, _, _ in _Readable(bag.scan(lambda _: True)))
        table = TopicTable(known, keys)
        messages = _Readable(bag.scan(table.channels.__contains__))
        schema = table.schema.append(pa.field(PARTIAL, pa.bool_()))
        with path.open("xb") as file, pq.ParquetWriter(file, schema) as writer:
            for batch in batches(table, messages):
                marks = pa.array([True] * batch.num_rows)
                writer.write_batch(pa.record_batch([*batch.columns, marks], schema=schema))
                rows += batch.num_rows
    return rows, messages.reason or "all messages were read; the bag lacks only its index"


class _Readable:
    """The messages before the first place that cannot be read."""

    def __init__(self, messages: Iterator[Message]) -> None:
        self._messages = messages
        self.reason = ""

    def __iter__(self) -> Iterator[Message]:
        try:
            yield from self._messages
        except (UnreadableError, sqlite3.Error) as error:
            self.reason = str(error)

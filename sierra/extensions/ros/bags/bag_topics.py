"""The reader of bags: the messages of the topics that `topics` names become the rows of a table.

A topic may have a name in braces for one part of it, which becomes a column, or `*`. So `/{robot}/odom` makes a table of the
odometry of all robots, with the columns `topic` and `robot`. Both times of a message are kept: `received_ns`, when the recorder
received it, and `header_stamp_ns`, the stamp in its header. The rows are in the order in which the messages were recorded.

The messages are read from the first to the last without the index of the bag. The index has their number, which must be the
same. They are written in batches, so a bag may be larger than memory.

Also: the least rate of topics in a bag: a topic that falls below it at any time makes a bag unreadable, so that its run fails.

A rate is judged over a time that is long enough for `SPAN` messages, and at least a second. After each message, as many more
must come within that time; of a topic with fewer messages, as many as the time to the end of the bag is long enough for. The
end is that of all topics, without the last second, because the nodes of a run do not end at the same time. Messages before the
first one of a topic do not count: nodes begin one after the other.
"""

from __future__ import annotations

import math
import re
import tempfile
from collections import deque
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple

from sierra.config.output_tables import PLACEHOLDER
from sierra.extensions.ros.bags import db3_bag, mcap_bag, ros1_bag
from sierra.extensions.ros.bags.containers import NS, Bag, Channel, Message
from sierra.extensions.ros.bags.message_types import MessageType, MessageTypes
from sierra.ingest.base import UnreadableError
from sierra.ingest.model import PLAIN, Shape
from sierra.ingest.parquet import Parquet
from sierra.ingest.rewriting import OriginalFile, Rewriter
from sierra.ingest.shipped_reader_base import TableReader
from sierra.ingest.sqlite_file import MAGIC as SQLITE
from sierra.ingest.sqlite_file import opened as opened_database
from sierra.store.connections import Database
from sierra.store.sql_names import column_names, stored_names
from sierra.util.lazy_definitions import dataclass, replace
from sierra.util.text import few

if TYPE_CHECKING:
    import pyarrow as pa


SPAN = 10
LEAVE_NS = NS
"""The time at the end of a bag in which topics may end."""


def checked(messages: Iterator[Message], topics: Collection[Channel], least: float) -> Iterator[Message]:
    """Yield those of all messages of a bag that are on some channels.

    Raises UnreadableError after the last one if one of their topics had fewer than `least` messages per second.
    """
    followed = {channel.topic: Topic(channel.topic, least) for channel in topics}
    begin, end = math.inf, 0
    for message in messages:
        channel, received, _ = message
        begin, end = min(begin, received), max(end, received)
        if channel in topics:
            followed[channel.topic].add(received)
            yield message
    for topic in followed.values():
        topic.check(begin, end)


class Topic:
    """The messages of one topic, which must not come too slowly."""

    def __init__(self, name: str, least: float) -> None:
        self._name = name
        self._least = least
        self._count = max(SPAN, math.ceil(least))
        self._last: deque[int] = deque(maxlen=self._count + 1)
        self._worst: tuple[float, int] | None = None
        """The lowest rate and the time from which on it was measured."""

    def add(self, received: int) -> None:
        self._last.append(received)
        if len(self._last) > self._count:
            self._judge(self._count, self._count, received)

    def _judge(self, count: int, expected: int, until: int) -> None:
        """Note the rate of the messages after the first of the last ones, if `expected` of them should have come until then."""
        took = until - self._last[0]
        if took > expected / self._least * NS:
            rate = count * NS / took
            self._worst = min(self._worst or (rate, self._last[0]), (rate, self._last[0]))

    def check(self, begin: float, end: int) -> None:
        """Raise UnreadableError if the topic was too slow at any time; `begin` and `end` are those of the bag."""
        if not self._last:
            raise UnreadableError(f"the topic {self._name!r} has no message; min_rate = {self._least:g}")
        if len(self._last) > self._count:
            self._last.popleft()
        self._judge(len(self._last) - 1, len(self._last), max(self._last[-1], end - LEAVE_NS))  # the next one is late
        if self._worst is not None:
            rate, since = self._worst
            raise UnreadableError(
                f"the topic {self._name!r} falls to {rate:.3g} messages a second, {(since - begin) / NS:.1f} s after the bag "
                f"begins; min_rate = {self._least:g}"
            )


ROWS, BYTES = 5_000, 16 << 20
"""The limits on the messages of a batch, and on their bytes."""
RECEIVED, STAMP = "received_ns", "header_stamp_ns"
"""The columns with the times when a message was received, and of its sensor."""
NAMED = 8
"""The number of topics that an error names."""


class Keys(NamedTuple):
    """The keys of `[outputs.NAME]` that decide rows and columns."""

    topics: tuple[str, ...]
    ros: str = ""
    messages: Mapping[str, str] | tuple[()] = ()
    covariances: bool = False
    min_rate: float = 0.0


class BagTopics(Rewriter):
    """The reader of bags."""

    def __init__(self, shape: Shape, connection: Database) -> None:
        super().__init__(shape, connection)
        self._counted = 0
        self._keys = Keys(**dict(shape.form.own))

    @classmethod
    def reader(cls) -> type[TableReader]:
        return Parquet

    def plain(self) -> Shape:
        return replace(self.shape, format="parquet", form=replace(PLAIN, na=self.shape.form.na))

    def rewrite(self, source: OriginalFile, target: BinaryIO) -> int:
        with opened(source) as bag:
            index = bag.index()
            table = TopicTable(index, self._keys)
            self.shape = replace(self.shape, lengths=table.lengths, places=(*table.places, *table.lengths))
            self._counted = sum(index[channel] for channel in table.channels)
            return write(table, self._messages(bag, table), target)

    def _messages(self, bag: Bag, table: TopicTable) -> Iterator[Message]:
        """Yield the messages of the table. Raises UnreadableError if a topic has too few."""
        least = self._keys.min_rate
        if not least:
            return bag.scan(table.channels.__contains__)
        return checked(bag.scan(lambda channel: True), table.channels, least)

    def count(self, source: OriginalFile, written: int) -> int:
        """Return the number of messages by the index, which `rewrite` has read."""
        return self._counted


@contextmanager
def opened(source: OriginalFile, *, whole: bool = True) -> Iterator[Bag]:
    """Open a bag. Raises UnreadableError if it is none; `whole`: also if parts of its file are missing."""
    head = next(source.pieces(), b"")
    if head.startswith(SQLITE):
        with opened_database(source, whole=whole) as database:
            yield db3_bag.Db3Bag(database)
    elif head.startswith((ros1_bag.MAGIC, mcap_bag.MAGIC)):
        kind = ros1_bag.Ros1Bag if head.startswith(ros1_bag.MAGIC) else mcap_bag.McapBag
        with _plain(source) as path, path.open("rb") as file:
            yield kind(file)
    else:
        raise UnreadableError("is not a bag: it is neither ROS 1 (version 2.0) nor MCAP nor SQLite" if head else "is empty")


@contextmanager
def _plain(source: OriginalFile) -> Iterator[Path]:
    """Yield the path of the decompressed file."""
    if not source.compressed:
        yield source.path
        return
    with tempfile.TemporaryDirectory(prefix="sierra-") as folder:
        path = Path(folder, "bag")
        with path.open("wb") as file:
            file.writelines(source.pieces())
        yield path


@dataclass(frozen=True, slots=True)
class Pattern:
    """A topic, or a pattern of topics; names in braces and `*` stand for parts."""

    text: str

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(PLACEHOLDER.findall(self.text))

    def of(self, topic: str) -> tuple[str, ...] | None:
        """Return the parts of a topic that the names stand for; None for another topic."""
        literals = PLACEHOLDER.split(self.text)[::2]
        found = re.fullmatch("([^/]+)".join(re.escape(one).replace(r"\*", ".*") for one in literals), topic)
        return None if found is None else found.groups()


class TopicTable:
    """The table of some topics of a bag: its channels and its columns."""

    def __init__(self, known: Mapping[Channel, int], keys: Keys) -> None:
        """Choose the channels. Raises UnreadableError if a topic is missing, or if topics have different columns."""
        patterns = [Pattern(topic) for topic in keys.topics]
        self.names = patterns[0].names
        self.channels: dict[Channel, tuple[str, ...]] = {}
        """The channels with the parts of their topics that are columns."""
        for pattern in patterns:
            matching = {channel: parts for channel in known if (parts := pattern.of(channel.topic)) is not None}
            if not matching:
                topics = sorted({channel.topic for channel in known})
                has = few(topics, NAMED) if topics else "no topic"
                raise UnreadableError(f"has no topic {pattern.text!r}; it has {has}")
            self.channels = matching | self.channels
        types = MessageTypes(keys.ros, dict(keys.messages))
        self._types = {channel: types.of(channel) for channel in self.channels}
        self._check_alike()
        first = next(iter(self._types.values()))
        self.fields = tuple(topic for topic in first.fields if keys.covariances or not _is_covariance(topic.name))
        self._places = _places(first)

    def _check_alike(self) -> None:
        (first, expected), *others = self._types.items()
        for channel, found in others:
            if found.fields != expected.fields:
                raise UnreadableError(
                    f"the topics {first.topic!r} ({first.type}) and {channel.topic!r} ({channel.type}) have different fields; "
                    "make a table of each type"
                )

    @cached_property
    def schema(self) -> pa.Schema:
        import pyarrow as pa

        own = [("topic", pa.string()), *((name, pa.string()) for name in self.names), (RECEIVED, pa.int64())]
        columns = [*own, *((field.name, field.arrow) for field in self.fields)]
        taken = column_names([name for name, _ in own], ())
        names = (*taken, *stored_names([field.name for field in self.fields], taken))
        return pa.schema([(name, kind) for name, (_, kind) in zip(names, columns, strict=True)])

    @property
    def lengths(self) -> tuple[str, ...]:
        """The columns that have only the number of the items of a list."""
        return tuple(field.name for field in self.fields if field.kind in ("length", "bytes"))

    @property
    def places(self) -> tuple[str, ...]:
        """The columns with the topic of a message, the parts of it that have names, and when it was received."""
        return tuple(self.schema.names[: len(self.names) + 2])

    def type_of(self, channel: Channel) -> MessageType:
        return self._types[channel]

    def decoded(self, channel: Channel, data: bytes) -> tuple[Any, ...]:
        return self._types[channel].decoded(data)

    def batch(self, heads: Sequence[tuple[Channel, int]], values: Sequence[tuple[Any, ...]]) -> pa.RecordBatch:
        """Return some rows: the channels and times of messages, and the values of their attributes. Raises UnreadableError."""
        import pyarrow as pa

        parts = list(zip(*((channel.topic, *self.channels[channel]) for channel, _ in heads), strict=True))
        own = [*parts, [received for _, received in heads]]
        attributes = list(zip(*values, strict=True))
        columns = [field.values(attributes[self._places[field.name]]) for field in self.fields]
        try:
            arrays = [pa.array(values, field.type) for values, field in zip([*own, *columns], self.schema, strict=True)]
            return pa.record_batch(arrays, schema=self.schema)
        except (pa.ArrowException, OverflowError) as error:
            raise UnreadableError(f"a table cannot hold its messages ({' '.join(str(error).split())})") from error


def _places(kind: MessageType) -> Mapping[str, slice]:
    """Return the places of the attributes of each field among those of all fields."""
    ends, places = 0, {}
    for field in kind.fields:
        places[field.name] = slice(ends, ends + len(field.attributes))
        ends += len(field.attributes)
    return places


def _is_covariance(name: str) -> bool:
    return "covariance" in name.rpartition(".")[2].lower()


def write(table: TopicTable, messages: Iterable[Message], target: BinaryIO) -> int:
    """Write the messages as Parquet; return their number. Raises UnreadableError."""
    import pyarrow.parquet as pq

    rows = 0
    with pq.ParquetWriter(target, table.schema) as writer:
        for batch in batches(table, messages):
            writer.write_batch(batch)
            rows += batch.num_rows
    return rows


def batches(table: TopicTable, messages: Iterable[Message]) -> Iterator[pa.RecordBatch]:
    """Yield the messages as rows, some at a time. Raises UnreadableError."""
    heads: list[tuple[Channel, int]] = []
    values: list[tuple[Any, ...]] = []
    size = 0
    for channel, received, data in messages:
        heads.append((channel, received))
        values.append(table.decoded(channel, data))
        size += len(data)
        if len(heads) >= ROWS or size >= BYTES:
            yield table.batch(heads, values)
            heads, values, size = [], [], 0
    if heads:
        yield table.batch(heads, values)

"""Bags of ROS 2 in SQLite (`.db3`), the default of ROS 2 before Iron.

Only databases of Iron and newer have the definitions of the types, and a table `metadata`, into which the recorder writes the
number of messages when it closes the file. In an older database that was not closed, nothing shows this.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Mapping

from sierra.extensions.ros.bags.containers import ZSTD, Bag, Channel, Message, Wanted, unpacked
from sierra.ingest.base import UnreadableError
from sierra.util.lazy_definitions import regex

NUMBER = regex(r"message_count: *([0-9]+)")
TABLES = ("topics", "messages")


class Db3Bag(Bag):
    """A bag in SQLite."""

    def __init__(self, database: sqlite3.Connection) -> None:
        self._sql = database
        self._tables = {name for [name] in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if lacking := [name for name in TABLES if name not in self._tables]:
            raise UnreadableError(f"is not a bag: the database has no table {lacking[0]!r}")
        self._channels = self._described()

    def index(self) -> Mapping[Channel, int]:
        counts = dict(self._sql.execute("SELECT topic_id, count(*) FROM messages GROUP BY topic_id").fetchall())
        if unknown := counts.keys() - self._channels.keys():
            raise UnreadableError(f"has messages of topic {min(map(str, unknown))}, which it does not describe")
        if counts and "metadata" in self._tables:
            rows = self._sql.execute("SELECT metadata FROM metadata ORDER BY id DESC LIMIT 1").fetchall()
            if not any(int(digits) for digits in NUMBER.findall(str(rows))[-1:]):
                raise UnreadableError(
                    "is incomplete: its metadata lack the number of messages, so its recorder did not close it"
                )
        return {channel: int(counts.get(number, 0)) for number, channel in self._channels.items()}

    def scan(self, wanted: Wanted) -> Iterator[Message]:
        for number, received, data in self._sql.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY id"):
            channel = self._channels.get(number)
            if channel is None or not isinstance(received, int) or not isinstance(data, bytes):
                raise UnreadableError("has a message without a topic, a time or data")
            if wanted(channel):
                yield channel, received, unpacked(data, "zstd") if data.startswith(ZSTD) else data

    def _described(self) -> dict[int, Channel]:
        definitions = {}
        if "message_definitions" in self._tables:
            rows = self._sql.execute("SELECT topic_type, encoding, encoded_message_definition FROM message_definitions")
            definitions = {name: (encoding, definition) for name, encoding, definition in rows}
        columns = {name for name, *_ in self._sql.execute("SELECT * FROM topics LIMIT 0").description}
        digest = "type_description_hash" if "type_description_hash" in columns else "''"
        channels = {}
        for number, *fields in self._sql.execute(f"SELECT id, name, type, serialization_format, {digest} FROM topics"):
            if not isinstance(number, int) or not all(isinstance(text, str) for text in fields):
                raise UnreadableError("has a topic without a number, a name or a type")
            topic, kind, serialization, hashed = fields
            language, definition = definitions.get(kind, ("", ""))
            if serialization != "cdr":
                channels[number] = Channel(number, topic, "", serialization, "msg", "", ros1=False)
                continue
            known = isinstance(definition, str) and language in ("ros2msg", "ros2idl")
            channels[number] = Channel(
                number,
                topic,
                kind,
                definition if known else None,
                "idl" if language == "ros2idl" else "msg",
                hashed,
                ros1=False,
            )
        return channels

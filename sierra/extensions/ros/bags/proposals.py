"""Proposals of tables for a bag: topics of one type that differ only in their first part, as robots' do, become one table."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sierra.extensions.ros.bags.bag_topics import RECEIVED, opened
from sierra.extensions.ros.bags.containers import Channel
from sierra.extensions.ros.bags.message_types import Field, MessageTypes
from sierra.ingest.base import UnreadableError
from sierra.ingest.model import Written
from sierra.ingest.rewriting import Source

STAMP = "header_stamp_ns"
ROBOT = "robot"


@dataclass(frozen=True, slots=True)
class Proposal:
    """Topics of a bag that make a table, or the reason why they make none."""

    topics: tuple[str, ...]
    """The topics, or one pattern of them."""
    type: str
    messages: int
    fields: tuple[Field, ...] = ()
    lacking: str = ""
    """The reason why these topics make no table; empty if they do."""

    @property
    def name(self) -> str:
        """A name for the table: the topic without the part that stands for the robot."""
        parts = [part for part in self.topics[0].split("/") if part and part != f"{{{ROBOT}}}"]
        return "_".join(parts)

    @property
    def units(self) -> dict[str, str]:
        times = [field.name for field in self.fields if field.kind == "time" and field.name == STAMP]
        return dict.fromkeys([RECEIVED, *times], "ns")


def proposals(content: bytes, name: str) -> Sequence[Proposal]:
    """Return the tables that a bag can make, in the order of their topics. Raises UnreadableError."""
    with tempfile.TemporaryDirectory(prefix="sierra-") as folder:
        path = Path(folder, "bag")
        path.write_bytes(content)
        with opened(Source(Written(str(path), "", "", name, "", 0, True, len(content)))) as bag:
            index = bag.index()
    alike: dict[tuple[str, str], list[Channel]] = {}
    for channel in sorted(index, key=lambda one: (one.topic, one.number)):
        alike.setdefault((channel.type, _rest(channel.topic)), []).append(channel)
    types = MessageTypes("")
    return [_proposal(channels, sum(index[one] for one in channels), types) for channels in alike.values()]


def _rest(topic: str) -> str:
    """Return the part of a topic that those of other robots share; of a topic with one part, all of it."""
    _, between, rest = topic.lstrip("/").partition("/")
    return between + rest if between and topic.startswith("/") else topic


def _proposal(channels: Sequence[Channel], messages: int, types: MessageTypes) -> Proposal:
    topics = tuple(dict.fromkeys(channel.topic for channel in channels))
    kind = channels[0].type
    if len(topics) > 1:
        topics = (f"/{{{ROBOT}}}{_rest(topics[0])}",)
    try:
        fields = types.of(channels[0]).fields
    except UnreadableError as error:
        return Proposal(topics, kind, messages, lacking=str(error))
    if bulky := [field.name.removesuffix(".length") for field in fields if field.kind == "bytes"]:
        return Proposal(
            topics, kind, messages, fields, f"{bulky[0]!r} has bytes, such as those of images, which stay in the bag"
        )
    return Proposal(topics, kind, messages, fields)

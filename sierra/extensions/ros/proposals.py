"""Proposals of tables for a bag: topics of one type that differ only in their first part, as robots' do, become one table."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

from sierra.config.output_tables import Keys, Proposal
from sierra.extensions.ros.bags.bag_topics import RECEIVED, STAMP, opened
from sierra.extensions.ros.bags.containers import Channel
from sierra.extensions.ros.bags.message_types import MessageTypes
from sierra.ingest.base import UnreadableError
from sierra.ingest.model import Written
from sierra.ingest.rewriting import OriginalFile
from sierra.util.text import counted

ROBOT = "robot"


def proposals(content: bytes, name: str) -> Sequence[Proposal]:
    """Return the tables that a bag can make, in the order of their topics.

    There are none for a bag that was cut off, and without the packages that read it.
    """
    try:
        return _proposals(content, name)
    except (UnreadableError, ImportError):
        return ()


def _proposals(content: bytes, name: str) -> Sequence[Proposal]:
    with tempfile.TemporaryDirectory(prefix="sierra-") as folder:
        path = Path(folder, "bag")
        path.write_bytes(content)
        with opened(OriginalFile(Written(str(path), "", "", name, "", 0, True, len(content)))) as bag:
            index = bag.index()
    alike: dict[tuple[str, str], list[Channel]] = {}
    for channel in sorted(index, key=lambda channel: (channel.topic, channel.number)):
        alike.setdefault((channel.type, _rest(channel.topic)), []).append(channel)
    types = MessageTypes("")
    return [_proposal(channels, sum(index[entry] for entry in channels), types) for channels in alike.values()]


def _rest(topic: str) -> str:
    """Return the part of a topic that those of other robots share; of a topic with one part, all of it."""
    _, between, rest = topic.lstrip("/").partition("/")
    return between + rest if between and topic.startswith("/") else topic


def _proposal(channels: Sequence[Channel], messages: int, types: MessageTypes) -> Proposal:
    topics = tuple(dict.fromkeys(channel.topic for channel in channels))
    kind = channels[0].type
    if len(topics) > 1:
        topics = (f"/{{{ROBOT}}}{_rest(topics[0])}",)
    what = f"topic {', '.join(topics)} ({kind}, {counted(messages, 'message')})"
    keys: Keys = {"format": "bag", "topics": list(topics)}
    parts = [part for part in topics[0].split("/") if part and part != f"{{{ROBOT}}}"]
    lacking, times = "", [RECEIVED]
    try:
        fields = types.of(channels[0]).fields
        times += [field.name for field in fields if field.kind == "time" and field.name == STAMP]
        if bulky := [field.name.removesuffix(".length") for field in fields if field.kind == "bytes"]:
            lacking = f"{bulky[0]!r} has bytes, such as those of images, which stay in the bag"
    except UnreadableError as error:
        lacking = str(error)
    usual: Keys = {"mismatch": "ragged", "volatile": [RECEIVED], "units": dict.fromkeys(times, "ns")}
    return Proposal(what, f"{'_'.join(parts)}.bag", keys, usual, lacking)

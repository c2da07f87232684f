"""Bags for tests, written by `rosbags` in each format that ROS records."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from rosbags.interfaces import Nodetype
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

KINDS = ("bag", "mcap", "db3")
ODOMETRY = "nav_msgs/msg/Odometry"
NS = 10**9


class Recorded(NamedTuple):
    """A message: its topic and type, when it was received in ns, and its values by their paths; all others are 0 or empty."""

    topic: str
    type: str
    received: int
    values: Mapping[str, Any] = {}


def record(
    folder: Path,
    kind: str,
    messages: Iterable[Recorded],
    topics: Mapping[str, str] | None = None,
    store: Typestore | None = None,
) -> Path:
    """Write a bag; return its path. `topics` are types by topics without messages; `store` has types of one's own."""
    folder.mkdir(parents=True, exist_ok=True)
    store = store or get_typestore(Stores.ROS1_NOETIC if kind == "bag" else Stores.ROS2_HUMBLE)
    if kind == "bag":
        return _write(Writer1(folder / "run.bag"), store, messages, topics, folder / "run.bag")
    plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
    writer = Writer2(folder / "run", version=9, storage_plugin=plugin)
    return _write(writer, store, messages, topics, folder / "run" / f"run.{kind}")


def odometry(robots: int = 2, count: int = 3) -> list[Recorded]:
    """Return messages of some robots in turn, which move along x; their clocks are 1 s behind the recorder's."""
    return [
        Recorded(
            f"/tb{robot}/odom",
            ODOMETRY,
            (step + 1) * NS + robot,
            {"header.stamp.sec": step, "header.frame_id": "map", "pose.pose.position.x": step + robot / 4},
        )
        for step in range(count)
        for robot in range(robots)
    ]


def _write(
    writer: Writer1 | Writer2,
    store: Typestore,
    messages: Iterable[Recorded],
    topics: Mapping[str, str] | None,
    path: Path,
) -> Path:
    with writer:
        known: dict[str, Any] = {}

        def connection(topic: str, kind: str) -> Any:
            if topic not in known:
                known[topic] = writer.add_connection(topic, kind, typestore=store)
            return known[topic]

        for topic, kind in (topics or {}).items():
            connection(topic, kind)
        for one in messages:
            content = message(store, one.type, one.values)
            data = store.serialize_ros1(content, one.type) if path.suffix == ".bag" else store.serialize_cdr(content, one.type)
            writer.write(connection(one.topic, one.type), one.received, data)
    return path


def message(store: Typestore, kind: str, values: Mapping[str, Any], path: str = "") -> Any:
    """Return a message with some values by their paths."""
    return store.types[kind](**{name: _value(store, detail, values, path + name) for name, detail in store.fielddefs[kind][1]})


def _value(store: Typestore, detail: Any, values: Mapping[str, Any], path: str) -> Any:
    import numpy as np

    match detail:
        case (Nodetype.NAME, kind):
            return message(store, kind, values, f"{path}.")
        case (Nodetype.BASE, (name, _)):
            return values.get(path, "" if name == "string" else 0)
        case (_, ((Nodetype.NAME, kind), _)):
            return [message(store, kind, item) for item in values.get(path, ())]
        case (_, ((_, ("string", _)), _)):
            return list(values.get(path, ()))
        case (_, ((_, (name, _)), size)):
            return np.array(values.get(path, [0] * size), dtype="uint8" if name == "char" else name)
    raise AssertionError(detail)

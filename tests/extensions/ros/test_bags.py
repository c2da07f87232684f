"""Topics of bags become tables with the same rows in each format; cut, damaged or hostile bags are errors of one line."""

from __future__ import annotations

import contextlib
import gzip
import itertools
import json
import sqlite3
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from sierra.config.output_tables import Output
from sierra.extensions.ros.bags import bag_topics
from sierra.extensions.ros.bags.containers import Channel
from sierra.extensions.ros.recovery import recover
from sierra.ingest.base import UnreadableError
from sierra.ingest.model import Form
from sierra.testing import readers as conformance
from tests import projects
from tests.projects import quick
from tests.readings import read_file

pytest.importorskip("rosbags")

from tests.extensions.ros import bags
from tests.extensions.ros.bags import KINDS, NS, Recorded, odometry, record

RECEIVED = "received_ns"
ROBOTS = ["/{robot}/odom"]


def rows(folder: Path, path: Path, topics: list[str], name: str = "", **keys: Any) -> list[dict[str, Any]]:
    reading, found = read_file(folder / "read", name or path.name, path.read_bytes(), format="bag", topics=topics, **keys)
    assert not reading.faults
    assert list(reading.counted.values()) == [len(found)]
    return found


def fault(folder: Path, content: bytes, topics: list[str] | None = None, **keys: Any) -> str:
    reading, found = read_file(folder / "read", "run.x", content, format="bag", topics=topics or ROBOTS, **keys)
    assert found == []
    assert "\n" not in reading.faults["e0"]
    assert "failed: " not in reading.faults["e0"]
    return reading.faults["e0"].removeprefix("run.x: ")


def values(row: dict[str, Any], *names: str) -> tuple[Any, ...]:
    return tuple(row[name] for name in names)


@pytest.mark.parametrize("kind", KINDS)
def test_messages_of_all_robots_are_the_rows_of_one_table(tmp_path: Path, kind: str) -> None:
    found = rows(tmp_path, record(tmp_path, kind, odometry()), ROBOTS)
    assert [values(row, "topic", "robot", "received_ns", "header_stamp_ns", "pose.pose.position.x") for row in found] == [
        (f"/tb{robot}/odom", f"tb{robot}", (step + 1) * NS + robot, step * NS, step + robot / 4)
        for step in range(3)
        for robot in range(2)
    ]
    others = [name for name in found[0] if name not in ("header.seq", "header_stamp_ns")]
    assert others[:6] == ["topic", "robot", "received_ns", "header.frame_id", "child_frame_id", "pose.pose.position.x"]
    assert ("header.seq" in found[0]) == (kind == "bag")  # only ROS 1 has it
    assert not any("covariance" in name for name in found[0])
    assert (
        len(rows(tmp_path, record(tmp_path / "c", kind, odometry(1, 1)), ROBOTS, covariances=True)[0]["pose.covariance"]) == 36
    )


@pytest.mark.parametrize("kind", KINDS)
def test_arrays_are_lists_and_of_images_and_lists_of_messages_there_is_the_length(tmp_path: Path, kind: str) -> None:
    path = record(
        tmp_path,
        kind,
        [
            Recorded("/scan", "sensor_msgs/msg/LaserScan", 5, {"ranges": [0.5, 1.5], "range_max": 2.0}),
            Recorded("/camera", "sensor_msgs/msg/Image", 6, {"height": 2, "data": [1, 2, 3, 4], "encoding": "mono8"}),
            Recorded("/path", "nav_msgs/msg/Path", 7, {"poses": [{"pose.position.x": 0.5}, {}]}),
            Recorded("/names", "sensor_msgs/msg/JointState", 8, {"name": ["ä", "b"], "header.stamp.nanosec": 9}),
            Recorded("/on", "std_msgs/msg/Bool", 9, {"data": True}),
            Recorded("/tick", "std_msgs/msg/Empty", 9),
            Recorded("/late", "sensor_msgs/msg/Imu", 9, {"header.stamp.sec": 1}),
        ],
    )
    [scan] = rows(tmp_path, path, ["/scan"])
    assert values(scan, "ranges", "range_max", "intensities") == ([0.5, 1.5], 2.0, [])
    [image] = rows(tmp_path, path, ["/camera"])
    assert values(image, "height", "encoding", "data.length") == (2, "mono8", 4)
    assert "data" not in image
    assert values(rows(tmp_path, path, ["/path"])[0], "topic", "received_ns", "poses.length") == ("/path", 7, 2)
    assert values(rows(tmp_path, path, ["/n*"])[0], "name", "header_stamp_ns") == (["ä", "b"], 9)
    assert rows(tmp_path, path, ["/tick"]) == [{"topic": "/tick", "received_ns": 9}]
    assert rows(tmp_path, path, ["/on"]) == [{"topic": "/on", "received_ns": 9, "data": True}]


@pytest.mark.parametrize("kind", KINDS)
def test_bytes_are_signed_in_ros_1_and_unsigned_in_ros_2(tmp_path: Path, kind: str) -> None:
    import numpy as np
    from rosbags.typesys import get_types_from_msg

    store = bags.get_typestore(bags.Stores.ROS1_NOETIC if kind == "bag" else bags.Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg("byte one\nbyte[3] three\nchar letter\nchar[2] letters\nint8 small", "t/msg/A"))
    pair = np.array([255, 1], dtype="uint8")
    content = store.types["t/msg/A"](one=-1, three=np.array([-128, 127, -1], "int8"), letter=255, letters=pair, small=-1)
    path = record(tmp_path, kind, [Recorded("/x", "t/msg/A", 1, vars(content))], store=store)
    [row] = rows(tmp_path, path, ["/x"])
    numbers = (-1, [-128, 127, -1]) if kind == "bag" else (255, [128, 127, 255])
    assert values(row, "one", "three", "letter", "letters", "small") == (*numbers, 255, [255, 1], -1)


@pytest.mark.parametrize("kind", KINDS)
def test_topic_without_messages_is_an_empty_table_and_an_absent_one_is_an_error(tmp_path: Path, kind: str) -> None:
    path = record(tmp_path, kind, odometry(), {"/goal": "std_msgs/msg/Float64", '/it\'s "quoted"': "std_msgs/msg/Float64"})
    assert rows(tmp_path, path, ["/goal"]) == []
    assert rows(tmp_path, path, ['/it\'s "quoted"']) == []
    content = path.read_bytes()
    assert fault(tmp_path, content, ["/{robot}/scan"]).startswith("has no topic '/{robot}/scan'; it has /goal, ")
    mixed = fault(tmp_path, content, ["/tb0/odom", "/goal"])
    assert mixed.startswith("the topics '/goal' (std_msgs/")
    assert mixed.endswith("have different fields; make a table of each type")


def test_compressed_bags_are_read(tmp_path: Path) -> None:
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2

    ros1, ros2 = bags.get_typestore(bags.Stores.ROS1_NOETIC), bags.get_typestore(bags.Stores.ROS2_HUMBLE)
    for number, compression in enumerate(Writer1.CompressionFormat):
        writer = Writer1(tmp_path / f"{number}.bag")
        writer.set_compression(compression)
        path = bags._write(writer, ros1, odometry(), None, tmp_path / f"{number}.bag")
        assert len(rows(tmp_path, path, ROBOTS)) == 6
    for name, plugin, mode in (
        ("a", StoragePlugin.MCAP, CompressionMode.STORAGE),
        ("b", StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
    ):
        two = Writer2(tmp_path / name, version=9, storage_plugin=plugin)
        two.set_compression(mode, CompressionFormat.ZSTD)
        ending = "mcap" if plugin is StoragePlugin.MCAP else "db3"
        assert len(rows(tmp_path, bags._write(two, ros2, odometry(), None, tmp_path / name / f"{name}.{ending}"), ROBOTS)) == 6
    packed = tmp_path / "run.bag.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    assert len(rows(tmp_path, packed, ROBOTS)) == 6


@pytest.mark.parametrize("kind", KINDS)
def test_bag_that_was_cut_off_or_changed_is_refused(tmp_path: Path, kind: str) -> None:
    content = record(tmp_path, kind, odometry()).read_bytes()
    for size in (1, 20, len(content) // 2, len(content) * 2 // 3, len(content) - 1):
        assert any(word in fault(tmp_path, content[:size]) for word in ("truncated", "not a bag", "SQLite cannot read"))
    assert fault(tmp_path, b"") == "is empty"
    assert "is not a bag" in fault(tmp_path, b"#ROSBAG V1.1\n" + content[13:])


def test_sizes_in_a_bag_are_not_trusted(tmp_path: Path) -> None:
    ros1 = record(tmp_path, "bag", odometry()).read_bytes()
    place = ros1.index(b"size=") + 5
    stated = struct.unpack("<I", ros1[place : place + 4])[0]
    assert "another size" in fault(tmp_path, ros1[:place] + struct.pack("<I", stated + 1) + ros1[place + 4 :])
    assert "maximum" in fault(tmp_path, ros1[:place] + b"\xff" * 4 + ros1[place + 4 :])
    length = ros1.index(struct.pack("<I", stated), place + 4)
    assert "maximum" in fault(tmp_path, ros1[:length] + b"\xff" * 4 + ros1[length + 4 :])
    count = ros1.rindex(b"count=") + 6
    changed = fault(tmp_path, ros1[: count + 20] + b"\x09" + ros1[count + 21 :])
    assert "rows, but 6 were found" in changed or "index" in changed
    assert "maximum" in fault(tmp_path, mcap(struct.pack("<BQ", 6, 1 << 62)))


def mcap(chunk: bytes) -> bytes:
    """Return a file in MCAP with this record, and without a summary."""
    head = struct.pack("<BQII", 1, 8, 0, 0)
    return (
        b"\x89MCAP0\r\n"
        + head
        + chunk
        + struct.pack("<BQI", 15, 4, 0)
        + struct.pack("<BQQQI", 2, 20, 0, 0, 0)
        + b"\x89MCAP0\r\n"
    )


@pytest.mark.parametrize("stated", [100, 1 << 40])
def test_compression_bomb_is_refused_before_it_fills_the_memory(tmp_path: Path, stated: int) -> None:
    import pyarrow as pa

    packed = pa.compress(bytes(1 << 26), "zstd", asbytes=True)
    body = struct.pack("<QQQII", 0, 0, stated, 0, 4) + b"zstd" + struct.pack("<Q", len(packed)) + packed
    refused = fault(tmp_path, mcap(struct.pack("<BQ", 6, len(body)) + body))
    assert ("another size than the 100 bytes" if stated == 100 else "is the maximum") in refused


def described(folder: Path, kind: str, definition: str, data: bytes = b"") -> bytes:
    """Return a bag of ROS 1 with a message of a type of its own on the topic `/x`."""
    from rosbags.rosbag1 import Writer as Writer1

    path = folder / f"{len(list(folder.iterdir()))}.bag"
    with Writer1(path) as writer:
        writer.write(writer.add_connection("/x", kind, msgdef=definition, md5sum="*"), 1, data)
    return path.read_bytes()


NEST = "\n".join(f"{'=' * 80}\nMSG: t/T{n}\n" + "\n".join(f"T{n + 1} f{m}" for m in range(10)) for n in range(1, 9))


@pytest.mark.parametrize(
    ("definition", "why"),
    [
        ("t/A again", "contains itself"),
        ("t/B[] items\n" + "=" * 80 + "\nMSG: t/B\nt/A[] more", "contains itself"),
        ("t/E[] items\n" + "=" * 80 + "\nMSG: t/E\n", "items without fields"),
        ("float64[1000000] all", "is the maximum"),
        ("t/Z unknown", "needs the type 't/msg/Z', which is not known"),
        ("T1 deep\n" + NEST + "\n" + "=" * 80 + "\nMSG: t/T9\nint8 x", "more than 10000 fields"),
        ("float64 x\nfloat64 x", "two fields of the same name"),
        ("float64 x; import os", "is damaged"),
        ("int8" + "[9] " * 20_000 + "x", "arrays of arrays"),
    ],
)
def test_definition_that_would_occupy_the_machine_is_refused(tmp_path: Path, definition: str, why: str) -> None:
    assert why in fault(tmp_path, described(tmp_path, "t/msg/A", definition, b"\xff" * 8), ["/x"])


def test_expressions_in_a_definition_do_not_occupy_the_parser() -> None:
    from sierra.extensions.ros.bags.containers import Channel
    from sierra.extensions.ros.bags.message_types import MessageTypes

    def fields(constant: str) -> list[str]:
        struct = '@verbatim (language="comment", text="a ((b" "c")\nstruct A { double x; }; // ((1))\n'
        definition = f"module t {{ module msg {{ module A_Constants {{ {constant} }}; {struct} }}; }};"
        channel = Channel(1, "/x", "t/msg/A", definition, "idl", "", ros1=False)
        return [field.name for field in MessageTypes("").of(channel).fields]

    assert fields("const uint8 C = 1;") == ["x"]
    for endless in ("(" * 30 + "1" + ")" * 30, "(1 + (1))", "1 << 99999999999"):
        with pytest.raises(UnreadableError, match="expressions within expressions"):
            fields(f"const uint8 C = {endless};")


def test_name_of_a_type_cannot_become_code(tmp_path: Path) -> None:
    content = record(tmp_path, "bag", odometry()).read_bytes()
    evil = b"x/A:\n  open('y',9)"[: len("nav_msgs/Odometry")]
    assert "is not the name of a type" in fault(tmp_path, content.replace(b"type=nav_msgs/Odometry", b"type=" + evil))


def test_own_fields_stay_beside_the_columns_of_all_bags(tmp_path: Path) -> None:
    path = tmp_path / "x.bag"
    path.write_bytes(described(tmp_path, "t/msg/A", "uint8 topic\nuint8 Received_ns\nuint8 class", b"\1\2\3"))
    found = rows(tmp_path, path, ["/x"])
    assert found == [{"topic": "/x", "received_ns": 1, "topic_": 1, "Received_ns_": 2, "class": 3}]


def change(path: Path, *statements: str) -> bytes:
    with sqlite3.connect(path) as database:
        for statement in statements:
            database.execute(statement)
    database.close()
    return path.read_bytes()


def test_database_of_an_older_ros_needs_its_version(tmp_path: Path) -> None:
    path = record(tmp_path, "db3", odometry())
    content = change(path, "DROP TABLE message_definitions")
    assert 'ros = "humble" names the version' in fault(tmp_path, content)
    assert len(rows(tmp_path, path, ROBOTS, ros="humble")) == 6
    content = change(path, "UPDATE topics SET type_description_hash = 'RIHS01_0'")
    assert "another definition of 'nav_msgs/msg/Odometry'" in fault(tmp_path, content, ros="humble")
    content = change(path, "UPDATE topics SET type = 'my_msgs/msg/Own'")
    assert "neither the bag nor ROS 2 humble has" in fault(tmp_path, content, ros="humble")


MESSAGES = {
    "t/msg/State": "std_msgs/Header header\nPart[2] parts\nPart best\n",
    "t/msg/Part": "float64 x\nuint8 UP=1\nstring name\n",
}
STATE = Recorded("/x", "t/msg/State", 1, {"header.stamp.sec": 2, "parts": [{}, {}], "best.x": 0.5, "best.name": "ä"})


def of_own_types(folder: Path, kind: str) -> Path:
    from rosbags.typesys import get_types_from_msg

    store = bags.get_typestore(bags.Stores.ROS1_NOETIC if kind == "bag" else bags.Stores.ROS2_HUMBLE)
    for name in reversed(MESSAGES):
        store.register(get_types_from_msg(MESSAGES[name], name))
    return record(folder, kind, [STATE], store=store)


def without_definitions(path: Path) -> bytes:
    """Return a bag without the definitions of its types: a database as before Iron, or MCAP with blank ones."""
    if path.suffix == ".db3":
        return change(path, "DROP TABLE message_definitions", "UPDATE topics SET type_description_hash = ''")
    import io

    from mcap.reader import make_reader
    from mcap.writer import Writer

    target = io.BytesIO()
    writer = Writer(target)
    writer.start()
    for schema, channel, message in make_reader(io.BytesIO(path.read_bytes())).iter_messages():
        assert schema is not None
        number = writer.register_channel(channel.topic, "cdr", writer.register_schema(schema.name, schema.encoding, b""))
        writer.add_message(number, message.log_time, message.data, message.publish_time)
    writer.finish()
    return target.getvalue()


@pytest.mark.parametrize("kind", KINDS)
def test_own_types_are_read_as_the_bag_defines_them_whatever_messages_says(tmp_path: Path, kind: str) -> None:
    path = of_own_types(tmp_path, kind)
    other = {"t/msg/State": "uint8 wrong", "t/msg/Part": "float32 x"}
    for messages in ({}, other):
        [row] = rows(tmp_path, path, ["/x"], messages=messages)
        assert values(row, "header_stamp_ns", "parts.length", "best.x", "best.name") == (2 * NS, 2, 0.5, "ä")


@pytest.mark.parametrize("kind", ["mcap", "db3"])
def test_messages_define_the_types_that_a_bag_does_not(tmp_path: Path, kind: str) -> None:
    path = of_own_types(tmp_path, kind)
    whole = rows(tmp_path, path, ["/x"])
    content = without_definitions(path)
    path.write_bytes(content)
    assert rows(tmp_path, path, ["/x"], ros="humble", messages=MESSAGES) == whole
    own_header = {"std_msgs/msg/Header": "builtin_interfaces/Time stamp\nstring frame_id\n"}
    assert rows(tmp_path, path, ["/x"], messages=MESSAGES | own_header) == whole
    cure = 'messages = ["FOLDER"] names a folder of the project with its PACKAGE/msg/NAME.msg'
    lacking = f"the type 't/msg/State' needs the type 'std_msgs/msg/Header', which is not known; {cure}"
    assert fault(tmp_path, content, ["/x"], messages=MESSAGES) == lacking
    shorter = {"t/msg/State": "std_msgs/Header header\nPart best\n", "t/msg/Part": "float64 x"}
    assert "a message of type 't/msg/State': is damaged" in fault(tmp_path, content, ["/x"], ros="humble", messages=shorter)
    if kind == "db3":
        assert fault(tmp_path, content, ["/x"]).endswith(cure)
        unknown = f"neither the bag nor messages has the definition of the type 't/msg/State'; {cure}"
        assert fault(tmp_path, content, ["/x"], messages=own_header) == unknown


def test_messages_before_the_types_of_ros_and_not_if_their_hash_is_another(tmp_path: Path) -> None:
    path = record(tmp_path, "db3", odometry())
    content = change(path, "DROP TABLE message_definitions")
    own = {"nav_msgs/msg/Odometry": "std_msgs/Header header\nstring child\n"}
    assert "another definition of 'nav_msgs/msg/Odometry'" in fault(tmp_path, content, ros="humble", messages=own)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("State again", "contains itself"),
        ("float64[1000000] all", "is the maximum"),
        ("float64 x\n" + "=" * 80 + "\nMSG: std_msgs/Header\nuint8 y", "defines other types too"),
        ("int8" + "[9] " * 20_000 + "x", "arrays of arrays"),
        ("a" * 50_000, "is damaged (Could not parse"),
        ("../../x/Y y", "is damaged"),
    ],
)
def test_messages_that_would_occupy_the_machine_are_refused(tmp_path: Path, text: str, why: str) -> None:
    said = fault(tmp_path, without_definitions(of_own_types(tmp_path, "db3")), ["/x"], messages={"t/msg/State": text})
    assert why in said
    assert len(said) < 400


def test_database_is_only_read(tmp_path: Path) -> None:
    topic = "/'; DROP TABLE messages; --"
    path = record(tmp_path, "db3", [Recorded(topic, "std_msgs/msg/Float64", 1, {"data": 0.5})])
    assert rows(tmp_path, path, [topic]) == [{"topic": topic, "received_ns": 1, "data": 0.5}]
    open_ended = change(path, "UPDATE metadata SET metadata = 'message_count: 0'")
    assert "its recorder did not close it" in fault(tmp_path, open_ended, [topic])
    endless = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT 1 FROM n) SELECT i AS id, 1 AS topic_id FROM n"
    content = change(path, "DROP TABLE messages", f"CREATE VIEW messages AS {endless}")
    assert "has no table 'messages'" in fault(tmp_path, content, [topic])


@pytest.mark.parametrize(
    ("keys", "why"),
    [
        ({}, "needs topics"),
        ({"topics": ["/{a}/x", "/{b}/x"]}, "the same names in braces"),
        ({"topics": ["/{topic}/x"]}, "none of topic, received_ns"),
        ({"topics": ["/{robot}/x"], "file": "{robot}/run.bag"}, "none of topic, received_ns, robot"),
        ({"topics": ["/x"], "ros": "noetic"}, "known are dashing"),
        ({"topics": ["/x"], "messages": ["../other"]}, "a path within the project"),
        ({"topics": ["/x"], "messages": {"t/../State": "uint8 x"}}, "should match pattern"),
    ],
)
def test_keys_of_a_bag_are_checked(keys: dict[str, Any], why: str) -> None:
    with pytest.raises(ValueError, match=why):
        Output.model_validate({"file": "run.bag", "format": "bag", **keys})


def test_missing_extra_is_named_before_anything_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rosbags", None)
    projects.make(tmp_path, projects.CONFIG + '[outputs.o]\nfile = "o.bag"\nformat = "bag"\ntopics = ["/x"]\n')
    ended = quick(tmp_path, "run", "population_size=1")
    said = "outputs in bags of ROS need the package rosbags: pip install 'sierra-experiments[bags]'"
    assert (ended.returncode, ended.stderr.splitlines()) == (3, [f"sierra: {said}"])


@pytest.mark.integration
@pytest.mark.parametrize("kind", KINDS)
def test_bag_is_a_reader(tmp_path: Path, kind: str) -> None:
    tables = {}
    for count in (2, 3):
        path = record(tmp_path / str(count), kind, odometry(2, count))
        found = rows(tmp_path / str(count), path, ROBOTS)
        tables[path.read_bytes()] = {name: [row[name] for row in found] for name in found[0]}
    first = next(iter(tables))
    conformance.check(
        "bag", tables, [first[:-9], gzip.compress(b"x")], tmp_path / "a", form=Form(own=(("topics", tuple(ROBOTS)),))
    )


READ_BY_ROS = """
import json, rosbag, sys
rows = []
for topic, message, time in rosbag.Bag(sys.argv[1]).read_messages():
    position = message.pose.pose.position
    rows.append([topic, time.to_nsec(), message.header.stamp.to_nsec(), message.header.seq, position.x, position.y])
print(json.dumps(rows))
"""
WRITTEN_BY_ROS = """
import random, rosbag, rospy, sys
from nav_msgs.msg import Odometry
with rosbag.Bag(sys.argv[1], "w", compression=sys.argv[2], chunk_threshold=4096) as bag:
    for step in range(50):
        message = Odometry()
        message.header.seq, message.header.stamp = step, rospy.Time(step, random.randrange(10**9))
        message.pose.pose.position.x, message.pose.pose.position.y = random.random(), -random.random()
        bag.write("/tb%d/odom" % (step % 3), message, rospy.Time(step, random.randrange(10**9)))
"""


@pytest.mark.integration
@pytest.mark.real
@pytest.mark.parametrize("compression", ["none", "bz2", "lz4"])
def test_values_are_those_that_ros_reads(tmp_path: Path, require: Callable[..., str], compression: str) -> None:
    def ros(code: str, *words: str) -> str:
        return subprocess.run(["/usr/bin/python3", "-c", code, *words], check=True, capture_output=True, text=True).stdout

    there = subprocess.run(["/usr/bin/python3", "-c", "import rosbag, nav_msgs"], check=False, capture_output=True)
    require("python3-rosbag", there=there.returncode == 0)
    path = tmp_path / "ros.bag"
    ros(WRITTEN_BY_ROS, str(path), compression)
    ours = [
        list(values(row, "topic", RECEIVED, "header_stamp_ns", "header.seq", "pose.pose.position.x", "pose.pose.position.y"))
        for row in rows(tmp_path, path, ROBOTS)
    ]
    assert ours == json.loads(ros(READ_BY_ROS, str(path)))


@pytest.mark.parametrize("kind", KINDS)
def test_messages_before_the_cut_are_recovered_and_marked(tmp_path: Path, kind: str) -> None:
    import pyarrow.parquet as pq

    whole = record(tmp_path, kind, odometry(2, 200))
    expected = rows(tmp_path, whole, ROBOTS)
    cut = tmp_path / f"cut.{kind}"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size * 2 // 3])
    output = Output.model_validate({"file": cut.name, "format": "bag", "topics": tuple(ROBOTS)})
    [found] = recover(cut, cut.name, {"odom": output, "other": Output(file="other.csv")})
    assert found.path.name == f"cut.{kind}.odom.partial.parquet"
    table = pq.read_table(found.path).to_pylist()
    assert 200 < found.rows == len(table) < 400
    assert table == [row | {"partial": True} for row in expected[: len(table)]]
    assert found.reason
    assert list(recover(whole, whole.name, {"odom": output.model_copy(update={"file": whole.name})})) == []


def times(*periods: float) -> Iterator[float]:
    """Yield the times of messages that follow each other after these periods, in s."""
    return itertools.accumulate(periods, initial=10.0)


STEADY = [0.1] * 100
"""Ten messages a second for ten seconds."""


@pytest.mark.parametrize(
    ("periods", "end", "rate"),
    [
        (STEADY, 20.0, None),
        ([*STEADY[:50], 0.2, *STEADY[51:]], 20.1, None),
        ([*STEADY[:50], 0.6, *STEADY[51:]], 20.5, (6.67, 14.1)),
        ([*STEADY[:50], *[0.2] * 25], 20.0, (5, 15.0)),
        (STEADY[:95], 20.0, None),
        (STEADY[:70], 20.0, (3.1, 16.1)),
        ([2.0] * 5, 20.0, (0.5, 10.0)),
        ([], 12.0, (0, 10.0)),
        ([], 11.1, None),
    ],
)
def test_topic_that_is_too_slow_at_any_time_is_noticed(
    periods: list[float], end: float, rate: tuple[float, float] | None
) -> None:
    scan, clock = (Channel(number, name, "", None, "msg", "", ros1=True) for number, name in enumerate(("/scan", "/clock")))
    stamps = sorted([*((scan, time) for time in times(*periods)), (clock, 5.0), (clock, end)], key=lambda one: one[1])
    messages = [(channel, round(time * NS), b"") for channel, time in stamps]
    words = (
        f"the topic '/scan' falls to {rate[0]:g} messages a second, {rate[1] - 5:.1f} s after the bag begins" if rate else ""
    )
    with pytest.raises(UnreadableError, match=words) if rate else contextlib.nullcontext():
        assert len(list(bag_topics.checked(iter(messages), [scan], 8.0))) == len(periods) + 1


@pytest.mark.parametrize(
    ("stamps", "slow"),
    [([0, 1, 2.02, 3, 4.04], False), ([0, 1, 3.9], True), ([0], True), ([3.5], False), ([0, 0.1, 0.2], True)],
)
def test_a_slow_topic_is_noticed_in_a_bag_that_is_too_short_for_ten_messages(stamps: list[float], slow: bool) -> None:
    scan, clock = (Channel(number, name, "", None, "msg", "", ros1=True) for number, name in enumerate(("/scan", "/clock")))
    messages = [(clock, 0, b""), *((scan, round(time * NS), b"") for time in stamps), (clock, 5 * NS, b"")]
    with pytest.raises(UnreadableError, match="falls to") if slow else contextlib.nullcontext():
        list(bag_topics.checked(iter(messages), [scan], 1.0))


@pytest.mark.parametrize("kind", KINDS)
def test_bag_whose_topic_falls_below_its_least_rate_is_refused(tmp_path: Path, kind: str) -> None:
    moving = odometry(2, 40)
    path = record(tmp_path, kind, moving, {"/tb2/odom": bags.ODOMETRY})
    assert len(rows(tmp_path, path, ROBOTS)) == 80
    assert fault(tmp_path, path.read_bytes(), min_rate=0.9) == "the topic '/tb2/odom' has no message; min_rate = 0.9"
    ends = [one for one in moving if one.topic == "/tb0/odom" or one.received < 20 * NS]
    content = record(tmp_path / "ends", kind, ends).read_bytes()
    slow = "the topic '/tb1/odom' falls to 0.31 messages a second, 9.0 s after the bag begins; min_rate = 0.9"
    assert fault(tmp_path, content, min_rate=0.9) == slow
    whole = record(tmp_path / "whole", kind, moving)
    assert len(rows(tmp_path, whole, ROBOTS, min_rate=0.9)) == 80


@pytest.mark.parametrize("kind", ["bag", "mcap", "db3"])
def test_bags_have_missing_values_but_not_in_what_says_where_a_message_was(tmp_path: Path, kind: str) -> None:
    places = [{"position": [-1.0, 2.0], "header.stamp.sec": 7}, {"header.stamp.sec": 7}]
    messages = [Recorded("/0/joints", "sensor_msgs/msg/JointState", at, one) for at, one in zip((0, 8), places, strict=True)]
    messages += [Recorded("/0/n", "std_msgs/msg/Int32", at, {"data": at}) for at in (0, 8)]
    content = record(tmp_path, kind, messages).read_bytes()
    keys: dict[str, Any] = {"format": "bag", "na": (-1, 0, "/0/n", "0")}
    reading, rows = read_file(tmp_path, f"t.{kind}", content, topics=("/{robot}/n",), **keys)
    assert not reading.faults
    assert [tuple(row.values()) for row in rows] == [("/0/n", "0", 0, None), ("/0/n", "0", 8, 8)]
    reading, rows = read_file(tmp_path, f"t.{kind}", content, topics=("/{robot}/joints",), **keys)
    assert not reading.faults
    assert [row["position"] for row in rows] == [[-1.0, 2.0], []]

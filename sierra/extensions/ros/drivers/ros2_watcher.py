"""Follow the graph of a run of ROS 2 and record topics: `python3 ros2_watcher.py [--bag FOLDER] [--clock] TOPIC ...`.

With `--place` and `--run`, it is that of one part of a run on several robots (see `ros2_fleet.py`). With `--own`, it records
only topics that a node in this namespace publishes.

It needs rclpy, and with `--bag` mcap. `TOPIC` are regular expressions. Its driver reads what it prints, a JSON object in each
line:

- `{"ready": true}`: it takes part, and what is published from now on can be recorded;
- `{"nodes": [...], "participants": 2, "publishers": 3, "pending": [...], "clock": 1.5, "unheard": 0}`: nodes, the numbers of
  programs and of publishers, the topics that it does not receive yet from all who publish them, the last time of `/clock`, and
  the number of subscribers of `/sierra/started` that it does not reach yet, whenever one of them has changed;
- `{"messages": 6000, "lost": {...}, "late": {...}, "silent": [...], "dropped": 0}` at the end: the number of messages in the
  bag; by topic, how many are lost, and how many were published before the start and before it received them; topics with a
  publisher from which nothing came; and the packets that the kernel dropped in the last seconds: the last messages, perhaps;
- `{"started": true}` when `/sierra/started` has come, and `{"members": [...]}`: the states of all parts that it knows;
- `{"failure": "..."}` if it cannot go on.

The line `start` on its standard input lets it publish `/sierra/started`, which new subscribers get too; any other line is the
state of its part. SIGINT, SIGTERM or the end of its standard input end it; then it closes the bag.

Publishers number their messages, so a message that is lost leaves a gap. A second subscription to each topic, which never waits
for what is missing, knows the last number. The middleware counts losses too. The larger number is told.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import importlib
import json
import os
import re
import select
import signal
import sys
import time
from collections.abc import Collection
from pathlib import Path
from typing import Any

import rclpy
from ament_index_python import get_package_share_directory
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Bool, String

NAME = "sierra_watcher"
RECORDERS = (NAME, "rosbag2_recorder")
STARTED, MEMBERS = "/sierra/started", "/sierra/members"
PREFIX = 12  # bytes of the identity of a publisher that are those of its participant
HIDDEN = re.compile(rf"/(_|launch_ros_|({'|'.join(RECORDERS)})$|{NAME}_witness$)")  # no nodes of the launch file
DEPTH = 5000  # messages of a topic that may wait
PARTS = 1000  # of a run, at most
TOLD_S = 5.0  # for all parts to have the last state of this one
CHUNK = 1 << 16
LOOK_S, LATER_S = 0.05, 0.3  # between two looks at the graph, before and after the start
REPAIRED_S = 5.0  # publishers of Fast DDS tell every 3 s what they have published
QUIET_S = 0.3  # without a message, until all have come
LINE = "=" * 80
PRIMITIVE = {
    "bool", "byte", "char", "float32", "float64", "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64",
    "string", "wstring",
}  # fmt: skip
SOURCE = bytes
"""The identity of a publisher, as the middleware gives it."""
ANY = b""
"""That of all publishers, where messages do not name theirs, as before ROS 2 Kilted."""


class Failure(Exception):
    """The recording has failed; the message is one line."""


def definition(kind: str) -> str:
    """Return the definition of a type with those of its fields, as rosbag2 writes it. Raises Failure if there is none."""
    texts: dict[str, str] = {}
    pending = [kind]
    while pending:
        name = pending.pop(0)
        if name in texts:
            continue
        package, _, message = name.split("/")
        try:
            texts[name] = Path(get_package_share_directory(package), "msg", f"{message}.msg").read_text()
        except (LookupError, OSError) as error:
            raise Failure(f"the definition of {name} is not installed ({error})") from error
        for line in texts[name].splitlines():
            words = line.partition("#")[0].split()
            base = words[0].partition("[")[0].partition("<")[0] if len(words) > 1 and "=" not in words[1] else ""
            if base and base not in PRIMITIVE:
                parts = base.split("/")
                pending.append(f"{parts[0] if len(parts) > 1 else package}/msg/{parts[-1]}")
    first, *others = texts.items()
    return first[1] + "".join(f"\n{LINE}\nMSG: {name.replace('/msg/', '/')}\n{text}" for name, text in others)


def dropped() -> int:
    """Return how many packets for the sockets of this process the kernel has dropped because they were full."""
    own = set()
    for descriptor in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):
            own.add(str(descriptor.readlink()))
    lines = [line.split() for line in Path("/proc/net/udp").read_text().splitlines()[1:]]
    return sum(int(words[-1]) for words in lines if f"socket:[{words[9]}]" in own)


def identity(information: Any) -> tuple[SOURCE, int]:
    """Return the publisher of a message, and its number. Raises Failure without a number, as before ROS 2 Iron."""
    try:
        number = int(information["publication_sequence_number"])
    except (KeyError, TypeError) as error:
        raise Failure("this version of ROS 2 does not number messages, so that lost ones would not be noticed") from error
    return bytes(information["publisher_gid"]["data"]) if "publisher_gid" in information else ANY, number


class Recorded:
    """A topic that is recorded."""

    def __init__(self, name: str, channel: int) -> None:
        self.name, self.channel = name, channel
        self.messages = 0
        self.lost_events = 0
        self.numbers: dict[SOURCE, tuple[int, int, int]] = {}
        """The first and the last number of each publisher, and how many messages came."""
        self.counts = collections.Counter[int]()
        """The number of messages with each number, where messages do not name their publishers."""

    def count(self, source: SOURCE, number: int) -> None:
        first, last, messages = self.numbers.get(source, (number, number, 0))
        self.numbers[source] = (min(first, number), max(last, number), messages + 1)
        self.counts.update([number] if source == ANY else [])
        self.messages += 1

    def see(self, source: SOURCE, number: int) -> None:
        """Take note of a message that was published, and that may not have come."""
        first, last, messages = self.numbers.get(source, (number, number, 0))
        self.numbers[source] = (first, max(last, number), messages)

    def lost(self, before: Collection[SOURCE]) -> int:
        """Return how many messages are missing; of publishers that were there `before` the start, since their first one."""
        gaps = sum(last - first + 1 - messages for source, (first, last, messages) in self.numbers.items() if source != ANY)
        begins = sum(first - 1 for source, (first, _, _) in self.numbers.items() if source not in before)
        return max(gaps + self._missing(), self.lost_events) + begins

    def _missing(self) -> int:
        """Return how many messages of unnamed publishers are missing at least: no number is rarer than a later one."""
        first, last, _ = self.numbers.get(ANY, (1, 0, 0))
        missing, most = 0, 1
        for number in range(last, first - 1, -1):
            most = max(most, self.counts[number])
            missing += most - self.counts[number]
        return missing

    def late(self, before: Collection[SOURCE]) -> int:
        """Return how many messages of publishers that were there before the start came before the first one."""
        return sum(first - 1 for source, (first, _, _) in self.numbers.items() if source in before)


class Bag:
    """A bag in MCAP, in a folder as rosbag2 makes it."""

    def __init__(self, folder: Path) -> None:
        from mcap.writer import CompressionType, Writer

        folder.mkdir()
        self._file = (folder / f"{folder.name}_0.mcap").open("xb")
        self._writer = Writer(self._file, chunk_size=1 << 18, compression=CompressionType.NONE)
        self._writer.start("ros2", NAME)
        self._types: dict[str, int] = {}

    def channel(self, topic: str, kind: str) -> int:
        """Describe a topic; return the number of its channel. Raises Failure."""
        if kind not in self._types:
            self._types[kind] = self._writer.register_schema(kind, "ros2msg", definition(kind).encode())
        return self._writer.register_channel(topic, "cdr", self._types[kind])

    def write(self, channel: int, content: bytes, received: int, sent: int, number: int) -> None:
        self._writer.add_message(channel, received, content, sent or received, number)

    def close(self) -> None:
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()


class Watcher:
    """The watcher of one run."""

    def __init__(self, topics: list[str], bag: Bag | None, *, clock: bool) -> None:
        self.node = Node(NAME, namespace="/sierra", enable_rosout=False, start_parameter_services=False)
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.topics, self.bag = [re.compile(topic) for topic in topics], bag
        self.recorded: dict[str, Recorded] = {}
        self.subscriptions: dict[str, Any] = {}
        self.witness = Node(f"{NAME}_witness", namespace="/sierra", enable_rosout=False, start_parameter_services=False)
        """A node that is never spun. Its subscriptions keep the newest messages, also if some before them are missing."""
        self.newest: dict[str, Any] = {}
        self.seen: dict[str, Any] = {}
        self.latest = 0.0
        self.drops: collections.deque[tuple[float, int]] = collections.deque()
        """The number of dropped packets, each second, for so long that what is missing would have been sent again."""
        self.looked = 0.0
        self.time: float | None = None
        self.failure = ""
        self.has_started = False
        self.topics_seen: list[Any] = []
        self.sources: dict[str, set[SOURCE]] = {}
        """All publishers of recorded topics that were seen, by topic."""
        self.before: set[SOURCE] = set()
        """Those that were seen before the start."""
        self.programs: set[SOURCE] = set()
        """The participants of DDS that publish something: one for each program."""
        latched = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.started = self.node.create_publisher(Bool, STARTED, latched)
        self.own: str | None = None
        """The namespace of the nodes whose topics are recorded; None: those of all."""
        self.members: dict[int, Any] = {}
        """The states that the parts of the run have told, by place."""
        self.told: Any = None
        """The publisher by which this part tells its state; None in a run without other parts."""
        self.part: dict[str, object] = {}
        self.is_closed = False
        if clock:
            lossy = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
            self.node.create_subscription(Clock, "/clock", self._tick, lossy)

    def _tick(self, message: Clock) -> None:
        now = message.clock.sec + message.clock.nanosec / 1e9
        if self.time is not None and now < self.time:
            self.failure = f"the simulated time went back from {self.time:g} s to {now:g} s"
        self.time = now

    def join(self, place: int, run: str) -> None:
        """Take part in a run on several robots, in this place."""
        latched = {"reliability": ReliabilityPolicy.RELIABLE, "durability": DurabilityPolicy.TRANSIENT_LOCAL}
        self.part = {"run": run, "place": place}
        self.told = self.node.create_publisher(String, MEMBERS, QoSProfile(depth=1, **latched))
        self.node.create_subscription(String, MEMBERS, self._hear, QoSProfile(depth=PARTS, **latched))
        self.node.create_subscription(Bool, STARTED, self._begin, QoSProfile(depth=1, **latched))

    def _hear(self, message: String) -> None:
        try:
            member = json.loads(message.data)
            self.members[member["place"]] = {name: member[name] for name in ("run", "place", "state")}
        except (ValueError, LookupError, TypeError):
            self.failure = f"a node publishes on {MEMBERS}, which is for SIERRA alone"

    def _begin(self, message: Bool) -> None:
        if not self.has_started:
            self._note_start()
        print(json.dumps({"started": True}), flush=True)

    def tell(self, state: Any) -> None:
        """Tell all parts the state of this one."""
        self.is_closed = state["closed"]
        self.told.publish(String(data=json.dumps({**self.part, "state": state})))

    def start(self) -> None:
        self._note_start()
        self.started.publish(Bool(data=True))

    def _note_start(self) -> None:
        self.has_started = True
        self.before = set().union(*self.sources.values())

    def spin(self) -> None:
        """Take what has come, and look at the graph now and then. Raises Failure."""
        self.executor.spin_once(LOOK_S)
        if self._has_to_look():
            self.looked = time.monotonic()
            publishers, pending = self._look()
            nodes = sorted({f"{space.rstrip('/')}/{name}" for name, space in self.node.get_node_names_and_namespaces()})
            self._count_drops()
            own = [name for name in nodes if not HIDDEN.search(name)]
            seen = {"nodes": own, "participants": len(self.programs), "publishers": publishers, "pending": pending}
            members = {"members": list(self.members.values())} if self.told is not None else {}
            self.say(**seen, clock=self.time, unheard=self._unheard(), **members)
        if self.failure:
            raise Failure(self.failure)

    def _unheard(self) -> int:
        """Return the number of subscribers of `/sierra/started` that are known and not connected yet."""
        known: int = self.node.count_subscribers(STARTED)
        return max(0, known - int(self.started.get_subscription_count()))

    def _has_to_look(self) -> bool:
        """Return whether it is time to look at the whole graph, which costs more when there are many topics."""
        passed = time.monotonic() - self.looked
        if passed < LOOK_S:
            return False
        before, self.topics_seen = self.topics_seen, self.node.get_topic_names_and_types()
        return not self.has_started or passed > LATER_S or self.topics_seen != before

    def _count_drops(self) -> None:
        now = time.monotonic()
        if not self.drops or now - self.drops[-1][0] >= 1:
            self.drops.append((now, dropped()))
        while now - self.drops[0][0] > REPAIRED_S:
            self.drops.popleft()

    def say(self, **seen: Any) -> None:
        if seen != self.seen:
            self.seen = seen
            print(json.dumps(seen), flush=True)

    def _look(self) -> tuple[int, list[str]]:
        """Subscribe to topics that are new; return the number of publishers, and topics that do not come from all of them."""
        count, pending = 0, []
        self.programs = set()
        for topic, kinds in self.topics_seen:
            known = self.node.get_publishers_info_by_topic(topic)
            publishers = [publisher for publisher in known if not HIDDEN.search(f"/{publisher.node_name}")]
            self.programs |= {bytes(publisher.endpoint_gid[:PREFIX]) for publisher in publishers}
            count += len(publishers)
            if topic in (STARTED, MEMBERS) or not any(wanted.fullmatch(topic) for wanted in self.topics):
                continue
            if self.bag is None:
                pending += [topic] if self.told is not None and publishers and not self._is_heard(topic) else []
                continue
            if topic not in self.recorded and not any(map(self._is_own, publishers)):
                continue
            if len(kinds) > 1:
                raise Failure(f"{topic} has several types: {', '.join(kinds)}")
            self.sources.setdefault(topic, set()).update(bytes(publisher.endpoint_gid) for publisher in publishers)
            if publishers and topic not in self.recorded:
                self._subscribe(topic, kinds[0], publishers)
            if publishers and self.subscriptions[topic].get_publisher_count() < len(publishers):
                pending.append(topic)
        return count, pending

    def _is_heard(self, topic: str) -> bool:
        """Return whether the part that records is known here as a subscriber of a topic."""
        return any(subscriber.node_name in RECORDERS for subscriber in self.node.get_subscriptions_info_by_topic(topic))

    def _is_own(self, publisher: Any) -> bool:
        """Return whether a publisher belongs to a node whose topics are recorded."""
        space: str = publisher.node_namespace
        return self.own is None or space == self.own or space.startswith(f"{self.own}/")

    def _subscribe(self, topic: str, kind: str, publishers: list[Any]) -> None:
        package, _, name = kind.split("/")
        try:
            message = getattr(importlib.import_module(f"{package}.msg"), name)
        except (ImportError, AttributeError) as error:
            raise Failure(f"{topic} has the type {kind}, which is not installed ({error})") from error
        profiles = [publisher.qos_profile for publisher in publishers]
        reliable = all(profile.reliability == ReliabilityPolicy.RELIABLE for profile in profiles)
        kept = all(profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for profile in profiles)
        wanted = QoSProfile(
            history=HistoryPolicy.KEEP_LAST,
            depth=DEPTH,
            reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if kept else DurabilityPolicy.VOLATILE,
        )
        assert self.bag is not None  # noqa: S101 - only then topics are looked for
        topic_ = self.recorded[topic] = Recorded(topic, self.bag.channel(topic, kind))

        def lost(event: Any) -> None:
            topic_.lost_events = event.total_count

        def incompatible(event: Any) -> None:
            self.failure = f"{topic} has publishers with another {event.last_policy_kind.name.lower()} than those before"

        events = SubscriptionEventCallbacks(message_lost=lost, incompatible_qos=incompatible)

        def take(content: bytes, information: Any) -> None:
            self._write(topic_, content, information)
            while (more := subscription.handle.take_message(message, True)) is not None:
                self._write(topic_, *more)

        subscription = self.node.create_subscription(message, topic, take, wanted, event_callbacks=events, raw=True)
        self.subscriptions[topic] = subscription
        if reliable:
            newest = QoSProfile(depth=max(10, 2 * len(publishers)), reliability=ReliabilityPolicy.BEST_EFFORT)
            self.newest[topic] = self.witness.create_subscription(message, topic, take, newest, raw=True)

    def _write(self, topic: Recorded, content: bytes, information: Any) -> None:
        assert self.bag is not None  # noqa: S101
        topic.count(*identity(information))
        received, sent = information["received_timestamp"], information["source_timestamp"]
        self.bag.write(topic.channel, content, received or time.time_ns(), sent, topic.messages)
        self.latest = time.monotonic()

    def close(self) -> None:
        """Wait for messages that are on their way, close the bag, and tell what is in it."""
        if self.is_closed:
            self.told.wait_for_all_acked(Duration(seconds=TOLD_S))
        begin = self.latest = time.monotonic()
        while time.monotonic() - self.latest < QUIET_S and time.monotonic() - begin < REPAIRED_S:
            self.executor.spin_once(LOOK_S)
        if self.bag is None:
            return
        for topic, subscription in self.newest.items():
            while (taken := subscription.handle.take_message(subscription.msg_type, True)) is not None:
                self.recorded[topic].see(*identity(taken[1]))
        topics = list(self.recorded.values())
        self.bag.close()
        before = {topic.name: {*self.before, *([ANY] if self.sources[topic.name] <= self.before else [])} for topic in topics}
        lost = {topic.name: count for topic in topics if (count := topic.lost(before[topic.name]))}
        late = {topic.name: count for topic in topics if (count := topic.late(before[topic.name]))}
        silent = [
            topic.name for topic in topics if self.sources[topic.name] - topic.numbers.keys() and ANY not in topic.numbers
        ]
        drops = dropped() - self.drops[0][1] if self.drops else 0
        account = {
            "messages": sum(topic.messages for topic in topics),
            "lost": lost,
            "late": late,
            "silent": silent,
            "dropped": drops,
        }
        print(json.dumps(account), flush=True)


def obey(watcher: Watcher) -> bool:
    """Do what the driver wants, one line for each; return False if it has ended."""
    chunk = os.read(sys.stdin.fileno(), CHUNK)
    for line in chunk.splitlines():
        watcher.start() if line == b"start" else watcher.tell(json.loads(line))
    return bool(chunk)


def main() -> None:
    """Watch a run until a signal comes."""
    parser = argparse.ArgumentParser()
    parser.add_argument("topics", nargs="*")
    parser.add_argument("--bag", type=Path)
    parser.add_argument("--clock", action="store_true")
    parser.add_argument("--place", type=int)
    parser.add_argument("--run", default="")
    parser.add_argument("--own")
    given = parser.parse_args()
    told: list[int] = []
    rclpy.init(signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, frame: told.append(number))
    try:
        watcher = Watcher(given.topics, Bag(given.bag) if given.bag else None, clock=given.clock)
        watcher.own = given.own
        if given.place is not None:
            watcher.join(given.place, given.run)
        print(json.dumps({"ready": True}), flush=True)
        while not told:
            watcher.spin()
            if select.select([sys.stdin], [], [], 0.0)[0] and not obey(watcher):
                told.append(0)  # its driver has ended
        watcher.close()
    except (Failure, OSError) as error:
        print(json.dumps({"failure": " ".join(str(error).split())}), flush=True)
        sys.exit(1)


if __name__ == "__main__":
    main()

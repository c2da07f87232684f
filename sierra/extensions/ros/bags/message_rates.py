"""The least rate of topics in a bag: a topic that falls below it at any time makes a bag unreadable, so that its run fails.

A rate is judged over a time that is long enough for `SPAN` messages, and at least a second. After each message, as many more
must come within that time; of a topic with fewer messages, as many as the time to the end of the bag is long enough for. The
end is that of all topics, without the last second, because the nodes of a run do not end at the same time. Messages before the
first one of a topic do not count: nodes begin one after the other.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection, Iterator

from sierra.extensions.ros.bags.containers import NS, Channel, Message
from sierra.ingest.base import UnreadableError

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

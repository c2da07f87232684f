"""Outputs that are bags of ROS."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, ClassVar

from pydantic import Field, StringConstraints

from sierra.config.field_types import InProject, NotNegative
from sierra.config.output_tables import PLACEHOLDER, Output, Proposal
from sierra.extensions.ros.bags import message_files
from sierra.util.lazy_definitions import regex

COLUMNS = ("topic", "received_ns")
"""The columns of each table that is made from a bag."""
VERSIONS = ("dashing", "eloquent", "foxy", "galactic", "humble", "iron", "jazzy", "kilted", "lyrical")
TypeOfMessage = Annotated[str, StringConstraints(pattern=rf"^{message_files.TYPE.pattern}$")]
DATABASE = regex(r"\.db3(\.gz|\.zst)?$")


class BagOutput(Output):
    """An output in a bag of ROS."""

    topics: tuple[str, ...] = Field(
        (),
        description="topics of a bag whose messages are the rows, such as `/{robot}/odom`: a name in braces is a part of the "
        "topic and a column, `*` is any text",
    )
    ros: str = Field(
        "", description="version of ROS 2, such as `humble`, whose types count if a bag does not have their definitions"
    )
    messages: tuple[InProject, ...] | Mapping[TypeOfMessage, str] = Field(
        (),
        description="folders of the project with packages whose `PACKAGE/msg/NAME.msg` count, before `ros`, if a bag does not "
        "have the definitions of its types; or these definitions by the names of the types, such as `my_msgs/msg/State`",
    )
    covariances: bool = Field(False, description="whether covariances in a bag become columns")
    min_rate: NotNegative = Field(
        0.0,
        description="fewest messages per second of each topic of a bag, at any time from its first message to the end of the "
        "bag; a run with fewer fails",
    )
    endings: ClassVar[Mapping[str, str]] = dict.fromkeys(("bag", "mcap", "db3"), 'format = "bag", topics = ["/TOPIC"]')
    most_searched: ClassVar[int] = 1 << 28
    needs: ClassVar[tuple[str, str, str] | None] = ("bags of ROS", "rosbags", "bags")

    def check_own_keys(self) -> None:
        if not self.topics:
            raise ValueError('format = "bag" needs topics, such as ["/{robot}/odom"]')
        names = [tuple(PLACEHOLDER.findall(topic)) for topic in self.topics]
        if len(set(names)) > 1:
            raise ValueError("topics: all should have the same names in braces, because these become columns")
        taken = [*COLUMNS, *self.ticks]
        if len({name.lower() for name in (*names[0], *taken)}) < len(names[0]) + len(taken):
            raise ValueError(f"topics: names in braces should be unique, and none of {', '.join(taken)}")
        if self.ros not in ("", *VERSIONS):
            raise ValueError(f"ros: unknown version {self.ros!r}; known are {', '.join(VERSIONS)}")

    def with_files(self, root: Path) -> BagOutput:
        from sierra.extensions.ros.bags import message_types
        from sierra.ingest.base import check_package

        check_package(self)

        texts = self.messages if isinstance(self.messages, Mapping) else message_files.texts(root, self.messages)
        message_types.parsed_messages(texts)
        return self.model_copy(update={"messages": texts}) if texts else self

    @classmethod
    def proposals(cls, content: Callable[[], bytes | None], name: str) -> Sequence[Proposal]:
        from sierra.extensions.ros import proposals

        return () if (bag := content()) is None else proposals.proposals(bag, name)

    @property
    def own_columns(self) -> tuple[str, ...]:
        return tuple(name for topic in self.topics for name in PLACEHOLDER.findall(topic))

    def doubt(self) -> str:
        """Return a warning about bags that may lack the definitions of their messages. The recorder of the robots decides."""
        if self.ros or self.messages or not DATABASE.search(self.file):
            return ""
        return (
            f"databases of ROS 2 before Iron ({self.file}) do not have the definitions of their messages, so that runs fail "
            'after the robots have moved: set ros = "humble", or the version that records'
        )

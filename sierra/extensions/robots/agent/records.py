"""Records of an agent: its messages, and the files of runs by which a later agent knows them."""

from __future__ import annotations

import json
import os
from typing import Any, Dict

Record = Dict[str, Any]

AGENT = "sierra.extensions.robots.agent.robot_agent"  # the agent, as the first argument of `worker.pyz`


class Refused(Exception):
    """A request that cannot be fulfilled, with the reason in one line, and the part of a `hello` that it is about."""

    def __init__(self, reason: str, about: str = "") -> None:
        super().__init__(reason)
        self.about = about


def write_whole(path: str, record: Record) -> None:
    """Write a record to a file that appears whole or not at all."""
    with open(path + ".part", "w", encoding="ascii") as file:
        json.dump(record, file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(path + ".part", path)


def read_record(path: str) -> Record | None:
    """Return the record in a file; None if there is none, or if it is damaged."""
    try:
        with open(path, encoding="ascii") as file:
            record = json.load(file)
    except (OSError, ValueError):
        return None
    return record if isinstance(record, dict) else None

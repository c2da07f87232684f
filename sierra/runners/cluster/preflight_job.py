"""Preflight job: one small task that checks nodes before all elements execute.

It checks that nodes see the project, and that they have a Python and the files that runs need. The elements wait for it
(`Request.after`), so that a problem is found once, before any run begins. A success is remembered for a day in the user's
cache, for the same cluster (as the project names it) and file system.
"""

from __future__ import annotations

import time
from pathlib import Path

from sierra.config.cluster_table import ClusterTable
from sierra.errors import Missing
from sierra.runners.cluster import submission_record
from sierra.runners.cluster.result_log_reader import Pack
from sierra.runners.schedulers.base import Request
from sierra.store.layout import SessionPaths, user_clusters
from sierra.util.cache import Cache
from sierra.util.hashing import digest
from sierra.util.json_types import Json
from sierra.worker.result_log import Finished, Trouble

VALID_S = 86_400.0
MAX_CACHED = 64


class Preflight:
    """The preflight job (probe) of one session."""

    def __init__(self, runner: str, table: ClusterTable, session: SessionPaths) -> None:
        self._session = session
        self._runner = runner
        self._table = table
        self._key = digest("cluster", {"runner": runner, "table": _node_settings(table), "device": _device(session.root)})
        self.name = submission_record.name_of(session, "probe")

    def is_needed(self) -> bool:
        """Return True unless a recent check has succeeded."""
        found = Cache(user_clusters(), MAX_CACHED).get(self._key)
        return not (isinstance(found, float) and 0 <= time.time() - found < VALID_S)

    def request(self) -> Request:
        """Return the request for the job."""
        return submission_record.request(self._session, self.name, (0,), self._table.python, "--probe")

    def has_passed(self) -> bool:
        """Return True if the check has succeeded, False while there is no answer. Raises Missing if it has found a problem."""
        for path in self._session.results.glob("probe.*.pack"):
            for event in Pack(path).read():
                match event:
                    case Trouble():
                        raise Missing(f"the nodes cannot execute these runs: {event.reason}")
                    case Finished():
                        self._remember()
                        return True
        return False

    def gone(self, word: str) -> Missing:
        """Return the error for a preflight job that has ended without recording anything."""
        if line := submission_record.last_line(self._session, "0"):
            return Missing(f"the nodes cannot execute these runs: {line}; see python and modules in [runners.{self._runner}]")
        where = f"check that {self._session.root} is on a file system that the nodes share"
        return Missing(f"the preflight job ended on the nodes without any output{f' ({word})' if word else ''}: {where}")

    def _remember(self) -> None:
        memory = Cache(user_clusters(), MAX_CACHED)
        memory.put(self._key, time.time())
        memory.save()


def _device(folder: Path) -> int:
    """Return the file system of a folder, or of its nearest existing parent."""
    return next(one.stat().st_dev for one in (folder, *folder.parents) if one.exists())


def _node_settings(table: ClusterTable) -> Json:
    """Return the settings of a cluster's table that affect which nodes are used and what they offer."""
    return table.model_dump(mode="json", exclude={"array_tasks", "attempts", "wall", "cancelled"})

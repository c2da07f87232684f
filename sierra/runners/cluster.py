"""Runs on a cluster: one array job whose elements execute many runs each, and what becomes of it.

Truth is what elements have recorded in their packs; a scheduler is only asked whether anything may still come. Two copies of
one task, a requeue, a lost node, a job that nobody remembers, a controller out of reach and a submitter that died are all one
case: see what is recorded, ask whether anything lives, submit again what is missing.
"""

from __future__ import annotations

from collections.abc import Set as AbstractSet

from sierra.config import ClusterTable
from sierra.paths import SessionPaths
from sierra.runners import Look, Work, schedulers


class Cluster:
    """The runner of a cluster's name, over its scheduler."""

    stays = True

    def __init__(self, slots: int, table: ClusterTable, *, name: str, scheduler: str) -> None:
        self.name = name
        self._table = table
        self._scheduler = schedulers.find(scheduler)(table)

    def submit(self, work: Work, session: SessionPaths) -> None:
        raise NotImplementedError

    def resume(self, session: SessionPaths, recorded: AbstractSet[str]) -> None:
        raise NotImplementedError

    def look(self) -> Look:
        raise NotImplementedError

    def stop(self) -> None:
        raise NotImplementedError

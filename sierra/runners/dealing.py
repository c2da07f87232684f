"""Dealing the jobs of a batch out to elements: run k goes to element k modulo their number."""

from __future__ import annotations

from collections.abc import Iterable

from sierra.model import Job
from sierra.paths import SessionPaths


def deal(jobs: Iterable[Job], elements: int, session: SessionPaths) -> tuple[int, ...]:
    """Write the jobs of each element; how many each got."""
    raise NotImplementedError

"""Options that several methods share, and the defaults of those that are left open."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, TypedDict

from sierra.errors import UsageError

if TYPE_CHECKING:
    from sierra.execution.observer import Observer


class Settings(TypedDict, total=False):
    """Settings of a query that all its experiments share; `sets` are pairs of XPath and value."""

    controller: str | None
    scenario: str | None
    sets: Sequence[tuple[str, str]]


class ExecutionOptions(TypedDict, total=False):
    """Options of an execution: see `Project.run`."""

    jobs: int | None
    fail_fast: bool
    figures: bool
    observer: Observer | None
    runner: str | None
    detach: bool
    progress: bool | None
    only: str | None
    retry: bool


def observer_for(wanted: bool | None) -> Observer:
    """Return the observer that shows the progress of executions, if that is `wanted`; None: in terminals and notebooks."""
    from sierra.execution import progress_display as progress

    return progress.observer(wanted)


def slots(jobs: int | None) -> int:
    """Return the number of runs at a time: `jobs`, or the user's setting, or the number of usable cores.

    Raises UsageError for less than 1.
    """
    from sierra.config import user
    from sierra.worker.machine import usable_cores

    slots = (user.load().jobs or usable_cores()) if jobs is None else jobs
    if slots < 1:
        raise UsageError(f"cannot execute {slots} runs at a time; use 1 or more")
    return slots

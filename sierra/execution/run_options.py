"""Options of an execution."""

from __future__ import annotations

from collections.abc import Set as AbstractSet

from sierra.execution.observer import Observer
from sierra.util.lazy_definitions import dataclass, field


@dataclass(frozen=True, slots=True)
class RunOptions:
    """Options of an execution: where runs execute, and callbacks for progress and notices."""

    slots: int
    runner: str = "local"
    fail_fast: bool = False
    only: AbstractSet[str] | None = None
    """Ids of the runs to execute; None for all."""
    observer: Observer = field(default_factory=Observer)
    detach: bool = False
    """True to leave jobs on a cluster without waiting for them."""
    retry: bool = False
    """True to execute runs again that failed twice in the same way."""

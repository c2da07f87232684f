"""Options of a replay."""

from __future__ import annotations

from sierra.containers.images.image import AnyImage
from sierra.replay.variation import Variation
from sierra.replay.verdicts import Tolerances
from sierra.store.recorded_files import ChosenExecution
from sierra.util.lazy_definitions import dataclass, field


@dataclass(frozen=True, slots=True)
class ReplayOptions:
    """Options of a replay."""

    slots: int
    runs: int | None = None
    """Number of runs to replay per experiment, from the first; None for all."""
    runner: str = "local"
    engine: str | None = None
    """Name of the engine; None for the one that was used before."""
    tolerances: Tolerances = field(default_factory=dict)
    """Tolerances that override those of the project."""
    keep: bool = False
    """True to keep the restored source and the folders of the runs."""
    only: frozenset[str] | None = None
    """Ids of the runs to replay; None for all."""
    image: AnyImage | None = None
    """The recorded image, if it is in another place than the pinned or recorded one."""
    earlier: frozenset[str] = frozenset()
    """Sessions of earlier replays. Their successful executions count, if programs, machine and isolation are the same."""
    variation: Variation = field(default_factory=Variation)
    """The ways in which runs are executed otherwise than they were recorded."""
    unattended: bool = False
    """True if robots may move without a person, although their trials are supervised."""

    def includes(self, one: ChosenExecution) -> bool:
        """Return whether a run is replayed."""
        return (self.runs is None or one.number < self.runs) and (self.only is None or one.run in self.only)

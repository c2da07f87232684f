"""The outcome of a reproduction: what was to be executed, the comparison of each batch, the claims, and the verdict."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from sierra.deliverables.claims.model import Evaluated, Verdict
from sierra.packages.reproduction.planned import PlannedBatch
from sierra.replay.verdicts import Replay
from sierra.util.lazy_definitions import dataclass, field
from sierra.util.text import counted

if TYPE_CHECKING:
    from sierra.packages.reproduction.drawn_again import DrawnAgain


@dataclass(frozen=True, slots=True)
class Statement:
    """The programs that would be executed, for the user to agree to."""

    lines: tuple[str, ...]
    must_ask: bool
    """True if anything would be executed outside of a container without network."""


@dataclass(frozen=True, slots=True)
class ReproducedBatch:
    """A batch, and the replay of its runs."""

    planned: PlannedBatch
    chosen: int
    """The number of runs that were chosen to be executed."""
    replay: Replay | None
    """None if nothing was executed."""
    reason: str = ""
    """The reason why nothing was executed, or not all."""

    @property
    def executed(self) -> int:
        """The number of runs that were executed again and compared."""
        return len(self.replay.runs) if self.replay else 0

    @property
    def lacking(self) -> bool:
        """True if something is missing, so that it was not executed; false if only the budget left it out."""
        return self.replay is None and bool(self.planned.missing or self.chosen)

    @property
    def complete(self) -> bool:
        """True if all runs with a recorded result were executed again."""
        done = {run.taken.run for run in self.replay.runs} if self.replay else set()
        return bool(self.planned.runs) and done.issuperset(run.run for run in self.planned.runs)

    @property
    def verdict(self) -> str:
        """The verdict of the comparison in words, with the number of runs."""
        if self.replay is None:
            return f"not executed: {self.reason}"
        part = f"{self.executed} of {counted(self.planned.of, 'run')} executed again"
        return f"interrupted: {part}" if self.replay.interrupted else f"{self.replay.verdict} ({part})"


@dataclass(frozen=True, slots=True)
class Reproduction:
    """The result of a reproduction."""

    package: str
    """The id of the package."""
    title: str
    folder: Path
    """The folder with the copy of the package and the reports."""
    notes: tuple[str, ...]
    batches: tuple[ReproducedBatch, ...]
    claims: tuple[Evaluated, ...]
    drawn: tuple[DrawnAgain, ...] = ()
    """The deliverables of batches of which all runs were executed again."""
    numbers: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    """The numbers of a paper's text by name, from the recorded and from the reproduced runs."""
    left_out: tuple[str, ...] = ()
    """One line for each batch and claim of which runs were left out because of the budget."""

    @property
    def interrupted(self) -> bool:
        return any(one.replay.interrupted for one in self.batches if one.replay)

    @property
    def differs(self) -> bool:
        """True if any compared result differs, or a claim does not hold or cannot be told."""
        return any(self._faults())

    def _faults(self) -> Iterator[str]:
        """Yield how many batches differ, and how many claims were not shown to hold."""
        compared = [batch.replay.verdict for batch in self.batches if batch.replay and not batch.replay.interrupted]
        if different := sum(not verdict.fine for verdict in compared):
            yield f"{different} of {len(compared)} batches different"
        if claims := sum(claim.verdict is not Verdict.holds for claim in self.claims):
            yield f"{claims} of {len(self.claims)} claims not shown to hold"

    @property
    def lacking(self) -> bool:
        """True if a batch was not executed because something is missing, or if a figure was not made from the new runs."""
        return any(one.lacking for one in self.batches) or any(one.is_lost for one in self.drawn)

    @property
    def verdict(self) -> str:
        """The verdict in words."""
        if self.interrupted:
            return "interrupted"
        if not any(batch.replay for batch in self.batches):
            return "not reproduced: nothing was executed"
        if self.differs:
            return f"not reproduced: {' and '.join(self._faults())}"
        if any(batch.lacking for batch in self.batches):
            return "reproduced in part: not all batches were executed"
        runs, of = sum(batch.executed for batch in self.batches), sum(batch.planned.of for batch in self.batches)
        said = f"{runs:,} of {counted(of, 'run')} executed again{self._made()}"
        return f"reproduced in part: {said}" if self.lacking else f"reproduced: {said}"

    def _made(self) -> str:
        """Return how many deliverables were made from the reproduced runs, in words; "" if there are none."""
        if not self.drawn:
            return ""
        made = sum(one.reproduced is not None for one in self.drawn)
        return f", {made} of {len(self.drawn)} figures, tables and comparisons made from them"

    @property
    def exit_code(self) -> int:
        """0 if all is reproduced, 1 if something differs or a claim does not hold, 3 if something is missing."""
        if self.interrupted:
            return 130
        executed = any(one.replay for one in self.batches)
        return 1 if executed and self.differs else 3 if self.lacking or not executed else 0

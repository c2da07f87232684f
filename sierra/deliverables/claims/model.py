"""The terms of claims: verdicts, grounds, and what an evaluation finds."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum

from sierra.store.sql_result import SqlValue
from sierra.util.lazy_definitions import dataclass, field


class Verdict(StrEnum):
    """The conclusion about a claim."""

    holds = "holds"
    does_not_hold = "does not hold"
    cannot_tell = "can't tell"
    """The runs decide neither: there are too few or none, too many have no value, or nothing was shown."""


class Ground(StrEnum):
    """The origin of the data that a verdict rests on."""

    RECORDED = "recomputed from recorded data"
    REEXECUTED = "re-executed"
    STATISTICALLY_REEXECUTED = "statistically re-executed"


class Registered(StrEnum):
    """The relation of a claim's registration to the executions that count for it."""

    PLANNED = "planned"
    """It was registered before any of them began."""
    EXPLORATORY = "exploratory"
    UNDECIDED = "registered, not yet decided"
    """No execution counts yet."""
    MISSING = "not registered"
    """No execution counts yet, and its text is not recorded."""


@dataclass(frozen=True, slots=True)
class Registration:
    """The registration of one claim."""

    word: Registered = Registered.MISSING
    reason: str = ""
    """The reason of the word, in one line."""
    claim: str = ""
    """The hash of the claim's normal form; "" if it has none, because its query is not valid."""
    changes: int = 0
    """The number of times that the claim's text has changed since this name was first registered."""
    first: str = ""
    """The day on which the claim's name was first registered, for people."""
    plan_n: str = ""
    """The `sierra plan-n` command that the number of runs came from; "" if the claim names none."""

    @property
    def history(self) -> str:
        """Return the changes of the claim in one line; "" if there are none."""
        times = "once" if self.changes == 1 else f"{self.changes} times"
        return f"changed {times} since it was first registered ({self.first})" if self.changes else ""

    @property
    def lines(self) -> tuple[str, ...]:
        """Return everything about the registration, for people."""
        runs = f"number of runs from: {self.plan_n}" if self.plan_n else ""
        return tuple(filter(None, (f"{self.word}: {self.reason}", self.history, runs)))


@dataclass(frozen=True, slots=True)
class ClaimResult:
    """The finding about one claim, without its name."""

    verdict: Verdict
    text: str
    """The numbers, in one line."""
    n: int = 0
    """The number of runs with a value that counts."""
    value: float | None = None
    """The value of a claim about one, in the column's unit; of two groups, the estimated difference: first minus second."""
    low: float | None = None
    """The lower end of the interval of `value`; None if there is none."""
    high: float | None = None
    p: float | None = None
    """The p value of the claim's test, corrected for all `tests`; None if it is not decided by a test."""
    tests: int | None = None
    """The number of the project's claims on the same table of pairs, which are corrected together."""
    pairs: int | None = None
    """The number of pairs of this table; None if the claim is not decided by a test."""
    claimed_pairs: int | None = None
    """The number of these pairs that claims of the project name."""
    runs: Mapping[str, float] = field(default_factory=dict)
    """The values of the runs by seed, for a claim about a value; none if the statistic counts times never reached."""
    numbers: Mapping[str, SqlValue] = field(default_factory=dict)
    """The further columns of a claim's SQL."""
    notes: tuple[str, ...] = ()
    """Notes on data that are not in the numbers."""


@dataclass(frozen=True, slots=True)
class Evaluated(ClaimResult):
    """The evaluation of one claim."""

    name: str = ""
    says: str = ""
    shown: str = ""
    """The figure, table or place in the paper."""
    kind: str = ""
    """The way it is decided: sql, value, order or equivalence."""
    ground: Ground = Ground.RECORDED
    batches: tuple[str, ...] = ()
    """The ids of the batches that decide it; none if they are not recorded."""
    registered: Registered = Registered.MISSING
    registration: Registration = Registration()
    """The registration behind `registered`."""

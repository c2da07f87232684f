"""The values of a model that a figure shows, with the deviation of the model from the figure's data."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from sierra.stats.comparison.wording import number
from sierra.store.data_hash import data_hash
from sierra.util.json_types import JsonView
from sierra.util.lazy_definitions import dataclass, field
from sierra.util.text import counted, few

if TYPE_CHECKING:
    import pyarrow as pa

    from sierra.deliverables.models.deviation import Deviation


SHORT = 30
"""The largest number of letters of a label in the small print."""


@dataclass(frozen=True, slots=True)
class Predicted:
    """One model in one figure."""

    name: str
    label: str
    table: pa.Table
    """`experiment`, over time `t`, and `value`, which is finite; sorted."""
    text: str
    """Its statement, expression or command, as SQL or as a comment of SQL."""
    facts: Mapping[str, JsonView] = field(default_factory=dict)
    """The facts about its origin, for the record of figures."""
    deviation: Deviation | None = None
    """None if no point of it can be compared with the data."""
    lacking: Mapping[str, int] = field(default_factory=dict)
    """The number of experiments, or of times in them, without a value, by the reason."""
    points: int = 0
    """The number of experiments, or of times in them, that it should predict."""

    @property
    def over_time(self) -> bool:
        return "t" in self.table.column_names

    @property
    def definition(self) -> dict[str, JsonView]:
        """Return its record in the definition of a figure."""
        return {"label": self.label, **self.facts, "data": data_hash(self.table)}

    @property
    def summary(self) -> str:
        """Return its deviation from the data in words."""
        if (deviation := self.deviation) is None:
            return "no point in common with the data"
        parts = [f"RMSE {number(deviation.rmse)}", f"bias {number(deviation.bias)}", f"largest {number(deviation.largest)}"]
        parts += [f"in {deviation.inside} of {counted(deviation.intervals, 'interval')}"] if deviation.intervals else []
        parts += (
            [f"at {deviation.compared} of {self.points} times"] if self.over_time and deviation.compared < self.points else []
        )
        return ", ".join(parts)

    @property
    def note(self) -> str:
        """Return its part of the small print."""
        lacking = sum(self.lacking.values())
        missing = [f"no value for {lacking} of {self._counted}"] if lacking else []
        return ", ".join([f"model {self._short}: {self.summary}", *missing])

    @property
    def problem(self) -> str:
        """Return which values it lacks and why, for messages; "" if it has all."""
        several = len(self.lacking) > 1
        reasons = few([f"{reason} ({count})" if several else reason for reason, count in self.lacking.items()], 3)
        lacking = sum(self.lacking.values())
        return f"model {self.name}: no value for {lacking} of {self._counted}: {reasons}" if lacking else ""

    @property
    def _short(self) -> str:
        return self.label if len(self.label) <= SHORT else f"{self.label[: SHORT - 1]}…"

    @property
    def _counted(self) -> str:
        return counted(self.points, "time" if self.over_time else "experiment")

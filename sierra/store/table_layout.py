"""The column `table_layout` of artifacts: the properties of a recorded table, as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping

from sierra.util.lazy_definitions import dataclass, field

Columns = Mapping[str, str]
"""The kind of values in each column."""


@dataclass(frozen=True, slots=True)
class TableLayout:
    """The properties of one file that became a table, for comparison with its siblings."""

    file: str | None = ""
    """The path of the file; None if an execution may write several files of the output."""
    columns: Columns = field(default_factory=dict)
    """The kinds of values by column: number, text, flag, empty, or another type."""
    ended: bool = True
    """False if the file's last line is not complete."""
    hints: Mapping[str, str] = field(default_factory=dict)
    """By column: the place where text begins, in a column in which most siblings have numbers."""
    times: bool = False
    """True for a CSV whose columns of text are no times; earlier versions recorded times as texts."""
    trimmed: bool = False
    """True for a CSV whose texts between `|`, if any, have no blanks around them; earlier versions recorded these blanks."""

    @classmethod
    def load(cls, text: str | None) -> TableLayout:
        """Return the layout from its JSON; None stands for the layout of a table that has none."""
        known = json.loads(text or "{}")
        return cls(**{name: known[name] for name in cls.__slots__ if name in known})

    def dump(self) -> str:
        """Return the layout as JSON."""
        fields = {"file": self.file, "columns": self.columns, "ended": self.ended}
        more = {name: value for name in ("hints", "times", "trimmed") if (value := getattr(self, name))}
        return json.dumps(fields | more)

"""The contract of ranges of criteria: the values of an independent variable, computed from the text of a query.

A criterion is a name, a dot and a range, as in `population_size.Log8`. A range that begins with a name, here `Log`, is a
plug-in under this name. SIERRA ships `Log` and `Linear` (see `sierra.design.query.named_ranges`). Others are entry points of
the group `sierra.criteria` (see `sierra.plugin`). Ranges that begin with a number (`.1.9.C5`), counts (`.C20`) and ranges
after `=` belong to the grammar: see `sierra.design.query.grammar`. `sierra.testing.criteria` has the conformance suite.

The values are computed when a query is resolved, and recorded with the batch: in SQL they are the values of the variable. What
has been recorded, also a replay, never needs the plug-in again.
"""

from __future__ import annotations

from typing import Any, ClassVar, Protocol

from sierra.config.field_types import Table
from sierra.model import Scale


class Range(Protocol):
    """A kind of range. Its name in queries is that of its entry point, of letters and `_` only.

    The same text and the same options always give the same values in the same order, because the ids of runs are made from
    them: no time, no unseeded random numbers, no file that may change, no order of a set.
    """

    contract: ClassVar[int]
    """The version of the contract: 1."""
    Options: ClassVar[type[Table]]
    """The model of `[criteria.NAME]`. The options are in no id; the values that they lead to are."""
    example: ClassVar[str]
    """A valid text after the name, for messages: `8` in `.Log8`."""

    def __init__(self, options: Any, /) -> None: ...

    def scale(self, text: str) -> Scale:
        """Return the values that a text describes: the part of the range after its name, which may be empty.

        Usually it is `Computed`: one `Point` for each value. Values are distinct, and all numbers or all names. A point may
        have changes of the template; they are made after those of the variable, which then need not be declared. It may also
        have `parameters` for expressions. Raises QueryError, in one line with a correction, for a text that means nothing.
        """

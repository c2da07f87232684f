"""Seconds on the time axis of figures, where a table's time column counts ticks.

The number of ticks per second is declared, or read from the recorded inputs: those of the first and of the last run of each
experiment, which must agree.
"""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

from sierra.config.project_file import Project
from sierra.errors import UsageError
from sierra.store.batch_data import BatchData
from sierra.store.store import Store
from sierra.templates.base import of_bytes
from sierra.util.arrow_columns import numpy_of

if TYPE_CHECKING:
    import pyarrow as pa


def rates(given: float | str, project: Project, store: Store, frame: BatchData) -> Mapping[int, float]:
    """Return the ticks per second of each experiment, by its position; `given` is the number, or an XPath of it in inputs.

    Raises UsageError if an input has no such number, or if runs of an experiment differ in it.
    """
    if not isinstance(given, str):
        return dict.fromkeys(frame.cells(), given)
    known: dict[int, float] = {}
    for ordinal, digest in frame.first_and_last_inputs():
        rate = _read(given, project, store.object(digest))
        if known.setdefault(ordinal, rate) != rate:
            raise UsageError(f"ticks_per_second: runs of an experiment have {known[ordinal]:g} and {rate:g}; use units instead")
    return known


def in_seconds(table: pa.Table, per_second: Mapping[int, float]) -> pa.Table:
    """Return a table of statistics with its times `t` divided by the ticks per second of each experiment."""
    import numpy as np
    import pyarrow as pa

    divisors = np.array([per_second[ordinal] for ordinal in table.column("experiment").to_pylist()], dtype=float)
    seconds = numpy_of(table.column("t")) / divisors
    return table.set_column(table.column_names.index("t"), "t", pa.array(seconds))


def note(time: str, per_second: Mapping[int, float]) -> str:
    """Return what the reader of a figure has to know."""
    least, most = min(per_second.values()), max(per_second.values())
    number = f"{least:g}" if least == most else f"{least:g} to {most:g}"
    return f"seconds: {time} / {number} per second"


def _read(path: str, project: Project, content: bytes) -> float:
    if project.template is None:
        raise UsageError("ticks_per_second: an XPath needs a project with one template; use a number")
    template = of_bytes(Path(project.template), content, project.template_formats, project.template_format)
    texts = template.find(path)
    try:
        (text,) = texts
        rate = float(Fraction(text.strip())) if len(text) < 40 else 0.0
    except (ValueError, ZeroDivisionError, OverflowError):
        rate = 0.0
    if rate <= 0:
        raise UsageError(
            f"ticks_per_second: {path!r} selects {', '.join(map(repr, texts[:3])) or 'nothing'} in an input; use one number"
        )
    return rate

"""The columns in which replayed tables differ from their records, a line for each, and the declaration of clocks."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from sierra.util.text import counted

if TYPE_CHECKING:
    from sierra.config.output_tables import Output
    from sierra.replay.clock_columns import Clock
    from sierra.replay.compare_values import Agreement, DifferentColumn
    from sierra.replay.verdicts import Replay

Columns = dict[str, list["DifferentColumn"]]
"""The differences by column: one for each run in which it differs."""


def column_lines(agreements: Sequence[Agreement]) -> Iterator[str]:
    """Yield a line for each column that differs in some of these runs, and one for the others."""
    columns = _by_column(agreements)
    clocks = clocks_among(columns)
    for name, runs in columns.items():
        rows, of = sum(run.rows for run in runs), sum(run.of for run in runs)
        where = f"in {rows} of {counted(of, 'row')} of {counted(len(runs), 'run')}"
        about = f" ({clocks[name]})" if name in clocks else ""
        within = "; within tolerance" if all(run.within for run in runs) else ""
        yield f"column {name!r}{about} differs {where}{_largest(runs)}{within}"
    compared = [each for each in agreements if each.columns]
    if compared and not any(each.form for each in agreements):
        others = max(each.same_columns + len(each.columns) for each in compared) - len(columns)
        yield (
            f"all {others} other columns are the same"
            if others > 1
            else "the other column is the same"
            if others
            else ("no other column was compared")
        )


def _by_column(found: Sequence[Agreement]) -> Columns:
    columns: Columns = {}
    for agreement in found:
        for one in agreement.columns:
            columns.setdefault(one.name, []).append(one)
    return columns


def _largest(runs: Sequence[DifferentColumn]) -> str:
    """Return the largest difference of a column in any run; empty if it is not numeric or not finite."""
    from sierra.replay.compare_values import distances

    far, rel, ulp = (
        [value for one in runs if (value := getattr(one, kind)) is not None] for kind in ("max_abs", "max_rel", "max_ulp")
    )
    if not far or max(far) == float("inf"):
        return ""
    return f"; largest difference {distances(max(far), max(rel), max(ulp))}"


def clocks_among(columns: Columns) -> dict[str, Clock]:
    """Return the columns that are probably clocks. A duration may be simulated: it counts only if no number differs."""
    from sierra.replay.clock_columns import Clock

    found = {name: max((one.clock for one in runs), key=list(Clock).index) for name, runs in columns.items()}
    sure = Clock.NO in found.values()
    return {name: clock for name, clock in found.items() if clock is Clock.YES or (clock is Clock.PERHAPS and not sure)}


def volatile_lines(answer: Replay, outputs: Mapping[str, Output]) -> Iterator[str]:
    """Yield for each table with clocks that differ the line in `sierra.toml` by which they are not compared."""
    by_output: dict[str, list[Agreement]] = {}
    files: dict[str, str] = {}
    for run in answer.runs:
        for path, agreement in run.outputs.items():
            if path is not None and agreement.output is not None and agreement.verdict == "different":
                by_output.setdefault(agreement.output, []).append(agreement)
                files[agreement.output] = path
    for name, agreements in sorted(by_output.items()):
        columns = _by_column(agreements)
        clocks = clocks_among(columns)
        if clocks:
            declared = outputs.get(name)
            every = [*(declared.volatile if declared else ()), *clocks]
            key = "" if declared else f"file = {json.dumps(files[name], ensure_ascii=False)}, "
            value = f"volatile = {json.dumps(every, ensure_ascii=False)}"
            rest = [column for column in columns if column not in clocks]
            but = f"; {counted(len(rest), 'other column')} would still differ" if rest else ""
            yield f"to leave out what clocks measure, set {key}{value} in [outputs.{name}]{but}"

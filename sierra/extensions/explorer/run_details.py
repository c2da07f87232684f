"""Details of runs: their records, recorded files, the reasons of their executions, differences, and curves over time.

Also: the list of batches, of which the page shows a part: a project can have ten thousand.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from datetime import UTC
from io import BytesIO
from typing import TYPE_CHECKING

from sierra.cli import diff, why
from sierra.cli.output import as_json
from sierra.config.project_file import LoadedProject
from sierra.deliverables.html import Chart, ChartAxis, SectionContent, Series, section
from sierra.deliverables.html.tables import Cell, Table
from sierra.errors import NotFound, UsageError
from sierra.execution import list_batches
from sierra.execution.list_batches import ListedBatch
from sierra.execution.shown_records import ShownRun
from sierra.store.export_recorded_files import content, listing
from sierra.store.store import Store
from sierra.util.hashing import short
from sierra.util.json_types import JsonView
from sierra.util.lazy_definitions import dataclass

if TYPE_CHECKING:
    import pyarrow as pa


PAGE = 100
"""The largest number of batches that one answer lists."""


@dataclass(frozen=True, slots=True)
class BatchList:
    """All batches of one state of a store, the newest first."""

    state: str
    batches: Sequence[ListedBatch]
    texts: Sequence[str]
    """The text of each batch in which the words of a filter are looked for, in lower case."""

    def part(self, words: str, first: int) -> JsonView:
        """Return the batches that contain all words, from the one at the place `first` on, and their number."""
        wanted = words.lower().split()
        matching = [batch for batch, text in zip(self.batches, self.texts, strict=True) if all(word in text for word in wanted)]
        shown = [as_data(batch) for batch in matching[first : first + PAGE]]
        return {"all": len(self.batches), "found": len(matching), "batches": shown}


def read(store: Store, state: str) -> BatchList:
    """Return the batches that the store has now."""
    found = list_batches.batches(store)[::-1]
    return BatchList(state, found, [_text(batch) for batch in found])


def as_data(batch: ListedBatch) -> JsonView:
    """Return the facts about a batch that the page shows."""
    return {
        "batch": batch.batch,
        "query": batch.query,
        "requested": f"{(batch.submitted or batch.created).astimezone(UTC):%Y-%m-%d %H:%M} UTC",
        "groups": list(filter(None, (batch.controller, batch.scenario, *batch.targets))),
        "experiments": batch.experiments,
        "runs": batch.runs,
        "state": _state(batch),
        "package": batch.package,
    }


def _state(one: ListedBatch) -> str:
    counts = ((len(one.clusters) and "on a cluster", ""), (one.failed, "failed"), (one.missing, "missing"))
    parts = [f"{count} {word}".strip() for count, word in counts if count]
    return ", ".join(parts) or "complete"


def _text(one: ListedBatch) -> str:
    return " ".join(filter(None, (one.batch, one.query, one.controller, one.scenario, *one.targets, _state(one)))).lower()


MOST_RUNS = 8
"""The largest number of runs that are compared at a time."""
LARGEST = 32 << 20
"""The largest size in bytes of a file whose beginning is shown."""
SHOWN = 200_000
"""The largest number of bytes that are shown of a file."""


def record(store: Store, run: str) -> JsonView:
    """Return what `sierra show` says about a run, with its files. Raises NotFound, and UsageError for another record."""
    from sierra.execution.show_record import show

    shown = show(store, run)
    if not isinstance(shown, ShownRun):
        raise UsageError(f"{short(run)} is the id of another kind ({shown.kind}); a run is required here")
    files = listing(store, run, check=False).files
    whole = shown.as_dict() | {"files": [{"path": f.path, "kind": f.kind, "bytes": f.bytes, "remark": f.remark} for f in files]}
    facts: JsonView = json.loads(as_json(whole))
    return facts


def file(store: Store, run: str, path: str) -> JsonView:
    """Return the beginning of a recorded file as text, as `sierra show RUN PATH` prints it.

    `path` only selects a file of the list: nothing is opened by it. Raises NotFound, UsageError for a file that is too large.
    """
    chosen = next((recorded for recorded in listing(store, run, check=False).files if recorded.path == path), None)
    command = shlex.join(("sierra", "show", short(run), path))
    if chosen is None:
        raise NotFound(f"run {short(run)} has no recorded file {path!r}")
    if (chosen.kept or chosen.bytes or 0) > LARGEST:
        raise UsageError(f"the file has more than {LARGEST >> 20} MiB; {command} prints it")
    target = BytesIO()
    content(store, chosen, target)
    data = target.getvalue()
    text = data[:SHOWN].decode("utf-8", "backslashreplace" if len(data) <= SHOWN else "replace")
    return {"text": text, "bytes": len(data), "shown": min(len(data), SHOWN), "remark": chosen.remark, "command": command}


def reasons(project: LoadedProject, store: Store, run: str) -> JsonView:
    """Return the lines of `sierra why` about a run."""
    from sierra.explain import why_executed

    return list(why.lines(why_executed.why(project, store, run)))


def differences(project: LoadedProject, store: Store, runs: Sequence[str]) -> JsonView:
    """Return the lines of `sierra diff` about the first run and each other one."""
    from sierra.explain.diff.compare import compare

    check(runs)
    first, *others = runs
    return [{"run": other, "lines": list(diff.lines(compare(project, store, first, other)))} for other in others]


def check(runs: Sequence[str]) -> None:
    """Raise UsageError unless these are a few different runs."""
    if not 2 <= len(set(runs)) == len(runs) <= MOST_RUNS:
        raise UsageError(f"choose 2 to {MOST_RUNS} runs, each of them once")


def curves(rows: pa.Table, names: Mapping[str, str], column: str, time: str) -> str:
    """Return the curves of runs as a section of a page; `rows` has the columns run, time, value and rows.

    `names` are the names of the runs, in the order of the curves. A long curve is thinned as in figures.
    """
    import numpy as np
    from matplotlib.colors import to_hex

    from sierra.deliverables.figures import style, thinning
    from sierra.deliverables.figures.interactive import on_dark
    from sierra.model import Axis
    from sierra.util.arrow_columns import numpy_of

    owners, times, values = (numpy_of(rows.column(name)) for name in ("run", "time", "value"))
    columns: tuple[list[Cell], list[Cell], list[Cell]] = ([], [], [])
    series, thinned = [], False
    for (run, name), colour in zip(names.items(), style.colours(Axis("run", tuple(names))), strict=True):
        (mine,) = np.nonzero(owners == run)
        kept = mine[thinning.kept(times[mine], values[mine])] if len(mine) else mine
        start, stop = len(columns[0]), len(columns[0]) + len(kept)
        for cells, shown in zip(columns, ([short(run)] * len(kept), times[kept].tolist(), values[kept].tolist()), strict=True):
            cells += shown
        thinned |= len(kept) < len(mine)
        series.append(Series(f"{short(run)}: {name}", to_hex(colour), start, stop, on_dark(colour)))
    data = Table("curves", ("run", time, column), columns)
    chart = Chart(data, ChartAxis(1, time), ChartAxis(2, column), series, group="run")
    missing = [short(run) for run, piece in zip(names, series, strict=True) if piece.start == piece.stop]
    notes = [f"Runs without values: {', '.join(missing)}."] * bool(missing)
    notes += ["Several rows of a run at one time are shown as their mean."] * bool((numpy_of(rows.column("rows")) > 1).any())
    notes += [
        "Long curves are thinned: of each part, the first, the last, the lowest and the highest value are shown."
    ] * thinned
    return section(SectionContent(f"{column} over {time}", (chart,), notes=tuple(notes), tables=(data,)))

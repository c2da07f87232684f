"""Differences between two packages, or between a recorded batch and a package.

Compared are batches, runs, results with their values, sources, programs and environments, and the metadata of two packages.
The records of both are read apart from each other, and nothing is executed. Results are those of effective executions.
"""

from __future__ import annotations

import contextlib
import json
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from collections.abc import Set as AbstractSet
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from sierra.config.output_tables import Output
from sierra.ingest.recording_context import rules_of
from sierra.maintenance.extract import extract
from sierra.packages.manifest import PackageManifest
from sierra.packages.reading.received import Received
from sierra.replay.compare_values import Verdict, of_tables
from sierra.replay.pair_files import pair
from sierra.store.row_types import ArtifactRow
from sierra.store.sql_names import identifier
from sierra.store.store import Store
from sierra.util.hashing import short
from sierra.util.lazy_definitions import dataclass
from sierra.util.text import counted, few, verb

if TYPE_CHECKING:
    import pyarrow as pa

METADATA = "metadata"
"""The kind of differences that only two packages have."""
SHOWN = 3
COMPARED = 20
"""The largest number of runs with other results whose values are compared."""
BESIDE = ("run", "execution", "number", "file")
"""Columns of outputs that are not values, as the independent variables are not."""
ROWS = ("row", "row_number")
"""The names of the column with the number of a row, which depends on the order in which runs were recorded."""


class PackageOrBatch(NamedTuple):
    """One of two things that are compared."""

    id: str
    """The id of the package, or of the batch."""
    store: Store
    """A store that holds only the compared records."""
    manifest: PackageManifest | None = None
    """The description of the package; None for a batch."""


class Difference(NamedTuple):
    """One difference, in a line."""

    kind: str
    line: str


@dataclass(frozen=True, slots=True)
class PackageDifferences:
    """The differences of two packages or batches, and the kinds in which they do not differ."""

    before: str
    after: str
    """The ids of both."""
    differences: tuple[Difference, ...]
    same: tuple[str, ...]


def of_package(package: Received) -> PackageOrBatch:
    """Return a whole package as a side."""
    return PackageOrBatch(package.id, package.store, package.manifest)


@contextlib.contextmanager
def of_batch(store: Store, batch: str) -> Iterator[PackageOrBatch]:
    """Yield a batch of a store as a side, until the end of the context: the records that a package of it would have."""
    with tempfile.TemporaryDirectory(prefix="sierra-", ignore_cleanup_errors=True) as folder:
        yield PackageOrBatch(batch, extract(store, (batch,), Path(folder, "store")))


def compare(before: PackageOrBatch, after: PackageOrBatch) -> PackageDifferences:
    """Return the differences of two packages or batches. Raises Damaged and SqlError if records cannot be read."""
    kinds = {kind: lines for kind, lines in KINDS.items() if kind != METADATA or (before.manifest and after.manifest)}
    found = [Difference(kind, line) for kind, lines in kinds.items() for line in lines(before, after)]
    differing = {one.kind for one in found}
    return PackageDifferences(before.id, after.id, tuple(found), tuple(kind for kind in kinds if kind not in differing))


def _metadata(before: PackageOrBatch, after: PackageOrBatch) -> Iterator[str]:
    for name in ("title", "date", "sierra", "redacted"):
        was, now = getattr(before.manifest, name), getattr(after.manifest, name)
        if was != now:
            yield f"{name}: {was} → {now}"


def _sets(statement: str) -> Callable[[PackageOrBatch, PackageOrBatch], Iterator[str]]:
    """Return a function that yields the names that only one side has; the statement selects the names of a side."""

    def lines(before: PackageOrBatch, after: PackageOrBatch) -> Iterator[str]:
        was, now = (set(one.store.values(str, statement)) for one in (before, after))
        for only, where in ((was - now, "first"), (now - was, "second")):
            if only:
                yield f"{len(only)} only in the {where}: {few(sorted(only), SHOWN)}"

    return lines


class _State(NamedTuple):
    run: str
    execution: str
    result: str


EFFECTIVE = """
SELECT m.run, any_value(e.execution) AS execution, any_value(e.result) AS result
FROM (SELECT DISTINCT batch, run FROM batch_runs) m JOIN effective f USING (batch, run)
JOIN executions e ON e.execution = f.execution GROUP BY m.run
"""


def _effective(store: Store) -> dict[str, _State]:
    return {row.run: row for row in store.select(_State, EFFECTIVE)}


def _results(before: PackageOrBatch, after: PackageOrBatch) -> Iterator[str]:
    """Yield whether runs in both have the same results, and for some runs that have not, how far their values are apart."""
    old, new = _effective(before.store), _effective(after.store)
    both = old.keys() & new.keys()
    for only, where in ((old.keys() - both, "first"), (new.keys() - both, "second")):
        if only:
            yield f"successful only in the {where}: {counted(len(only), 'run')}: {few(sorted(map(short, only)), SHOWN)}"
    hashes = sorted(run for run in both if old[run].result != new[run].result)
    files = _files(before.store, after.store, {run: (old[run].execution, new[run].execution) for run in hashes})
    other = [run for run in hashes if files[run]]
    if other:
        runs = f"{len(other)} of {counted(len(both), 'run')} in both {verb(len(other), 'has', 'have')}"
        yield f"{runs} other results: {few(list(map(short, other)), SHOWN)}"
        counts = Counter(path for run in other for path in files[run])
        yield from (f"{path} differs in {counted(count, 'run')}" for path, count in sorted(counts.items()))
        yield from _values(before.store, after.store, list(islice(other, COMPARED)))


def _files(before: Store, after: Store, pairs: Mapping[str, tuple[str, str]]) -> dict[str, list[str]]:
    """Return the paths of the outputs that differ between two executions of each run, without those that differ in name."""
    was = _artifacts(before, [execution for execution, _ in pairs.values()])
    now = _artifacts(after, [execution for _, execution in pairs.values()])
    declared = _declared(before) | _declared(after)
    paths: dict[str, list[str]] = {}
    for run, (old, new) in pairs.items():
        ours = was.get(old, {})
        theirs = pair(ours, now.get(new, {}), declared).found
        same = {path for path in ours.keys() & theirs.keys() if ours[path].sha256 == theirs[path].sha256}
        paths[run] = sorted((ours.keys() | theirs.keys()) - same)
    return paths


def _artifacts(store: Store, executions: list[str]) -> dict[str, dict[str, ArtifactRow]]:
    """Return the outputs of executions, by execution and path."""
    outputs: dict[str, dict[str, ArtifactRow]] = {}
    statement = "SELECT * FROM artifacts WHERE kind <> 'log' AND list_contains($e, execution)"
    for row in store.select(ArtifactRow, statement, e=executions):
        outputs.setdefault(row.execution, {})[row.path] = row
    return outputs


def _declared(store: Store) -> dict[str, Output]:
    """Return the recorded declarations of outputs."""
    recorded = store.values(str, "SELECT declared FROM ingest_rules ORDER BY ingest_rules")
    return {name: output for text in recorded for name, output in rules_of(json.loads(text))[0].items()}


def _values(before: Store, after: Store, runs: list[str]) -> Iterator[str]:
    """Yield the tables whose values differ in these runs, with the first difference and the greatest distances."""
    beside = {*BESIDE, *_axes(before), *_axes(after)}
    for name in sorted(_tables(before) & _tables(after)):
        statement = f"SELECT * FROM {identifier(name)} WHERE run = $run ORDER BY ALL"  # noqa: S608 - a quoted name
        for run in runs:
            was, now = (_without(store.sql(statement, run=run), beside) for store in (before, after))
            answer = of_tables(was, now)
            if answer.verdict is Verdict.DIFFERENT:
                yield f"table {name}, run {short(run)}: {answer.reason}"
                break


def _axes(store: Store) -> list[str]:
    return store.values(str, "SELECT DISTINCT unnest(axes) FROM batches")


def _without(table: pa.Table, names: AbstractSet[str]) -> pa.Table:
    number = next((name for name in table.column_names if name in ROWS), "")  # the first is not a column of the output itself
    return table.drop_columns([name for name in table.column_names if name in names or name == number])


def _tables(store: Store) -> set[str]:
    return set(store.outputs())


KINDS: dict[str, Callable[[PackageOrBatch, PackageOrBatch], Iterator[str]]] = {
    METADATA: _metadata,
    "batches": _sets("SELECT left(batch, 10) || ' (' || query || ')' FROM batches"),
    "runs": _sets("SELECT DISTINCT left(run, 10) FROM batch_runs"),
    "source": _sets("SELECT DISTINCT tree FROM sources"),
    "programs": _sets(
        "SELECT DISTINCT concat_ws(' ', name, version, left(sha256, 10)) FROM programs WHERE kind IN ('program', 'library')",
    ),
    "environment": _sets(
        "SELECT DISTINCT concat_ws(', ', os, 'kernel ' || kernel, cpu, libc, 'Python ' || python) FROM environments"
    ),
    "results": _results,
}
"""The kinds of differences, in the order in which they are shown, with the functions that find them."""

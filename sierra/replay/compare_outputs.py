"""Comparison of the outputs of two executions, file by file: bytes first, then values if the bytes differ."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from sierra.config.output_tables import Output
from sierra.errors import Damaged
from sierra.ingest.match_outputs import claims
from sierra.replay.compare_values import Agreement, Rules, Verdict, of_tables, of_texts, other_columns
from sierra.replay.pair_files import Artifacts, Pairs, pair
from sierra.store.parquet_row_counts import rows_by_file
from sierra.store.recorded_files import holding
from sierra.store.results import objects, rows_of
from sierra.store.row_types import ArtifactRow
from sierra.store.sql_names import stored_name
from sierra.store.store import Snapshot
from sierra.store.table_layout import TableLayout
from sierra.util.chunking import by_weight
from sierra.util.hashing import merkle

if TYPE_CHECKING:
    import pyarrow as pa

BYTES = 64 << 20
"""Maximum total size, in bytes, of the recorded files that are compared at a time."""
PAIRS = 1000
OTHERS = "; files of the archive that are no tables are not compared"

_Pair = tuple[tuple[Artifacts, Pairs], list[tuple[ArtifactRow, ArtifactRow]]]
"""The artifacts of a pair of executions, and the files of both whose bytes differ."""


def compare(snapshot: Snapshot, recorded: str, found: str, declared: Mapping[str, Output]) -> dict[str | None, Agreement]:
    """Compare the outputs of `found` with those of `recorded`, by path; both are judgements of executions.

    `declared` gives volatile parts and tolerances. Raises Damaged if the store lacks an output.
    """
    return next(compare_all(snapshot, [(recorded, found)], declared))


def compare_all(
    snapshot: Snapshot, pairs: Sequence[tuple[str, str]], declared: Mapping[str, Output]
) -> Iterator[dict[str | None, Agreement]]:
    """Yield the result of `compare` for each pair of executions, with only a few of them in memory at a time."""
    artifacts = _artifacts(snapshot, (execution for pair in pairs for execution in pair))
    left = {execution: _joined(own, declared) for execution, own in artifacts.items()}
    counted = _counted(snapshot, left)
    sides = ((left[recorded], pair(left[recorded], left[replayed], declared)) for recorded, replayed in pairs)
    unlike = ((both, list(_unlike(both[0], both[1].found))) for both in sides)
    for some in by_weight(unlike, _size, BYTES, lambda group, _: len(group) < PAIRS):
        compared = [files for _, differing in some for files in differing if _same_kind(*files)]
        contents = _Contents(snapshot, [row for files in compared for row in files], counted)
        for (was, now), _ in some:
            yield _of_artifacts(contents, was, now, declared)


def _artifacts(snapshot: Snapshot, executions: Iterable[str]) -> dict[str, Artifacts]:
    """Return the artifacts of each of these executions by path, without logs; those of a file of several tables by both."""
    left: dict[str, dict[str, ArtifactRow]] = {execution: {} for execution in executions}
    snapshot.add_table("compared", execution=left)
    statement = "SELECT a.* FROM all_artifacts a SEMI JOIN compared USING (execution) WHERE kind <> 'log'"
    rows = snapshot.select(ArtifactRow, statement)
    tables = Counter((row.execution, row.name) for row in rows)
    for row in rows:
        several = tables[row.execution, row.name] > 1
        left[row.execution][f"{row.name} ({row.output})" if several else row.name] = row
    return dict(left)


def _joined(artifacts: Artifacts, declared: Mapping[str, Output]) -> Artifacts:
    """Return the artifacts with the parts of each rotated file as one: the newest, whose table has the rows of all."""
    rotated = {name for name, output in declared.items() if output.rotated}
    tables = {row.output: path for path, row in artifacts.items() if row.output in rotated and row.kind == "table"}
    parts: dict[str, list[str]] = {}
    for path, row in sorted(artifacts.items()):
        if row.output in tables:
            parts.setdefault(tables[row.output], []).append(f"{path} {row.sha256}")
    kept = {path: row for path, row in artifacts.items() if path in parts or row.output not in tables}
    return kept | {path: kept[path]._replace(sha256=merkle("parts", several)) for path, several in parts.items()}


def _counted(snapshot: Snapshot, left: Mapping[str, Artifacts]) -> Counter[tuple[str, str, str | None]]:
    """Return how many rows the store has of each table of these executions, counted without DuckDB.

    The key is an execution, an output and, if the output has several files, the file.
    """
    outputs = {row.output for rows in left.values() for row in rows.values() if row.kind == "table"}
    counted: Counter[tuple[str, str, str | None]] = Counter()
    for segment in holding(snapshot, sorted(left)) if outputs else ():
        for output, path in segment.outputs():
            if output in outputs:
                with contextlib.suppress(Damaged):  # a damaged file is not counted, and its rows are reported as missing
                    rows = rows_by_file(path).items()
                    counted.update({(execution, output, file): count for (execution, file), count in rows if execution in left})
    return counted


def _size(pair: _Pair) -> int:
    return sum(row.size for files in pair[1] for row in files)


def _unlike(was: Artifacts, now: Artifacts) -> Iterator[tuple[ArtifactRow, ArtifactRow]]:
    """Yield the files that both have, with different bytes."""
    for path in was.keys() & now.keys():
        if was[path].sha256 != now[path].sha256:
            yield was[path], now[path]


def _same_kind(was: ArtifactRow, now: ArtifactRow) -> bool:
    return bool(was.kind == now.kind)


class _Contents:
    """Content of some artifacts."""

    def __init__(
        self, snapshot: Snapshot, artifacts: Sequence[ArtifactRow], counted: Mapping[tuple[str, str, str | None], int]
    ) -> None:
        """Read the artifacts; `counted` has the rows of all compared tables, counted in another way."""
        self._counted = counted
        tables = [row for row in artifacts if row.kind == "table"]
        files = [row.sha256 for row in artifacts if row.kind != "table"]
        self._rows = rows_of(snapshot, {row.execution for row in tables}, {str(row.output) for row in tables}) if tables else {}
        self._bytes = objects(snapshot, files) if files else {}

    def rows(self, artifact: ArtifactRow) -> pa.Table | None:
        rows = self._rows.get(_key(artifact))
        if (count := 0 if rows is None else rows.num_rows) != artifact.rows:
            present = f"{count} of the {artifact.rows} rows that execution {artifact.execution[:10]} wrote"
            raise Damaged(f"the store has {present} to {artifact.output!r}")
        return rows

    def lost(self, was: ArtifactRow, now: ArtifactRow) -> str | None:
        """Return the difference between the store's row counts of two tables with the same bytes; None if there is none."""
        for whose, one, other in (("recorded", was, now), ("new", now, was)):
            known = [row.counted_rows for row in (one, other) if row.counted_rows is not None]
            truth = next(iter(known), one.rows)
            if (count := self._counted.get(_key(one), 0)) != truth:
                return f"the same bytes, but the {whose} table has {count} of {truth} rows (see sierra fsck)"
        return None

    def bytes(self, artifact: ArtifactRow) -> bytes:
        return self._bytes[artifact.sha256]


def _of_artifacts(
    contents: _Contents, was: Artifacts, pairs: Pairs, declared: Mapping[str, Output]
) -> dict[str | None, Agreement]:
    agreements: dict[str | None, Agreement] = {}
    now = pairs.found
    for path in sorted(was.keys() | now.keys()):
        if path not in now or path not in was:
            reason = "was not written before and is new" if path in now else "was written before and is missing now"
            why = f" ({pairs.unpaired[path]})" if path in pairs.unpaired else ""
            agreements[path] = Agreement(Verdict.DIFFERENT, reason + why, form=True)
        elif was[path].sha256 == now[path].sha256:
            agreements[path] = _identical(contents, was[path], now[path])
        else:
            agreements[path] = _renamed(_output(contents, was[path], now[path], declared), was[path], now[path])
    return agreements


def _renamed(agreement: Agreement, was: ArtifactRow, now: ArtifactRow) -> Agreement:
    """Return the agreement with the name that a file has now, if it is another one."""
    return agreement if was.name == now.name else replace(agreement, reason=f"{agreement.reason}; now named {now.name!r}")


def _identical(contents: _Contents, was: ArtifactRow, now: ArtifactRow) -> Agreement:
    """Compare one output with identical bytes; the store must have all rows of a table."""
    tables = was.kind == now.kind == "table"
    if lost := contents.lost(was, now) if tables else None:
        return Agreement(Verdict.DIFFERENT, lost, form=True)
    if was.name == now.name:
        return Agreement(Verdict.IDENTICAL)
    return Agreement(Verdict.EQUAL, f"the same bytes, now named {now.name!r}")


def _key(artifact: ArtifactRow) -> tuple[str, str, str | None]:
    """Return the key of a table in the store: the execution, the output and, if it has several files, the file's path."""
    several = TableLayout.load(artifact.table_layout).file is None
    return artifact.execution, str(artifact.output), artifact.name if several else None


def _output(contents: _Contents, was: ArtifactRow, now: ArtifactRow, declared: Mapping[str, Output]) -> Agreement:
    """Compare one output whose bytes differ."""
    rules = declared.get(was.output or "") or next((o for o in declared.values() if o.matches(was.path)), None)
    volatile = rules.volatile if rules else ()
    if not _same_kind(was, now):
        return Agreement(Verdict.DIFFERENT, f"was a {was.kind} and is a {now.kind}", form=True)
    if was.kind != "table":
        texts = contents.bytes(was), contents.bytes(now)
        if _without_matches(texts, [declared[name].lines for name in claims(declared, was.path)], was.path):
            return Agreement(Verdict.EQUAL, "no line matches lines in both, and other lines are not compared")
        return of_texts(*texts, volatile)
    old, new = contents.rows(was), contents.rows(now)
    if old is None or new is None:
        return _without_rows(was, now)
    agreement = of_tables(old, new, _rules(rules, old.column_names) if rules else Rules())
    others = OTHERS if was.member and agreement.verdict is not Verdict.DIFFERENT else ""
    return replace(agreement, output=was.output, reason=agreement.reason + others)


def _without_matches(texts: Iterable[bytes], patterns: Sequence[str], path: str) -> bool:
    """Return True if all outputs of a file have `lines`, and these match in none of its texts."""
    if not patterns or not all(patterns):
        return False
    from sierra.ingest.matching_lines import has_match
    from sierra.ingest.rewriting import is_compressed

    return not is_compressed(path) and not any(has_match(text, patterns) for text in texts)


def _rules(output: Output, columns: Sequence[str]) -> Rules:
    """Return the rules of an output, with the names in the store of the columns that it names as its files do."""
    tolerance = {stored_name(name, columns): one for name, one in output.tolerance.items()}
    volatile = [stored_name(name, columns) for name in output.volatile]
    return Rules(tolerance, volatile, stored_name(output.time, columns), output.ordered)


def _without_rows(was: ArtifactRow, now: ArtifactRow) -> Agreement:
    """Compare two tables by their columns' names; one or both of them have no rows."""
    columns, others = (list(TableLayout.load(one.table_layout).columns) for one in (was, now))
    if columns != others:
        return Agreement(Verdict.DIFFERENT, other_columns(columns, others), form=True)
    if was.rows != now.rows:
        return Agreement(Verdict.DIFFERENT, f"{was.rows} rows were recorded, {now.rows} found")
    return Agreement(Verdict.EQUAL, "the same columns, and no rows")

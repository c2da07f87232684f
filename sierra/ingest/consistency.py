"""Comparison of an execution with its siblings, the other runs of its experiment: the majority is taken as right."""

from __future__ import annotations

import contextlib
import json
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from typing import NamedTuple

from sierra.config.output_tables import Output
from sierra.errors import SierraError
from sierra.ingest import open_names, shared_use
from sierra.ingest.event_tables import of_events
from sierra.ingest.messages import difference
from sierra.ingest.model import Group, Siblings
from sierra.ingest.recording_context import SAME_PROGRAMS, Context
from sierra.model import Status
from sierra.store import endings
from sierra.store.layout import SessionPaths
from sierra.store.row_types import FindingRow
from sierra.store.store import Store
from sierra.store.table_layout import Columns, TableLayout
from sierra.store.type_inference import AS_TEXT, TIME_KINDS, own_kind, right_kind
from sierra.store.view_sql import ORDER
from sierra.util.lazy_definitions import dataclass
from sierra.util.text import counted, verb

ANY_TABLE = "SELECT 1 FROM all_artifacts WHERE kind = 'table' LIMIT 1"


def find_inconsistent(
    store: Store, session: SessionPaths, context: Context, lost: float = math.inf, *, final: bool = False
) -> set[str]:
    """Find executions that may be wrong although they have ended well, record findings, and return their runs.

    Their tables differ from their siblings', or they shared a file with other runs: see `shared_use.find`, also for `lost` and
    `final`.
    """
    return shared_use.find(store, session, context, lost, final=final) | _find_inconsistent_tables(store, session, context)


def _find_inconsistent_tables(store: Store, session: SessionPaths, context: Context) -> set[str]:
    """Find executions whose tables differ from their siblings', record findings, and return their runs.

    Siblings are the successful executions of one experiment with the same programs, whenever they were recorded. The majority
    is taken as right; in a tie, the greater number. Row counts of tables of events (see `sierra.ingest.event_tables`) may
    differ; `Recorder.notes` reports them. Row counts and columns of an output with `mismatch = "ragged"` may
    differ, and an output that is not required may be absent. The kind of values in a column (numbers, text, …) must be the
    same among siblings. It may differ between experiments; `Recorder.notes` reports that.
    """
    with store.snapshot() as snapshot:
        if not snapshot.values(int, ANY_TABLE):
            return set()
        rows = snapshot.select(Sibling, GOOD + ODD, **parameters(context))
    tables: dict[tuple[int, str], list[Sibling]] = {}
    for row in rows:
        tables.setdefault((row.ordinal, row.output), []).append(row)
    reasons: dict[str, str] = {}
    events = _events(store, context, tables)
    ended = endings.left_running(store, context.batch) if tables else ""
    advice = _patterns(context, tables)
    for (ordinal, name), siblings in sorted(tables.items()):
        for execution, reason in _inconsistent(siblings, name, context.outputs.get(name), ended, events=name in events):
            reasons.setdefault(execution, reason + advice.get((ordinal, name), ""))
    now, lamport = datetime.now(UTC), context.lamport()
    writer = store.writer(session.segment, context.batch)
    writer.records(FindingRow(execution, now, Status.MISMATCH, reason, lamport) for execution, reason in reasons.items())
    store.publish(writer)
    return {row.run for row in rows if row.execution in reasons}


def _events(store: Store, context: Context, tables: Mapping[tuple[int, str], Sequence[Sibling]]) -> set[str]:
    """Return the outputs with `mismatch = "strict"` that are taken as tables of events."""
    sizes: dict[str, dict[int, list[int]]] = {}
    for (ordinal, name), siblings in tables.items():
        declared = context.outputs.get(name)
        if declared is None or declared.mismatch == "strict":
            sizes.setdefault(name, {})[ordinal] = [row.rows for row in siblings if row.rows is not None]
    return of_events(store, context.batch, sizes)


def _patterns(context: Context, tables: Mapping[tuple[int, str], Sequence[Sibling]]) -> dict[tuple[int, str], str]:
    """Return the advice for undeclared tables whose files have other names in each run, by experiment and table."""
    files: dict[int, dict[str, dict[str, str]]] = {}
    for (ordinal, name), siblings in tables.items():
        for row in siblings if name not in context.outputs else ():
            layouts = map(TableLayout.load, row.forms or ())
            runs = files.setdefault(ordinal, {})
            runs.setdefault(row.execution, {}).update({layout.file: name for layout in layouts if layout.file})
    by_table = {}
    for ordinal, runs in files.items():
        proposals = open_names.patterns(runs.values())
        advice = f" ({open_names.advice(sorted(set(proposals.values())))})"
        by_table.update(
            {(ordinal, name): advice for names in runs.values() for file, name in names.items() if file in proposals}
        )
    return by_table


def parameters(context: Context) -> dict[str, str]:
    """Return the parameters of the statements below."""
    return {"batch": context.batch, "ingest_rules": context.ingest_rules, **context.same_programs}


GOOD = f"""
WITH good AS (
    SELECT m.ordinal, e.run, arg_max(e.judgement, {ORDER}) AS execution
    FROM (SELECT DISTINCT ordinal, run FROM batch_runs WHERE batch = $batch) m
    JOIN all_candidates e ON e.run = m.run AND e.status = 'ok' AND e.purpose = 'run'
        AND {SAME_PROGRAMS} AND e.ingest_rules = $ingest_rules
    GROUP BY ALL
)"""
"""The successful executions of a batch, each with its last judgement and the position of its experiment."""


ODD = """,
tables AS (
    SELECT g.ordinal, g.execution, a.output, sum(a.rows)::BIGINT AS rows, list_sort(list(DISTINCT a.table_layout)) AS forms
    FROM good g JOIN all_artifacts a ON a.execution = g.execution AND a.kind = 'table'
    GROUP BY ALL
),
counted AS (
    SELECT g.ordinal, g.run, g.execution, x.output, t.rows, t.forms
    FROM good g JOIN (SELECT DISTINCT ordinal, output FROM tables) x USING (ordinal)
    LEFT JOIN tables t USING (ordinal, execution, output)
),
differing AS (
    SELECT ordinal, output FROM counted GROUP BY ALL
    HAVING count(rows) < count(*) OR min(rows) < max(rows) OR min(forms) < max(forms)
)
SELECT c.* FROM counted c JOIN differing USING (ordinal, output) ORDER BY execution
"""


class Sibling(NamedTuple):
    """The table of one output that an execution wrote; without rows and forms if it wrote none."""

    ordinal: int
    run: str
    execution: str
    output: str
    rows: int | None
    forms: list[str] | None


def _inconsistent(
    siblings: Sequence[Sibling], name: str, declared: Output | None, ended: str = "", *, events: bool
) -> Iterator[tuple[str, str]]:
    """Yield the executions among siblings whose table `name` differs, each with the difference.

    `ended`: a remark on processes of these runs that were ended, which may be the cause. `events`: it is taken as a table of
    events, so that its number of rows may differ.
    """
    having = [row for row in siblings if row.rows is not None]
    lacking = [row for row in siblings if row.rows is None]
    others = f"the {counted(len(siblings) - 1, 'other run')} of its experiment"
    ragged = declared is not None and declared.mismatch == "ragged"
    if declared is None or declared.required:
        if len(having) < len(lacking):
            for row in having:
                have = verb(len(lacking), "has", "have")
                yield row.execution, f"there is a table {name!r}, but {len(lacking)} of {others} {have} none"
            return
        for row in lacking:
            have = verb(len(having), "has", "have")
            yield row.execution, f"table {name!r} is missing, but {len(having)} of {others} {have} it"
    forms = Counter(form for row in having for form in row.forms or ())
    parsed = {form: TableLayout.load(form) for form in forms}
    likely = _usual([(parsed[form], number) for form, number in forms.items()])
    allow = _allowing(name, None if declared else likely.file, ended)
    for row in having:
        for form in row.forms or ():
            if reason := _unlike(parsed[form], likely, ragged, allow):
                yield row.execution, f"table {name!r} {reason}"
    if not (ragged or events):
        rows = Counter(row.rows or 0 for row in having)
        most = max(rows, key=lambda number: (rows[number], number))
        for row in having:
            if row.rows != most:
                message = f"has {row.rows} rows, but {rows[most]} of {others} have {most}"
                yield row.execution, f"table {name!r} {message} {allow}"


def _allowing(name: str, undeclared: str | None, ended: str) -> str:
    """Return the hint about the declaration that allows tables to differ, after what may be the cause."""
    cause = f"{ended}: let the command wait for them; " if ended else ""
    file = f"file = {json.dumps(undeclared, ensure_ascii=False)}, " if undeclared else ""
    return f'({cause}to allow this, set {file}mismatch = "ragged" in [outputs.{name}])'


@dataclass(frozen=True, slots=True)
class _Usual:
    """The most frequent properties of the tables of siblings, each on its own."""

    file: str | None
    columns: tuple[str, ...]
    kinds: Columns
    ended: bool


def _usual(forms: Sequence[tuple[TableLayout, int]]) -> _Usual:
    files: Counter[str | None] = Counter()
    columns: Counter[tuple[str, ...]] = Counter()
    ended: Counter[bool] = Counter()
    for form, number in forms:
        files[form.file] += number
        columns[tuple(form.columns)] += number
        ended[form.ended] += number
    return _Usual(
        max(files, key=lambda file: files[file]),
        max(columns, key=lambda names: (columns[names], len(names))),
        _usual_kinds(forms),
        ended[True] >= ended[False],
    )


def _usual_kinds(forms: Iterable[tuple[TableLayout, int]]) -> dict[str, str]:
    """Return the expected kind of each column, marked as text if all siblings with numbers keep them as text."""
    counts: dict[str, Counter[str]] = {}
    for form, number in forms:
        for name, kind in form.columns.items():
            if kind != "empty":
                counts.setdefault(name, Counter())[kind] += number
    return {name: _kind(kinds) for name, kinds in counts.items()}


def _kind(kinds: Mapping[str, int]) -> str:
    """Return the kind that siblings should have in a column. Numbers that are text in all of them stay text."""
    right = right_kind(kinds)
    return right if right in kinds or right == "text" else right + AS_TEXT


def _unlike(form: TableLayout, likely: _Usual, ragged: bool, allow: str) -> str | None:
    """Return how a table differs from its siblings', apart from the number of rows; None if it does not."""
    if form.file != likely.file:
        return f"comes from {form.file!r}, but in other runs from {likely.file!r}"
    columns = tuple(form.columns)
    if columns and columns != likely.columns and not ragged:
        return f"{difference(columns, likely.columns)} {allow}"
    if wrong := _misfit(form.columns, likely.kinds):
        name, kind = wrong
        if (hint := form.hints.get(name)) and likely.kinds[name] == "number":
            return f"differs from other runs: {hint}"
        message = f"has {many(kind)} in column {name!r}, but other runs have {many(likely.kinds[name])}"
        again = kind.endswith(AS_TEXT) or likely.kinds[name] == "text"
        return message + " (it was recorded before most of them; run the query again to read it like them)" * again
    if likely.ended and not form.ended:
        return "is truncated: its last line does not end with a line feed"
    return None


def _misfit(columns: Columns, kinds: Columns) -> tuple[str, str] | None:
    """Return the first column with an unexpected kind, and that kind; times and values kept as text pass for text."""
    for name, kind in columns.items():
        right = kinds.get(name, kind)
        is_text = right == "text" and (kind.endswith(AS_TEXT) or kind in TIME_KINDS)
        if kind not in (right, "empty") and not is_text:
            return name, kind
    return None


def many(kind: str) -> str:
    """Return the words for values of this kind."""
    own = own_kind(kind)
    return {"number": "numbers", "flag": "flags", "duration": "durations"}.get(own, own) + kind.removeprefix(own)


def siblings(store: Store, context: Context, name: str) -> Siblings:
    """Return what the store knows about table `name` in the experiments of this batch, whichever session recorded it."""
    alike = {**parameters(context), "output": name}
    with store.snapshot() as snapshot:
        if not snapshot.values(int, ANY_TABLE):
            return Siblings()
        forms = snapshot.values(str, SIBLINGS + SIBLINGS_FORMS, **alike)
    mixed = {
        column for form in forms for column, kind in TableLayout.load(form).columns.items() if kind not in ("number", "empty")
    }

    def ask(runs: Sequence[str]) -> tuple[dict[str, Group], dict[tuple[Group, str], Counter[str]]]:
        places = store.select(_Place, PLACES, batch=context.batch)
        votes: dict[tuple[Group, str], Counter[str]] = {}
        for row in store.select(_Vote, SIBLINGS + SIBLINGS_VOTES, **alike):
            for column, kind in TableLayout.load(row.table_layout).columns.items():
                if kind != "empty":
                    votes.setdefault((row.ordinal, column), Counter())[own_kind(kind)] += row.executions
        wanted = set(runs)
        return {row.run: row.ordinal for row in places if row.run in wanted}, votes

    def recorded() -> Iterator[TableLayout]:
        return map(TableLayout.load, store.values(str, RECORDED_FORMS, output=name))

    def names() -> set[str]:
        return {column for layout in recorded() for column in layout.columns}

    def texts_without(mark: str) -> set[str]:
        old = (layout for layout in recorded() if not getattr(layout, mark))
        return {column for layout in old for column, kind in layout.columns.items() if kind == "text"}

    def example() -> tuple[bytes, int] | None:
        for row in store.select(_Example, SIBLINGS + SIBLINGS_EXAMPLE, **alike):
            with contextlib.suppress(SierraError):  # the store does not have its bytes any more
                return store.object(row.sha256), row.rows
        return None

    return Siblings(frozenset(mixed), ask, texts_without, names, example)


class _Place(NamedTuple):
    run: str
    ordinal: int


class _Example(NamedTuple):
    sha256: str
    rows: int


class _Vote(NamedTuple):
    ordinal: int
    table_layout: str
    executions: int


PLACES = "SELECT run, min(ordinal) AS ordinal FROM batch_runs WHERE batch = $batch GROUP BY run"
SIBLINGS = f"""
WITH mine AS (SELECT DISTINCT ordinal, run FROM batch_runs WHERE batch = $batch),
alike AS (SELECT DISTINCT mine.ordinal, m.batch, m.ordinal AS theirs FROM mine JOIN batch_runs m USING (run)),
family AS (
    SELECT DISTINCT a.ordinal, m.run FROM alike a JOIN batch_runs m ON m.batch = a.batch AND m.ordinal = a.theirs
),
good AS (
    SELECT f.ordinal, e.run, arg_max(e.judgement, {ORDER}) AS execution
    FROM family f
    JOIN all_candidates e ON e.run = f.run AND e.status = 'ok' AND e.purpose = 'run'
        AND {SAME_PROGRAMS} AND e.ingest_rules = $ingest_rules
    GROUP BY ALL
)"""
"""The successful executions of a batch's experiments, including those of the same experiment with another number of runs."""
SIBLINGS_FORMS = """
SELECT DISTINCT a.table_layout FROM all_artifacts a
WHERE a.kind = 'table' AND a.output = $output AND a.execution IN (SELECT execution FROM good)
"""
SIBLINGS_EXAMPLE = """
SELECT a.sha256, a.rows FROM all_artifacts a
WHERE a.kind = 'table' AND a.member IS NULL AND a.output = $output AND a.execution IN (SELECT execution FROM good)
ORDER BY ALL LIMIT 1
"""
RECORDED_FORMS = "SELECT DISTINCT table_layout FROM all_artifacts WHERE kind = 'table' AND output = $output"
SIBLINGS_VOTES = """
SELECT g.ordinal, a.table_layout, count(DISTINCT a.execution) AS executions
FROM all_artifacts a JOIN good g USING (execution) WHERE a.kind = 'table' AND a.output = $output
GROUP BY ALL
"""

"""Notes on how the runs of a batch ended: processes that still ran, and errors on standard error of successful runs."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from enum import StrEnum
from typing import NamedTuple

from sierra.store.store import Snapshot, Store
from sierra.util.lazy_definitions import regex
from sierra.util.text import counted, few, verb


class Kind(StrEnum):
    """The kinds of remarks in the table `endings`."""

    LEFT_RUNNING = "left running"
    ERROR = "error"
    ERROR_ON_STDOUT = "error on stdout"
    AFTER_MARKER = "after marker"
    RESUMED = "resumed"


CURES = {
    Kind.ERROR: "stderr = {pattern} in [success] makes such runs fail",
    Kind.ERROR_ON_STDOUT: 'on standard output; marker = "stdout" and contains in [success] make runs fail that do not print '
    "a text, such as the last line of good runs",
}
"""Remedies for errors that runs print, by where they print them; `pattern` finds those that were seen."""
NAMED = 3
WORD = regex(r"(?:[A-Za-z_]\w*\.)*[A-Za-z_]\w*:")
"""The beginning of most messages: an error word, or the name of an exception."""
LAST = """
WITH last AS (
    SELECT e.run, arg_max(e.execution, e.lamport) AS execution, arg_max(e.status, e.lamport) AS status
    FROM executions e WHERE e.purpose = 'run' AND e.run IN (SELECT run FROM batch_runs WHERE batch = $b) GROUP BY e.run
), ended AS (SELECT execution FROM last WHERE status IN ('ok', 'mismatch'))
"""
"""The last executions of the runs of a batch that were successful, at least by themselves."""
REMARKS = (
    LAST
    + """
SELECT kind, text, count(DISTINCT execution) AS runs, (SELECT count(*) FROM ended) AS of
FROM endings JOIN ended USING (execution) GROUP BY ALL ORDER BY runs DESC, text
"""
)
AFFECTED = (
    LAST
    + """
SELECT kind, '' AS text, count(DISTINCT execution) AS runs, (SELECT count(*) FROM ended) AS of
FROM endings JOIN ended USING (execution) GROUP BY ALL
"""
)
TABLES = ("executions", "batch_runs", "endings")


class _Remark(NamedTuple):
    kind: str
    text: str
    runs: int
    of: int


def of_batch(store: Store, batch: str) -> list[str]:
    """Return the notes on the ends of a batch's runs, one line each."""
    with store.snapshot() as snapshot:
        return list(notes(snapshot, batch))


def notes(snapshot: Snapshot, batch: str) -> Iterator[str]:
    """Yield the notes on the ends of a batch's runs, one line each."""
    affected, texts = _remarks(snapshot, batch)
    if left := affected.get(Kind.LEFT_RUNNING):
        cure = 'let the command wait for them; leftovers = "fail" in [success] makes such runs fail'
        yield f"{_left_running(left, texts)} ({cure})"
    if resumed := affected.get(Kind.RESUMED):
        yield (
            f"{resumed.runs} of {counted(resumed.of, 'run')} continued from the checkpoint of an execution that was cut off; "
            "sierra replay executes them from the beginning"
        )
    for kind, cure in CURES.items():
        if bad := affected.get(kind):
            yield _errors(bad, texts[kind], cure.format(pattern=_pattern([remark.text for remark in texts[kind]])))


def left_running(store: Store, batch: str) -> str:
    """Return that processes were ended that still ran when the command of a batch's runs had ended; "" if none were."""
    with store.snapshot() as snapshot:
        affected, texts = _remarks(snapshot, batch)
    left = affected.get(Kind.LEFT_RUNNING)
    return _left_running(left, texts) if left else ""


def _remarks(snapshot: Snapshot, batch: str) -> tuple[dict[str, _Remark], dict[str, list[_Remark]]]:
    """Return, by kind, how many runs of a batch have a remark, and the texts of the remarks."""
    if not snapshot.holds("endings"):
        return {}, {}
    snapshot.views.make(TABLES)
    texts: dict[str, list[_Remark]] = {}
    for row in snapshot.select(_Remark, REMARKS, b=batch):
        texts.setdefault(row.kind, []).append(row)
    return {row.kind: row for row in snapshot.select(_Remark, AFFECTED, b=batch)}, texts


def _left_running(row: _Remark, texts: Mapping[str, list[_Remark]]) -> str:
    named = few([one.text for one in texts[Kind.LEFT_RUNNING]], NAMED)
    where = f"in {row.runs} of {counted(row.of, 'run')}"
    return f"{where} processes were still running when the command ended, and were ended: {named}"


def _errors(row: _Remark, texts: list[_Remark], cure: str) -> str:
    first, *others = texts
    more = f" (and {counted(len(others), 'other message')})" if others else ""
    ends = f"{verb(row.runs, 'was', 'were')} successful, but what {verb(row.runs, 'it', 'they')} printed ends with an error"
    return f"{row.runs} of {counted(row.of, 'run')} {ends}: {first.text}{more} ({cure})"


def _pattern(texts: Sequence[str]) -> str:
    """Return the value of `stderr` that finds all of these messages, in TOML; words if there is no simple one."""
    words = dict.fromkeys(found and f"^{re.escape(found[0])}" for found in map(WORD.match, texts))
    return json.dumps("|".join(map(str, words))) if None not in words and len(words) <= NAMED else "a pattern for these lines"

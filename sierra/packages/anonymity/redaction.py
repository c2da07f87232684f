"""Redaction: the decision about each column of the records, so that they no longer show who executed runs, where and when.

A column without a decision stops the command. Ids of batches,
experiments, runs, executions and sessions, hashes of outputs and of programs, and all rows and files that runs wrote stay as
they are. The decision about each other column is beside the column, in `sierra.store.row_types`.

The table `redactions` names the sessions whose records were rewritten. Texts that are kept may contain names all the same: see
`sierra.packages.anonymity.content_search`.
"""

from __future__ import annotations

from collections.abc import Mapping

from sierra.errors import Damaged
from sierra.store.row_types import Redaction
from sierra.store.schema import RECORDED

VERSION = "sierra redaction 1"
"""The version of these rules, which the table `redactions` names."""

RULES: Mapping[str, Mapping[str, Redaction | None]] = {
    name: {column.name: column.redaction for column in table.columns} for name, table in RECORDED.items()
}
"""The decision about each column, by table. Texts in columns that are kept are searched for names."""


def rule(table: str, column: str) -> Redaction:
    """Return the decision about a column. Raises Damaged if there is none."""
    found = RULES.get(table, {}).get(column)
    if found is None:
        raise Damaged(f"the table {table} has a column {column!r} that this SIERRA cannot make anonymous")
    return found

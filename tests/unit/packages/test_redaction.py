"""Every column of every recorded table has a decision, and rewriting keeps what must stay."""

from __future__ import annotations

import pytest

from sierra.errors import Damaged
from sierra.packages.anonymity.redact_rows import RowRedactor
from sierra.packages.anonymity.redact_store import MARKED, RULES, rule
from sierra.store.row_types import Redaction
from sierra.store.schema import ID, RECORDED, TIME


def test_every_column_has_a_decision_and_no_other_has() -> None:
    """Texts say how they are redacted; numbers are kept, and times are moved."""
    assert not [(table, column) for table, columns in RULES.items() for column, decision in columns.items() if decision is None]
    with pytest.raises(Damaged, match="column 'owner' that this SIERRA cannot make anonymous"):
        rule("sessions", "owner")


def test_times_and_references_to_rewritten_records_are_rewritten_everywhere() -> None:
    expected = {
        "environment": {Redaction.ENVIRONMENT, Redaction.ROW},
        "isolation": {Redaction.ISOLATION, Redaction.ROW},
        "host": {Redaction.HOST, Redaction.ROW},
        "node": {Redaction.HOST},
        "attempt": {Redaction.ATTEMPT},
        "files_read.files": {Redaction.ROW},
        "observations.files": {Redaction.ROW},
        "sessions.source": {Redaction.SOURCE},
    }
    for name, table in RECORDED.items():
        for column in table.columns:
            decision = RULES[name][column.name]
            if column.type == TIME:
                assert decision in (Redaction.TIME, Redaction.NOTHING), (name, column.name)
            for key in (column.name, f"{name}.{column.name}"):
                assert decision in expected.get(key, {decision}), (name, column.name)
            if column.name == "session" and column.type == ID and "batch" in RULES[name]:
                assert name in {*MARKED, "judgements", "imported_sessions"}, "sessions in this table get no mark"


@pytest.mark.parametrize(
    ("path", "shown"),
    [
        ("/home/jane/bin/argos3", "/redacted/1/argos3"),
        ("/home/jane/lib:/usr/lib:/opt/lab", "/redacted/1/lib:/usr/lib:/redacted/2/lab"),
        ("/usr/lib/../../home/jane/x", "/redacted/1/x"),
        ("{home}/x", "/redacted/1/x"),
        ("{project}/a/b", "{project}/a/b"),
        ("/usr/bin/python3", "/usr/bin/python3"),
        ("/usrhome/jane", "/redacted/1/jane"),
        ("libc.so.6", "libc.so.6"),
    ],
)
def test_folders_that_may_identify_get_numbers(path: str, shown: str) -> None:
    class Snapshot:
        def values(self, kind: type, text: str) -> list[str]:
            return [path]

        def select(self, kind: type, text: str) -> list[object]:
            return []

    assert RowRedactor(Snapshot()).place(path) == shown  # type: ignore[arg-type]

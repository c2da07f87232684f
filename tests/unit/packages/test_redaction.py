"""Every column of every recorded table has a decision, and rewriting keeps what must stay."""

from __future__ import annotations

import pytest

from sierra.errors import Damaged
from sierra.packages.anonymity.redact_rows import RowRedactor
from sierra.packages.anonymity.redact_store import MARKED
from sierra.packages.anonymity.redaction import RULES, Rule, rule
from sierra.store.schema import ID, RECORDED, TIME


def test_every_column_has_a_decision_and_no_other_has() -> None:
    assert {table: set(columns) for table, columns in RULES.items()} == {
        name: {column.name for column in table.columns} for name, table in RECORDED.items()
    }
    with pytest.raises(Damaged, match="column 'owner' that this SIERRA cannot make anonymous"):
        rule("sessions", "owner")


def test_times_and_references_to_rewritten_records_are_rewritten_everywhere() -> None:
    expected = {
        "environment": {Rule.ENVIRONMENT, Rule.ROW},
        "isolation": {Rule.ISOLATION, Rule.ROW},
        "host": {Rule.HOST, Rule.ROW},
        "node": {Rule.HOST},
        "attempt": {Rule.ATTEMPT},
        "files_read.files": {Rule.ROW},
        "observations.files": {Rule.ROW},
        "sessions.source": {Rule.SOURCE},
    }
    for name, table in RECORDED.items():
        for column in table.columns:
            decision = RULES[name][column.name]
            if column.type == TIME:
                assert decision in (Rule.TIME, Rule.NOTHING), (name, column.name)
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

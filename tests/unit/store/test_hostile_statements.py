"""No statement of a user changes the store, the connection or a file, or reads anything but the store."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from sierra.errors import SqlError
from sierra.store.store import Snapshot, Store
from tests import stores

STATEMENTS = [
    "ATTACH ':memory:' AS other",
    "DETACH memory",
    "USE memory.main",
    "LOAD httpfs",
    "LOAD '/tmp/other.duckdb_extension'",
    "SET GLOBAL memory_limit = '400GB'",
    "SET lock_configuration = false",
    "RESET memory_limit",
    "RESET max_temp_directory_size",
    "PRAGMA enable_profiling",
    "PRAGMA database_list",
    "CALL pragma_version()",
    "CALL enable_logging()",
    "CHECKPOINT",
    "VACUUM",
    "EXPORT DATABASE '/tmp/sierra-explorer'",
    "IMPORT DATABASE '/tmp/sierra-explorer'",
    "CREATE TABLE other AS SELECT 1",
    "CREATE MACRO other() AS 1",
    "CREATE SECRET (TYPE s3)",
    "INSERT INTO runs SELECT * FROM runs",
    "UPDATE runs SET run = ''",
    "DELETE FROM runs",
    "ALTER TABLE runs ADD COLUMN other INTEGER",
    "BEGIN",
    "PREPARE other AS SELECT 1",
    "EXECUTE other",
    "EXPLAIN DROP TABLE runs",
    "EXPLAIN ANALYZE COPY runs TO '/tmp/sierra-explorer.csv'",
    "COPY (SELECT 1) TO '/dev/stdout'",
    "COPY runs FROM '/etc/passwd'",
    "SELECT * FROM query('SELECT * FROM read_text(''/etc/passwd'')')",
    "SELECT * FROM query_table('/etc/passwd')",
    "SELECT * FROM '/etc/passwd'",
    "SELECT * FROM 'https://example.org/a.csv'",
    "SELECT * FROM read_blob('/etc/passwd')",
    "SELECT * FROM read_parquet('/etc/passwd')",
    "SELECT * FROM read_json('/etc/passwd')",
    "SELECT * FROM parquet_scan('https://example.org/a.parquet')",
    "SELECT * FROM sniff_csv('/etc/passwd')",
    "SELECT * FROM glob('/etc/*')",
    "SELECT * FROM json_execute_serialized_sql(json_serialize_sql('SELECT * FROM read_text(''/etc/passwd'')'))",
    "PRAGMA json_execute_serialized_sql(json_serialize_sql('SELECT 1'))",
    "SELECT * FROM enable_logging()",
    "SELECT * FROM write_log('x')",
    "SELECT * FROM force_checkpoint()",
    "SELECT * FROM which_secret('s3://a', 's3')",
    "SELECT getenv('HOME')",
    "WITH a AS (SELECT 1) DELETE FROM runs",
    "FROM runs; DROP TABLE runs",
    "UPDATE EXTENSIONS",
    "EXPLAIN UPDATE EXTENSIONS",
    "SELECT '\udcff'",
]
SETTINGS = "SELECT name, value FROM duckdb_settings() ORDER BY name"


@pytest.fixture(scope="module")
def snapshot(recorded: Path) -> Iterator[Snapshot]:
    with Store(recorded / ".sierra").snapshot() as snapshot:
        yield snapshot


@pytest.mark.parametrize("statement", STATEMENTS)
def test_a_hostile_statement_is_refused(snapshot: Snapshot, recorded: Path, statement: str) -> None:
    settings, state = snapshot.run(SETTINGS), stores.state(recorded)
    with pytest.raises(SqlError):
        snapshot.sql(statement)
    assert snapshot.run(SETTINGS) == settings
    assert stores.state(recorded) == state


def test_half_of_a_character_in_a_parameter_is_refused(snapshot: Snapshot) -> None:
    with pytest.raises(SqlError, match="no character of UTF-8"):
        snapshot.sql("SELECT $given", given="\ud800")

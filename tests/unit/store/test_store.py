"""The store: segments appear as a whole, are never counted twice, and are read-only."""

from __future__ import annotations

import hashlib
import os
import subprocess
import threading
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import duckdb
import pytest

import sierra
from sierra.api import Project
from sierra.errors import Damaged, Missing, NotFound, SqlError
from sierra.store.batch_data import BatchData
from sierra.store.connections import connect
from sierra.store.objects import PART, Objects
from sierra.store.schema import DERIVED, RECORDED, check_name
from sierra.store.segments import MANIFEST, Writer
from sierra.store.store import Store
from tests import stores
from tests.projects import quick

TOML = """
template = "t.xml"
command = "sh sim.sh {input} {seed}"
seed = "//e/@seed"
runs = 2
[variables]
n = "//e/@n"
k = "//e/@k"
[scenarios.low]
changes = [{ set = "//e/@mode", value = "low" }]
[scenarios.high]
changes = [{ set = "//e/@mode", value = "high" }]
"""
SIM = "printf 'tick,v\\n0,1\\n1,%s\\n' $2 > out.csv; echo said\n"


@pytest.fixture
def project(tmp_path: Path) -> Project:
    (tmp_path / "sierra.toml").write_text(TOML)
    (tmp_path / "t.xml").write_text('<e seed="0" n="0" k="0" mode="none"/>')
    (tmp_path / "sim.sh").write_text(SIM)
    return sierra.open(tmp_path)


def run(project: Project, *query: str, **options: Any) -> Any:
    return project.run(*query, figures=False, **options)


def one(project: Project, statement: str, **parameters: Any) -> Any:
    return project.sql(statement, **parameters).column(0)[0].as_py()


# ---------------------------------------------------------------- segments


@pytest.mark.integration
def test_the_manifest_of_a_segment_lists_and_hashes_all_its_files(project: Project) -> None:
    stores.ask(project.root, "n=1")
    segments = list((project.paths.store / "segments").iterdir())
    assert segments
    for segment in segments:
        subprocess.run(["sha256sum", "--check", "--quiet", MANIFEST], cwd=segment, check=True)
        manifest = (segment / MANIFEST).read_bytes()
        assert segment.name.partition("-")[2] == hashlib.sha256(manifest).hexdigest()[:16]
        assert {line.split()[1].decode() for line in manifest.splitlines()} == {
            path.name for path in segment.iterdir() if path.name != MANIFEST
        }


def test_a_segment_is_not_visible_before_it_is_published(tmp_path: Path) -> None:
    store = Store.create(tmp_path / "s")
    writer = store.writer(tmp_path / "s" / "work" / "one", "ab" * 32)
    writer.rows("findings", [{"execution": "e", "status": "mismatch"}])
    assert store.rows("SELECT * FROM findings") == []
    assert store.publish(writer)
    assert [row["execution"] for row in store.rows("SELECT * FROM findings")] == ["e"]


@pytest.mark.integration
@pytest.mark.parametrize("name", ["executions.parquet", "output.*.parquet", "MANIFEST"])
def test_a_store_that_lacks_a_recorded_file_is_not_read(project: Project, name: str) -> None:
    run(project, "n=1")
    for segment in (project.paths.store / "segments").iterdir():
        os.utime(segment, (1, 1))
    assert project.store.segments()
    lost = next(project.paths.store.glob(f"segments/*/{name}"))
    lost.unlink()
    with pytest.raises(Damaged, match=rf"{lost.parent.name}/{lost.name} is missing: run sierra fsck --repair"):
        project.store.segments()


def test_publishing_the_same_segment_twice_adds_it_once(tmp_path: Path) -> None:
    store = Store.create(tmp_path / "s")
    for _ in range(2):
        writer = store.writer(tmp_path / "s" / "work" / "one", "ab" * 32)
        writer.rows("programs", [{"programs": "p", "name": "n"}])
        store.publish(writer)
    assert len(store.segments()) == 1
    assert not store.publish(Writer(tmp_path / "s" / "work" / "none", "ab" * 32))


@pytest.mark.integration
def test_a_store_has_markers_and_refuses_another_format(project: Project) -> None:
    stores.ask(project.root, "n=1")
    root = project.paths.store
    assert (root / ".gitignore").read_text() == "*\n"
    assert (root / "CACHEDIR.TAG").read_text().startswith("Signature: 8a477f597d28d172789f06886806bc55\n")
    (root / "format").write_text("sierra store 1\n")
    with pytest.raises(Damaged, match="'sierra store 1'"):
        Store(root)
    with pytest.raises(Missing, match="nothing has been run"):
        Store(root / "elsewhere")


@pytest.mark.integration
@pytest.mark.parametrize("kind", ["lost", "link", "folder", "pipe"])
def test_a_store_whose_format_cannot_be_read_is_never_taken_for_none(project: Project, kind: str) -> None:
    stores.ask(project.root, "n=1")
    mark = project.paths.store / "format"
    mark.unlink()
    if kind == "link":
        mark.symlink_to("/nonexistent")
    elif kind == "folder":
        mark.mkdir()
    elif kind == "pipe":
        os.mkfifo(mark)
    with pytest.raises(Damaged, match=r"format: cannot be read: .*fsck --repair"):
        Store(project.paths.store)
    assert quick(project.root, "fsck", "--repair").returncode == 0
    assert quick(project.root, "ls").returncode == 0


@pytest.mark.nightly
def test_the_number_of_files_does_not_grow_with_runs(project: Project) -> None:
    run(project, "n=1", runs=2)
    few = sum(1 for path in project.paths.store.rglob("*") if path.is_file())
    (project.root / "sim.sh").write_text(SIM + "# changed\n")
    run(project, "n=1", runs=60)
    many = sum(1 for path in project.paths.store.rglob("*") if path.is_file()) - few
    assert many <= few + 8


# ---------------------------------------------------------------- SQL


@pytest.mark.parametrize(
    "statement",
    [
        "SELECT * FROM read_text('/etc/passwd')",
        "SELECT * FROM read_csv('/etc/passwd')",
        "SELECT * FROM '/etc/passwd'",
        "SELECT * FROM glob('/*')",
        "SELECT * FROM read_text('{store}/format')",
        "SELECT * FROM read_parquet('{store}/segments/../../x.parquet')",
        "COPY runs TO '{store}/segments/x.csv'",
        "EXPLAIN ANALYZE COPY runs TO '{store}/segments/x.csv'",
        "CREATE TABLE t AS SELECT 1",
        "INSERT INTO runs VALUES (1)",
        "ATTACH '{store}/x.db'",
        "INSTALL httpfs",
        "LOAD httpfs",
        "SET enable_external_access = true",
        "PRAGMA enable_logging",
        "EXPORT DATABASE '{store}/segments/x'",
        "SELECT 1; SELECT 2",
        "SELECT * FROM nothing",
        "",
    ],
)
def test_sql_cannot_write_or_access_other_files(project: Project, statement: str) -> None:
    stores.ask(project.root, "n=1")
    (project.root / "x.parquet").write_bytes(b"PAR1")
    before = sorted(project.paths.store.rglob("*"))
    with pytest.raises(SqlError) as caught:
        project.sql(statement.format(store=project.paths.store))
    assert "\n" not in str(caught.value)
    assert sorted(project.paths.store.rglob("*")) == before


@pytest.mark.parametrize(
    "statement",
    [
        "SELECT count(*) FROM Runs",
        'FROM "runs" SELECT count(*)',
        "WITH x AS (SELECT * FROM runs) SELECT count(*) FROM x, (SELECT 1)",
        "SELECT count(*) FROM out o JOIN runs r USING (run) JOIN executions e ON e.execution = o.execution WHERE tick = 0",
        "SELECT count(*) FROM (SELECT 1), OUT WHERE tick = 0",
        "SELECT (SELECT count(*) FROM runs)",
        "SELECT count(*) FROM main.runs",
        "SELECT count(*) FROM /* all of the */ runs",
    ],
)
def test_tables_are_found_anywhere_in_a_statement(project: Project, statement: str) -> None:
    stores.ask(project.root, "n=1")
    assert one(project, statement) == 2


@pytest.mark.integration
def test_tables_have_the_documented_columns_and_types(project: Project) -> None:
    stores.ask(project.root, "n=1")
    for table in (*RECORDED.values(), *DERIVED.values()):
        found = {row["column_name"]: row["column_type"] for row in project.sql(f"DESCRIBE {table.name}").to_pylist()}
        said = {column.name: column.type for column in table.columns}
        assert {name: found.get(name) for name in said} == said, table.name
        assert found.keys() - said.keys() <= {"n", "k"}
    shown = set(project.sql("SHOW TABLES").column(0).to_pylist())
    assert shown >= {*RECORDED, *DERIVED, "out"}


def test_outputs_may_not_be_named_like_a_table_of_the_store() -> None:
    assert not any(map(check_name, ("runs", "Runs", "EXECUTIONS")))
    assert check_name("out")


# ---------------------------------------------------------------- batches that share runs


@pytest.mark.nightly
def test_extending_a_batch_executes_only_new_runs(project: Project) -> None:
    first = run(project, "n=1,2", runs=8)
    seen = set(project.sql("SELECT execution FROM executions").column(0).to_pylist())
    second = run(project, "n=1,2", runs=10)
    assert (first.executed, second.executed, second.reused) == (16, 4, 16)
    assert seen < set(project.sql("SELECT execution FROM runs").column(0).to_pylist())
    assert one(project, "SELECT count(*) FROM runs") == 20
    assert one(project, "SELECT count(*) FROM out") == 40
    assert one(project, "SELECT count(*) FROM batches") == 2
    assert one(project, "SELECT count(*) FROM batch_runs") == 36


@pytest.mark.nightly
def test_runs_that_batches_share_are_counted_once(project: Project) -> None:
    run(project, "n=1,2")
    shared = run(project, "n.Log4")
    assert (shared.executed, shared.reused) == (2, 4)
    assert one(project, "SELECT count(*) FROM runs") == 6
    assert project.sql("SELECT n, count(*) AS c FROM out GROUP BY n ORDER BY n").to_pylist() == [
        {"n": n, "c": 4} for n in (1, 2, 4)
    ]


@pytest.mark.nightly
def test_axes_of_all_batches_are_columns_with_a_common_type(project: Project) -> None:
    run(project, "n=1", "k=0.5,1.5")
    run(project, "k=7")
    run(project, "scenario=low,high")
    run(project, "n=9", scenario="low")
    found = project.sql("SELECT n, k, scenario, count(*) AS c FROM runs GROUP BY ALL ORDER BY ALL").to_pylist()
    assert [tuple(row.values()) for row in found] == [
        (1, 0.5, None, 2),
        (1, 1.5, None, 2),
        (9, None, "low", 2),
        (None, 7.0, None, 2),
        (None, None, "high", 2),
        (None, None, "low", 2),
    ]


@pytest.mark.nightly
def test_an_output_column_named_like_an_axis_keeps_its_values(project: Project) -> None:
    (project.root / "sim.sh").write_text("printf 'N,n_\\n5,6\\n' > out.csv\n")
    run(project, "n=1", runs=1)
    assert project.sql('SELECT n, "N_", "n__" FROM out').to_pylist() == [{"n": 1, "N_": 5, "n__": 6}]


@pytest.mark.nightly
def test_rows_of_a_run_can_be_sorted_in_the_order_of_writing(project: Project) -> None:
    other = "printf 'v\\n3\\n1\\n2\\n' > other.csv\n"
    (project.root / "sim.sh").write_text("printf 'v,row\\n3,a\\n1,b\\n2,c\\n' > out.csv\n" + other)
    run(project, "n=1,2")
    assert project.sql("SELECT v FROM out WHERE n = 2 AND number = 1 ORDER BY row_number").column(0).to_pylist() == [3, 1, 2]
    assert project.sql("SELECT v FROM other WHERE n = 1 AND number = 1 ORDER BY row").column(0).to_pylist() == [3, 1, 2]
    assert project.sql("SELECT DISTINCT row FROM out ORDER BY 1").column(0).to_pylist() == ["a", "b", "c"]


def test_a_damaged_segment_is_reported_with_its_file(project: Project) -> None:
    stores.ask(project.root, "n=1")
    for name in ("executions", "sessions"):
        for path in project.paths.store.glob(f"segments/*/{name}.parquet"):
            path.chmod(0o644)
            path.write_bytes(b"")
    for ask in (lambda: run(project, "n=1"), lambda: project.batches, lambda: project.sql("SELECT * FROM runs")):
        with pytest.raises(Damaged, match=r"(executions|sessions)\.parquet"):
            ask()


def test_an_error_without_a_class_is_about_damaged_files(project: Project) -> None:
    stores.ask(project.root, "n=1")
    with project.store.snapshot() as snapshot, pytest.raises(Damaged, match="Out of buffer; sierra fsck"), snapshot.errors():
        raise duckdb.Error("Out of buffer")  # as it says for a damaged page of a Parquet file


@pytest.mark.nightly
def test_axes_of_other_batches_do_not_rename_columns_of_one_batch(project: Project) -> None:
    (project.root / "sim.sh").write_text("printf 'k\\n5\\n' > out.csv\n")
    batch = run(project, "n=1", runs=1).batch
    run(project, "k=7", runs=1)
    assert project.sql("SELECT n, k FROM out", within=batch).to_pylist() == [{"n": 1, "k": 5}]
    assert project.sql("SELECT n, k, k_ FROM out ORDER BY n").to_pylist() == [
        {"n": 1, "k": None, "k_": 5},
        {"n": None, "k": 7, "k_": 5},
    ]


@pytest.mark.integration
def test_the_last_successful_execution_with_the_last_programs_is_effective(project: Project, tmp_path: Path) -> None:
    simulator = tmp_path / "sim"
    project = _with_program(project, simulator, 1)
    batch = run(project, "n=1").batch
    _with_program(project, simulator, 2)
    assert run(project, "n=1").executed == 2
    _with_program(project, simulator, 3)
    with simulator.open("a") as file:
        file.write('test "$1" != ' + str(_seed(1)) + "\n")
    assert run(project, "n=1").failed == 1
    rows = project.sql("SELECT r.number, status, executions, v FROM runs r JOIN out USING (run) ORDER BY 1").to_pylist()
    assert [tuple(row.values()) for row in rows] == [(0, "ok", 3, 3)]
    assert project.sql("SELECT status FROM runs ORDER BY number").to_pylist() == [{"status": "ok"}, {"status": "failed"}]
    with BatchData(project.store, batch) as frame:
        assert frame.counts() == {0: (1, 2)}
        frame.samples("out", "v")
        assert frame.sql("SELECT number, value FROM samples").to_pylist() == [{"number": 0, "value": 3.0}]


def _seed(number: int) -> int:
    from sierra.design.seeds import seed

    return seed(0, number)


def _with_program(project: Project, path: Path, value: int) -> Project:
    path.write_text(f"#!/bin/sh\nprintf 'v\\n{value}\\n' > out.csv\n")
    path.chmod(0o755)
    toml = TOML.replace("sh sim.sh {input} {seed}", f"{path} {{seed}}") + '[source]\npaths = ["sim.sh"]\n'
    (project.root / "sierra.toml").write_text(toml)
    return sierra.open(project.root)


@pytest.mark.integration
def test_a_finding_removes_an_execution_from_all_tables(project: Project) -> None:
    batch = stores.ask(project.root, "n=1")
    [first, _] = project.sql("SELECT execution FROM runs ORDER BY number").column(0).to_pylist()
    writer = project.store.writer(project.paths.store / "work" / "w", batch)
    found = {"execution": first, "found_at": datetime.now(UTC), "status": "mismatch", "reason": "so it is", "lamport": 1 << 50}
    writer.rows("findings", [found])
    project.store.publish(writer)
    assert project.sql("SELECT number, status FROM runs ORDER BY 1").to_pylist() == [
        {"number": 0, "status": "mismatch"},
        {"number": 1, "status": "ok"},
    ]
    assert one(project, "SELECT count(*) FROM out") == 2
    assert run(project, "n=1").executed == 1
    assert one(project, "SELECT count(*) FROM out") == 4


@pytest.mark.integration
def test_sql_is_consistent_while_a_batch_runs(
    project: Project, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sierra.ingest.recorder.SOON_S", 0.1)
    folder = tmp_path_factory.mktemp("beside")
    waits = f'[ "$(stat -c %s {folder}/begun)" -le 10 ] || until [ -e {folder}/gate ]; do sleep 0.02; done\n'
    (project.root / "sim.sh").write_text(f"echo >> {folder}/begun\n{waits}{SIM}")
    asking = threading.Thread(target=lambda: run(project, "n=1", runs=20, jobs=2))
    asking.start()
    seen = set()
    while asking.is_alive():
        if (project.paths.store / "format").exists() and project.store.outputs():
            counts = project.sql(
                "SELECT (SELECT count(*) FROM executions), (SELECT count(*) FROM out), "
                "(SELECT count(*) FROM runs WHERE status = 'ok')"
            ).to_pylist()[0]
            executions, rows, good = counts.values()
            assert executions * 2 == rows == good * 2
            seen.add(executions)
        if any(seen):
            (folder / "gate").touch()
        time.sleep(0.1)
    asking.join()
    assert 0 < min(filter(None, seen)) < 20
    assert one(project, "SELECT count(*) FROM out") == 40


def test_an_id_is_found_by_its_prefix(project: Project) -> None:
    batch = stores.ask(project.root, "n=1")
    assert project.store.resolve(batch[:8]).kind == "batch"
    with pytest.raises(NotFound, match="4 to 64"):
        project.store.resolve("abc")
    with pytest.raises(NotFound, match="begins with"):
        project.store.resolve("0" * 64)


# ---------------------------------------------------------------- objects


@pytest.mark.integration
@pytest.mark.parametrize("size", [4 * PART + 7, 3 * PART + 5, PART + 1, PART, PART - 1, 1, 0])
def test_an_object_is_read_back_byte_for_byte(tmp_path: Path, size: int) -> None:
    store = Store.create(tmp_path / "s")
    content = (hashlib.sha256(str(size).encode()).digest() * (size // 32 + 1))[:size]
    file = tmp_path / "file"
    file.write_bytes(content)
    writer = store.writer(tmp_path / "s" / "work" / "w", "ab" * 32)
    objects = Objects(writer.path("objects"))
    digest = hashlib.sha256(content).hexdigest()
    objects.add_file(file, digest, size)
    assert objects.add(content) == digest
    objects.add(b"another")
    objects.close()
    store.publish(writer)
    assert store.object(digest) == content
    with connect() as connection:
        held = f"SELECT count(*) FROM '{tmp_path}/s/segments/*/objects.parquet' WHERE sha256 = '{digest}'"
        assert connection.execute(held).fetchone() == (max(1, -(-size // PART)),)


def test_a_damaged_object_is_detected(tmp_path: Path) -> None:
    store = Store.create(tmp_path / "s")
    writer = store.writer(tmp_path / "s" / "work" / "w", "ab" * 32)
    writer.rows("objects", [{"sha256": "a" * 64, "part": 0, "size": 1, "content": b"x"}])
    store.publish(writer)
    with pytest.raises(Damaged, match="differs from the record"):
        store.object("a" * 64)
    with pytest.raises(NotFound, match="no recorded file"):
        store.object("b" * 64)


def test_rows_are_complete_if_another_statement_runs_while_they_are_read(tmp_path: Path) -> None:
    with Store.create(tmp_path / "store").snapshot() as snapshot:
        found = []
        for (number,) in snapshot.each("SELECT i FROM range(10000) t(i)", {}):
            found.append(number)
            if number in (5, 9000):
                assert snapshot.run("SELECT 1") == [(1,)]
                inner = snapshot.each("SELECT i FROM range(5000) t(i)", {})
                assert len(list(inner)) == 5000
            if number == 7:
                next(snapshot.each("SELECT i FROM range(5000) t(i)", {}))
        assert found == list(range(10000))

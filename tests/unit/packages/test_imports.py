"""Imported records keep their origin, never join what was executed here, and are added as a whole or not at all."""

from __future__ import annotations

import hashlib
import shutil
import signal
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import sierra
from sierra.errors import Damaged, Missing, SierraError, UsageError
from sierra.packages import archive
from sierra.packages.members import MANIFEST
from sierra.packages.subject import Member
from sierra.store.lamport_clock import stamp
from sierra.store.segments import manifest
from tests import projects, stores

TOML = """
[package]
title = "Coverage of a swarm"
authors = [{ name = "Jane Doe" }]
license = "MIT"
"""
SIMULATOR = projects.SIMULATOR + 'import time\nopen("clock.csv", "w").write(f"now\\n{time.time_ns()}\\n")\n'
"""Its output `clock` differs in each execution, so laboratories get other results for the same runs."""
FIRST, SECOND = ("population_size=1,2",), ("population_size=2,3",)
EFFECTIVE = "SELECT count(*) FROM effective JOIN all_judgements USING (judgement)"
NOW = "SELECT run, now FROM clock ORDER BY run"
pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project with two batches that share runs, and packages of the first (`first.zip`) and of both (`both.zip`)."""
    folder = tmp_path_factory.mktemp("imports")
    root = projects.make(folder / "lab", projects.CONFIG + TOML, simulator=SIMULATOR)
    shutil.copytree(root, folder / "empty")
    project = sierra.open(root)
    batches = [project.run(*query, figures=False).batch for query in (FIRST, SECOND)]
    project.replay(batches[0], runs=1)
    project.packages.pack(batches[0], report=False, path=folder / "first.zip")
    project.packages.pack(*batches, report=False, path=folder / "both.zip")
    return root


@pytest.fixture
def other(lab: Path, tmp_path: Path) -> Path:
    """The same project in another laboratory, without records."""
    return stores.copy(lab.parent / "empty", tmp_path / "other")


def rows(root: Path, statement: str) -> list[dict[str, Any]]:
    return sierra.open(root).sql(statement).to_pylist()


def value(root: Path, statement: str) -> Any:
    [row] = rows(root, statement)
    return next(iter(row.values()))


@pytest.mark.nightly
def test_a_new_batch_is_read_like_one_of_this_store_and_keeps_its_origin(lab: Path, other: Path) -> None:
    said = projects.quick(other, "import", str(lab.parent / "both.zip"))
    assert said.returncode == 0, said.stderr
    assert ": Coverage of a swarm\n6 executions added, 2 of replays or captures left out\n" in said.stdout
    assert said.stdout.count(": its executions count\n") == 2
    assert rows(other, NOW) == rows(lab, NOW)
    project = sierra.open(other)
    [package] = {one.package for one in project.batches}
    assert package is not None
    assert said.stdout.startswith(f"package {package[:10]}: ")
    assert project.maintenance.fsck().sound
    assert f"\npackage  {package}" not in projects.quick(other, "show", project.batches[0].batch).stdout
    assert "Coverage of a swarm" in projects.quick(other, "show", project.batches[0].batch).stdout
    execution = value(other, "SELECT min(execution) FROM executions")
    assert package[:10] in projects.quick(other, "show", execution).stdout
    assert value(other, "SELECT count(*) FROM replays") == 0
    before = stores.state(other)
    again = project.packages.import_records(lab.parent / "both.zip")
    assert (again.executions, again.known) == (0, 6)
    project.packages.import_records(lab.parent / "first.zip")
    assert {name for name in stores.state(other) if "segments" in name} == {name for name in before if "segments" in name}


def test_imported_executions_are_not_reused_and_do_not_count_beside_own_ones(lab: Path, other: Path) -> None:
    project = sierra.open(other)
    project.packages.import_records(lab.parent / "both.zip")
    summary = project.run(*SECOND, figures=False)
    assert (summary.executed, summary.reused) == (4, 0)
    own = rows(other, "SELECT DISTINCT execution FROM all_judgements WHERE packages IS NULL")
    effective = f"SELECT execution FROM effective WHERE batch = '{summary.batch}'"
    assert sorted(row["execution"] for row in rows(other, effective)) == sorted(row["execution"] for row in own)
    assert [one.package is None for one in project.batches] == [False, True]
    first = project.batches[0].batch
    theirs = f"SELECT execution FROM effective WHERE batch = '{first}' ORDER BY 1"
    assert rows(other, theirs) == rows(lab, theirs)
    assert value(other, f"SELECT count(*) FROM sessions WHERE batch = '{summary.batch}'") == 1
    assert value(other, f"SELECT count(*) FROM all_sessions WHERE batch = '{summary.batch}'") == 2
    assert value(other, "SELECT count(*) FROM nondeterminism") == 0
    why = projects.quick(other, "why", summary.batch).stdout
    assert "executed elsewhere; it came in package" in why
    assert "did not finish" not in why
    assert "executed with other programs" not in why
    project.maintenance.collect()
    assert project.maintenance.fsck().sound
    assert sorted(row["execution"] for row in rows(other, effective)) == sorted(row["execution"] for row in own)
    again = project.run(*SECOND, figures=False)
    assert (again.executed, again.reused) == (0, 4)


@pytest.mark.nightly
def test_an_import_changes_no_result_of_a_batch_that_was_executed_here(lab: Path, other: Path) -> None:
    project = sierra.open(other)
    batch = project.run(*FIRST, figures=False).batch
    before = rows(other, NOW), rows(other, "SELECT * FROM effective ORDER BY ALL")
    for _ in range(3):  # so that the other laboratory has the higher numbers
        sierra.open(lab).run(*FIRST, figures=False)
    newer = lab.parent / "newer.zip"
    if not newer.exists():
        sierra.open(lab).packages.pack(batch, report=False, path=newer)
    done = project.packages.import_records(newer)
    assert [one.counts for one in done.batches] == [False]
    assert (rows(other, NOW), rows(other, "SELECT * FROM effective ORDER BY ALL")) == before
    assert value(other, "SELECT count(DISTINCT packages) FROM all_judgements") == 1
    assert project.maintenance.fsck().sound
    project.packages.import_records(lab.parent / "both.zip")
    assert rows(other, f"SELECT * FROM effective WHERE batch = '{batch}' ORDER BY ALL") == before[1]
    assert project.run(*FIRST, figures=False).reused == 4
    assert project.replay(batch, runs=1).runs


@pytest.mark.nightly
def test_an_import_changes_no_run_that_another_batch_executed_here(lab: Path, other: Path) -> None:
    project = sierra.open(other)
    project.run(*FIRST, figures=False)
    before = rows(other, NOW), rows(other, "SELECT run, status, execution FROM runs ORDER BY run")
    for _ in range(2):  # so that the other laboratory has the higher numbers
        batch = sierra.open(lab).run(*SECOND, figures=False).batch
    sierra.open(lab).packages.pack(batch, report=False, path=other.parent / "second.zip")
    done = project.packages.import_records(other.parent / "second.zip")
    assert [one.counts for one in done.batches] == [True]
    now = rows(other, NOW), rows(other, "SELECT run, status, execution FROM runs ORDER BY run")
    assert [[row for row in new if row in old] for new, old in zip(now, before, strict=True)] == list(before)
    assert len(now[0]) == len(before[0]) + 2
    run = next(row for row in before[1] if value(other, f"SELECT count(*) FROM batch_runs WHERE run = '{row['run']}'") == 2)
    shown = projects.quick(other, "show", str(run["run"])).stdout
    assert next(line for line in shown.splitlines() if line.startswith("execution")).split()[1] == run["execution"][:10]
    here = rows(lab, f"SELECT execution FROM effective WHERE batch = '{batch}' ORDER BY 1")
    assert rows(other, f"SELECT execution FROM effective WHERE batch = '{batch}' ORDER BY 1") == here


def test_a_claim_names_the_package_of_the_runs_that_decide_it(lab: Path, other: Path) -> None:
    project = sierra.open(other)
    done = project.packages.import_records(lab.parent / "first.zip")
    how = f'query = "{FIRST[0]}"\nsql = "SELECT count(*) = 4 AS holds FROM runs"\n'
    config = other / "sierra.toml"
    config.write_text(config.read_text() + f'[claims.all]\nsays = "All runs succeed."\npaper = "Fig. 1"\n{how}')
    [claim] = sierra.open(other).claims.evaluate()
    assert (claim.verdict, claim.batches) == ("holds", (done.batches[0].batch,))
    assert claim.notes == (f"batch {claim.batches[0][:10]} was not executed here: it came in package {done.package[:10]}",)
    sierra.open(other).run(*FIRST, figures=False)
    [claim] = sierra.open(other).claims.evaluate()
    assert (claim.verdict, claim.notes) == ("holds", ())


@pytest.mark.nightly
def test_a_package_of_imported_batches_keeps_whose_executions_count(lab: Path, other: Path, tmp_path: Path) -> None:
    project = sierra.open(other)
    project.packages.import_records(lab.parent / "both.zip")
    own = project.run(*SECOND, figures=False).batch
    project.packages.pack(*(one.batch for one in project.batches), report=False, path=tmp_path / "again.zip")
    third = stores.copy(lab.parent / "empty", tmp_path / "third")
    sierra.open(third).packages.import_records(tmp_path / "again.zip")
    for batch in (own, project.batches[0].batch):
        statement = f"SELECT run, execution FROM effective WHERE batch = '{batch}' ORDER BY ALL"
        assert rows(third, statement) == rows(other, statement)
    assert value(third, "SELECT max(len(packages)) FROM imported_sessions") == 2
    back = sierra.open(lab).packages.import_records(tmp_path / "again.zip")
    assert back.executions == 4  # those of the other laboratory
    assert rows(
        lab, "SELECT count(*) AS n FROM effective JOIN all_judgements USING (judgement) WHERE packages IS NOT NULL"
    ) == [{"n": 0}]
    sierra.open(third).records.remove(own)
    assert sierra.open(third).maintenance.fsck().sound
    assert value(third, f"{EFFECTIVE} WHERE packages IS NULL") == 0


@pytest.mark.nightly
def test_two_packages_are_compared_without_a_project(lab: Path, other: Path, tmp_path: Path) -> None:
    project = sierra.open(other)
    batch = project.run(*FIRST, figures=False).batch
    project.packages.pack(batch, report=False, path=tmp_path / "theirs.zip")
    ours = str(lab.parent / "first.zip")
    said = projects.quick(tmp_path, "diff", ours, "theirs.zip")
    assert said.returncode == 1, said.stderr
    assert "results: 4 of 4 runs in both have other results" in said.stdout
    assert "results: clock.csv differs in 4 runs\n" in said.stdout
    assert "swarm.csv" not in said.stdout
    assert "results: table clock, run " in said.stdout
    assert "\nthe same: " in said.stdout
    assert {"batches", "runs", "source", "programs", "environment"} <= set(said.stdout.rpartition(": ")[2].strip().split(", "))
    both = projects.quick(tmp_path, "diff", ours, str(lab.parent / "both.zip"))
    assert "batches: 1 only in the second: " in both.stdout
    assert "runs: 2 only in the second: " in both.stdout
    assert "other results" not in both.stdout
    same = projects.quick(tmp_path, "diff", ours, ours)
    assert (same.returncode, same.stdout.count("\n")) == (0, 2)


def test_a_batch_of_a_store_is_compared_with_one_in_a_package(lab: Path, other: Path) -> None:
    project = sierra.open(other)
    batch, second = (project.run(*query, figures=False).batch for query in (FIRST, SECOND))
    both = str(lab.parent / "both.zip")
    said = projects.quick(other, "diff", batch, both)
    assert said.returncode == 1, said.stderr
    assert "results: 4 of 4 runs in both have other results" in said.stdout
    assert "results: clock.csv differs in 4 runs\n" in said.stdout
    assert said.stdout.endswith("\nthe same: batches, runs, source, programs, environment\n")
    other_way = projects.quick(other, "diff", f"{both}:{second[:10]}", batch[:10])
    assert "batches: 1 only in the first: " in other_way.stdout
    assert "runs: 2 only in the second: " in other_way.stdout
    assert projects.quick(lab, "diff", batch, both).returncode == 0
    assert projects.quick(other, "diff", batch, f"{both}:0000").returncode == 2


def test_executions_whose_origin_is_lost_never_count_as_own_ones(lab: Path, other: Path) -> None:
    package = str(lab.parent / "first.zip")
    project = sierra.open(other)
    project.packages.import_records(package)
    second = project.run(*SECOND, figures=False).batch
    for lost in (other / ".sierra").rglob("imported_sessions.parquet"):
        lost.unlink()
    with pytest.raises(Damaged, match=r"imported_sessions\.parquet is missing"):
        sierra.open(other).batches  # noqa: B018 - a property
    assert not sierra.open(other).maintenance.fsck().sound
    assert sierra.open(other).maintenance.repair().report.sound
    assert value(other, EFFECTIVE) == 6  # four executions; two of them also count in the first batch
    assert [row["batch"] for row in rows(other, "SELECT DISTINCT batch FROM executions")] == [second]
    sierra.open(other).records.remove(*(one.batch for one in sierra.open(other).batches))
    assert sierra.open(other).packages.import_records(package).executions == 4
    assert value(other, f"{EFFECTIVE} WHERE packages IS NULL") == 0


@pytest.mark.nightly
def test_gc_and_rm_keep_the_origin_of_imported_batches(lab: Path, other: Path) -> None:
    project = sierra.open(other)
    first = project.run(*FIRST, figures=False).batch
    project.packages.import_records(lab.parent / "both.zip")
    before = rows(other, "SELECT * FROM origins ORDER BY batch"), rows(other, NOW)
    assert project.maintenance.collect() is not None
    assert (rows(other, "SELECT * FROM origins ORDER BY batch"), rows(other, NOW)) == before
    project.records.remove(first)
    assert project.maintenance.fsck().sound
    [left] = rows(other, "SELECT batch, packages IS NOT NULL AS imported FROM batches JOIN origins USING (batch)")
    assert left["imported"]
    project.records.remove(left["batch"])
    assert project.packages.import_records(lab.parent / "both.zip").executions == 6
    assert project.maintenance.fsck().sound


KILLED = """
import os, signal, sys
from sierra.store.segments import Writer
import sierra
publish, count = Writer.publish, [0]
def published(self, segments):
    publish(self, segments)
    count[0] += 1
    if count[0] == int(sys.argv[2]):
        os.kill(os.getpid(), signal.SIGKILL)
Writer.publish = published
sierra.open(".").packages.import_records(sys.argv[1])
"""


@pytest.mark.nightly
def test_a_killed_import_adds_nothing_and_the_next_one_completes(lab: Path, other: Path) -> None:
    project = sierra.open(other)
    for count in (1, 2):
        command = [sys.executable, "-c", KILLED, lab.parent / "both.zip", str(count)]
        assert subprocess.run(command, cwd=other, check=False).returncode == -signal.SIGKILL
        assert value(other, "SELECT count(*) FROM executions") == 0
    assert project.packages.import_records(lab.parent / "both.zip").executions == 6
    assert project.maintenance.fsck().sound
    project.maintenance.collect()
    assert rows(other, NOW) == rows(lab, NOW)
    assert not any(path.is_dir() for path in (other / ".sierra" / "work").iterdir())


@pytest.mark.nightly
def test_two_imports_at_once_add_one_copy(lab: Path, other: Path) -> None:
    both = [projects.start(other, "import", str(lab.parent / "both.zip")) for _ in range(2)]
    said = [one.communicate(timeout=100) for one in both]
    assert [one.returncode for one in both] == [0, 0], said
    assert value(other, "SELECT count(*) FROM executions") == 6
    assert value(other, "SELECT count(*) FROM batch_runs") == 8
    assert sierra.open(other).maintenance.fsck().sound


@pytest.mark.nightly
def test_a_full_disk_leaves_the_store_as_it_was(lab: Path, other: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    project = sierra.open(other)
    project.run(*SECOND, figures=False)
    before = stores.state(other)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=9))
    with pytest.raises(Missing, match="free space"):
        project.packages.import_records(lab.parent / "both.zip")
    monkeypatch.undo()
    assert {name for name in stores.state(other) if "segments" in name} == {name for name in before if "segments" in name}


# hostile packages


def forged(package: Path, target: Path, table: str, change: Callable[[pa.Table], pa.Table]) -> Path:
    """Write a package whose hashes are right, with one table changed in all segments."""
    folder = target.with_suffix("")
    with zipfile.ZipFile(package) as file:
        file.extractall(folder)
    (folder / MANIFEST).unlink()
    for path in stores.files(folder / "project", table):
        pq.write_table(change(pq.read_table(path)), path)
        segment = path.parent
        (segment / "MANIFEST").unlink()
        text = manifest(sorted(segment.iterdir()))
        (segment / "MANIFEST").write_bytes(text)
        segment.rename(segment.with_name(f"{segment.name[:12]}-{hashlib.sha256(text).hexdigest()[:16]}"))
    files = {path.relative_to(folder).as_posix(): path for path in sorted(folder.rglob("*")) if path.is_file()}
    archive.write(target, {name: Member(name, path, "") for name, path in files.items()})
    return target


def column(name: str, change: Callable[[Any], Any]) -> Callable[[pa.Table], pa.Table]:
    def changed(table: pa.Table) -> pa.Table:
        place = table.schema.get_field_index(name)
        values = pa.array([change(one) for one in table.column(name).to_pylist()], table.schema.field(name).type)
        return table.set_column(place, table.schema.field(name), values)

    return changed


@pytest.mark.parametrize(
    ("table", "change", "said"),
    [
        ("executions", column("result", lambda one: "0" * 64), "result hash that follows"),
        ("artifacts", column("sha256", lambda one: "0" * 64), "result hash that follows|not in the store"),
        ("batch_runs", column("seed", lambda one: one + 1), "ids that follow from their spec, inputs and seeds"),
        ("batches", column("lamport", lambda one: stamp((1 << 23) - 2, "f" * 16)), "which SIERRA never assigns"),
        ("output.swarm", column("execution", lambda one: "0" * 64), "as many rows as executions wrote"),
        ("objects", column("content", lambda one: b"x" + one[1:]), "does not have the content of its SHA-256"),
    ],
)
def test_records_that_do_not_prove_themselves_are_refused(
    lab: Path, other: Path, tmp_path: Path, table: str, change: Callable[[pa.Table], pa.Table], said: str
) -> None:
    package = forged(lab.parent / "first.zip", tmp_path / "forged.zip", table, change)
    with pytest.raises(Damaged, match=said) as error:
        sierra.open(other).packages.import_records(package)
    assert "\n" not in str(error.value)
    assert not list((other / ".sierra" / "segments").iterdir())


def test_records_that_claim_to_be_of_this_store_are_refused(lab: Path, other: Path, tmp_path: Path) -> None:
    sierra.open(other).run(*FIRST, figures=False)
    session = value(other, "SELECT session FROM sessions")
    theirs = forged(lab.parent / "first.zip", tmp_path / "forged.zip", "executions", column("session", lambda one: session))
    before = rows(other, "SELECT * FROM effective ORDER BY ALL")
    with pytest.raises(UsageError, match=f"session {session}, which was executed here"):
        sierra.open(other).packages.import_records(theirs)
    assert rows(other, "SELECT * FROM effective ORDER BY ALL") == before


def test_what_is_no_package_is_refused_in_one_line(other: Path, tmp_path: Path) -> None:
    for content in (b"", b"PK\x03\x04" * 9):
        (tmp_path / "x.zip").write_bytes(content)
        with pytest.raises(SierraError):
            sierra.open(other).packages.import_records(tmp_path / "x.zip")
        said = projects.quick(other, "import", str(tmp_path / "x.zip"))
        assert said.returncode == 1
        assert said.stderr.count("\n") == 1
    assert projects.quick(other, "import", str(tmp_path / "none.zip")).returncode == 3

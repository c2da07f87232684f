"""`sierra rm` deletes exactly the announced items, completely or not at all."""

from __future__ import annotations

import json
import random
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from collections.abc import Set as AbstractSet
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

import sierra
from sierra.maintenance import remove
from sierra.store.row_types import (
    ROWS,
    About,
    ArtifactRow,
    AttemptRow,
    BatchRow,
    BatchRunRow,
    DeliverableRow,
    DuplicateRow,
    EnvironmentRow,
    ExecutionRow,
    ExperimentRow,
    LookIntervalRow,
    LookRow,
    Of,
    ProgramRow,
    ReplayRow,
    SessionRow,
    SharedFileRow,
    SourceRow,
    SpecRow,
    StudyRow,
    To,
    TrialRow,
    VerdictRow,
)
from sierra.store.schema import OUTPUTS, RECORDED, columns_with
from sierra.store.store import Store
from tests import projects, stores
from tests.conftest import held
from tests.support import rows_of_tables
from tests.support.rows_of_tables import filled

MOMENT = datetime(2026, 1, 1, tzinfo=UTC)


@pytest.fixture
def root(recorded: Path, tmp_path: Path) -> Path:
    return stores.copy(recorded, tmp_path / "project")


def batches(root: Path) -> dict[str, str]:
    return {row.query: row.batch for row in sierra.open(root).batches}


def rows(root: Path, text: str, **more: Any) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = sierra.open(root).sql(text, **more).to_pylist()
    return found


def sound(root: Path) -> bool:
    report = sierra.open(root).maintenance.fsck()
    assert [str(one) for one in report.findings] == []
    return report.sound


def without(root: Path, batch: str, table: str, key: str = "batch") -> list[dict[str, Any]]:
    return rows(root, f"SELECT * EXCLUDE (row) FROM {table} WHERE {key} <> $b ORDER BY ALL", b=batch)


@pytest.mark.integration
def test_dry_run_lists_the_items_to_delete_and_changes_nothing(root: Path) -> None:
    before = stores.state(root)
    first = batches(root)["population_size=1,2"]
    ended = projects.quick(root, "rm", first[:8], "--dry-run")
    assert (ended.returncode, ended.stderr) == (0, "")
    assert f"batch {first[:10]} (population_size=1,2): 2 experiments, 4 runs" in ended.stdout
    assert "3 executions of 2 runs" in ended.stdout  # the runs of population_size=1, one of them replayed
    other = batches(root)["population_size=2,3"]
    assert f"not removed: 2 runs with their executions, which also belong to batch {other[:10]}" in ended.stdout
    assert stores.state(root) == before


@pytest.mark.integration
def test_removed_run_is_missing_from_the_remaining_batch(root: Path) -> None:
    batch = batches(root)["noise=0.5"]
    [run, *_] = sierra.open(root).sql("SELECT run FROM batch_runs", within=batch).column("run").to_pylist()
    projects.quick(root, "rm", run, "--yes")
    [told] = [row for row in sierra.open(root).batches if row.batch == batch]
    assert (told.failed, told.missing) == (0, 1)
    assert "1 missing" in projects.quick(root, "ls").stdout


@pytest.mark.integration
def test_rm_without_a_terminal_needs_yes(root: Path) -> None:
    before = stores.state(root)
    ended = projects.quick(root, "rm", batches(root)["noise=0.5"])
    assert (ended.returncode, ended.stderr.count("\n")) == (2, 1)
    assert "--yes" in ended.stderr
    assert stores.state(root) == before


@pytest.mark.integration
def test_batch_is_removed_completely_but_shared_runs_stay(root: Path) -> None:
    named = batches(root)
    gone, stays = named["population_size=1,2"], named["population_size=2,3"]
    shared = rows(root, "SELECT DISTINCT run FROM batch_runs WHERE batch = $b", b=stays)
    keep = {row["run"] for row in shared}
    before = rows(root, "SELECT * FROM executions ORDER BY execution")
    swarm = rows(root, "SELECT * EXCLUDE (row) FROM swarm ORDER BY ALL", within=stays)
    bytes_of = {row["sha256"] for row in rows(root, "SELECT DISTINCT sha256 FROM objects")}
    said = json.loads(projects.quick(root, "rm", gone[:8], "--yes", "--json").stdout)
    assert (said["done"], said["left"], said["shared"], said["sharing"]) == (True, 0, 2, [stays])
    assert gone not in batches(root).values()
    for table in ("batches", "experiments", "batch_runs", "sessions", "replays"):
        assert rows(root, f"SELECT * FROM {table} WHERE batch = $b", b=gone) == []
    others = [row for row in before if row["run"] in keep or row["batch"] == named["noise=0.5"]]
    assert rows(root, "SELECT * FROM executions ORDER BY execution") == others
    assert rows(root, "SELECT * EXCLUDE (row) FROM swarm ORDER BY ALL", within=stays) == swarm
    assert {row["sha256"] for row in rows(root, "SELECT DISTINCT sha256 FROM objects")} < bytes_of
    assert sound(root)
    assert not [path for path in (root / ".sierra" / "work").iterdir() if path.is_dir()]


def test_a_removal_knows_each_table() -> None:
    """The columns of a new table say with which objects its rows are removed, or which columns name them."""
    assert {*columns_with(*Of, *About), *(to.table for to in To)} == {*RECORDED, OUTPUTS}


def test_columns_with_the_name_of_a_record_say_that_they_name_it() -> None:
    for to in (To.ENVIRONMENT, To.ISOLATION, To.INGEST_RULES, To.PROGRAMS):
        named = {table.name for table in RECORDED.values() if any(column.name == to.key for column in table.columns)}
        assert {*columns_with(to), to.table} == named
    assert all(to.key in ROWS[to.table]._fields for to in To)


def shared_store(root: Path) -> Store:
    """Return a store with two batches a and b. Both have the run r2; r1 is a run of a, which was replayed."""
    rows = [filled(EnvironmentRow, environment=name) for name in ("one", "two")]
    for batch, runs in (("a", ("r1", "r2")), ("b", ("r2", "r3"))):
        rows += [filled(BatchRunRow, batch=batch, run=run, input=f"input of {run}", spec=f"spec {batch}") for run in runs]
        rows += [
            filled(BatchRow, batch=batch, experiments=1, runs=2),
            filled(ExperimentRow, experiment=f"x{batch}", batch=batch),
            filled(SpecRow, spec=f"spec {batch}", source="tree", image=None, shared_files=f"files of {batch}"),
            filled(SharedFileRow, shared=f"files of {batch}", sha256="map"),
            filled(ProgramRow, programs=f"of {batch}"),
            filled(SessionRow, session=f"s{batch}", batch=batch, programs=f"of {batch}", source="source", build=None),
            filled(DeliverableRow, deliverable=f"d{batch}", batch=batch, batches=["a", "b"]),
            filled(LookRow, look=f"l{batch}", study="study", batch=batch),
            filled(LookIntervalRow, look=f"l{batch}"),
        ]
    for number, batch in enumerate(("a", "a", "b"), start=1):
        execution, run = f"e{number}", f"r{number}"
        values = {"batch": batch, "session": f"s{batch}", "programs": f"of {batch}", "environment": "one", "isolation": None}
        rows += [
            filled(ExecutionRow, execution=execution, run=run, status="ok", purpose="run", **values),
            filled(ArtifactRow, execution=execution, run=run, kind="log", sha256=f"log of {execution}"),
            filled(TrialRow, execution=execution),
        ]
    rows += [
        filled(ReplayRow, replay="replay", batch="a", environment="two", programs="of b"),
        filled(VerdictRow, replay="replay", run="r1", recorded="e1", execution="e1"),
        filled(SourceRow, source="source", tree="tree", files="list"),
        filled(StudyRow, study="study", batch="a"),
    ]
    return rows_of_tables.store(root, rows)


def going(store: Store, **named: AbstractSet[str]) -> dict[str, dict[str, AbstractSet[str]]]:
    with store.snapshot() as snapshot:
        return remove.rows_of(snapshot, store, {kind: named.get(kind, frozenset()) for kind in remove.KINDS})


def test_rows_that_another_batch_shares_stay(tmp_path: Path) -> None:
    rows = going(shared_store(tmp_path), batch={"a"})
    for table in ("batches", "experiments", "batch_runs", "sessions", "deliverables"):
        assert rows[table]["batch"] == {"a"}
    assert (rows["executions"], rows["trials"]) == ({"execution": {"e1"}}, {"execution": {"e1"}})
    assert (rows["replays"], rows["environments"]) == ({"replay": {"replay"}}, {"environment": {"two"}})
    assert (rows["specs"], rows["shared_files"]) == ({"spec": {"spec a"}}, {"shared": {"files of a"}})
    assert (rows["looks"], rows["look_intervals"]) == ({"look": {"la"}}, {"look": {"la"}})
    assert rows["objects"] == {"sha256": {"input of r1", "log of e1"}}
    assert not rows.keys() & {"programs", "sources", "studies"}


def test_rows_that_batches_share_go_with_the_last_of_them(tmp_path: Path) -> None:
    rows = going(shared_store(tmp_path), batch={"a", "b"})
    assert (rows["executions"], rows["studies"]) == ({"execution": {"e1", "e2", "e3"}}, {"study": {"study"}})
    assert (rows["programs"], rows["sources"]) == ({"programs": {"of a", "of b"}}, {"source": {"source"}})
    inputs, logs = {f"input of r{number}" for number in (1, 2, 3)}, {f"log of e{number}" for number in (1, 2, 3)}
    assert rows["objects"] == {"sha256": {*inputs, *logs, "list", "map"}}


def test_a_run_is_removed_with_the_remarks_on_it_and_not_with_its_batches(tmp_path: Path) -> None:
    rows = going(shared_store(tmp_path), run={"r2"})
    assert (rows["executions"], rows["trials"]) == ({"execution": {"e2"}}, {"execution": {"e2"}})
    assert rows["objects"] == {"sha256": {"log of e2"}}
    assert not rows.keys() & {"batches", "batch_runs", "specs", "programs", "environments", "looks"}


def test_what_a_cluster_did_for_a_batch_is_removed_with_it(root: Path) -> None:
    """Records of attempts and duplicates once stayed, and an environment that only attempts named was lost."""
    opened = sierra.open(root)
    execution = rows(root, "SELECT * FROM executions JOIN sessions s USING (session) WHERE purpose = 'run' LIMIT 1")[0]
    session, batch, environment = execution["session"], execution["batch"], execution["environment"]
    values = {"session": session, "batch": batch, "environment": environment, "started": MOMENT, "ended": MOMENT}
    fields = dict.fromkeys(AttemptRow._fields) | {
        "attempt": "a 1",
        "array_task": 0,
        "node": "n",
        "runs": 1,
        "interrupted_runs": 0,
    }
    writer = opened.store.writer(root / "new", batch)
    writer.records([AttemptRow(**(fields | {"state": "finished"} | values))])  # type: ignore[arg-type]
    writer.records([DuplicateRow(execution["execution"], execution["run"], "a 1", execution["result"], True)])
    opened.store.publish(writer)
    for one in rows(root, "SELECT execution FROM executions WHERE environment = $e", e=environment):
        opened.records.remove(one["execution"])
    assert rows(root, "SELECT environment FROM environments WHERE environment = $e", e=environment)
    assert not rows(root, "FROM duplicates")
    assert rows(root, "FROM attempts")
    opened.records.remove(batch)
    assert not rows(root, "FROM attempts")
    assert sound(root)


@pytest.mark.nightly
def test_remaining_runs_are_reused_and_removed_runs_are_executed_again(root: Path) -> None:
    named = batches(root)
    projects.quick(root, "rm", named["population_size=1,2"], "--yes")
    assert sierra.open(root).run("population_size=2,3", runs=3, figures=False).executed == 0
    again = sierra.open(root).run("population_size=1,2", figures=False)
    assert (again.batch, again.executed, again.reused) == (named["population_size=1,2"], 2, 2)
    assert sound(root)


@pytest.mark.nightly
def test_segments_of_other_batches_stay_unchanged(root: Path) -> None:
    named = batches(root)
    gone = named["noise=0.5"]
    before = {path: data for path, data in stores.state(root).items() if not path.startswith(f"segments/{gone[:12]}")}
    projects.quick(root, "rm", gone, "--yes")
    after = {path: data for path, data in stores.state(root).items() if not path.startswith(f"segments/{gone[:12]}")}
    assert after == before
    assert sound(root)


@pytest.mark.nightly
@pytest.mark.parametrize("kind", ["experiment", "run", "execution"])
def test_removed_parts_of_a_batch_are_executed_again_by_the_same_query(root: Path, kind: str) -> None:
    batch = batches(root)["noise=0.5"]
    table = "experiments" if kind == "experiment" else "executions"
    statement = f"SELECT {kind} AS id FROM {table} WHERE batch = $b ORDER BY 1 LIMIT 1"
    [one] = rows(root, statement, b=batch)
    ended = projects.quick(root, "rm", one["id"], "--yes")
    assert ended.returncode == 0, ended.stderr
    assert sound(root)
    assert batches(root)["noise=0.5"] == batch
    gone = 2 if kind == "experiment" else 1
    assert sierra.open(root).run("noise=0.5", figures=False).executed == gone
    assert sound(root)


@pytest.mark.nightly
def test_runs_shared_only_by_batches_removed_together_are_removed(root: Path) -> None:
    named = batches(root)
    both = [named["population_size=1,2"], named["population_size=2,3"]]
    assert projects.quick(root, "rm", *both, "--yes").returncode == 0
    assert rows(root, "SELECT DISTINCT batch FROM executions") == [{"batch": named["noise=0.5"]}]
    assert sound(root)
    assert projects.quick(root, "rm", named["noise=0.5"], "--yes").returncode == 0
    assert rows(root, "SELECT (SELECT count(*) FROM executions) + (SELECT count(*) FROM objects) AS n") == [{"n": 0}]
    assert list((root / ".sierra" / "segments").iterdir()) == []
    assert sierra.open(root).run("population_size=1,2", figures=False).executed == 4
    assert sound(root)


def test_unknown_invalid_and_missing_ids_are_refused(root: Path) -> None:
    before = stores.state(root)
    for word in ("ffff00", "xyz", ""):
        assert projects.quick(root, "rm", word, "--yes").returncode == 2
    assert projects.quick(root, "rm").returncode == 2
    assert stores.state(root) == before


@pytest.mark.nightly
def test_killed_rm_has_removed_everything_or_nothing_and_can_be_repeated(recorded: Path, tmp_path: Path) -> None:
    numbers = random.Random(3)
    named = batches(recorded)
    both = [named["population_size=1,2"], named["population_size=2,3"]]
    outcomes = set()
    for attempt in range(5):
        root = stores.copy(recorded, tmp_path / str(attempt))
        process = subprocess.Popen([str(projects.SIERRA), "rm", *both, "--yes"], cwd=root, stdout=subprocess.DEVNULL)
        if attempt % 2:
            segments = root / ".sierra" / "segments"
            known = set(segments.iterdir())
            while process.poll() is None and known == set(segments.iterdir()):
                time.sleep(0.0005)
            time.sleep(numbers.random() * 0.02)
        else:
            time.sleep(0.4 + numbers.random() if attempt else 0)
        process.send_signal(signal.SIGKILL)
        process.wait()
        count = rows(root, "SELECT count(*) AS n FROM executions")[0]["n"]
        assert count in (2, 12)
        outcomes.add(count)
        assert sierra.open(root).maintenance.fsck().sound
        ended = projects.quick(root, "rm", *both, "--yes")
        assert ended.returncode == (0 if count == 12 else 2)
        assert rows(root, "SELECT count(*) AS n FROM executions") == [{"n": 2}]
        sierra.open(root).run("noise=0.5", "population_size=1", figures=False)
        assert sierra.open(root).maintenance.fsck().sound
        shutil.rmtree(root)
    assert 12 in outcomes


@pytest.mark.nightly
def test_full_disk_during_rm_loses_nothing(recorded: Path, tmp_path: Path) -> None:
    root = stores.copy(recorded, tmp_path / "project")
    before = stores.state(root)
    batch = batches(root)["population_size=1,2"]
    command = ["bash", "-c", 'trap "" XFSZ; ulimit -f 1; exec "$@"', "-", str(projects.SIERRA), "rm", batch, "--yes"]
    ended = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr.count("\n")) == (3, 1), ended.stderr
    assert stores.state(root) == before
    assert sound(root)


@pytest.mark.nightly
def test_executing_batch_is_not_removed_but_other_batches_are(simulate: Callable[..., Any]) -> None:
    project = simulate(held(4))
    assert project.quick("run", "size=1", "--runs", "3", "--no-figures").returncode == 0
    [other] = project.sql("SELECT batch FROM batches")
    running = project.start("run", "size=5,6", "--runs", "5", "-j", "2", "--no-figures")
    project.until_executed(5, running)
    [mine] = project.sql(f"SELECT batch FROM batches WHERE batch <> '{other['batch']}'")
    refused = project.quick("rm", mine["batch"], "--yes")
    assert refused.returncode == 3
    assert "is being executed" in refused.stderr
    assert project.quick("rm", other["batch"], "--yes").returncode == 0
    project.open()
    assert project.end_of(running).returncode == 0
    assert project.sql("SELECT count(*) AS n FROM executions WHERE status = 'ok'") == [{"n": 10}]
    assert project.quick("fsck").returncode == 0
    assert project.quick("rm", mine["batch"], "--yes").returncode == 0
    assert project.quick("fsck").returncode == 0

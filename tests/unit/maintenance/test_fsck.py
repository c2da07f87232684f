"""`sierra fsck` finds all damage in a store, names the files, and reports which records are affected."""

from __future__ import annotations

import json
import random
import shutil
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import sierra
from sierra.execution.sessions import Session
from sierra.ingest import recorder
from sierra.maintenance.findings import Kind
from sierra.maintenance.fsck import Report
from sierra.store.row_types import ChannelRow, EndingRow, FileWrittenRow, TrialRow
from sierra.store.segments import manifest
from sierra.util.hashing import sha256
from tests import projects, stores
from tests.conftest import Simulated, held

Where = tuple[str, int, int]


@pytest.fixture
def root(recorded: Path, tmp_path: Path) -> Path:
    """A copy of a project outside git, which a test may damage."""
    return stores.copy(recorded, tmp_path / "project")


def fsck(root: Path) -> Report:
    return sierra.open(root).maintenance.fsck()


def wrong(root: Path) -> list[tuple[Kind, str]]:
    return [(finding.kind, finding.path) for finding in fsck(root).findings if not finding.kind.fine]


def segment_with(root: Path, table: str) -> Path:
    """Return the largest segment that has the table (segment names begin with a hash, so they give no fixed order)."""
    folders = [path.parent for path in stores.files(root, table)]
    return max(folders, key=lambda folder: (sum(file.stat().st_size for file in folder.iterdir()), folder.name))


@pytest.mark.integration
def test_undamaged_store_is_reported_as_sound(recorded: Path) -> None:
    ended = projects.quick(recorded, "fsck")
    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout.startswith("sound: ")
    report = json.loads(projects.quick(recorded, "fsck", "--json").stdout)
    assert (report["sound"], report["findings"], report["executions"]) == (True, [], 12)


@pytest.mark.integration
def test_damage_is_reported_with_the_command_that_repairs_it(root: Path) -> None:
    segment = segment_with(root, "batch_runs")
    (segment / "batch_runs.parquet").write_bytes(b"")
    said = projects.quick(root, "fsck").stdout
    assert f"damaged: segments/{segment.name}/batch_runs.parquet: " in said
    assert said.splitlines()[-1].startswith("sierra fsck --repair moves damaged segments aside")
    assert "--repair puts" not in projects.quick(root, "fsck", "--repair").stdout


def positions(data: bytes, name: str, numbers: random.Random) -> Iterator[int]:
    """Yield positions of all kinds in a file: its ends, its middle, its footer, and a random one."""
    size = len(data)
    yield from {0, size // 2, size - 1, max(size - 6, 0), max(size - 9, 0)}
    if name.endswith(".parquet"):
        footer = int.from_bytes(data[-8:-4], "little")
        yield from {4, size - 8 - footer, size - 8 - footer // 2, size - 9 - footer}
    yield from (numbers.randrange(size) for _ in range(1))


def flip(path: Path, place: int, numbers: random.Random) -> None:
    data = bytearray(path.read_bytes())
    data[place] ^= 1 << numbers.randrange(8)
    path.write_bytes(data)


@pytest.mark.nightly
def test_any_flipped_bit_is_found_and_its_file_is_named(recorded: Path, root: Path) -> None:
    """Each attempt flips one bit in a file of each segment and in one of the store's own files."""
    numbers = random.Random(1)
    own = [path.relative_to(root) for path in sorted((root / ".sierra").iterdir()) if path.is_file()]
    folders = [sorted(path.relative_to(root) for path in one.iterdir()) for one in root.glob(".sierra/segments/*")]
    for attempt in range(9):
        chosen = [own[attempt % len(own)], *(numbers.choice(files) for files in folders)]
        for file in chosen:
            places = [0] if file in own else [*positions((root / file).read_bytes(), file.name, numbers)]
            flip(root / file, numbers.choice(places), numbers)
        named = {finding.path for finding in fsck(root).findings if not finding.kind.fine}
        assert {str(file.relative_to(".sierra")) for file in chosen} <= named
        for file in chosen:
            shutil.copyfile(recorded / file, root / file)
    assert fsck(root).sound


def test_segment_names_and_manifests_depend_on_every_bit_of_the_files(recorded: Path) -> None:
    """This covers every bit without one check per bit: hashes depend on every bit, so the hashes are compared."""
    for folder in sorted((recorded / ".sierra" / "segments").iterdir()):
        files = sorted(path for path in folder.iterdir() if path.name != "MANIFEST")
        text = manifest(files)
        assert (folder / "MANIFEST").read_bytes() == text
        assert folder.name.endswith(sha256(text)[:16])


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1])


def extend(path: Path) -> None:
    path.write_bytes(path.read_bytes() + b"\0")


def empty(path: Path) -> None:
    path.write_bytes(b"")


def link(path: Path) -> None:
    target = path.rename(path.parents[3] / "elsewhere")
    path.symlink_to(target)


@pytest.mark.integration
@pytest.mark.parametrize("damage", [truncate, extend, empty, link, Path.unlink])
@pytest.mark.parametrize("file", ["MANIFEST", "executions.parquet", "objects.parquet"])
def test_truncated_extended_emptied_linked_and_deleted_files_are_named(
    root: Path, damage: Callable[[Path], None], file: str
) -> None:
    path = segment_with(root, "executions") / file
    damage(path)
    kind = Kind.ABSENT if damage is Path.unlink and file != "MANIFEST" else Kind.DAMAGED
    assert (kind, str(path.relative_to(root / ".sierra"))) in wrong(root)


@pytest.mark.integration
def test_files_swapped_between_segments_are_named(root: Path) -> None:
    one, other = sorted(root.glob(".sierra/segments/*/executions.parquet"))[:2]
    mine, others = one.read_bytes(), other.read_bytes()
    one.write_bytes(others)
    other.write_bytes(mine)
    assert {path for kind, path in wrong(root) if kind is Kind.DAMAGED} == {
        str(path.relative_to(root / ".sierra")) for path in (one, other)
    }


@pytest.mark.integration
@pytest.mark.parametrize("name", ["{prefix}-0123456789abcdef", "0123456789ab-{hash}", "copy of it", "{prefix}-{hash}.bak"])
def test_duplicate_segments_are_named(root: Path, name: str) -> None:
    segment = segment_with(root, "executions")
    prefix, _, digits = segment.name.partition("-")
    double = segment.with_name(name.format(prefix=prefix, hash=digits))
    shutil.copytree(segment, double)
    told = {path for _, path in wrong(root)}
    assert any(path.startswith(("segments/" + double.name, "segments/" + segment.name)) for path in told)


@pytest.mark.nightly
def test_stray_files_are_named_and_unfinished_files_are_not_damage(root: Path) -> None:
    (root / ".sierra" / "segments" / "notes.txt").write_text("")
    (root / ".sierra" / "segments" / "link").symlink_to("/tmp")
    (root / ".sierra" / "mine").mkdir()
    (segment_with(root, "executions") / "more").write_text("")
    (root / ".sierra" / ".format.123").write_text("")
    assert sorted(Path(path).name for kind, path in wrong(root) if kind is Kind.STRAY) == ["link", "mine", "more", "notes.txt"]
    assert [finding.path for finding in fsck(root).findings if finding.kind is Kind.LEFT] == [".format.123"]


def test_equal_environments_and_programs_may_be_recorded_for_two_batches(root: Path) -> None:
    """On a cluster, environments and programs are recorded before runs execute: the same bytes for each batch."""
    for batch in ("0123456789ab", "ba9876543210"):
        around = root / ".sierra" / "segments" / f"{batch}-"
        around.mkdir()
        for table in ("environments", "programs"):
            shutil.copy(segment_with(root, table) / f"{table}.parquet", around)
        seal(around)
    assert fsck(root).sound


@pytest.mark.integration
def test_damage_is_reported_with_the_affected_executions_and_batches(root: Path) -> None:
    path = segment_with(root, "executions") / "objects.parquet"
    extend(path)
    [finding] = [finding for finding in fsck(root).findings if finding.path == str(path.relative_to(root / ".sierra"))]
    assert finding.affected.executions
    assert finding.affected.batches
    assert " executions of batch " in finding.affected.text
    assert "=" in finding.affected.text
    ended = projects.quick(root, "fsck")
    assert ended.returncode == 1
    assert ended.stdout.splitlines()[0].startswith("damaged: segments/")


# Forged records with correct hashes.


def forge(root: Path, table: str, change: Callable[[dict[str, Any]], None]) -> None:
    """Rewrite a table of a segment with each row changed, and update MANIFEST and the segment's name."""
    folder = segment_with(root, table)
    path = stores.file(folder, table)
    found = pq.read_table(path)
    rows = found.to_pylist()
    for row in rows:
        change(row)
    pq.write_table(pa.Table.from_pylist(rows, schema=found.schema), path)
    seal(folder)


def seal(folder: Path) -> None:
    text = manifest(sorted(path for path in folder.iterdir() if path.name != "MANIFEST"))
    (folder / "MANIFEST").write_bytes(text)
    folder.rename(folder.with_name(folder.name[:13] + sha256(text)[:16]))


FORGED: dict[str, tuple[str, Callable[[dict[str, Any]], None]]] = {
    "a seed": ("batch_runs", lambda row: row.update(seed=row["seed"] + 1)),
    "an input": ("batch_runs", lambda row: row.update(input="0" * 64)),
    "a run": ("batch_runs", lambda row: row.update(run="0" * 64)),
    "a run's number": ("batch_runs", lambda row: row.update(number=1 - row["number"] if row["number"] < 2 else 2)),
    "a value": ("experiments", lambda row: row.update({k: 7 for k in row if k in ("population_size", "noise")})),
    "an experiment": ("experiments", lambda row: row.update(experiment="0" * 64)),
    "an order": ("experiments", lambda row: row.update(ordinal=5 - row["ordinal"])),
    "a command": ("specs", lambda row: row.update(command=["true"])),
    "a kernel": ("environments", lambda row: row.update(kernel="9")),
    "a commit": ("sources", lambda row: row.update(commit="0" * 40)),
    "a tree": ("sources", lambda row: row.update(tree="swh:1:dir:" + "0" * 40)),
    "a list of files": ("sources", lambda row: row.update(files="0" * 64)),
    "a program": ("programs", lambda row: row.update(sha256="0" * 64)),
    "a declaration": ("ingest_rules", lambda row: row.update(declared='{"outputs": {}, "success": {}}')),
    "a result": ("executions", lambda row: row.update(result="0" * 64)),
    "an execution's run": ("executions", lambda row: row.update(run="0" * 64)),
    "an execution": ("executions", lambda row: row.update(execution=sha256(row["execution"].encode()))),
    "an artifact's digest": ("artifacts", lambda row: row.update(sha256="0" * 64)),
    "an artifact's rows": ("artifacts", lambda row: row.update(rows=row["rows"] and row["rows"] + 1)),
    "an artifact's count": ("artifacts", lambda row: row.update(counted_rows=row["counted_rows"] and row["counted_rows"] + 1)),
    "rows": ("output.swarm", lambda row: row.update(execution="0" * 64)),
    "content": ("objects", lambda row: row.update(content=row["content"] + b"x")),
    "an object's size": ("objects", lambda row: row.update(size=row["size"] + 1)),
    "a verdict": ("verdicts", lambda row: row.update(recorded="0" * 64)),
    "a verdict's replay": ("verdicts", lambda row: row.update(replay="0" * 16)),
}


@pytest.mark.integration
@pytest.mark.parametrize("what", FORGED)
def test_forged_records_are_found_even_if_all_file_hashes_match(root: Path, what: str) -> None:
    forge(root, *FORGED[what])
    assert {kind for kind, _ in wrong(root)} & {Kind.INCONSISTENT, Kind.LOST}


@pytest.mark.nightly
def test_rows_that_were_never_read_are_found_missing_and_their_execution_is_dropped(root: Path) -> None:
    """A parser that stops early leaves this: the table has as many rows as recorded, but the file had more."""
    folder = segment_with(root, "output.swarm")
    file = stores.file(folder, "output.swarm")
    swarm = pq.read_table(file)
    lost = swarm.column("execution")[0].as_py()
    pq.write_table(swarm.slice(1), file)
    artifacts = pq.read_table(folder / "artifacts.parquet")
    rows = artifacts.to_pylist()
    [row] = [row for row in rows if (row["execution"], row["path"]) == (lost, "swarm.csv")]
    assert row["counted_rows"] == row["rows"]
    row["rows"] -= 1
    pq.write_table(pa.Table.from_pylist(rows, schema=artifacts.schema), folder / "artifacts.parquet")
    seal(folder)
    [finding] = [finding for finding in fsck(root).findings if not finding.kind.fine]
    assert (finding.kind, finding.path) == (Kind.LOST, "output.swarm")
    assert f"(swarm.csv: {row['rows']} instead of {row['counted_rows']})" in finding.what
    assert any("lost: 1 execution;" in line for line in repaired(root))
    assert fsck(root).sound


ROWS_OF_NOTHING = (
    EndingRow("0" * 64, "error", "no GPU"),
    ChannelRow("0" * 64, "127.0.0.1:20001", "given"),
    FileWrittenRow("0" * 64, "/dev/shm/pose", "written"),
    TrialRow("0" * 64, datetime.now(UTC), valid=True),
)


def test_records_of_executions_that_are_not_recorded_are_found_in_each_table(root: Path) -> None:
    store = sierra.open(root).store
    session = Session(store.paths, logged=False)
    session.take_number()
    writer = store.writer(session.paths.segment, str(next(iter(store.values(str, "SELECT batch FROM batches")))))
    for row in ROWS_OF_NOTHING:
        writer.records([row])
    store.publish(writer)
    session.close()
    problems = {finding.what for finding in fsck(root).findings if finding.kind is Kind.LOST}
    tables = ("endings", "channels", "files_written", "trials")
    assert problems >= {f"{table} belong to executions that are not recorded" for table in tables}


@pytest.mark.nightly
def test_missing_table_is_found_even_if_the_manifest_does_not_list_it(root: Path) -> None:
    for table in ("artifacts", "objects", "output.swarm", "executions"):
        copy = stores.copy(root, root.with_name(table))
        folder = segment_with(copy, "executions")
        stores.file(folder, table).unlink()
        seal(folder)
        assert {kind for kind, _ in wrong(copy)} & {Kind.LOST, Kind.INCONSISTENT}, table


@pytest.mark.nightly
def test_missing_table_is_found_in_each_of_several_segments(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A busy machine records many segments: a table that one of them lacks is found missing."""
    monkeypatch.setattr(recorder, "PENDING_RUNS", 1)
    root = projects.make(tmp_path / "several", simulator=stores.SIMULATOR)
    sierra.open(root).run("population_size=1", runs=4, jobs=1, figures=False)
    executed = sorted(path.parent.name for path in root.glob(".sierra/segments/*/executions.parquet"))
    assert len(executed) > 1
    for place, table in enumerate(("artifacts", "objects", "output.swarm", "executions")):
        copy = stores.copy(root, root.with_name(table))
        folder = copy / ".sierra" / "segments" / executed[place % len(executed)]
        stores.file(folder, table).unlink()
        seal(folder)
        assert {kind for kind, _ in wrong(copy)} & {Kind.LOST, Kind.INCONSISTENT}, table


@pytest.mark.integration
def test_wrong_columns_and_invalid_parquet_files_are_named(root: Path) -> None:
    folder = segment_with(root, "executions")
    pq.write_table(pa.table({"execution": ["a"], "content": [b"x"]}), folder / "artifacts.parquet")
    (folder / "ingest_rules.parquet").write_bytes(b"PAR1 no PAR1")
    seal(folder)
    assert sum(kind is Kind.INCONSISTENT and "segments/" in path for kind, path in wrong(root)) >= 2


@pytest.mark.integration
def test_decompression_bomb_is_reported_as_inconsistent(root: Path) -> None:
    folder = segment_with(root, "objects")
    row = {"sha256": "0" * 64, "part": 0, "size": 1 << 40, "content": bytes(200 << 20)}
    schema = pq.read_schema(folder / "objects.parquet")
    pq.write_table(pa.Table.from_pylist([row], schema=schema), folder / "objects.parquet", compression="zstd")
    seal(folder)
    assert any(kind is Kind.INCONSISTENT and path.endswith("objects.parquet") for kind, path in wrong(root))


@pytest.mark.nightly
def test_fsck_survives_arbitrary_bytes_in_files(recorded: Path, root: Path) -> None:
    """A file of each segment gets random bytes; its MANIFEST and name are updated to match."""
    numbers = random.Random(2)
    for _ in range(5):
        for folder in sorted(root.glob(".sierra/segments/*")):
            path = numbers.choice(sorted(folder.glob("*.parquet")))
            data = bytearray(path.read_bytes())
            for _ in range(numbers.randrange(1, 20)):
                data[numbers.randrange(len(data))] = numbers.randrange(256)
            path.write_bytes(data)
            seal(folder)
        fsck(root)
        shutil.rmtree(root / ".sierra")
        shutil.copytree(recorded / ".sierra", root / ".sierra")
    assert fsck(root).sound


def test_unreadable_list_of_sources_is_reported(root: Path) -> None:
    for path in root.glob(".sierra/segments/*/sources.parquet"):
        data = path.read_bytes()
        footer = len(data) - 8 - int.from_bytes(data[-8:-4], "little")
        path.write_bytes(data[:4] + b"\xff" * (footer - 4) + data[footer:])
        seal(path.parent)
    assert (Kind.INCONSISTENT, "sources") in wrong(root)


@pytest.mark.integration
def test_source_missing_from_git_is_reported_as_gone(tmp_path: Path) -> None:
    root = projects.commit(projects.make(tmp_path / "project"))
    sierra.open(root).run("population_size=1", runs=1, figures=False)
    assert fsck(root).sound
    shutil.rmtree(root / ".git")
    [(kind, _)] = wrong(root)
    assert kind is Kind.GONE


# Repair.


def repaired(root: Path) -> list[str]:
    """Repair the store and return the reported actions; check first that a dry run changes nothing."""
    before = stores.state(root)
    dry = json.loads(projects.quick(root, "fsck", "--repair", "--dry-run", "--json").stdout)["repaired"]
    assert stores.state(root) == before
    done = list(sierra.open(root).maintenance.repair().done)
    assert len(done) >= len(dry) > 0
    return done


def everything(root: Path) -> bytes:
    """Return the content of all files of the store, joined in sorted order."""
    return b"".join(sorted(stores.state(root).values()))


@pytest.mark.nightly
@pytest.mark.parametrize(
    "damages", [(truncate, empty, Path.unlink), (empty, Path.unlink, truncate), (Path.unlink, truncate, empty)]
)
def test_standard_files_of_the_store_are_rewritten_by_repair(recorded: Path, root: Path, damages: Sequence[Any]) -> None:
    names = ("format", ".gitignore", "CACHEDIR.TAG")
    for name, damage in zip(names, damages, strict=True):
        damage(root / ".sierra" / name)
    assert sorted(repaired(root)) == sorted(f"{name}: written again" for name in names)
    assert fsck(root).sound
    assert stores.state(root) == stores.state(recorded)


@pytest.mark.nightly
def test_manifest_is_restored_by_repair(recorded: Path, root: Path) -> None:
    truncate(segment_with(root, "executions") / "MANIFEST")
    assert len(repaired(root)) == 1
    assert stores.state(root) == stores.state(recorded)


@pytest.mark.nightly
def test_stray_files_are_moved_aside_by_repair(root: Path) -> None:
    (segment_with(root, "executions") / "more").write_text("mine")
    shutil.copytree(segment_with(root, "executions"), root / ".sierra" / "segments" / "copy")
    assert len(repaired(root)) == 2
    assert fsck(root).sound
    assert (root / ".sierra" / "damaged" / "more").read_text() == "mine"


@pytest.mark.nightly
@pytest.mark.parametrize("tables", [("executions", "objects", "artifacts"), ("output.swarm", "ingest_rules", "output.notes")])
def test_only_lost_executions_are_executed_again_after_repair(root: Path, tables: Sequence[str]) -> None:
    """Damage each table in executions of a different batch; the second batch has files that no other batch has."""
    project = sierra.open(root)
    executed = "SELECT batch, count(*) AS n, count_if(purpose = 'run') AS most FROM executions GROUP BY batch"
    before = {row["batch"]: row for row in project.sql(executed).to_pylist()}
    batches = [row.batch for row in project.batches]
    purposes = {path: pq.read_table(path)["purpose"][0].as_py() for path in root.glob(".sierra/segments/*/executions.parquet")}
    of_runs = [path.parent for path, purpose in purposes.items() if purpose == "run"]
    folders = [next(folder for folder in of_runs if folder.name.startswith(batch[:12])) for batch in batches]
    for folder, table in zip(folders, tables, strict=True):
        extend(stores.file(folder, table))
    repaired(root)
    assert {folder.name for folder in folders} <= {path.name for path in root.glob(".sierra/damaged/*")}
    assert fsck(root).sound
    after = {row["batch"]: row["n"] for row in project.sql(executed).to_pylist()}
    lost = [before[batch]["n"] - after.get(batch, 0) for batch in batches]
    assert [count > 0 for count in lost] == [table != "ingest_rules" for table in tables]  # other segments have the rules too
    assert all(count <= before[batch]["most"] for batch, count in zip(batches, lost, strict=True))
    summaries = [project.run(batch, figures=False) for batch in batches]
    assert sum(one.failed + one.missing for one in summaries) == 0
    assert sum(one.executed for one in summaries) == sum(lost)
    assert fsck(root).sound


@pytest.mark.nightly
def test_damaged_ingest_rules_cause_no_loss_of_executions(
    simulate: Callable[..., Simulated], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder, "PENDING_RUNS", 1)
    root = simulate().folder
    sierra.open(root).run("size=1,2", runs=8, figures=False)
    assert len(list(root.glob(".sierra/segments/*/executions.parquet"))) > 1
    extend(segment_with(root, "ingest_rules") / "ingest_rules.parquet")
    repaired(root)
    assert sierra.open(root).run("size=1,2", runs=8, figures=False).executed == 0
    assert fsck(root).sound


@pytest.mark.integration
@pytest.mark.parametrize(
    "tables",
    [
        ("blobs", "batches", "experiments"),
        *(pytest.param(those, marks=pytest.mark.nightly) for those in (("batch_runs", "specs", "sources"), ("objects",))),
    ],
)
def test_damaged_batch_descriptions_are_recorded_again_without_executing_runs(root: Path, tables: Sequence[str]) -> None:
    """Damage each table in the segment of a different batch."""
    folders = [path.parent for path in root.glob(".sierra/segments/*/batch_runs.parquet")]
    folders.sort(key=lambda folder: ((folder / "blobs.parquet").exists(), folder.name))  # segment with unique content last
    for table in tables:
        folder = next(one for one in folders if (one / f"{table}.parquet").exists())
        folders.remove(folder)
        extend(stores.file(folder, table))
    repaired(root)
    again = [("population_size=1,2", None), ("population_size=2,3", 3), ("noise=0.5", None)]
    assert sum(sierra.open(root).run(query, runs=runs, figures=False).executed for query, runs in again) == 0
    assert fsck(root).sound


@pytest.mark.nightly
def test_lost_content_of_source_files_is_recorded_again_without_executing_runs(root: Path) -> None:
    folder = segment_with(root, "blobs")
    content = pq.read_table(folder / "objects.parquet")
    extend(folder / "objects.parquet")
    repaired(root)
    assert (folder.parent.parent / "damaged" / folder.name).exists()
    for query, runs in [("population_size=1,2", None), ("population_size=2,3", 3), ("noise=0.5", None)]:
        assert sierra.open(root).run(query, runs=runs, figures=False).executed == 0
    assert fsck(root).sound
    again = sierra.open(root).sql("SELECT sha256 FROM objects")["sha256"].to_pylist()
    assert set(content["sha256"].to_pylist()) <= set(again)


@pytest.mark.integration
def test_verdicts_of_a_lost_replay_are_removed_by_repair(root: Path) -> None:
    [folder] = [path.parent for path in root.glob(".sierra/segments/*/replays.parquet")]
    extend(folder / "replays.parquet")
    ended = projects.quick(root, "fsck", "--repair")
    assert (ended.returncode, ended.stderr) == (0, ""), ended.stdout
    assert "lost: 1 replay; the executions stay, and their verdicts are removed" in ended.stdout
    [counts] = projects.sql(root, "SELECT (SELECT count(*) FROM verdicts) AS verdicts, count(*) AS n FROM executions")
    assert counts == {"verdicts": 0, "n": 12}


@pytest.mark.nightly
def test_repair_reports_lost_raw_files_of_tables(root: Path) -> None:
    folder = segment_with(root, "output.swarm")
    extend(folder / "objects.parquet")
    assert any(f"segments/{folder.name}: the bytes of files that became tables" in line for line in repaired(root))
    assert fsck(root).sound


@pytest.mark.nightly
def test_fsck_works_while_a_batch_is_executing(simulate: Callable[..., Any]) -> None:
    project = simulate(held(20))
    running = project.start("run", "size=1,2", "--runs", "20", "-j", "2", "--no-figures")
    project.until_executed(5, running)
    assert [project.quick("fsck").returncode for _ in range(3)] == [0, 0, 0]
    assert running.poll() is None
    project.open()
    while running.poll() is None:
        assert project.quick("fsck").returncode == 0
    assert project.end_of(running).returncode == 0


def test_store_of_another_format_is_reported_and_not_repaired(root: Path) -> None:
    store = root / ".sierra"
    (store / "format").write_text("sierra store 1\n")
    before = {path: path.read_bytes() for path in store.rglob("*") if path.is_file()}
    ended = projects.quick(root, "fsck")
    assert (ended.returncode, "format" in ended.stdout) == (1, True)
    ended = projects.quick(root, "fsck", "--repair")
    assert (ended.returncode, ended.stderr.count("\n"), "does not repair" in ended.stderr) == (1, 1, True)
    assert {path: path.read_bytes() for path in store.rglob("*") if path.is_file()} == before

"""`sierra fsck` finds every damage of a store, names it, and says what of the record it concerns."""

from __future__ import annotations

import json
import random
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import sierra
from sierra.ingest import recorder
from sierra.maintenance.findings import Kind
from sierra.maintenance.fsck import Report
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
    return sierra.open(root).fsck()


def wrong(root: Path) -> list[tuple[Kind, str]]:
    return [(finding.kind, finding.path) for finding in fsck(root).findings if not finding.kind.fine]


def segment_with(root: Path, table: str) -> Path:
    """Of those that have the table, the one that holds most, whatever it is called: names begin with a hash."""
    folders = [path.parent for path in root.glob(f".sierra/segments/*/{table}.parquet")]
    return max(folders, key=lambda folder: (sum(file.stat().st_size for file in folder.iterdir()), folder.name))


def test_a_sound_store_is_sound(recorded: Path) -> None:
    ended = projects.quick(recorded, "fsck")
    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout.startswith("sound: ")
    report = json.loads(projects.quick(recorded, "fsck", "--json").stdout)
    assert (report["sound"], report["findings"], report["executions"]) == (True, [], 12)


@pytest.mark.integration
def test_where_something_is_damaged_the_next_step_is_named(root: Path) -> None:
    segment = segment_with(root, "batch_runs")
    (segment / "batch_runs.parquet").write_bytes(b"")
    said = projects.quick(root, "fsck").stdout
    assert f"damaged: segments/{segment.name}/batch_runs.parquet: " in said
    assert said.splitlines()[-1].startswith("sierra fsck --repair puts aside what is damaged")
    assert "--repair puts" not in projects.quick(root, "fsck", "--repair").stdout


def positions(data: bytes, name: str, numbers: random.Random) -> Iterator[int]:
    """Places of all kinds in a file: its ends, its footer, each line of a text, and any."""
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
    """One bit in a file of each segment at a time, and in one of the store's own."""
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


def test_each_bit_of_a_segment_counts_in_what_vouches_for_it(recorded: Path) -> None:
    """All places at once, without a whole check for each: hashes see every bit, so it is the hash that must be compared."""
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


@pytest.mark.parametrize("damage", [truncate, extend, empty, link, Path.unlink])
@pytest.mark.parametrize("file", ["MANIFEST", "executions.parquet", "objects.parquet"])
def test_files_that_are_cut_grown_linked_or_gone_are_named(root: Path, damage: Callable[[Path], None], file: str) -> None:
    path = segment_with(root, "executions") / file
    damage(path)
    kind = Kind.ABSENT if damage is Path.unlink and file != "MANIFEST" else Kind.DAMAGED
    assert (kind, str(path.relative_to(root / ".sierra"))) in wrong(root)


def test_files_swapped_between_segments_are_named(root: Path) -> None:
    one, other = sorted(root.glob(".sierra/segments/*/executions.parquet"))[:2]
    mine, others = one.read_bytes(), other.read_bytes()
    one.write_bytes(others)
    other.write_bytes(mine)
    assert {path for kind, path in wrong(root) if kind is Kind.DAMAGED} == {
        str(path.relative_to(root / ".sierra")) for path in (one, other)
    }


@pytest.mark.parametrize("name", ["{prefix}-0123456789abcdef", "0123456789ab-{hash}", "copy of it", "{prefix}-{hash}.bak"])
def test_a_doubled_segment_is_named(root: Path, name: str) -> None:
    segment = segment_with(root, "executions")
    prefix, _, digits = segment.name.partition("-")
    double = segment.with_name(name.format(prefix=prefix, hash=digits))
    shutil.copytree(segment, double)
    told = {path for _, path in wrong(root)}
    assert any(path.startswith(("segments/" + double.name, "segments/" + segment.name)) for path in told)


@pytest.mark.integration
def test_strays_are_named_and_what_is_only_left_is_no_damage(root: Path) -> None:
    (root / ".sierra" / "segments" / "notes.txt").write_text("")
    (root / ".sierra" / "segments" / "link").symlink_to("/tmp")
    (root / ".sierra" / "mine").mkdir()
    (segment_with(root, "executions") / "more").write_text("")
    (root / ".sierra" / ".format.123").write_text("")
    assert sorted(Path(path).name for kind, path in wrong(root) if kind is Kind.STRAY) == ["link", "mine", "more", "notes.txt"]
    assert [finding.path for finding in fsck(root).findings if finding.kind is Kind.LEFT] == [".format.123"]


def test_what_surrounds_two_askings_may_be_recorded_of_each(root: Path) -> None:
    """As on a cluster, where it is recorded on its own, before anything was executed: the same bytes for each batch."""
    for batch in ("0123456789ab", "ba9876543210"):
        around = root / ".sierra" / "segments" / f"{batch}-"
        around.mkdir()
        for table in ("environments", "programs"):
            shutil.copy(segment_with(root, table) / f"{table}.parquet", around)
        seal(around)
    assert fsck(root).sound


@pytest.mark.integration
def test_what_is_concerned_is_said(root: Path) -> None:
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


# What has the right hashes, and yet is not what was recorded.


def forge(root: Path, table: str, change: Callable[[dict[str, Any]], None]) -> None:
    """Write a table of a segment anew, each row changed, and make MANIFEST and name fit."""
    folder = segment_with(root, table)
    path = folder / f"{table}.parquet"
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


@pytest.mark.parametrize("what", FORGED)
def test_a_forged_record_is_found_though_all_hashes_of_files_are_right(root: Path, what: str) -> None:
    forge(root, *FORGED[what])
    assert {kind for kind, _ in wrong(root)} & {Kind.INCONSISTENT, Kind.LOST}


@pytest.mark.integration
def test_rows_that_were_never_read_are_missed_and_executed_again(root: Path) -> None:
    """As a parser leaves them that stops early: the table has as many rows as the record says, the file had more."""
    folder = segment_with(root, "output.swarm")
    swarm = pq.read_table(folder / "output.swarm.parquet")
    lost = swarm.column("execution")[0].as_py()
    pq.write_table(swarm.slice(1), folder / "output.swarm.parquet")
    artifacts = pq.read_table(folder / "artifacts.parquet")
    rows = artifacts.to_pylist()
    [row] = [row for row in rows if (row["execution"], row["path"]) == (lost, "swarm.csv")]
    assert row["counted_rows"] == row["rows"]
    row["rows"] -= 1
    pq.write_table(pa.Table.from_pylist(rows, schema=artifacts.schema), folder / "artifacts.parquet")
    seal(folder)
    [finding] = [finding for finding in fsck(root).findings if not finding.kind.fine]
    assert (finding.kind, finding.path) == (Kind.LOST, "output.swarm")
    assert f"(swarm.csv: {row['rows']}, not {row['counted_rows']})" in finding.what
    assert any("1 executions are lost" in line for line in repaired(root))
    assert fsck(root).sound


@pytest.mark.integration
def test_a_file_that_vanished_is_missed_though_manifest_does_not_list_it(root: Path) -> None:
    for table in ("artifacts", "objects", "output.swarm", "executions"):
        copy = stores.copy(root, root.with_name(table))
        folder = segment_with(copy, "executions")
        (folder / f"{table}.parquet").unlink()
        seal(folder)
        assert {kind for kind, _ in wrong(copy)} & {Kind.LOST, Kind.INCONSISTENT}, table


@pytest.mark.integration
def test_no_segment_of_several_is_overlooked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As many as a busy machine records: what one of them lacks is missed."""
    monkeypatch.setattr(recorder, "PENDING_RUNS", 1)
    root = projects.make(tmp_path / "several", simulator=stores.SIMULATOR)
    sierra.open(root).run("population_size=1", runs=4, jobs=1, figures=False)
    executed = sorted(path.parent.name for path in root.glob(".sierra/segments/*/executions.parquet"))
    assert len(executed) > 1
    for place, table in enumerate(("artifacts", "objects", "output.swarm", "executions")):
        copy = stores.copy(root, root.with_name(table))
        folder = copy / ".sierra" / "segments" / executed[place % len(executed)]
        (folder / f"{table}.parquet").unlink()
        seal(folder)
        assert {kind for kind, _ in wrong(copy)} & {Kind.LOST, Kind.INCONSISTENT}, table


def test_other_columns_and_what_is_no_parquet_are_named(root: Path) -> None:
    folder = segment_with(root, "executions")
    pq.write_table(pa.table({"execution": ["a"], "content": [b"x"]}), folder / "artifacts.parquet")
    (folder / "ingest_rules.parquet").write_bytes(b"PAR1 no PAR1")
    seal(folder)
    assert sum(kind is Kind.INCONSISTENT and "segments/" in path for kind, path in wrong(root)) >= 2


@pytest.mark.integration
def test_a_bomb_is_refused_and_not_expanded(root: Path) -> None:
    folder = segment_with(root, "objects")
    row = {"sha256": "0" * 64, "part": 0, "size": 1 << 40, "content": bytes(200 << 20)}
    schema = pq.read_schema(folder / "objects.parquet")
    pq.write_table(pa.Table.from_pylist([row], schema=schema), folder / "objects.parquet", compression="zstd")
    seal(folder)
    assert any(kind is Kind.INCONSISTENT and path.endswith("objects.parquet") for kind, path in wrong(root))


@pytest.mark.integration
def test_nothing_that_stands_in_files_makes_it_fail(recorded: Path, root: Path) -> None:
    """Any bytes in a file of each segment, each of which is what its MANIFEST and its name say."""
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


def test_a_list_of_sources_that_cannot_be_read_is_said(root: Path) -> None:
    for path in root.glob(".sierra/segments/*/sources.parquet"):
        data = path.read_bytes()
        footer = len(data) - 8 - int.from_bytes(data[-8:-4], "little")
        path.write_bytes(data[:4] + b"\xff" * (footer - 4) + data[footer:])
        seal(path.parent)
    assert (Kind.INCONSISTENT, "sources") in wrong(root)


@pytest.mark.integration
def test_a_source_that_git_lost_is_named_apart(tmp_path: Path) -> None:
    root = projects.commit(projects.make(tmp_path / "project"))
    sierra.open(root).run("population_size=1", runs=1, figures=False)
    assert fsck(root).sound
    shutil.rmtree(root / ".git")
    [(kind, _)] = wrong(root)
    assert kind is Kind.GONE


# Repairing.


def repaired(root: Path) -> list[str]:
    """What a repair says that it does; a dry run says the same first, and does nothing."""
    before = stores.state(root)
    dry = json.loads(projects.quick(root, "fsck", "--repair", "--dry-run", "--json").stdout)["repaired"]
    assert stores.state(root) == before
    done = list(sierra.open(root).repair().done)
    assert len(done) >= len(dry) > 0
    return done


def everything(root: Path) -> bytes:
    """All bytes of the store, wherever they are."""
    return b"".join(sorted(stores.state(root).values()))


@pytest.mark.integration
@pytest.mark.parametrize(
    "damages", [(truncate, empty, Path.unlink), (empty, Path.unlink, truncate), (Path.unlink, truncate, empty)]
)
def test_what_is_the_same_in_every_store_is_written_again(recorded: Path, root: Path, damages: Sequence[Any]) -> None:
    names = ("format", ".gitignore", "CACHEDIR.TAG")
    for name, damage in zip(names, damages, strict=True):
        damage(root / ".sierra" / name)
    assert sorted(repaired(root)) == sorted(f"{name}: written again" for name in names)
    assert fsck(root).sound
    assert stores.state(root) == stores.state(recorded)


@pytest.mark.integration
def test_a_manifest_is_made_again(recorded: Path, root: Path) -> None:
    truncate(segment_with(root, "executions") / "MANIFEST")
    assert len(repaired(root)) == 1
    assert stores.state(root) == stores.state(recorded)


@pytest.mark.integration
def test_strays_are_put_aside(root: Path) -> None:
    (segment_with(root, "executions") / "more").write_text("mine")
    shutil.copytree(segment_with(root, "executions"), root / ".sierra" / "segments" / "copy")
    assert len(repaired(root)) == 2
    assert fsck(root).sound
    assert (root / ".sierra" / "damaged" / "more").read_text() == "mine"


@pytest.mark.nightly
@pytest.mark.parametrize("tables", [("executions", "objects", "artifacts"), ("output.swarm", "ingest_rules", "output.notes")])
def test_what_was_executed_and_is_lost_is_executed_again_and_nothing_else(root: Path, tables: Sequence[str]) -> None:
    """Each of the tables in what another batch executed; the second batch has files that no other has."""
    project = sierra.open(root)
    executed = "SELECT batch, count(*) AS n, count_if(purpose = 'run') AS most FROM executions GROUP BY batch"
    before = {row["batch"]: row for row in project.sql(executed).to_pylist()}
    batches = [row["batch"] for row in project.batches]
    purposes = {path: pq.read_table(path)["purpose"][0].as_py() for path in root.glob(".sierra/segments/*/executions.parquet")}
    of_runs = [path.parent for path, purpose in purposes.items() if purpose == "run"]
    folders = [next(folder for folder in of_runs if folder.name.startswith(batch[:12])) for batch in batches]
    for folder, table in zip(folders, tables, strict=True):
        extend(folder / f"{table}.parquet")
    repaired(root)
    assert {folder.name for folder in folders} <= {path.name for path in root.glob(".sierra/damaged/*")}
    assert fsck(root).sound
    after = {row["batch"]: row["n"] for row in project.sql(executed).to_pylist()}
    lost = [before[batch]["n"] - after.get(batch, 0) for batch in batches]
    assert [count > 0 for count in lost] == [table != "ingest_rules" for table in tables]  # which other segments have too
    assert all(count <= before[batch]["most"] for batch, count in zip(batches, lost, strict=True))
    summaries = [project.run(batch, figures=False) for batch in batches]
    assert sum(one.failed + one.missing for one in summaries) == 0
    assert sum(one.executed for one in summaries) == sum(lost)
    assert fsck(root).sound


@pytest.mark.integration
def test_declarations_that_are_damaged_take_no_execution_with_them(
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
def test_what_says_that_there_is_a_batch_is_recorded_again(root: Path, tables: Sequence[str]) -> None:
    """Each of the tables in the segment of another batch."""
    folders = [path.parent for path in root.glob(".sierra/segments/*/batch_runs.parquet")]
    folders.sort(key=lambda folder: ((folder / "blobs.parquet").exists(), folder.name))  # what nobody else has comes last
    for table in tables:
        folder = next(one for one in folders if (one / f"{table}.parquet").exists())
        folders.remove(folder)
        extend(folder / f"{table}.parquet")
    repaired(root)
    again = [("population_size=1,2", None), ("population_size=2,3", 3), ("noise=0.5", None)]
    assert sum(sierra.open(root).run(query, runs=runs, figures=False).executed for query, runs in again) == 0
    assert fsck(root).sound


@pytest.mark.integration
def test_files_of_a_source_are_recorded_again_where_only_their_content_is_lost(root: Path) -> None:
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
def test_a_repair_says_that_bytes_of_tables_are_lost(root: Path) -> None:
    folder = segment_with(root, "output.swarm")
    extend(folder / "objects.parquet")
    assert any(f"segments/{folder.name}: the bytes of files that became tables" in line for line in repaired(root))
    assert fsck(root).sound


@pytest.mark.integration
def test_a_batch_that_is_executing_is_not_in_the_way_of_a_check(simulate: Callable[..., Any]) -> None:
    project = simulate(held(20))
    running = project.start("run", "size=1,2", "--runs", "20", "-j", "2", "--no-figures")
    project.until_executed(5, running)
    assert [project.quick("fsck").returncode for _ in range(3)] == [0, 0, 0]
    assert running.poll() is None
    project.open()
    while running.poll() is None:
        assert project.quick("fsck").returncode == 0
    assert project.end_of(running).returncode == 0


def test_a_store_of_another_format_is_named_and_not_repaired(root: Path) -> None:
    store = root / ".sierra"
    (store / "format").write_text("sierra store 1\n")
    before = {path: path.read_bytes() for path in store.rglob("*") if path.is_file()}
    ended = projects.quick(root, "fsck")
    assert (ended.returncode, "format" in ended.stdout) == (1, True)
    ended = projects.quick(root, "fsck", "--repair")
    assert (ended.returncode, ended.stderr.count("\n"), "does not repair" in ended.stderr) == (1, 1, True)
    assert {path: path.read_bytes() for path in store.rglob("*") if path.is_file()} == before

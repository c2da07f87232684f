"""Files of outputs in segments: called by numbers, so that a table of any name is recorded; the names are found again."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import sierra
import sierra.store.connections
from sierra.errors import Damaged
from sierra.maintenance import check_files
from sierra.maintenance.findings import Finding, Kind
from sierra.store import segments
from sierra.store.compaction import Compaction, groups, tidy
from sierra.store.duckdb_file_io import copy
from sierra.store.segments import AFTER, MANIFEST, OUTPUTS, REPLACES, Writer, on_disk
from sierra.store.store import Store
from sierra.util.hashing import sha256
from tests import projects, stores
from tests.unit.maintenance.test_fsck import seal

NAMES = (
    *("a" * 251 + ".csv", "\U00010400" * 62 + "b.csv", "x\ny.csv", "-rf.csv", "a\\b.csv", "..%2f..%2fetc.csv", "a\u2215b.csv"),
    *("lr=0.001," * 27 + "x.csv", "c" * 251 + ".txt", "d" * 255, f"{'e' * 255}/{'f' * 251}.csv"),
)
"""Names of up to 255 bytes, the most that file systems allow."""
WRITES = f"""
import os
for name in {NAMES!r}:
    os.makedirs(os.path.dirname(name) or ".", exist_ok=True)
    with open(name, "w") as file:
        print("t,v", *(f"{{t}},{{count * t}}" for t in range(3)), sep="\\n", file=file)
"""


def made(store: Store, *tables: str) -> None:
    """Add a segment with a table of one row for each name."""
    writer = store.writer(store.paths.work / "made", "ab" * 32)
    for name in tables:
        with sierra.store.connections.connect() as connection:
            connection.execute(copy("SELECT 'r' AS run, 'e' AS execution, 1 AS v", writer.path(f"output.{name}"), name))
    store.publish(writer)


@pytest.mark.nightly
def test_a_file_with_the_longest_name_stops_no_other_command(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "lab", simulator=projects.SIMULATOR + WRITES)
    for words in (
        ("run", "population_size=1", "--runs", "1", "--no-figures"),
        ("run", "population_size=2", "--runs", "1", "--no-figures"),
        *(("gc", "--yes"), ("fsck",)),
    ):
        ended = projects.quick(root, *words)
        assert ended.returncode == 0, ended.stderr
    assert sierra.open(root).sql(f"SELECT sum(v) FROM {'a' * 251}").to_pylist() == [{"sum(v)": 9}]


@pytest.mark.nightly
@pytest.mark.integration
def test_files_with_the_longest_names_are_recorded_drawn_exported_and_packed(tmp_path: Path) -> None:
    about = '[package]\ntitle = "T"\nauthors = [{ name = "Jane Doe" }]\nlicense = "MIT"\n'
    root = projects.make(
        tmp_path / "lab", f'figure_formats = ["txt"]\n{projects.CONFIG}{about}', simulator=projects.SIMULATOR + WRITES
    )
    for words in (
        ("run", "population_size=1,2", "--runs", "1"),
        ("figures",),
        ("report", "--to", "../r.html"),
        ("gc", "--yes"),
    ):
        ended = projects.quick(root, *words)
        assert ended.returncode == 0, ended.stderr
    tables = {name for name in sierra.open(root).store.outputs() if name.strip("a") == "" or "lr_0_001" in name}
    assert [len(name) for name in sorted(tables)] == [251, 244]
    batch = sierra.open(root).batches[0].batch
    for words in (("files", batch, "--to", "../out"), ("package", batch, "-o", "../p.zip", "--no-report"), ("fsck",)):
        ended = projects.quick(root, *words)
        assert ended.returncode == 0, ended.stderr
    written = {path.name for path in (tmp_path / "out").rglob("*") if path.is_file()}
    assert {Path(name).name for name in NAMES} <= written
    other = projects.make(tmp_path / "other")
    assert projects.quick(other, "import", "../p.zip").returncode == 0
    assert sierra.open(other).sql(f"SELECT sum(v) FROM {'a' * 251}").to_pylist() == [{"sum(v)": 9}]
    assert max(len(path.name.encode()) for path in root.glob("figures/*/*")) <= 210


def test_files_of_outputs_have_numbers_and_name_their_tables_twice(tmp_path: Path) -> None:
    store = Store.create(tmp_path / "s")
    names = ("z" * 300, "1", "a~b"[:1])
    made(store, *names)
    [folder] = store.paths.segments.iterdir()
    assert {path.name for path in folder.iterdir()} == {MANIFEST, OUTPUTS, *(f"output.{k}.parquet" for k in (1, 2, 3))}
    subprocess.run(["sha256sum", "--check", "--quiet", MANIFEST], cwd=folder, check=True)
    assert (folder / OUTPUTS).read_text() == "".join(f"{k} {json.dumps(name)}\n" for k, name in enumerate(names, 1))
    assert store.outputs() == sorted(names)
    metadata = [pq.read_metadata(folder / f"output.{k}.parquet").metadata[b"sierra_table"].decode() for k in (1, 2, 3)]
    assert metadata == list(names)


@pytest.mark.parametrize(
    "text",
    ["", '1 "x"\n2 "x"\n', '1 "x"\n', '1 "x"\n2 3\n', '1 "x"\n2 "a~b"\n', "1 x\n2 y\n", f'1 "x"\n2 {"[" * 9999}\n', "\0\n"],
)
def test_no_rows_are_left_out_because_their_table_is_unknown(tmp_path: Path, text: str) -> None:
    store = Store.create(tmp_path / "s")
    made(store, "x", "y")
    [folder] = store.paths.segments.iterdir()
    (folder / OUTPUTS).write_text(text)
    seal(folder)
    assert store.outputs() == ["x", "y"]


@pytest.mark.parametrize("unnamed", [False, True])
def test_a_changed_list_of_tables_gives_no_other_answer(tmp_path: Path, unnamed: bool) -> None:
    store = Store.create(tmp_path / "s")
    made(store, "x", "y")
    [folder] = store.paths.segments.iterdir()
    names = {path: pq.read_metadata(path).metadata[b"sierra_table"].decode() for path in map(str, folder.glob("output.*"))}
    if unnamed:  # as files that came from stores of a former format
        for path in names:
            pq.write_table(pq.read_table(path).replace_schema_metadata(None), path)
        seal(folder)
        [folder] = store.paths.segments.iterdir()
    for damage in (lambda path: path.write_text('1 "y"\n2 "x"\n'), Path.unlink):
        damage(folder / OUTPUTS)
        if unnamed:
            with pytest.raises(Damaged, match=f"{OUTPUTS} (has other bytes than SIERRA wrote|is missing: run sierra fsck)"):
                store.sql("FROM batches")
        else:
            found = {path: name for one in store.segments() for name, path in one.outputs()}
            assert found == names


def _flip(path: Path) -> None:
    text = bytearray(path.read_bytes())
    text[-3] ^= 1
    path.write_bytes(text)


def _append(path: Path) -> None:
    path.write_bytes(path.read_bytes() + b"junk\n")


@pytest.mark.integration
@pytest.mark.parametrize("damage", [_flip, _append, Path.unlink])
def test_no_row_is_lost_with_a_list_of_tables(tmp_path: Path, damage: Callable[[Path], None]) -> None:
    root = projects.make(tmp_path / "p", simulator=stores.SIMULATOR)
    stores.ask(root, "population_size=1,2")
    before = sierra.open(root).sql("FROM swarm ORDER BY ALL").to_pylist()
    folder = stores.files(root, "output.swarm")[0].parent
    damage(folder / OUTPUTS)
    for command in (("ls",), ("sql", "FROM swarm"), ("run", "population_size=1,2", "--no-figures")):
        ended = projects.quick(root, *command)
        assert ended.returncode == 0, ended.stderr
    assert projects.quick(root, "fsck").returncode == 1
    repaired = projects.quick(root, "fsck", "--repair")
    assert repaired.returncode == 0, repaired.stderr
    assert projects.quick(root, "fsck").returncode == 0
    assert sierra.open(root).sql("FROM swarm ORDER BY ALL").to_pylist() == before


@pytest.mark.integration
def test_a_list_of_tables_is_compared_with_the_files_and_made_again_from_them(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "p", simulator=stores.SIMULATOR)
    stores.ask(root, "population_size=1,2")
    before = sierra.open(root).sql("FROM swarm ORDER BY ALL").to_pylist()
    folder = stores.files(root, "output.swarm")[0].parent
    names = dict(line.split() for line in (folder / OUTPUTS).read_text().splitlines())
    (folder / OUTPUTS).write_text("".join(f"{k} {text}\n" for k, text in zip(names, reversed(names.values()), strict=True)))
    seal(folder)
    found = [finding for finding in sierra.open(root).maintenance.fsck().findings if finding.kind is Kind.INCONSISTENT]
    assert [finding for finding in found if "names itself 'swarm'" in finding.what]
    folder = stores.files(root, "output.swarm")[0].parent
    (folder / OUTPUTS).unlink()
    assert projects.quick(root, "fsck").returncode == 1
    assert projects.quick(root, "fsck", "--repair").returncode == 0
    assert sierra.open(root).sql("FROM swarm ORDER BY ALL").to_pylist() == before


def _link(path: Path) -> None:
    path.symlink_to("/no/such/folder/content")


def _loop(path: Path) -> None:
    path.symlink_to(path.name)


def _device(path: Path) -> None:
    path.symlink_to("/dev/zero")


@pytest.mark.parametrize("put", [_link, _loop, _device, os.mkfifo, Path.mkdir])
def test_no_segment_is_hidden_because_a_file_in_it_cannot_be_read(tmp_path: Path, put: Callable[[Path], None]) -> None:
    """As git-annex and DataLad leave links without their content, and a lost mount leaves links to folders."""
    store = Store.create(tmp_path / ".sierra")
    made(store, "x")
    compaction = Compaction(store.paths, tmp_path / "new", "new")
    compaction.write((store.segments()[0],), {})
    compaction.new("cd" * 32).rows("batches", [{"batch": "cd" * 32}])
    compaction.publish()
    tidy(store.paths, tmp_path / "old")
    found = [path for mark in (MANIFEST, OUTPUTS, REPLACES, AFTER) for path in store.paths.segments.glob(f"*/{mark}")]
    assert {path.name for path in found} == {MANIFEST, OUTPUTS, REPLACES, AFTER}
    for path in (*found, found[0].parent, store.paths.segments):
        kept = path.rename(tmp_path / "kept")
        put(path)
        if path.name == OUTPUTS:
            assert [name for one in store.segments() for name, _ in one.outputs()] == ["x"]
        elif put is not Path.mkdir or path != store.paths.segments:
            with pytest.raises(Damaged, match="run sierra fsck"):
                store.sql("FROM batches")
        shown = str(path.relative_to(store.paths.root))
        assert path == store.paths.segments or shown in {one.path.removesuffix("/MANIFEST") for one in fsck(store)} | {
            one.path for one in fsck(store)
        }
        path.rmdir() if path.is_dir() else path.unlink()
        kept.rename(path)
    assert store.outputs() == ["x"]


def fsck(store: Store) -> list[Finding]:
    return [finding for finding in check_files.read(store.paths).findings if not finding.kind.fine]


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("mark", "put"), [(MANIFEST, None), (MANIFEST, Path.mkdir), (REPLACES, None), (REPLACES, os.mkfifo), (OUTPUTS, _link)]
)
def test_no_record_is_lost_with_a_file_that_lists_others(tmp_path: Path, mark: str, put: Callable[[Path], None] | None) -> None:
    root = projects.make(tmp_path / "p", simulator=stores.SIMULATOR)
    stores.ask(root, "population_size=1,2")
    sierra.open(root).run("population_size=3", figures=False)
    before = sierra.open(root).sql("FROM swarm ORDER BY ALL").to_pylist()
    store = sierra.open(root).store
    compaction = Compaction(store.paths, tmp_path / "new", "new")
    for group in groups(store.segments()):
        compaction.write(group, {})
    compaction.publish()
    tidy(store.paths, tmp_path / "old")
    path = next(iter(sorted((root / ".sierra" / "segments").glob(f"*/{mark}"))))
    path.unlink()
    if put is not None:
        put(path)
    ended = projects.quick(root, "fsck")
    assert (ended.returncode, ended.stderr) == (1, "")
    assert f"{path.parent.name}/{mark}: " in ended.stdout
    repaired = projects.quick(root, "fsck", "--repair")
    assert repaired.returncode == 0, repaired.stderr
    assert projects.quick(root, "fsck").returncode == 0
    assert sierra.open(root).sql("FROM swarm ORDER BY ALL").to_pylist() == before


def test_a_table_without_rows_stays_when_segments_are_merged_or_written_again(tmp_path: Path) -> None:
    store = Store.create(tmp_path / "s")
    for run in ("a", "b"):
        writer = store.writer(store.paths.work / "made", "ab" * 32)
        artifact = {"execution": run, "run": run, "path": "x.csv", "kind": "table", "output": "x", "rows": 0}
        writer.rows("artifacts", [{**artifact, "size": 1, "sha256": "00"}])
        with sierra.store.connections.connect() as connection:
            connection.execute(copy("SELECT '' AS run, '' AS execution, 1 AS v WHERE false", writer.path("output.x"), "x"))
        store.publish(writer)
    for gone, tables in (("", ["x"]), ("a", ["x"]), ("b", [])):
        compaction = Compaction(store.paths, tmp_path / f"new{gone}", f"new{gone}")
        drop = {"output": {"execution": {gone}}, "artifacts": {"execution": {gone}}} if gone else {}
        compaction.write(tuple(store.segments()), drop)
        compaction.publish()
        assert store.outputs() == tables
        for segment in store.segments():
            for _, path in segment.outputs():
                assert (pq.read_table(path).num_rows, pq.read_schema(path).names) == (0, ["run", "execution", "v"])
                assert pq.read_metadata(path).metadata[b"sierra_table"] == b"x"


def test_a_table_without_rows_stays_when_its_file_of_a_former_format_is_copied(tmp_path: Path) -> None:
    store = Store.create(tmp_path / "s")
    writer = store.writer(store.paths.work / "old", "ab" * 32)
    pq.write_table(pa.table({"run": ["r"], "execution": ["e"], "v": [1]}).slice(0, 0), writer.path("output.x"))
    store.publish(writer)
    compaction = Compaction(store.paths, tmp_path / "new", "new")
    compaction.write((store.segments()[0],), {})
    compaction.publish()
    [(name, path)] = store.segments()[0].outputs()
    assert (name, pq.read_table(path).num_rows, pq.read_metadata(path).metadata[b"sierra_table"]) == ("x", 0, b"x")


def test_a_file_that_does_not_name_its_table_is_written_again_so_that_it_does(tmp_path: Path) -> None:
    store = Store.create(tmp_path / "s")
    writer = store.writer(store.paths.work / "old", "ab" * 32)
    pq.write_table(pa.table({"run": ["r"], "execution": ["e"], "v": [1]}), writer.path("output.x"))
    store.publish(writer)
    before = pq.read_table(*store.segments()[0].files.values()).to_pylist()
    compaction = Compaction(store.paths, tmp_path / "new", "new")
    compaction.write((store.segments()[0],), {})
    compaction.publish()
    [segment] = store.segments()
    (store.paths.segments / segment.name / OUTPUTS).unlink()
    [(name, path)] = store.segments()[0].outputs()
    assert (name, pq.read_table(path).to_pylist()) == ("x", before)


def test_a_segment_that_is_written_twice_has_the_same_name(tmp_path: Path) -> None:
    store = Store.create(tmp_path / "s")
    for _ in range(2):
        made(store, "x", "y")
    assert [len(segment.files) for segment in on_disk(store.paths.segments)] == [2]
    assert not store.publish(Writer(tmp_path / "s" / "work" / "none", "ab" * 32))
    assert sha256((next(store.paths.segments.iterdir()) / MANIFEST).read_bytes())[:16] in store.segments()[0].name


def test_files_of_a_segment_are_in_the_order_of_their_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """So the spelling of columns does not depend on the order in which a file system lists them."""
    for name in ("output.1.parquet", "output.1~2.parquet", "executions.parquet"):
        (tmp_path / name).touch()
    names = ["executions.parquet", "output.1.parquet", "output.1~2.parquet"]
    for order in (1, -1):
        listed = [SimpleNamespace(name=name, path=str(tmp_path / name)) for name in names[::order]]
        monkeypatch.setattr(os, "scandir", lambda _, listed=listed: contextlib.nullcontext(listed))
        assert list(segments._read(str(tmp_path), "a-b").files) == [name.removesuffix(".parquet") for name in names]

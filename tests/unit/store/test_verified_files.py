"""Damaged files of the store are found before a statement answers from them, and verified files are not hashed again."""

from __future__ import annotations

import os
import random
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

import sierra
from sierra.errors import Damaged
from sierra.store import segments, verified_files
from sierra.store.layout import user_verified
from sierra.store.segments import MANIFEST, OUTPUTS, REPLACES
from tests import stores
from tests.projects import quick

DAMAGED = re.compile(
    r"sierra: \S+/segments/([0-9a-f]{10})\S+ has other bytes than SIERRA wrote \(batch \1\): run sierra fsck\n"
)


@pytest.fixture
def root(recorded: Path, tmp_path: Path) -> Path:
    return stores.copy(recorded, tmp_path / "project")


@pytest.fixture
def remembers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep the states of files that have just been written, which only the kernel can make older."""
    monkeypatch.setattr(verified_files, "RACY_NS", -(10**15))


@pytest.fixture
def hashed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the names of the files that are hashed from now on."""
    names: list[str] = []
    hash_of = verified_files.sha256_file

    def noted(path: Path) -> str:
        names.append(path.name)
        return hash_of(path)

    monkeypatch.setattr(verified_files, "sha256_file", noted)
    return names


def files(root: Path, pattern: str = "*") -> list[Path]:
    return sorted(path for path in root.glob(f".sierra/segments/*/{pattern}") if path.is_file())


def flip(path: Path, chance: random.Random) -> None:
    """Change one bit of a file, and give the file its old time."""
    status, content = path.stat(), bytearray(path.read_bytes())
    bit = chance.randrange(8 * len(content))
    content[bit // 8] ^= 1 << bit % 8
    path.write_bytes(content)
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))


def new_process() -> None:
    """Forget what this process knows of stores."""
    verified_files._save_all()
    verified_files._caches.clear()
    segments._known.clear()


def table_of(path: Path) -> str:
    [name] = [name for name, file in segments._segment(str(path.parent), path.parent.name).files.items() if file == str(path)]
    return segments.table_of(name)


def rows(root: Path, table: str) -> list[object]:
    found: list[object] = sierra.open(root).store.sql(f'FROM "{table}" ORDER BY ALL').to_pylist()
    return found


@pytest.mark.parametrize("pattern", ["output.*", "executions.*", "batch_runs.*"])
def test_no_flipped_bit_reaches_an_answer(root: Path, pattern: str) -> None:
    path = files(root, pattern)[0]
    rows(root, table_of(path))
    flip(path, random.Random(pattern))
    with pytest.raises(
        Damaged, match=f"{path} has other bytes than SIERRA wrote .batch {path.parent.name[:10]}.: run sierra fsck"
    ):
        rows(root, table_of(path))


@pytest.mark.nightly
@pytest.mark.integration
def test_200_flipped_bits_give_no_other_answer(root: Path, remembers: None) -> None:
    chance, known = random.Random(58), {}
    places = [path for path in files(root) if path.name not in (MANIFEST, OUTPUTS, REPLACES)]
    for path in places:
        known[table_of(path)] = rows(root, table_of(path))
    for path in (chance.choice(places) for _ in range(200)):
        content = path.read_bytes()
        flip(path, chance)
        new_process()
        try:
            assert rows(root, table_of(path)) == known[table_of(path)]
            raise AssertionError(f"nobody noticed that {path} was changed")
        except Damaged:
            path.write_bytes(content)


@pytest.mark.parametrize("command", [("sql", "FROM swarm"), ("stats", "swarm", "coverage"), ("ls",)])
def test_commands_report_damage_in_one_line(root: Path, command: tuple[str, ...]) -> None:
    flip(files(root, "batch_runs.parquet")[0], random.Random(1))
    ended = quick(root, *command)
    assert (ended.returncode, ended.stdout) == (1, "")
    assert DAMAGED.fullmatch(ended.stderr)


@pytest.mark.nightly
@pytest.mark.integration
@pytest.mark.each_case
@pytest.mark.parametrize("table", ["executions", "observations", "output.swarm", "artifacts", "objects", "sources"])
def test_no_command_answers_otherwise_than_from_sound_files(recorded: Path, tmp_path: Path, table: str) -> None:
    first, second = (one.batch for one in sierra.open(recorded).batches[:2])
    for command in (
        ("show", first),
        ("files", first),
        ("files", first, "*.csv", "--to", str(tmp_path / "out")),
        ("figures", first),
        ("report", first, "--to", str(tmp_path / "report.html")),
        ("compare", first, second, "--column", "coverage"),
        ("why", first),
        ("diff", first, second),
        ("outputs", first),
        ("plan-n", first, "--half-width", "0.02", "--column", "coverage"),
        ("run", "population_size=1,2", "-n"),
        ("run", "population_size=1,2"),
        ("replay", first, "--runs", "1"),
        ("gc", "--dry-run"),
    ):
        ended = []
        for damaged in (False, True):
            for folder in ("project", "out"):
                shutil.rmtree(tmp_path / folder, ignore_errors=True)
            root = stores.copy(recorded, tmp_path / "project")
            if damaged:
                flip(stores.files(root, table)[0], random.Random(table))
            new_process()
            ended.append(quick(root, *command))
        sound, other = ended
        assert sound.returncode in (0, 1), sound.stderr
        if (other.returncode, other.stdout) != (sound.returncode, sound.stdout):
            assert other.returncode == 1, command
            assert "sierra fsck" in other.stdout + other.stderr, command


@pytest.mark.parametrize("damage", [lambda path: b"", lambda path: path.read_bytes().replace(b"a", b"b", 1)])
def test_a_changed_list_of_replaced_segments_is_found(root: Path, damage: Callable[[Path], bytes]) -> None:
    store = sierra.open(root).store
    [segment, *_] = store.segments()
    writer = store.writer(store.paths.work / "made", segment.batch)
    writer.mark(REPLACES, [segment.name])
    store.publish(writer)
    assert segment.name not in [one.name for one in store.segments()]
    [mark] = files(root, REPLACES)
    mark.write_bytes(damage(mark))
    with pytest.raises(Damaged, match="REPLACES has other bytes than SIERRA wrote"):
        store.segments()


def test_a_changed_manifest_is_found(root: Path) -> None:
    flip(files(root, MANIFEST)[0], random.Random(3))
    new_process()
    with pytest.raises(Damaged, match="MANIFEST has other bytes than SIERRA wrote"):
        sierra.open(root).sql("FROM batches")


def test_statements_that_name_files_are_answered_from_verified_ones(root: Path) -> None:
    path = stores.files(root, "output.swarm")[0]
    statement = f"SELECT count(*) FROM read_parquet('{path}')"
    assert quick(root, "sql", statement).returncode == 0
    flip(path, random.Random(4))
    assert DAMAGED.fullmatch(quick(root, "sql", statement).stderr)


def test_verified_files_are_hashed_once(root: Path, remembers: None, hashed: list[str]) -> None:
    rows(root, "swarm")
    assert {path.name for path in stores.files(root, "output.swarm")} <= set(hashed)
    hashed.clear()
    new_process()
    rows(root, "swarm")
    assert hashed == []


def test_files_that_changed_within_the_same_tick_are_hashed_again(root: Path, hashed: list[str]) -> None:
    rows(root, "swarm")
    hashed.clear()
    new_process()
    rows(root, "swarm")
    assert {path.name for path in stores.files(root, "output.swarm")} <= set(hashed)


def test_files_that_this_process_wrote_are_not_hashed_again(root: Path, hashed: list[str]) -> None:
    store = sierra.open(root).store
    writer = store.writer(store.paths.work / "made", "ab" * 32)
    writer.rows("findings", [{"execution": "cd" * 32, "status": "failed", "reason": "no room", "lamport": 1}])
    store.publish(writer)
    hashed.clear()
    assert [row["reason"] for row in store.rows("FROM findings")] == ["no room"]
    assert "findings.parquet" not in hashed


@pytest.mark.parametrize("content", [b"", b"nothing", b"[1]"])
def test_a_damaged_cache_costs_one_pass(root: Path, remembers: None, hashed: list[str], content: bytes) -> None:
    before = rows(root, "swarm")
    new_process()
    user_verified(f"{root}/.sierra/segments").write_bytes(content)
    hashed.clear()
    assert rows(root, "swarm") == before
    assert {path.name for path in stores.files(root, "output.swarm")} <= set(hashed)


def test_a_store_is_read_without_a_cache(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", "/dev/null")
    assert rows(root, "swarm") != []
    flip(stores.files(root, "output.swarm")[0], random.Random(5))
    with pytest.raises(Damaged):
        rows(root, "swarm")


def test_segments_that_another_process_removes_are_not_damaged(root: Path) -> None:
    path = stores.files(root, "output.swarm")[0]
    shutil.rmtree(path.parent)
    verified_files.verify([str(path)])


def test_damaged_rows_are_not_copied_to_new_segments(root: Path) -> None:
    path = stores.files(root, "output.swarm")[0]
    flip(path, random.Random(6))
    before = stores.state(root)
    ended = quick(root, "gc", "--yes")
    assert ended.returncode == 1
    assert str(path) in ended.stderr
    assert {name: before[name] for name in before if name.startswith("segments/")} == {
        name: content for name, content in stores.state(root).items() if name.startswith("segments/")
    }

"""The order of records: by the Lamport numbers of sessions, never by clocks."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable
from datetime import timedelta
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

import sierra
from sierra.errors import Damaged
from sierra.execution.sessions import Session
from sierra.store.lamport_clock import POSITION, TIE, number_of
from sierra.store.layout import StorePaths
from sierra.store.schema import LATER, STAMPED
from sierra.store.segments import MANIFEST, manifest
from sierra.store.store import Store
from sierra.util.hashing import sha256
from tests import projects

Change = Callable[[str, pa.Table], pa.Table]
"""A function that changes a file of records, given the name of its table."""
DAYS = timedelta(days=2)


def install(root: Path, value: int) -> None:
    """Install a program outside the project whose result is this value."""
    program = root.parent / "simulator"
    program.write_text(f"#!/bin/sh\nprintf 'tick,v\\n0,{value}\\n' > out.csv\n")
    program.chmod(0o755)


def make(folder: Path) -> Path:
    root = projects.make(folder / "project", projects.CONFIG.replace("python3 sim.py", str(folder / "simulator")))
    for value in (1, 2):
        install(root, value)
        assert ask(root).executed == 2
    return root


def ask(root: Path) -> Any:
    return sierra.open(root).run("population_size=1", figures=False)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a project whose runs were executed by a program with the result 1, then by one with the result 2."""
    return make(tmp_path_factory.mktemp("order"))


@pytest.fixture
def root(made: Path) -> Any:
    """Return an unchanged copy of that project."""
    kept = made.parent / "kept"
    if not kept.exists():
        shutil.copytree(made, kept, symlinks=True)
    shutil.rmtree(made)
    shutil.copytree(kept, made, symlinks=True)
    install(made, 2)
    return made


def rewrite(root: Path, change: Change, tables: Iterable[str] = STAMPED) -> None:
    """Rewrite all records of these tables, as another clock or another version would have written them."""
    for folder in sorted((root / ".sierra" / "segments").iterdir()):
        for path in folder.glob("*.parquet"):
            if path.stem in tables:
                table = change(path.stem, pq.read_table(path))
                path.unlink()
                pq.write_table(table, path)
        text = manifest(sorted(path for path in folder.iterdir() if path.name != MANIFEST))
        (folder / MANIFEST).write_bytes(text)
        folder.rename(folder.with_name(f"{folder.name.partition('-')[0]}-{sha256(text)[:16]}"))


def later(number: int, by: timedelta, only: Callable[[pa.Table], Any] | None = None) -> Change:
    """Return a change that shifts the times of the records of the session with that number."""

    def change(name: str, table: pa.Table) -> pa.Table:
        mine = pc.equal(pc.shift_right(table["lamport"], TIE + POSITION), number)
        mine = mine if only is None or name != "executions" else pc.and_(mine, only(table))
        for place, field in enumerate(table.schema):
            if pa.types.is_timestamp(field.type):
                moved = pc.add(table[field.name], pa.scalar(by, pa.duration("us")))
                table = table.set_column(place, field, pc.if_else(mine, moved, table[field.name]))
        return table

    return change


def numbers(root: Path, table: str) -> list[int]:
    """Return the Lamport numbers of the rows of a table."""
    return sorted(number_of(row["lamport"]) for row in sierra.open(root).sql(f"SELECT lamport FROM {table}").to_pylist())


def found(root: Path) -> set[Any]:
    """Return the values that statistics, SQL and other outputs report, as one set."""
    project = sierra.open(root)
    [batch] = project.batches
    [statistics] = project.statistics(batch.batch, "out", "v").to_pylist()
    values = {row["v"] for row in project.sql("SELECT v FROM out").to_pylist()}
    within = {row["v"] for row in project.sql("SELECT v FROM out", within=batch.batch).to_pylist()}
    assert {row["status"] for row in project.sql("SELECT status FROM runs").to_pylist()} == {"ok"}
    assert project.records.show(batch.batch).experiments[0].succeeded == 2
    return {statistics["mean"], *values, *within}


@pytest.mark.integration
@pytest.mark.parametrize(("number", "by"), [(1, DAYS), (2, -DAYS)], ids=["ahead before", "behind now"])
def test_the_later_session_is_effective_for_any_time_of_its_clock(root: Path, number: int, by: timedelta) -> None:
    rewrite(root, later(number, by))
    assert found(root) == {2}
    assert ask(root).executed == 0
    [old, new] = sierra.open(root).records.show(sierra.open(root).batches[0].batch).sessions
    assert old.started > new.started, "times stay as they were recorded"
    install(root, 3)
    assert ask(root).executed == 2
    assert found(root) == {3}


@pytest.mark.nightly
def test_figures_show_the_last_executions(root: Path) -> None:
    def drawn() -> dict[str, bytes]:
        paths = sierra.open(root).run("population_size=1").figures
        return {path: Path(root, path).read_bytes() for path in paths}

    rewrite(root, later(2, DAYS))
    before = drawn()
    install(root, 3)
    after = drawn()
    assert before.keys() == after.keys() != set()
    assert all(before[path] != after[path] for path in before)


@pytest.mark.integration
def test_a_clock_that_jumps_back_during_a_session_does_not_change_results(root: Path) -> None:
    rewrite(root, later(2, -DAYS, only=lambda table: pc.equal(pc.bit_wise_and(table["lamport"], 1), 1)))
    assert found(root) == {2}
    places = sierra.open(root).sql("SELECT lamport FROM executions ORDER BY ALL").column(0).to_pylist()
    assert [(number_of(place), place % 2**POSITION) for place in places] == [(1, 0), (1, 1), (2, 0), (2, 1)]


@pytest.mark.integration
@pytest.mark.parametrize("by", [DAYS, -DAYS])
def test_the_session_with_the_greater_id_is_later_if_numbers_are_equal(root: Path, by: timedelta) -> None:
    rewrite(root, later(1, by))

    def tied(name: str, table: pa.Table) -> pa.Table:
        place = table.schema.get_field_index("lamport")
        rest = pc.bit_wise_and(table["lamport"], 2 ** (TIE + POSITION) - 1)
        return table.set_column(place, table.schema.field(place), pc.bit_wise_or(rest, 1 << TIE + POSITION))

    sessions = {row["session"]: number_of(row["lamport"]) for row in sierra.open(root).sql("FROM sessions").to_pylist()}
    rewrite(root, tied)
    assert found(root) == {sessions[max(sessions)]}, "the first asking found 1, and the second one 2"


@pytest.mark.nightly
def test_a_column_that_older_segments_lack_is_null(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(LATER, "artifacts", last := ("counted_rows", *LATER["artifacts"]))
    rewrite(root, lambda name, table: table.drop_columns(list(last)), ["artifacts"])
    counted = "SELECT count(counted_rows) AS n FROM artifacts"
    assert projects.quick(root, "fsck").returncode == 0
    assert sierra.open(root).sql(counted).to_pylist() == [{"n": 0}]
    install(root, 3)
    ask(root)
    assert sierra.open(root).sql(counted).to_pylist() == [{"n": 2}]
    assert projects.quick(root, "gc", "--yes").returncode == 0
    assert len([*root.glob(".sierra/segments/*/artifacts.parquet")]) == 1
    assert sierra.open(root).sql(counted).to_pylist() == [{"n": 2}]
    assert projects.quick(root, "fsck").returncode == 0
    assert found(root) == {3}


@pytest.mark.nightly
def test_batches_are_listed_in_the_order_of_their_submission(root: Path) -> None:
    rewrite(root, later(2, DAYS))
    last = sierra.open(root).run("population_size=2", figures=False).batch
    assert sierra.open(root).batches[-1].batch == last
    assert ask(root).executed == 0
    assert sierra.open(root).batches[-1].batch != last


@pytest.mark.integration
def test_a_session_has_a_greater_number_than_all_visible_ones(root: Path) -> None:
    store = sierra.open(root).paths.store
    one, two = Session(StorePaths(store)), Session(StorePaths(store))
    one.take_number()
    two.take_number()
    assert (one.number, two.number) == (3, 4), "also of those that live"
    one.close()
    two.close()
    batch = sierra.open(root).batches[0].batch
    sierra.open(root).replay(batch)
    assert numbers(root, "replays") == [3]
    (store / "numbers").write_text("nonsense")
    install(root, 3)
    ask(root)
    assert numbers(root, "executions") == [1, 1, 2, 2, 3, 3, 4, 4]


@pytest.mark.integration
def test_invalid_lamport_numbers_are_reported(root: Path) -> None:
    def beyond(name: str, table: pa.Table) -> pa.Table:
        place = table.schema.get_field_index("lamport")
        return table.set_column(place, table.schema.field(place), pa.array([2**63 - 1] * len(table), pa.int64()))

    rewrite(root, beyond)
    (root / ".sierra" / "numbers").unlink()
    install(root, 3)
    with pytest.raises(Damaged, match="Lamport number"):
        ask(root)


def test_a_session_that_is_taken_over_keeps_its_number(tmp_path: Path) -> None:
    store = Store.create(tmp_path / "store").paths
    left, other = Session(store), Session(store)
    left.take_number()
    left.paths.submission.write_text("{}")
    left.leave()
    left.close()
    other.take_number()
    adopted = Session.adopted(store, left.paths)
    assert adopted is not None
    assert (left.number, other.number, adopted.number) == (1, 2, 1)
    adopted.leave()
    adopted.close()
    other.close()

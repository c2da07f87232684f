"""No answer depends on the index: commands print the same bytes with it, without it, and with whatever has become of it."""

from __future__ import annotations

import shutil
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import pytest

from sierra.store import index_builder, index_files, index_reader
from sierra.store.layout import StorePaths
from sierra.store.schema import DERIVED, RECORDED
from sierra.store.store import Store
from tests import stores
from tests.projects import quick
from tests.support import varied_store

OUTPUTS = ("swarm", "levels", "wide", "notes", "Notes_2")
STATEMENTS = (
    *(f'SELECT * FROM "{name}" ORDER BY ALL' for name in (*RECORDED, *DERIVED, *OUTPUTS)),
    *(f'DESCRIBE "{name}"' for name in ("runs", "experiments", *OUTPUTS)),
    "SHOW TABLES",
    "SHOW ALL TABLES",
)
PART = 8
"""The part of these statements that is executed with each old index: one of so many."""
FORMER = Path(__file__).parents[1] / "data" / "stores" / "format-4.zip"


class Made(NamedTuple):
    """A project that has been through much, and its answers without an index."""

    root: Path
    indexes: list[Path]
    """The indexes that were built at earlier moments; the last but one is that of another store."""
    answers: list[object]
    said: list[object]
    """The output of the commands."""


def paths_of(root: Path) -> StorePaths:
    return StorePaths(root / ".sierra")


def forget() -> None:
    """Let this process read indexes as a new one does."""
    index_files._held.clear()
    index_reader._facts.clear()


def answers(root: Path, statements: Sequence[str] = STATEMENTS) -> list[object]:
    forget()
    with Store(root / ".sierra").snapshot() as snapshot:
        found: list[object] = [snapshot.sql(statement).to_pylist() for statement in statements]
        return [*found, sorted(segment.name for segment in snapshot.segments)]


def said(root: Path) -> list[object]:
    """Return what commands that read the store say."""
    forget()
    store = Store(root / ".sierra")
    first, second, *_, last = store.values(str, "SELECT batch FROM batches ORDER BY lamport")
    [run] = store.values(str, "SELECT min(run) FROM runs WHERE executions > 1")
    [execution] = store.values(str, "SELECT min(execution) FROM executions WHERE status <> 'ok'")
    commands = [
        ("ls", "--json"),
        ("status",),
        *(("show", one) for one in (last, execution)),
        ("why", run),
        ("diff", first, second),
        ("files", second),
        ("compare", first, second),
        ("sql", "-b", first, "SELECT * FROM levels ORDER BY ALL"),
        ("sql", "SELECT population_size, kind, kind_text, count(*) FROM swarm GROUP BY ALL ORDER BY ALL"),
        ("sql", "SELECT no_column FROM runs"),
        ("run", *varied_store.QUERIES[3], "-n"),
    ]
    found: list[object] = []
    for words in commands:
        done = quick(root, *words)
        found.append((words, done.returncode, done.stdout, done.stderr))
    return found


def drawn(root: Path) -> dict[str, bytes]:
    """Draw figures and a report, and return all files of them."""
    forget()
    first, *_, last = Store(root / ".sierra").values(str, "SELECT batch FROM batches ORDER BY lamport")
    for words in (("figures", first), ("report", last)):
        done = quick(root, *words)
        assert done.returncode == 0, done.stderr
    files = (path for path in (root / "figures").rglob("*") if path.is_file())
    return {str(path.relative_to(root)): path.read_bytes() for path in files}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    folder = tmp_path_factory.mktemp("varied")
    indexes: list[Path] = []

    def keep(root: Path) -> None:
        path = index_builder.build(paths_of(root))
        assert path is not None
        indexes.append(Path(shutil.copy(path, folder)))

    root = varied_store.make(folder / "project", keep)
    shutil.rmtree(paths_of(root).index, ignore_errors=True)
    return Made(root, indexes, answers(root), said(root))


@pytest.fixture(autouse=True)
def _no_index_is_left(made: Made) -> Iterator[None]:
    yield
    shutil.rmtree(paths_of(made.root).index, ignore_errors=True)


def test_answers_are_the_same_with_an_index_of_all_segments(made: Made) -> None:
    assert index_builder.build(paths_of(made.root)) is not None
    assert answers(made.root) == made.answers
    with Store(made.root / ".sierra").snapshot() as snapshot:
        assert (snapshot.listing.rest, snapshot.listing.without) == ([], frozenset())


def test_commands_say_the_same_with_an_index(made: Made) -> None:
    assert index_builder.build(paths_of(made.root)) is not None
    assert said(made.root) == made.said


@pytest.mark.nightly
def test_commands_say_the_same_with_an_old_index(made: Made) -> None:
    """It names segments that have been replaced since, and some that are gone."""
    use(made, -3)
    assert said(made.root) == made.said


@pytest.mark.nightly
def test_figures_and_reports_have_the_same_bytes_with_an_index(made: Made, tmp_path: Path) -> None:
    indexed, without = (stores.copy(made.root, tmp_path / name / "project") for name in ("indexed", "without"))
    assert index_builder.build(paths_of(indexed)) is not None
    found, wanted = drawn(indexed), drawn(without)
    assert found.keys() == wanted.keys()
    assert [name for name in wanted if found[name] != wanted[name]] == []
    assert len(wanted) > 10


def use(made: Made, number: int) -> None:
    """Give the store one of the indexes of earlier moments."""
    paths_of(made.root).index.mkdir()
    shutil.copy(made.indexes[number], paths_of(made.root).index)


def test_answers_are_the_same_with_indexes_of_all_earlier_moments_and_of_another_store(made: Made) -> None:
    gone = []
    for number in range(len(made.indexes)):
        use(made, number)
        assert answers(made.root, STATEMENTS[number % PART :: PART]) == [
            *made.answers[number % PART : -1 : PART],
            made.answers[-1],
        ]
        with Store(made.root / ".sierra").snapshot() as snapshot:
            gone.append(len(snapshot.listing.without))
        shutil.rmtree(paths_of(made.root).index)
    assert any(gone)


def test_rows_of_a_removed_batch_are_in_no_index_that_is_built_later(made: Made) -> None:
    word = varied_store.REMOVED.encode()
    assert any(word in path.read_bytes() for path in made.indexes)
    use(made, -3)
    path = index_builder.build(paths_of(made.root), 0)
    assert path is not None
    assert word not in path.read_bytes()
    assert [path] == list(paths_of(made.root).index.iterdir())
    with Store(made.root / ".sierra").snapshot() as snapshot:
        assert not snapshot.rows("SELECT * FROM experiments WHERE kind_text = $w", w=varied_store.REMOVED)


def test_a_store_of_the_former_format_has_the_same_answers_with_an_index(tmp_path: Path) -> None:
    with zipfile.ZipFile(FORMER) as packed:
        packed.extractall(tmp_path)
    root = tmp_path / "project"
    statements = [f'SELECT * FROM "{name}" ORDER BY ALL' for name in (*RECORDED, *DERIVED, "swarm", "_1")]
    without = answers(root, statements)
    assert index_builder.build(paths_of(root)) is not None
    assert answers(root, statements) == without
    with Store(root / ".sierra").snapshot() as snapshot:
        assert snapshot.listing.rest == []

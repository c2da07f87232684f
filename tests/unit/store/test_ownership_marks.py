"""SIERRA removes and writes only in folders that have its mark."""

from __future__ import annotations

import json
import shutil
import signal
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier

import pytest

import sierra
from sierra.errors import Damaged
from sierra.execution.checkout import _copy_in
from sierra.execution.sessions import Session, exclusively
from sierra.store.layout import ProjectPaths, StorePaths
from sierra.store.ownership_marks import identity
from sierra.store.store import Store
from tests import projects, stores
from tests.conftest import Simulated, held

OWNER = {"pid": 1, "born": 5, "boot": "0", "where": ["elsewhere"]}


@pytest.fixture
def theirs(tmp_path: Path) -> Path:
    """Return a folder with files of somebody else; some of them look like a session."""
    folder = tmp_path / "scratch"
    for name in ("thesis", "0123456789abcdef"):
        (folder / name).mkdir(parents=True)
        (folder / name / "precious").write_text("data\n")
    (folder / "0123456789abcdef" / "lock").touch()
    return folder


def files(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


@pytest.mark.parametrize("target", ["../../scratch", "{tmp}/scratch"])
@pytest.mark.parametrize("words", [("run", "population_size=1"), ("gc", "--yes"), ("gc", "--dry-run"), ("rm", "{batch}", "-y")])
def test_a_work_folder_that_links_to_somebody_elses_folder_is_refused(
    recorded: Path, tmp_path: Path, theirs: Path, target: str, words: tuple[str, ...]
) -> None:
    root = stores.copy(recorded, tmp_path / "project")
    shutil.rmtree(root / ".sierra" / "work")
    (root / ".sierra" / "work").symlink_to(target.format(tmp=tmp_path))
    batch = sierra.open(root).batches[0].batch
    before = files(theirs)
    ended = projects.quick(root, *(word.format(batch=batch) for word in words))
    assert (ended.returncode, ended.stderr.count("\n")) == (3, 1)
    assert "[store] work" in ended.stderr
    assert files(theirs) == before


@pytest.mark.integration
def test_the_work_folder_may_link_to_an_empty_folder_that_the_store_then_owns(tmp_path: Path) -> None:
    (tmp_path / "scratch").mkdir()
    one, two = projects.make(tmp_path / "one"), projects.make(tmp_path / "two")
    for root in (one, two):
        (root / ".sierra").mkdir()
        (root / ".sierra" / "work").symlink_to(tmp_path / "scratch")
    for _ in range(2):
        assert projects.quick(one, "run", "population_size=1", "--no-figures").returncode == 0
    assert projects.quick(one, "gc", "--yes").returncode == 0
    assert projects.quick(one, "fsck").returncode == 0
    ended = projects.quick(two, "run", "population_size=1", "--no-figures")
    assert (ended.returncode, ended.stderr.count("\n")) == (3, 1)
    assert "another store" in ended.stderr
    assert projects.quick(one, "run", "population_size=2", "--no-figures").returncode == 0


def test_a_work_folder_that_links_nowhere_or_to_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("data\n")
    for number, target in enumerate(("nowhere", "file")):
        root = projects.make(tmp_path / str(number))
        (root / ".sierra").mkdir()
        (root / ".sierra" / "work").symlink_to(tmp_path / target)
        ended = projects.quick(root, "run", "population_size=1", "--no-figures")
        assert (ended.returncode, ended.stderr.count("\n")) == (3, 1)
    assert (tmp_path / "file").read_text() == "data\n"
    assert not (tmp_path / "nowhere").exists()


@pytest.mark.integration
def test_entries_of_the_work_folder_that_are_not_sessions_are_kept_and_reported(
    recorded: Path, tmp_path: Path, theirs: Path
) -> None:
    root = stores.copy(recorded, tmp_path / "project")
    work = root / ".sierra" / "work"
    shutil.copytree(theirs, work, dirs_exist_ok=True)
    (work / "fedcba9876543210").symlink_to(theirs)
    before = files(theirs)
    assert projects.quick(root, "run", "population_size=7", "--no-figures").returncode == 0
    assert projects.quick(root, "gc", "--yes").returncode == 0
    assert files(theirs) == before
    assert set(before) < set(files(work))
    found = [finding.path for finding in sierra.open(root).maintenance.fsck().findings]
    assert found == ["work/0123456789abcdef", "work/fedcba9876543210", "work/thesis"]


@pytest.mark.nightly
def test_a_store_without_marks_of_an_older_version_continues_to_work(
    tmp_path: Path, simulate: Callable[..., Simulated]
) -> None:
    project = simulate(held(4))
    asked = project.start("run", "size=1,2,3,4", "-j", "2", "--no-figures")
    project.until_executed(4, asked)
    asked.send_signal(signal.SIGKILL)
    asked.communicate()
    project.kill_all()
    for mark in (".sierra/id", ".sierra/work/mark"):
        (project.folder / mark).unlink()
    project.open()
    assert project.ask("run", "size=1,2,3,4", "--runs", "10", "--no-figures").returncode == 0
    assert project.work() == []
    assert (project.folder / ".sierra/work/mark").read_bytes() == (project.folder / ".sierra/id").read_bytes()
    assert set(project.executed().values()) <= {1, 2}
    assert project.ask("fsck").returncode == 0


def test_a_folder_that_is_not_empty_does_not_become_a_store(tmp_path: Path, theirs: Path) -> None:
    (theirs / ".gitignore").write_text("theirs\n")
    root = projects.make(tmp_path / "project")
    (root / ".sierra").symlink_to(theirs)
    before = files(theirs)
    ended = projects.quick(root, "run", "population_size=1", "--no-figures")
    assert (ended.returncode, ended.stderr.count("\n")) == (3, 1)
    assert files(theirs) == before
    assert (theirs / ".gitignore").read_text() == "theirs\n"


@pytest.mark.parametrize(
    "words",
    [("run", "population_size=1", "-n"), ("run", "population_size=1"), ("fsck",), ("fsck", "--repair"), ("gc", "--yes")],
)
def test_a_folder_that_is_not_a_store_stays_unchanged(
    tmp_path: Path, theirs: Path, words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sierra.provenance.source.plain_tree.SETTLED_NS", -1e12)  # cache the hashes of new files too
    for name in ("files", "numbers"):
        (theirs / name).write_text("theirs\n")
    root = projects.make(tmp_path / "project")
    (root / ".sierra").symlink_to(theirs)
    before = stores.state(root)
    ended = projects.quick(root, *words)
    assert stores.state(root) == before
    if "-n" not in words:
        assert (ended.returncode, ended.stderr.count("\n")) == (3, 1)


@pytest.mark.nightly
def test_gc_removes_only_segments_from_the_folder_of_damaged_files(recorded: Path, tmp_path: Path, theirs: Path) -> None:
    root = stores.copy(recorded, tmp_path / "project")
    shutil.copytree(theirs, root / ".sierra" / "theirs")
    next(root.glob(".sierra/segments/*/executions.parquet")).write_bytes(b"")
    assert projects.quick(root, "fsck", "--repair").returncode == 0
    assert projects.quick(root, "gc", "--damaged", "--yes").returncode == 0
    assert [path.name for path in (root / ".sierra" / "damaged").iterdir()] == ["theirs"]
    assert files(root / ".sierra" / "damaged" / "theirs") == files(theirs)
    assert [(one.kind, one.path) for one in sierra.open(root).maintenance.fsck().findings] == [("foreign", "damaged/theirs")]


def died(root: Path, theirs: Path, **fields: object) -> Path:
    """Forge a dead session, as an attacker could: its journal has a run whose folder is `theirs`."""
    session = root / ".sierra" / "work" / "00000000deadbeef"
    session.mkdir(parents=True)
    (session / "owner.0").write_text(json.dumps(OWNER))
    (session / "lock").touch()
    row = sierra.open(root).sql("SELECT * FROM executions WHERE status = 'ok' LIMIT 1").to_pylist()[0]
    context = {
        "session": "00000000deadbeef",
        "batch": row["batch"],
        "purpose": "run",
        "environment": row["environment"],
        "programs": row["programs"],
        "outputs": {},
        "success": {},
    }
    (session / "context.json").write_text(json.dumps(context))
    event = {
        "event": "end",
        "run": row["run"],
        "execution": "e" * 64,
        "directory": str(theirs),
        "started": 0.0,
        "ended": 1.0,
        "exit_code": 0,
        "signal": None,
        "stopped": None,
        "error": None,
        "user_s": 0.0,
        "system_s": 0.0,
        "max_rss_bytes": 0,
        "host": "x",
        "slot": 0,
        "outputs": [],
    }
    (session / "journal.jsonl").write_text(json.dumps({**event, **fields}) + "\n")
    return session


@pytest.mark.integration
def test_a_journal_cannot_cause_access_to_a_folder_outside_its_session(recorded: Path, tmp_path: Path, theirs: Path) -> None:
    root = stores.copy(recorded, tmp_path / "project")
    session = died(root, theirs)
    before = files(theirs)
    projects.quick(root, "run", "population_size=7", "--no-figures")
    assert files(theirs) == before
    assert not session.exists()


@pytest.mark.integration
def test_a_dead_session_cannot_add_files_from_outside_to_the_store(recorded: Path, tmp_path: Path) -> None:
    root = stores.copy(recorded, tmp_path / "project")
    secret = tmp_path / "secret"
    secret.write_text("do not publish\n")
    for path in ("../../../../../../secret", "link"):
        output = {"path": path, "bytes": 15, "sha256": "0" * 64}
        session = died(root, tmp_path, directory=f"{root}/.sierra/work/00000000deadbeef/1", outputs=[output])
        (session / "1" / "output").mkdir(parents=True)
        (session / "1" / "output" / "link").symlink_to(secret)
        projects.quick(root, "run", "population_size=7", "--no-figures")
        assert not any(b"do not publish" in content for content in stores.state(root).values())
        assert sierra.open(root).sql("SELECT * FROM executions WHERE execution = $e", e="e" * 64).num_rows == 0
    assert secret.read_text() == "do not publish\n"


@pytest.mark.integration
def test_a_lock_that_is_a_link_is_not_followed(recorded: Path, tmp_path: Path) -> None:
    root = stores.copy(recorded, tmp_path / "project")
    thesis = tmp_path / "thesis"
    thesis.write_text("data\n")
    session = died(root, tmp_path)
    (session / "lock").unlink()
    (session / "lock").symlink_to(thesis)
    (session / "submission.json").write_text("{}")
    for words in (("status",), ("run", "population_size=7", "--no-figures")):
        projects.quick(root, *words)
    assert Session.adopted(Store(root / ".sierra").paths, Store(root / ".sierra").paths.session(session.name)) is None
    assert thesis.read_text() == "data\n"


# ---------------------------------------------------------------- [store] work


def scratch(tmp_path: Path, name: str, path: Path | str) -> Path:
    return projects.make(tmp_path / name, projects.CONFIG + f'[store]\nwork_folder = "{path}"\n')


@pytest.mark.nightly
def test_two_projects_may_share_one_external_work_folder(tmp_path: Path, theirs: Path) -> None:
    before = files(theirs)
    roots = [scratch(tmp_path, name, theirs) for name in ("one", "two")]
    for root in roots:
        assert projects.quick(root, "run", "population_size=1,2", "--no-figures").returncode == 0
        assert projects.quick(root, "gc", "--yes").returncode == 0
        assert projects.quick(root, "fsck").returncode == 0
        assert projects.quick(root, "replay", sierra.open(root).batches[0].batch[:8]).returncode == 0
    more = sorted(set(files(theirs)) - set(before))
    ids = sorted((root / ".sierra" / "id").read_text().strip() for root in roots)
    assert more == sorted([*ids, *(f"{one}/mark" for one in ids)])


@pytest.mark.integration
def test_a_dead_session_in_an_external_work_folder_is_recorded_and_removed(
    tmp_path: Path, theirs: Path, simulate: Callable[..., Simulated], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MY_SCRATCH", str(theirs))
    project = simulate(f"pwd >> '{tmp_path}/places'\n{held(4)}")
    with (project.folder / "sierra.toml").open("a") as file:
        file.write('[store]\nwork_folder = "$MY_SCRATCH"\n')
    before = files(theirs)
    asked = project.start("run", "size=1,2,3,4", "-j", "2", "--no-figures")
    project.until_executed(4, asked)
    asked.send_signal(signal.SIGKILL)
    asked.communicate()
    project.kill_all()
    places = (tmp_path / "places").read_text().splitlines()
    assert all(Path(place).is_relative_to(theirs) for place in places)
    finished = len([event for event in project.journals() if event["event"] == "end" and event["stopped"] is None])
    project.open()
    assert project.ask("gc", "--yes").returncode == 0
    assert project.sql("SELECT count(*) AS n FROM executions") == [{"n": finished}]
    assert len(set(files(theirs)) - set(before)) == 2


@pytest.mark.integration
def test_an_external_folder_named_by_a_session_is_removed_only_with_a_mark(
    recorded: Path, tmp_path: Path, theirs: Path
) -> None:
    root = stores.copy(recorded, tmp_path / "project")
    session = died(root, theirs)
    before = files(theirs)
    for target in (theirs, theirs / "0123456789abcdef"):
        session.mkdir(exist_ok=True)
        (session / "owner.0").write_text(json.dumps(OWNER))
        (session / "elsewhere").write_text(f"{target}\n")
        projects.quick(root, "gc", "--yes")
        assert files(theirs) == before
        assert not session.exists()


def test_threads_that_create_a_store_at_once_agree_on_its_id(tmp_path: Path) -> None:
    def create(store: StorePaths, together: Barrier) -> str:
        together.wait()
        with exclusively(store):
            return identity(store)

    for repetition in range(50):
        store, together = StorePaths(tmp_path / str(repetition)), Barrier(4)
        store.root.mkdir()
        with ThreadPoolExecutor(4) as threads:
            ids = {created.result() for created in [threads.submit(create, store, together) for _ in range(4)]}
        assert len(ids) == 1
        assert files(store.root) == ["id", "work", "work/lock", "work/mark"]


@pytest.mark.nightly
def test_the_external_work_folder_may_be_on_another_disk_and_a_link_may_not(
    tmp_path: Path, disk: Callable[[Path, str], Path]
) -> None:
    other = disk(tmp_path / "other", "16m")
    root = scratch(tmp_path, "project", other / "made")
    assert projects.quick(root, "run", "population_size=1", "--no-figures").returncode == 0
    batch = sierra.open(root).batches[0].batch
    left = files(other)
    assert [Path(path).name for path in left if not (other / path).is_dir()] == ["mark"]
    for more in ((), ("--no-record",), ("--keep",)):
        assert projects.quick(root, "replay", batch, *more).returncode == 0
        assert files(other) == left
    (other / "empty").mkdir()
    (root / ".sierra" / "work").rename(tmp_path / "away")
    (root / ".sierra" / "work").symlink_to(other / "empty")
    ended = projects.quick(root, "run", "population_size=2", "--no-figures")
    assert (ended.returncode, ended.stderr.count("\n")) == (3, 1)
    assert "another file system" in ended.stderr
    assert files(other / "empty") == []


def test_a_work_folder_that_cannot_be_created_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for path, code in ((tmp_path / "file", 3), ("$NO_SUCH_VARIABLE/x", 3), ("relative", 2)):
        root = scratch(tmp_path, "project", path)
        ended = projects.quick(root, "run", "population_size=1", "--no-figures")
        assert (ended.returncode, ended.stderr.count("\n")) == (code, 1)
        assert "work" in ended.stderr


# ---------------------------------------------------------------- names from records


def test_gc_removes_nothing_through_a_link_instead_of_the_image_folder(recorded: Path, tmp_path: Path) -> None:
    root = stores.copy(recorded, tmp_path / "project")
    home = tmp_path / "home"
    (home / "lib").mkdir(parents=True)
    for name in (".cache.4194399", "lib/.so.4194399", "lib/.rootfs.sqfs.4194399"):
        (home / name).write_text("theirs\n")
    before = files(home)
    (root / ".sierra" / "images").symlink_to(home)
    assert projects.quick(root, "gc", "--yes").returncode == 0
    assert files(home) == before


def test_names_from_a_record_never_leave_their_folder(tmp_path: Path) -> None:
    store, project = StorePaths(tmp_path / ".sierra"), ProjectPaths(tmp_path)
    for name in ("../x", "/x", "sha256-../../x", ""):
        with pytest.raises(Damaged):
            store.image(name)
        with pytest.raises(Damaged):
            project.drawn(name)


def test_a_checkout_writes_nothing_through_a_link_out_of_it(tmp_path: Path, theirs: Path) -> None:
    root, project = tmp_path / "root", tmp_path / "project"
    (project / "out").mkdir(parents=True)
    (project / "out" / "new").write_text("stranger's\n")
    root.mkdir()
    (root / "out").symlink_to(theirs)
    before = files(theirs)
    _copy_in(project / "out" / "new", root, Path("out", "new"))
    assert files(theirs) == before
    assert ((root / "out").is_symlink(), (root / "out" / "new").read_text()) == (False, "stranger's\n")

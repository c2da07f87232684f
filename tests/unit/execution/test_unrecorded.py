"""A session that cannot be recorded fails alone: it is moved away and named, and every other command goes on."""

from __future__ import annotations

import errno
import json
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import duckdb
import pytest

import sierra
from sierra.errors import Damaged, Missing
from sierra.ingest.recorder import Recorder
from tests import projects
from tests.support.irregular_files import irregular


class Faulty:
    """A fault of the sessions of one batch, whenever their executions are written."""

    def __init__(self, batch: str, error: Callable[[], Exception]) -> None:
        self.batch, self.error = batch, error
        self.before = Recorder._write

    def write(self, recorder: Recorder, writer: Any) -> Any:
        if recorder.context.batch == self.batch:
            raise self.error()
        return self.before(recorder, writer)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return projects.make(tmp_path / "project")


@pytest.fixture
def fail(root: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """Return a function that executes a query whose session cannot be recorded, and returns the session."""

    def fail(error: Callable[[], Exception]) -> str:
        batch = sierra.open(root).plan("population_size=1").batch.id
        faulty = Faulty(batch, error)
        monkeypatch.setattr(Recorder, "_write", lambda recorder, writer: faulty.write(recorder, writer))
        assert projects.quick(root, "run", "population_size=1", "--no-figures").returncode != 0
        [session] = [path.name for path in (root / ".sierra" / "work").iterdir() if path.is_dir()]
        return session

    return fail


def interrupt_writing(patch: pytest.MonkeyPatch, number: signal.Signals) -> None:
    """Send a signal to this process within the next statement that writes a file, which ends then as DuckDB ends it."""
    execute = duckdb.DuckDBPyConnection.execute

    def interrupted(connection: duckdb.DuckDBPyConnection, text: str, *more: Any) -> Any:
        if not text.startswith("COPY"):
            return execute(connection, text, *more)
        try:
            signal.raise_signal(number)
        except KeyboardInterrupt:
            raise RuntimeError("Query interrupted") from None
        raise AssertionError("nothing handles the signal")

    patch.setattr(duckdb.DuckDBPyConnection, "execute", interrupted)


def system(number: int) -> OSError:
    return OSError(number, os.strerror(number), "a file")


def too_long() -> Exception:
    error = Missing("cannot write to a folder: File name too long")
    error.__cause__ = system(errno.ENAMETOOLONG)
    return error


@pytest.mark.integration
@pytest.mark.parametrize("error", [lambda: ValueError("a\nfault"), lambda: Damaged("not a record"), too_long])
def test_a_session_that_cannot_be_recorded_is_moved_away_by_the_next_command_that_writes(
    root: Path, fail: Callable[..., str], monkeypatch: pytest.MonkeyPatch, error: Callable[[], Exception]
) -> None:
    session = fail(error)
    for words in (("ls",), ("sql", "FROM runs"), ("fsck",)):
        assert projects.quick(root, *words).returncode == 0
    other = projects.quick(root, "run", "population_size=2", "--no-figures")
    assert (other.returncode, "2 executed" in other.stdout) == (0, True)
    place = f"damaged/work-{session}"
    assert f"session {session} cannot be recorded (" in other.stderr
    assert (root / ".sierra" / place / "journal.jsonl").is_file()
    checked = projects.quick(root, "fsck")
    assert (checked.returncode, f"unrecorded: {place}: session {session} cannot be" in checked.stdout) == (1, True)
    assert "--repair" not in checked.stdout
    assert f"in .sierra/{place}; sierra run executes its runs again" in projects.quick(root, "status").stderr
    assert projects.quick(root, "gc", "--yes").returncode == 0
    monkeypatch.undo()
    assert projects.run(root, "population_size=1")[0]["executed"] == 2
    assert projects.quick(root, "gc", "--damaged", "--yes").returncode == 0
    assert projects.quick(root, "fsck").returncode == 0


@pytest.mark.integration
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.ESTALE, errno.EIO])
def test_a_session_that_lacks_something_is_recorded_later(
    root: Path, fail: Callable[..., str], monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    session = fail(lambda: system(number))
    other = projects.quick(root, "run", "population_size=2", "--no-figures")
    assert (other.returncode, os.strerror(number) in other.stderr) == (3, True)
    assert (root / ".sierra" / "work" / session).is_dir()
    monkeypatch.undo()
    assert projects.run(root, "population_size=1")[0]["executed"] == 0
    assert not (root / ".sierra" / "damaged").exists()


@pytest.mark.integration
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("words", [("gc", "--yes"), ("run", "population_size=2", "--no-figures")])
def test_a_session_whose_recording_is_interrupted_is_recorded_later(
    root: Path, fail: Callable[..., str], monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], number: signal.Signals
) -> None:
    session = fail(lambda: ValueError("a fault"))
    monkeypatch.undo()
    interrupt_writing(monkeypatch, number)
    ended = projects.quick(root, *words)
    assert ended.returncode == 130
    assert (root / ".sierra" / "work" / session).is_dir()
    assert not (root / ".sierra" / "damaged").exists()
    monkeypatch.undo()
    assert projects.run(root, "population_size=1")[0]["executed"] == 0


@pytest.mark.integration
@pytest.mark.parametrize("name", ["context.json", "journal.jsonl", "owner.1", "number", "claims.json"])
def test_no_command_waits_for_a_pipe_among_the_files_of_a_session(root: Path, fail: Callable[..., str], name: str) -> None:
    session = fail(lambda: ValueError("a fault"))
    irregular(root / ".sierra" / "work" / session / name, "pipe")
    for words in (("ls",), ("status",), ("fsck",), ("run", "population_size=2", "--no-figures"), ("gc", "--yes")):
        done = projects.quick(root, *words)
        assert (done.returncode in (0, 1, 3), "Traceback" in done.stderr) == (True, False), done


@pytest.mark.integration
def test_a_session_of_somebody_else_stays_until_they_return(
    root: Path, fail: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    session = fail(lambda: system(errno.EACCES))
    other = projects.quick(root, "run", "population_size=2", "--no-figures")
    assert (other.returncode, "2 executed" in other.stdout) == (0, True)
    assert f"session {session} has died and cannot be recorded by this process" in other.stderr
    monkeypatch.undo()
    assert projects.run(root, "population_size=1")[0]["executed"] == 0


@pytest.mark.integration
def test_engines_that_cannot_be_read_concern_only_their_session(
    root: Path, fail: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    session = fail(lambda: ValueError("a fault"))
    monkeypatch.undo()
    context = root / ".sierra" / "work" / session / "context.json"
    context.write_text(json.dumps(json.loads(context.read_bytes()) | {"engine": "podman", "engines": "abc"}))
    other = projects.quick(root, "run", "population_size=2", "--no-figures")
    assert (other.returncode, "2 executed" in other.stdout) == (0, True), other.stderr
    assert (f"session {session} " in other.stderr, "fault in SIERRA" in other.stderr) == (True, False)


@pytest.mark.integration
def test_files_of_runs_in_a_work_folder_are_named_and_removed_too(tmp_path: Path, fail: Callable[..., str], root: Path) -> None:
    (root / "sierra.toml").write_text(projects.CONFIG + f'[store]\nwork_folder = "{tmp_path}/runs"\n')
    session = fail(lambda: Damaged(f"x: is from elsewhere; move {root}/.sierra/work/{session_of(root)} away, or do not"))
    [runs] = (tmp_path / "runs").glob(f"*/{session}")
    other = projects.quick(root, "run", "population_size=2", "--no-figures")
    assert f"(x: is from elsewhere); its files are in .sierra/damaged/work-{session} and {runs};" in other.stderr
    assert runs.is_dir()
    assert projects.quick(root, "gc", "--damaged", "--yes").returncode == 0
    assert not runs.exists()
    assert projects.quick(root, "fsck").returncode == 0


@pytest.mark.integration
@pytest.mark.parametrize("words", [(), ("--json",)])
def test_gc_reports_sessions_that_cannot_be_recorded(root: Path, fail: Callable[..., str], words: tuple[str, ...]) -> None:
    session = fail(lambda: Damaged("not a record"))
    done = projects.quick(root, "gc", "--yes", *words)
    assert done.returncode == 1
    assert done.stderr.startswith(
        f"note: session {session} cannot be recorded (not a record); its files are in .sierra/damaged/"
    )
    if words:
        found = json.loads(done.stdout)
        assert (found["sessions"], len(found["unrecorded"])) == (0, 1)
    else:
        assert done.stdout.endswith("nothing was removed\n")
    assert projects.quick(root, "gc", "--yes").returncode == 0


@pytest.mark.integration
def test_rm_and_import_report_sessions_that_cannot_be_recorded(root: Path, fail: Callable[..., str], tmp_path: Path) -> None:
    session = fail(lambda: Damaged("not a record"))
    message = f"session {session} cannot be recorded (not a record)"
    work = root / ".sierra" / "work" / session
    assert message in projects.quick(root, "rm", "abcdef").stderr
    (root / ".sierra" / "damaged" / f"work-{session}").rename(work)
    assert message in projects.quick(root, "import", str(tmp_path / "none.zip")).stderr


def session_of(root: Path) -> str:
    return next(path.name for path in (root / ".sierra" / "work").iterdir() if path.is_dir())

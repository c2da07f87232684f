"""Messages go to the logger `sierra`, to standard error with -v, and to a log file for each session."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

import sierra
from sierra.store import session_log_file
from sierra.store.layout import StorePaths
from sierra.util import lazy_logger
from sierra.util.log_handlers import Stderr, listen
from tests import projects

QUERY = ("run", "population_size=1", "--no-figures")


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return projects.make(tmp_path / "project")


@pytest.fixture
def store(tmp_path: Path) -> StorePaths:
    """Return an empty store with the folders that a log needs."""
    store = StorePaths(tmp_path / "store")
    store.root.mkdir()
    store.format.touch()
    return store


@pytest.fixture
def own() -> Iterator[list[logging.LogRecord]]:
    """Yield the messages that a handler of a program with SIERRA receives at the level INFO."""
    got: list[logging.LogRecord] = []
    handler = logging.Handler()
    handler.emit = got.append  # type: ignore[method-assign]
    before = logging.getLogger().level
    logging.getLogger().addHandler(handler)
    logging.getLogger().setLevel(logging.INFO)
    yield got
    logging.getLogger().setLevel(before)
    logging.getLogger().removeHandler(handler)


def logs(root: Path) -> list[Path]:
    return sorted((root / ".sierra" / "logs").glob("*"))


@pytest.mark.integration
def test_a_session_has_a_log_file_that_show_names(root: Path) -> None:
    assert projects.quick(root, *QUERY).stderr == ""
    [file] = logs(root)
    text = file.read_text()
    [batch] = sierra.open(root).batches
    assert f"session {file.stem} started" in text
    assert f"batch {batch.batch} on local with none" in text
    assert "2 runs: 2 executed, 0 failed, 0 missing" in text
    assert text.endswith(f"session {file.stem} ended\n")
    shown = json.loads(projects.quick(root, "show", batch.batch, "--json").stdout)
    assert shown["log_file"] == str(file)
    session = json.loads(projects.quick(root, "show", file.stem[:8], "--json").stdout)
    assert (session["kind"], session["session"], session["executed"]) == ("session", file.stem, 2)
    assert session["log_file"] == str(file)
    assert str(file) in projects.quick(root, "show", file.stem).stdout
    (root / "usual").touch()
    assert file.stat().st_mode == (root / "usual").stat().st_mode, "the file follows the umask"


@pytest.mark.nightly
def test_v_logs_events_and_vv_details_to_standard_error(root: Path) -> None:
    quiet = projects.quick(root, "-v", *QUERY)
    assert "INFO sierra.execution.execute: query population_size=1" in quiet.stderr
    assert "DEBUG" not in quiet.stderr
    loud = projects.quick(root, "-vv", "run", "population_size=2", "--no-figures")
    assert "worker/__main__.py" in loud.stderr
    assert "first run: python3 " in loud.stderr
    assert "INFO" not in loud.stdout
    assert "INFO" not in projects.quick(root, "run", "population_size=3", "--no-figures").stderr


@pytest.mark.integration
def test_failed_runs_are_counted_in_the_log(root: Path) -> None:
    (root / "sierra.toml").write_text(projects.CONFIG.replace("python3 sim.py", "sh -c 'exit 3' {project}/sim.py"))
    assert projects.quick(root, *QUERY).returncode == 1
    assert "2 runs: 2 executed, 2 failed, 0 missing" in logs(root)[0].read_text()


@pytest.mark.integration
@pytest.mark.parametrize("kind", ["file", "link"])
def test_a_log_that_cannot_be_written_does_not_fail_the_command(root: Path, tmp_path: Path, kind: str) -> None:
    assert projects.quick(root, *QUERY).returncode == 0
    for file in logs(root):
        file.unlink()
    folder, elsewhere = root / ".sierra" / "logs", tmp_path / "elsewhere"
    folder.rmdir()
    elsewhere.mkdir()
    if kind == "file":
        folder.touch()
    else:
        folder.symlink_to(elsewhere)
    ended = projects.quick(root, "run", "population_size=2", "--no-figures")
    assert (ended.returncode, ended.stderr) == (0, "")
    assert not list(elsewhere.iterdir())


def test_a_log_never_writes_through_a_link(store: StorePaths, tmp_path: Path) -> None:
    store.logs.mkdir()
    store.log("0" * 16).symlink_to(tmp_path / "target")
    end = session_log_file.open_log(store, "0" * 16)
    lazy_logger.Log("sierra.test").info("hello")
    end()
    assert not (tmp_path / "target").exists()


def test_a_log_has_two_files_at_most_and_keeps_the_latest_messages(store: StorePaths) -> None:
    end = session_log_file.open_log(store, "0" * 16)
    for number in range(300):
        lazy_logger.Log("sierra.test").info("message %d %s", number, "x" * 9000)
    end()
    files = session_log_file.logs(store)
    assert {path.name for path in files} == {f"{'0' * 16}.log", f"{'0' * 16}.old"}
    assert all(path.stat().st_size <= session_log_file.LARGEST for path in files)
    assert "message 299 " in store.log("0" * 16).read_text()


def test_a_store_keeps_a_limited_number_of_logs(store: StorePaths) -> None:
    store.logs.mkdir()
    for number in range(150):
        path = store.log(f"{number:016x}")
        path.write_text("old\n")
        os.utime(path, (number, number))
    end = session_log_file.open_log(store, "f" * 16)
    lazy_logger.Log("sierra.test").info("hello")
    end()
    kept = {path.stem for path in session_log_file.logs(store)}
    assert len(kept) == session_log_file.KEPT
    assert {"f" * 16, f"{149:016x}"} <= kept
    assert f"{0:016x}" not in kept


def test_each_message_is_one_line_without_control_characters(store: StorePaths) -> None:
    end = session_log_file.open_log(store, "0" * 16)
    lazy_logger.Log("sierra.test").info("a\nINFO forged\x1b[2J%s", "\r")
    end()
    [line] = store.log("0" * 16).read_text().splitlines()
    assert line.endswith("a\\nINFO forged\\x1b[2J\\x0d")


@pytest.mark.parametrize(
    ("argv", "text"),
    [
        (("podman", "run", "--env=TOKEN=abc", "--rm"), "podman run --env=TOKEN=… --rm"),
        (("qsub", "-v", "A=1,B=2"), "qsub -v A=…"),
        (("sbatch", "--export=ALL,KEY=abc", "--time=5"), "sbatch --export=ALL,KEY=… --time=5"),
        (("tool", "--password=abc", "--api-key=x"), "tool --password=… --api-key=…"),
        (("git", "push", "https://ada:abc@example.org/x"), "git push https://…@example.org/x"),
    ],
)
def test_commands_are_logged_without_values_of_variables_and_passwords(argv: tuple[str, ...], text: str) -> None:
    assert lazy_logger.shown(argv).replace("'", "") == text
    assert "abc" not in lazy_logger.shown(argv)


@pytest.mark.integration
def test_no_value_of_an_environment_variable_is_in_a_log(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SWARM_TOKEN", "topsecret")
    (root / "sierra.toml").write_text(projects.CONFIG + '[environment]\nset = { SWARM_MODE = "topsecret" }\n')
    ended = projects.quick(root, "-vv", *QUERY)
    assert ended.returncode == 0, ended.stderr
    assert "topsecret" not in ended.stderr
    assert "topsecret" not in logs(root)[0].read_text()


@pytest.mark.nightly
def test_a_program_that_uses_sierra_receives_messages_of_its_level(root: Path, own: list[logging.LogRecord]) -> None:
    sierra.open(root).run("population_size=1", figures=False)
    assert {record.levelno for record in own if record.name.startswith("sierra")} == {logging.INFO}
    assert logging.getLogger("sierra").level == logging.NOTSET
    assert logging.getLogger("sierra").handlers == []


def test_listeners_end_in_any_order_and_leave_no_handlers(own: list[logging.LogRecord]) -> None:
    first, second = listen(Stderr(logging.ERROR)), listen(Stderr(logging.ERROR))
    first()
    lazy_logger.Log("sierra.test").info("heard")
    second()
    lazy_logger.Log("sierra.test").info("heard too")
    lazy_logger.Log("sierra.test").debug("not heard")
    assert [record.getMessage() for record in own] == ["heard", "heard too"]


@pytest.mark.integration
def test_gc_removes_logs_of_unrecorded_sessions_and_fsck_names_unknown_files(root: Path) -> None:
    assert projects.quick(root, *QUERY).returncode == 0
    [recorded] = logs(root)
    unrecorded, strange = recorded.with_name(f"{'0' * 16}.log"), recorded.with_name("mine.txt")
    unrecorded.write_text("x\n")
    strange.write_text("x\n")
    checked = projects.quick(root, "fsck")
    assert checked.returncode == 0
    assert "logs/mine.txt" in checked.stdout
    assert "1 log file of sessions that are not recorded" in projects.quick(root, "gc", "--dry-run").stdout
    assert projects.quick(root, "gc", "--yes").returncode == 0
    assert logs(root) == [recorded, strange]
    assert json.loads(projects.quick(root, "gc", "--dry-run", "--json").stdout)["logs"] == 0


@pytest.mark.nightly
def test_the_recovery_of_a_dead_session_is_logged(root: Path) -> None:
    assert projects.quick(root, *QUERY).returncode == 0
    folder = root / ".sierra" / "work" / ("0" * 16)
    folder.mkdir()
    (folder / "owner.0").write_text(json.dumps({"pid": 1, "where": ["nowhere"]}))
    ended = projects.quick(root, "-v", "run", "population_size=2", "--no-figures")
    assert f"WARNING sierra.execution.recover: session {'0' * 16} has died" in ended.stderr

"""Corrupt bytes and terminal escape sequences are shown on one line and have no effect."""

from __future__ import annotations

import json
import os
import pty
import shutil
from pathlib import Path

import pytest

import sierra
from sierra.cli.output import readable, safe
from tests import projects, stores
from tests.support.characters import MIXED, SHOWN
from tests.unit.store.test_ownership_marks import died

EVIL = "\x1b[2J\x1b]0;owned\x07\x9b31m\u202egnp.exe"
SIMULATOR = (
    projects.SIMULATOR
    + f"""
open("pic{EVIL[:4]}.bin", "wb").write(bytes([0, 255]))
open("more{EVIL[4:8]}.csv", "w").write("a,b{EVIL}\\n1,{EVIL}\\n")
print({EVIL!r})
print({EVIL!r}, file=sys.stderr)
if count == 2:
    sys.exit({EVIL!r})
"""
)
HARMFUL = ("\x1b", "\x07", "\x9b", "\u202e")


@pytest.fixture(scope="module")
def evil(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project whose runs leave names, values and logs with escape sequences."""
    root = projects.make(tmp_path_factory.mktemp("evil") / "project", simulator=SIMULATOR)
    sierra.open(root).run("population_size=1,2", figures=False)
    return root


def harmless(text: str) -> bool:
    return not any(sign in text for sign in HARMFUL)


WORDS = [
    ("ls",),
    ("show", "{batch}"),
    ("show", "{run}"),
    ("files", "{run}"),
    ("sql", "SHOW TABLES"),
    ("sql", "SELECT log_tail, reason FROM executions"),
    ("sql", "SELECT chr(27) || '[2J' AS \"a\x1bb\""),
    ("why", "{batch}"),
    ("run", "population_size=1,2", "--no-figures"),
    ("figures",),
    ("files", "{run}", "\x1b[2J"),
    ("fsck",),
]


@pytest.mark.integration
@pytest.mark.parametrize("words", WORDS, ids=lambda words: "-".join(words)[:20].replace("\x1b", ""))
def test_recorded_escape_sequences_are_never_printed(evil: Path, words: tuple[str, ...]) -> None:
    [row] = sierra.open(evil).sql("SELECT batch, run FROM executions WHERE status <> 'ok' LIMIT 1").to_pylist()
    done = projects.quick(evil, *(word.format(**row) for word in words))
    assert harmless(done.stdout + done.stderr)
    assert "fault in SIERRA" not in done.stderr


@pytest.mark.integration
def test_log_shows_escape_sequences_in_escaped_form(evil: Path) -> None:
    [row] = sierra.open(evil).sql("SELECT run FROM executions WHERE status <> 'ok' LIMIT 1").to_pylist()
    assert "\\x1b[2J" in projects.quick(evil, "show", row["run"]).stdout


def test_json_and_exported_files_keep_recorded_escape_sequences(evil: Path, tmp_path: Path) -> None:
    [row] = sierra.open(evil).sql("SELECT run FROM executions WHERE status <> 'ok' LIMIT 1").to_pylist()
    done = projects.quick(evil, "sql", "SELECT chr(27) AS a", "--json")
    assert harmless(done.stdout)
    assert json.loads(done.stdout) == [{"a": "\x1b"}]
    assert projects.quick(evil, "sql", "SELECT chr(27) AS a", "--format", "csv", "-o", str(tmp_path / "x.csv")).returncode == 0
    assert b"\x1b" in (tmp_path / "x.csv").read_bytes()
    assert projects.quick(evil, "files", row["run"], "stdout", "--to", str(tmp_path / "to")).returncode == 0
    assert any(EVIL.encode() in path.read_bytes() for path in (tmp_path / "to").rglob("stdout"))


def test_csv_output_on_a_terminal_has_no_escape_sequences(evil: Path) -> None:
    ours, theirs = pty.openpty()
    assert (
        projects.start(evil, "sql", "SELECT chr(27) || 'x' AS a", "--format", "csv", stdout=theirs, stderr=theirs).wait() == 0
    )
    os.close(theirs)
    assert b"\x1b" not in os.read(ours, 4096)
    os.close(ours)


def test_safe_text_stays_unchanged() -> None:
    assert safe("a\tb\nc äöü → 中文 … é") == "a\tb\nc äöü → 中文 … é"
    assert safe("\ud800\r\u2066") == "\\ud800\\r\\u2066"
    assert safe(MIXED) == readable(MIXED) == SHOWN
    assert readable("a\tb\r\nc") == "a\\tb\\r\\nc"


def test_tables_of_a_command_show_letters_and_escape_what_deceives(evil: Path) -> None:
    assert projects.quick(evil, "sql", f"SELECT '{MIXED}' AS a").stdout.splitlines()[1] == SHOWN


# ---------------------------------------------------------------- bytes that are not text


@pytest.mark.integration
def test_corrupt_format_file_is_reported_as_damage_and_can_be_repaired(recorded: Path, tmp_path: Path) -> None:
    root = stores.copy(recorded, tmp_path / "project")
    for content in (b"\xff", b"\xff" * 100_000, b"\x1b[2J\n", b""):
        (root / ".sierra" / "format").write_bytes(content)
        for words in (("ls",), ("run", "population_size=1")):
            done = projects.quick(root, *words)
            assert (done.returncode, done.stderr.count("\n")) == (1, 1)
            assert "format: this is" in done.stderr
            assert "sierra fsck --repair writes it again" in done.stderr
            assert len(done.stderr) < 1000
            assert harmless(done.stderr)
    assert projects.quick(root, "fsck").returncode == 1
    assert projects.quick(root, "fsck", "--repair").returncode == 0
    assert projects.quick(root, "ls").returncode == 0


@pytest.mark.integration
@pytest.mark.parametrize("name", ["context.json", "claims.json", "owner.0", "submission.json", "asking.json", "journal.jsonl"])
def test_corrupt_session_files_do_not_crash_status_or_gc(recorded: Path, tmp_path: Path, name: str) -> None:
    root = stores.copy(recorded, tmp_path / "project")
    for content in (b"\xff\n", b"7", b"[" * 100_000):
        shutil.rmtree(root / ".sierra" / "work" / "00000000deadbeef", ignore_errors=True)
        (died(root, tmp_path) / name).write_bytes(content)
        for words in (("status",), ("gc", "--yes")):
            done = projects.quick(root, *words)
            assert "fault in SIERRA" not in done.stderr, (words, done.stderr)
            assert done.stderr.count("sierra: ") <= 1


@pytest.mark.integration
@pytest.mark.parametrize("name", ["sierra.toml", "sierra.lock", "pyproject.toml", "arena.xml", "figures/{batch}/.drawn"])
def test_corrupt_project_files_do_not_crash_commands(recorded: Path, tmp_path: Path, name: str) -> None:
    root = stores.copy(recorded, tmp_path / "project")
    file = root / name.format(batch=sierra.open(root).batches[-1].batch[:10])
    file.parent.mkdir(parents=True, exist_ok=True)
    for content in (b"\xff\xfe\n", b"[]"):
        file.write_bytes(content)
        for words in (("run", "population_size=1", "-n"), *([("figures",)] if ".drawn" in name else [])):
            done = projects.quick(root, *words)
            assert "fault in SIERRA" not in done.stderr, (words, done.stderr)

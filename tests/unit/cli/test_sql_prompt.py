"""The prompt of `sierra sql`, driven through a pseudo-terminal."""

from __future__ import annotations

import fcntl
import os
import pty
import select
import signal
import subprocess
import termios
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from sierra.cli.sql_prompt import is_complete
from tests.projects import SIERRA, make, quick, sierra
from tests.waiting import PATIENCE_S

LONG = "SELECT sum(a.range * b.range) FROM range(10000000) a, range(10000000) b;\n"
"""A statement that takes hours."""


@pytest.fixture(scope="module")
def answered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = make(tmp_path_factory.mktemp("prompt") / "project")
    assert quick(folder, "run", "population_size.Log2", "--no-figures").returncode == 0
    return folder


class Terminal:
    """A terminal in which `sierra sql` runs."""

    def __init__(self, folder: Path, home: Path) -> None:
        self._ours, theirs = pty.openpty()
        environment = {**os.environ, "HOME": str(home), "XDG_STATE_HOME": "", "TERM": "dumb", "INPUTRC": os.devnull}
        self.process = subprocess.Popen(
            [SIERRA, "sql"],
            cwd=folder,
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            env=environment,
            start_new_session=True,
            preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),  # so that Ctrl-C is a signal
        )
        os.close(theirs)
        self._unread = ""

    def until(self, text: str, press: str = "") -> str:
        """Return the output up to and including `text`; press the key `press` each second until then.

        (A signal that arrives between the prompt and the wait for a key is handled only after the next key.)
        """
        give_up = time.monotonic() + PATIENCE_S
        pressed = 0.0
        while text not in self._unread:
            assert time.monotonic() < give_up, self._unread
            if press and time.monotonic() - pressed > 1:
                pressed = time.monotonic()
                self.type(press)
            if select.select([self._ours], [], [], 0.1)[0]:
                self._unread += os.read(self._ours, 1 << 16).decode().replace("\r", "")
        said, _, self._unread = self._unread.partition(text)
        return said + text

    def type(self, text: str) -> None:
        os.write(self._ours, text.encode())

    def ended(self) -> int:
        return self.process.wait(PATIENCE_S)

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        os.close(self._ours)


@pytest.fixture
def open_terminal(answered: Path, tmp_path: Path) -> Iterator[Callable[[], Terminal]]:
    opened: list[Terminal] = []

    def open_terminal() -> Terminal:
        opened.append(Terminal(answered, tmp_path))
        opened[-1].until("sql> ")
        return opened[-1]

    yield open_terminal
    for terminal in opened:
        terminal.close()


@pytest.mark.parametrize(
    "word",
    ["exit", "\\q", "\x04", *(pytest.param(word, marks=pytest.mark.nightly) for word in ("quit", ".quit", ".exit", "EXIT;"))],
)
def test_prompt_ends_with_exit_words_and_ctrl_d(open_terminal: Callable[[], Terminal], word: str) -> None:
    terminal = open_terminal()
    terminal.type(word if word == "\x04" else word + "\n")
    assert terminal.ended() == 0


@pytest.mark.integration
def test_statements_span_lines_until_a_semicolon_and_errors_do_not_end_the_prompt(
    open_terminal: Callable[[], Terminal],
) -> None:
    terminal = open_terminal()
    terminal.type("SELECT 'a;\n")
    terminal.until("...> ")
    terminal.type("\n")
    terminal.until("...> ")
    terminal.type("b' AS t, count(*) + 40 AS n -- ;\n")
    terminal.until("...> ")
    terminal.type("FROM runs;\n")
    assert "44" in terminal.until("sql> ")
    terminal.type("SELECT nope;\n")
    assert "sierra: Binder Error" in terminal.until("sql> ")
    terminal.type("DROP TABLE runs;\n")
    assert "the store is read-only here" in terminal.until("sql> ")
    terminal.type(".tables\n")
    assert {"swarm", "runs", "executions"} <= set(terminal.until("sql> ").split())
    terminal.type(".help\n")
    assert "Ctrl-D" in terminal.until("sql> ")
    terminal.type(".nope\n")
    assert "unknown command .nope" in terminal.until("sql> ")
    assert terminal.process.poll() is None


@pytest.mark.integration
def test_ctrl_c_discards_the_line_or_stops_the_query_but_keeps_the_prompt(open_terminal: Callable[[], Terminal]) -> None:
    terminal = open_terminal()
    terminal.type("SELECT this is nothing\n")
    terminal.until("...> ")
    terminal.until("sql> ", press="\x03")
    terminal.type(LONG)
    time.sleep(1)
    terminal.until("sierra: ", press="\x03")
    terminal.until("sql> ")
    terminal.type("SELECT 41 + 1 AS n;\n")
    assert "42" in terminal.until("sql> ")


@pytest.mark.integration
@pytest.mark.parametrize("typed", [LONG, ""])
def test_sigterm_ends_the_prompt_with_exit_code_130(open_terminal: Callable[[], Terminal], typed: str) -> None:
    terminal = open_terminal()
    terminal.type(typed)
    time.sleep(1)
    give_up = time.monotonic() + PATIENCE_S
    while terminal.process.poll() is None and time.monotonic() < give_up:
        terminal.process.send_signal(signal.SIGTERM)
        time.sleep(0.5)
    assert terminal.ended() == 130


@pytest.mark.nightly
def test_history_is_saved_in_the_state_folder(open_terminal: Callable[[], Terminal], tmp_path: Path) -> None:
    pytest.importorskip("readline")
    terminal = open_terminal()
    terminal.type("SELECT 123 AS n;\n")
    terminal.until("sql> ")
    terminal.type("\x04")
    assert terminal.ended() == 0
    assert "SELECT 123 AS n;" in (tmp_path / ".local/state/sierra/sql_history").read_text()
    terminal = open_terminal()
    terminal.type("\x1b[A\n")  # the key that goes back in history
    assert "SELECT 123 AS n;" in terminal.until("sql> ")


def test_piped_statements_run_without_a_prompt_until_exit(answered: Path) -> None:
    ended = sierra(answered, "sql", stdin="SELECT 1\n\nAS a;\nexit\nSELECT 2 AS b;\n")
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "a\n1\n", "")


def test_unknown_batch_is_refused_before_any_statement_is_read(answered: Path) -> None:
    ended = sierra(answered, "sql", "-b", "00000000", stdin="SELECT 1;\n")
    assert (ended.returncode, ended.stdout, ended.stderr.count("\n")) == (2, "", 1)


@pytest.mark.parametrize(
    ("text", "complete"),
    [
        ("SELECT 1;", True),
        ("SELECT 1; -- it's done", True),
        ("SELECT 1; /* a;\nb */ ", True),
        ("SELECT 'it''s;';", True),
        ("SELECT 1", False),
        ("SELECT ';", False),
        ('SELECT "a;', False),
        ("SELECT 1 -- ;", False),
        ("SELECT 1 /* ;", False),
    ],
)
def test_semicolons_in_quotes_or_comments_do_not_end_a_statement(text: str, complete: bool) -> None:
    assert is_complete(text) is complete

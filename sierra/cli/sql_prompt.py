"""The prompt of `sierra sql`: statements over one or more lines, each ended by a semicolon, until the user leaves."""

from __future__ import annotations

import contextlib
import re
import signal
import sys
from collections.abc import Callable, Iterator

from sierra.errors import SierraError
from sierra.store.layout import user_state
from sierra.util.lazy_definitions import regex
from sierra.util.signals import raise_in_handler

WELCOME = "End each SQL statement with a semicolon. .help shows help; .quit, exit or Ctrl-D quits."
HELP = """\
SELECT …;       a statement may have several lines; Ctrl-C discards the typed lines, or stops the running statement
.tables         list the tables (DESCRIBE name; shows the columns of a table)
.help           show this help
.quit           quit; so do .exit, exit, quit, \\q and Ctrl-D"""
LEAVE = frozenset((".quit", ".exit", "quit", "exit", "\\q"))
TABLES = 'SELECT table_name AS "table" FROM information_schema.tables ORDER BY ALL'
HISTORY = "sql_history"
REMEMBERED = 1000
QUOTED = regex(r"""'(?:[^']|'')*'|"(?:[^"]|"")*"|--[^\n]*|/\*.*?\*/""", re.DOTALL)


def prompt(answer: Callable[[str], None]) -> None:
    """Read statements from standard input and pass each one to `answer`. Without a terminal, the first error ends the prompt.

    On a terminal, Ctrl-C discards the current line or stops the current statement; without one, it ends the prompt.
    """
    interactive = sys.stdin.isatty() and sys.stdout.isatty()
    with _history() if interactive else contextlib.nullcontext():
        if interactive:
            print(WELCOME)
        for text in _statements(interactive):
            try:
                _answer(answer, text)
            except SierraError as error:
                if not interactive:
                    raise
                print(f"sierra: {error}", file=sys.stderr)
            except KeyboardInterrupt:
                if not interactive:
                    raise
                print("sierra: stopped", file=sys.stderr)


def _answer(answer: Callable[[str], None], text: str) -> None:
    match text.lower():
        case ".help":
            print(HELP)
        case word if word.startswith(".") and word != ".tables":
            print(f"sierra: unknown command {text}; .help lists the commands", file=sys.stderr)
        case word:
            answer(TABLES if word == ".tables" else text)


def _statements(interactive: bool) -> Iterator[str]:
    """Yield statements, and commands like `.tables`, until the user leaves."""
    lines: list[str] = []
    while True:
        try:
            line = input(("sql> " if not lines else "...> ") if interactive else "")
        except EOFError:
            if interactive:
                print()
            if "".join(lines).strip(" ;\n"):
                yield "\n".join(lines)
            return
        except KeyboardInterrupt:
            if not interactive:
                raise
            print()
            lines = []
            continue
        word = line.strip().rstrip(";").rstrip()
        if not lines and word.lower() in LEAVE:
            return
        if not lines and word.startswith("."):
            yield word
        elif lines or word:
            lines.append(line)
            if is_complete("\n".join(lines)):
                yield "\n".join(lines)
                lines = []


def is_complete(text: str) -> bool:
    """Return whether the text ends with a semicolon outside quotes and comments."""
    bare = QUOTED.sub(" ", text)
    return bare.rstrip().endswith(";") and not any(mark in bare for mark in ("'", '"', "/*"))


@contextlib.contextmanager
def _history() -> Iterator[None]:
    """Provide earlier lines, if readline is available. Inside this context, SIGTERM ends the prompt, which Ctrl-C does not."""
    before = signal.signal(signal.SIGTERM, lambda *_: raise_in_handler(SystemExit(130)))
    try:
        import readline
    except ImportError:
        yield
        return
    file = user_state() / HISTORY
    with contextlib.suppress(OSError):
        readline.read_history_file(file)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
        with contextlib.suppress(OSError):
            file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            readline.set_history_length(REMEMBERED)
            readline.write_history_file(file)

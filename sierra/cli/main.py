"""The program `sierra`: runs a command, and turns errors into one line and an exit code."""

from __future__ import annotations

import atexit
import gc
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn, Protocol, runtime_checkable

from sierra.cli.output import guarded
from sierra.errors import SierraError
from sierra.util import open_files, signals
from sierra.util.shortage import shortage

INTERRUPTED = 130
ERRORS = 20
"""The largest number of errors of one file that are printed."""
YOUNG = 200_000
"""The number of new objects after which Python looks for unreachable ones.

By default, it looks dozens of times while modules load, and finds nothing. Short commands make fewer objects.
"""


def program() -> NoReturn:
    """Run the program `sierra` and end this process without freeing its memory, which takes a tenth of most commands' time."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:  # it was closed; no other file may get its number
            setattr(sys, name, Path(os.devnull).open(mode))  # noqa: SIM115 - it stays open
    try:
        main()
    except SystemExit as ended:
        atexit._run_exitfuncs()
        try:
            sys.stdout.flush()
            sys.stderr.flush()
        except OSError:
            raise ended from None  # Python reports it
        os._exit(ended.code if isinstance(ended.code, int) else 0)


def main() -> NoReturn:
    """Execute a command, and raise SystemExit with a code of `sierra.errors`; users never see a traceback."""
    gc.set_threshold(YOUNG, 20, 20)
    open_files.raise_limit()
    with guarded():
        code = _ended()
    if code == INTERRUPTED:
        signals.ignore()
    sys.exit(code if isinstance(code, int) else 0)


def _ended() -> object:
    """Execute the command; return the exit code."""
    code: object
    said = ""
    _damage()
    try:
        signals.handle()
        from sierra.cli.app import app  # only now, because `main` has set how Python looks for unreachable objects

        code = app(standalone_mode=False, prog_name="sierra")
    except SierraError as error:
        said = str(error)
        code = _say(said, error.exit_code)
        _say_more(getattr(error, "__notes__", ()))
    except KeyboardInterrupt:
        code = _say("interrupted", INTERRUPTED)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    except Exception as error:
        code = _other(error)
    return _with_damage(code, said)


def _with_damage(code: object, said: str) -> object:
    """Return the exit code; report damaged files of the store that no message named, as a failure."""
    damage = _damage()
    if damage and damage[0] not in said:
        return _say(damage[0], code if isinstance(code, int) and code else 1)
    return code


def _damage() -> list[str]:
    """Return the messages about damaged files since the last call."""
    verified = sys.modules.get("sierra.store.verified_files")  # commands that read no store do not import it
    messages: list[str] = list(verified.damage) if verified else []
    if verified:
        verified.damage.clear()
    return messages


def _other(error: Exception) -> int:
    """Report an error that typer raised by itself, or an unexpected one; return the exit code."""
    if isinstance(error, WrongArguments):
        return _usage(error)
    if type(error).__name__ == "Abort":
        return _say("interrupted", INTERRUPTED)
    lack = shortage(error)
    if isinstance(error, OSError) or lack is not None:
        where = f"{error.filename}: " if isinstance(error, OSError) and error.filename else ""
        return _say(f"{where}{lack or getattr(error, 'strerror', None) or error}", 3)
    return _unforeseen(error)


@runtime_checkable
class WrongArguments(Protocol):
    """Typer's error about arguments; `ctx` has the command, if it is known."""

    exit_code: int

    def format_message(self) -> str: ...

    def show(self) -> None: ...


def _usage(error: WrongArguments) -> int:
    """Report typer's error about arguments in one line, or print the help if no command was given; return the exit code."""
    if type(error).__name__ == "NoArgsIsHelpError":
        error.show()
        return error.exit_code
    context = getattr(error, "ctx", None)
    command = context.command_path if context else "sierra"
    message = error.format_message().rstrip(".").replace("Value error, ", "").replace("Input should", "should")
    return _say(f"{message[:1].lower()}{message[1:]}; see {command} --help", error.exit_code)


def _unforeseen(error: Exception) -> int:
    if os.environ.get("SIERRA_DEBUG"):
        raise error
    from sierra.config.plugin_registry import culprit

    theirs = culprit(error)
    message = f"a fault in {theirs or 'SIERRA itself'}: {type(error).__name__}: {error}"
    request = "please report it to its authors" if theirs else "please report it"
    try:
        return _say(f"{message}; {request} with {_report(error)}", 1)
    except OSError:
        return _say(f"{message}; {request} (SIERRA_DEBUG=1 shows the traceback)", 1)


def _report(error: Exception) -> str:
    """Write the traceback of an unexpected error to a file; return its path. Raises OSError."""
    import tempfile
    import traceback

    from sierra.store.layout import user_state

    folder = user_state()
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile("w", prefix="fault-", suffix=".txt", dir=folder, delete=False) as file:
        traceback.print_exception(error, file=file)
    return file.name


def _say_more(errors: Sequence[str]) -> None:
    """Print the other errors of a file, so that all can be corrected at once."""
    for text in errors[: ERRORS - 1]:
        _say(text, 0)
    if len(errors) >= ERRORS:
        _say(f"… and {len(errors) - ERRORS + 1} more", 0)


def _say(message: str, code: int) -> int:
    print("sierra: " + " ".join(message.split("\n")), file=sys.stderr)
    return code

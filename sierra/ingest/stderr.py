"""Standard error of runs: the error message with which it ends, and what a run must not print there.

Some programs print a traceback and end with status 0. A message counts only at the end of standard error: the program has
survived an error in the middle. Progress, warnings and numbers are no errors. If standard error is empty, tracebacks and
crashes at the end of standard output count, because a command may send both streams there.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from sierra.store.endings import Kind
from sierra.store.layout import RUN_STDERR, RUN_STDOUT
from sierra.util.kept_log import kept_of
from sierra.util.lazy_definitions import regex
from sierra.util.text import one_line

READ = 1 << 16
"""The number of bytes that are read of a log, most of them from its end."""
SHOWN = 200
"""The number of characters of a line that are shown."""
EMPTY = "empty"
"""The rule that nothing is printed."""
LONGEST_LINE = 4096
LONGEST_MESSAGE = 5
"""The number of lines that may follow the first line of an exception's message."""

ESCAPES = regex(rb"\x1b(?:\[[0-?]*[ -/]*[@-~]|\][^\x07\x1b]*(?:\x07|\x1b\\)|[@-Z\\-_])")
"""Sequences that steer a terminal, such as those for colours and titles (ECMA-48)."""
OF_CONDUCTOR = regex(r"== (?:before|after): |\[(?!info\]|warn|debug|error|fatal|crit|trace)[a-z][\w.-]*\] ")
"""Lines of services, and those before the output of other commands (see `sierra.worker.conductor`)."""
OF_ROBOT = regex(r"==> .* <==")
"""The line before the log of a robot (see `sierra.extensions.robots.results`)."""
PREFIX = regex(r"(?:\[[\d:.,TZ+/ -]*(?:ms)?\]|\d[\d:.,TZ+/-]*|\[(?=[A-Za-z]+\]))[ :]*")
"""A time, or the bracket of a level, before a message."""
LEVEL = regex(r"\[?(?:info|debug|warn(?:ing)?|trace|notice)\b", re.I)
ERROR = regex(
    r"(?:fatal error|fatal|error|critical|panic|aborted|exception|failure)(?:\]|:|!| \(| on proc\b|"
    r" (?:in|at|on|while|when|during|reading|opening|loading|parsing|writing|using|code|from)\b)",
    re.I,
)
UPPER = regex(r"(?:FATAL|ERROR|CRITICAL|PANIC)\b")
EXCEPTION = regex(r"(?:[\w$]+[.:]+)*[\w$]*(?:Error|Exception|Failure|Interrupt|Exit)(?::|$)")
CRASH = regex(
    r"terminate called |.*\b(?:Segmentation fault|Bus error|Floating point exception|Illegal instruction|core dumped)|"
    r"Aborted(?: \(core dumped\))?$|Execution halted$|.* panicked at "
)
NUMBER = regex(
    r"[\s:=\])(!]*(?:[-+]?(?:\d[\d.e+-]*|nan|inf)\s*(?:[%,;|/(]|[a-z]{0,3}$)|none$)|[\s\w()=.-]*[:=]\s*[-+]?\d[\d.e+-]*\s*%?$",
    re.I,
)
"""The rest of a line that reports a number, such as `error: 0.001` or `ERROR RATE: 0.1`."""
TRAILER = regex(r"Last command: |Quitting \(on error\)|in expression starting at |exit status \d+$")
"""Lines with which LAMMPS, SUMO, Julia and Go end after an error message."""
TRACEBACK = "Traceback (most recent call last):"
IGNORED = "Exception ignored in"


def error_at_end(directory: str) -> tuple[Kind, str] | None:
    """Return the line with the error with which what a run has printed ends, and where that is; None if there is none.

    `directory` is the run's folder. At most 64 KiB of its logs are read.
    """
    kind, content = Kind.ERROR, kept_of(f"{directory}/{RUN_STDERR}", READ)[0]
    if not any(_lines(content)):
        kind, content = Kind.ERROR_ON_STDOUT, kept_of(f"{directory}/{RUN_STDOUT}", READ)[0]
    error = error_line(content, words=kind is Kind.ERROR)
    return None if error is None else (kind, error)


def error_line(content: bytes, *, words: bool = True) -> str | None:
    """Return the error with which a log ends, in one line; `words`: a line that begins with an error word is one, too."""
    for lines in map(_without_ignored, _of_programs(list(_lines(content)))):
        found = _crash(lines) or _traceback(lines) or (_word(lines) if words else None)
        if found is not None:
            shown = one_line(found)
            return shown if len(shown) <= SHOWN else shown[: SHOWN - 1] + "…"
    return None


def against(rule: str, directory: str) -> str | None:
    """Return why a run fails by the rule `stderr` of `[success]`, with the line that it printed; None if it does not fail."""
    if not rule:
        return None
    pattern = None if rule == EMPTY else re.compile(rule)
    try:
        with Path(directory, RUN_STDERR).open("rb") as file:
            for line in file:
                plain = ESCAPES.sub(b"", line).rstrip(b"\r\n").decode("utf-8", "replace")
                if pattern.search(plain) if pattern else plain.strip() and not _is_title(plain):
                    shown = one_line(plain.rpartition("\r")[2])[:SHOWN]
                    rather = "should be empty" if pattern is None else f"must not have {rule!r}"
                    return f"standard error {rather}: {shown}"
    except FileNotFoundError:
        pass  # a missing log is an empty log
    return None


def _is_title(line: str) -> bool:
    return line.startswith(("== before: ", "== after: "))


def _lines(content: bytes) -> Iterator[str]:
    """Yield the lines of a log that are not blank, as a terminal would show them, without those that SIERRA adds."""
    for line in ESCAPES.sub(b"", content).decode("utf-8", "replace").split("\n"):
        shown = line.rstrip("\r").rpartition("\r")[2].rstrip()
        if shown.strip() and not OF_CONDUCTOR.match(shown):
            yield shown[:LONGEST_LINE]


def _of_programs(lines: Sequence[str]) -> Iterator[Sequence[str]]:
    """Yield the lines of each program: those of each robot are below a title."""
    starts = [place for place, line in enumerate(lines) if OF_ROBOT.fullmatch(line)]
    for start, end in zip([0, *starts], [*starts, len(lines)], strict=True):
        yield [line for line in lines[start:end] if not OF_ROBOT.fullmatch(line)]


def _without_ignored(lines: Sequence[str]) -> Sequence[str]:
    """Return the lines before exceptions that Python has ignored at the end, as it does while it shuts down."""
    while (ignored := max((place for place, line in enumerate(lines) if line.startswith(IGNORED)), default=None)) is not None:
        more = [line for line in lines[ignored + 1 :] if not line[:1].isspace() and line != TRACEBACK]
        if len(more) > 1:
            break
        lines = lines[:ignored]
    return lines


def _traceback(lines: Sequence[str]) -> str | None:
    """Return the exception of a traceback at the end."""
    places = [index for index, line in enumerate(lines) if line.strip() == TRACEBACK]
    if not places:
        return None
    inner = len(lines[places[-1]]) - len(lines[places[-1]].lstrip())
    after = lines[places[-1] + 1 :]
    ends = [index for index, line in enumerate(after) if not line[inner : inner + 1].isspace()]
    if not ends:
        return None
    message = after[ends[0] :]
    if len(message) > 1 + LONGEST_MESSAGE or any(_is_log(line) for line in message[1:]):
        return None
    return message[0].strip()


def _is_log(line: str) -> bool:
    """Return whether a line belongs to a log that goes on, and not to a message."""
    return bool(LEVEL.match(PREFIX.sub("", line, count=1)) or re.match(r"\[|\d{2,4}[-/:]\d\d[-/:]", line))


def _crash(lines: Sequence[str]) -> str | None:
    """Return the line by which a run-time system or a shell reports a crash at the end."""
    return next((line.strip() for line in lines[-3:] if CRASH.match(line)), None)


def _word(lines: Sequence[str]) -> str | None:
    """Return the last line if it begins with an error word. Indented lines below it, such as those of a stack, belong to it."""
    belongs = (line[:1].isspace() or TRAILER.match(line) for line in reversed(lines))
    end = next((len(lines) - 1 - index for index, more in enumerate(belongs) if not more), None)
    if end is None:
        return None
    line = message = lines[end]
    while (prefix := PREFIX.match(message)) and prefix.end():
        message = message[prefix.end() :]
    for pattern in (ERROR, UPPER, EXCEPTION):
        if (match := pattern.match(message)) and not NUMBER.match(message[match.end() :]):
            return line.strip()
    return None

"""The success of an execution, as far as it is known immediately after its end."""

from __future__ import annotations

import signal
from collections.abc import Mapping
from pathlib import Path

from sierra.config.output_tables import Output, Success
from sierra.ingest import astray, robot_files, stderr
from sierra.ingest.match_outputs import claimed_twice
from sierra.model import Result, Status
from sierra.store.layout import RUN_OUTPUT, RUN_STDERR, RUN_STDOUT
from sierra.util.lazy_definitions import dataclass

STOPPED = {
    Status.TIMEOUT: "ran longer than its limit ([limits] wall)",
    Status.MEMORY: "took more memory than its limit ([limits] memory)",
    Status.CPU: "took more CPU time than its limit ([limits] cpu)",
    Status.OUTPUT: "wrote more bytes than its limit ([limits] output; standard output and error: 256 MiB each)",
    Status.STOPPED: "was stopped by the operator",
    Status.INTERRUPTED: "was interrupted",
}
AFTER_MARKER = "; its marker was met: with a short after_marker in [limits], such runs are ended and count"


@dataclass(frozen=True, slots=True)
class Judgement:
    """An execution with its preliminary or final status."""

    result: Result
    status: Status
    reason: str | None
    """The reason why it is not successful; of an accepted end, this end."""


def judge(result: Result, outputs: Mapping[str, Output], success: Success) -> tuple[Status, str | None]:
    """Return the status of an execution by what is known immediately, and the reason if it is not successful."""
    if result.error is not None and result.stopped != Status.INTERRUPTED:
        return Status.FAILED, result.error
    if result.stopped is not None:
        met = success.marker and result.stopped == Status.TIMEOUT and _marked(result, success)[0] is Status.OK
        return Status(result.stopped), STOPPED[Status(result.stopped)] + (AFTER_MARKER if met else "")
    if (end := _accepted(result, success)) is not None:
        wrong = _left_running(result, success) or astray.failure(result, outputs) or claimed_twice(result, outputs)
        return (Status.FAILED, wrong) if wrong else (Status.ACCEPTED, end)
    if result.after_marker is None and (reason := _bad_end(result, success)) is not None:
        return Status.FAILED, reason
    paths = [file.path for file in result.outputs]
    for name, output in outputs.items():
        if output.required and (robot := robot_files.lacking(output, paths, result.robots)) is not None:
            return Status.FAILED, f"{robot_files.named(robot, result.robots)} did not write {robot_files.own(output)!r}"
        if output.required and not any(map(output.matches, paths)):
            return Status.FAILED, astray.lacking(name, output, result.elsewhere, paths)
    if (reason := astray.failure(result, outputs) or claimed_twice(result, outputs)) is not None:
        return Status.FAILED, reason
    status, reason = _marked(result, success)
    if status is Status.OK and (printed := stderr.against(success.stderr, result.directory)) is not None:
        return Status.FAILED, printed
    return status, reason


def _accepted(result: Result, success: Success) -> str | None:
    """Return the end of a program if it is no success, but a result; None otherwise."""
    if not success.accept or result.after_marker is not None:
        return None
    return success.accepted(result.exit_code if result.signal is None else -result.signal)


def _bad_end(result: Result, success: Success) -> str | None:
    """Return why the end of a program means a failure; None if it does not."""
    if result.signal is not None:
        if -result.signal in success.statuses:
            return _left_running(result, success)
        return f"ended by signal {result.signal} ({_signal_name(result.signal)})"
    return f"exit status {result.exit_code}" if result.exit_code not in success.statuses else _left_running(result, success)


def _left_running(result: Result, success: Success) -> str | None:
    if success.leftovers == "end" or not result.left_running:
        return None
    return f"processes were still running when the command ended: {', '.join(result.left_running)}"


def _marked(result: Result, success: Success) -> tuple[Status, str | None]:
    if not success.marker:
        return Status.OK, None
    log = success.marker in (RUN_STDOUT, RUN_STDERR)
    for path in (success.marker,) if log else robot_files.markers(success.marker, result):
        marker = Path(result.directory, "" if log else RUN_OUTPUT, path)
        there = not marker.is_symlink() and marker.is_file()
        if not there and not log:  # a missing log is an empty log
            return Status.FAILED, f"did not write its marker {path!r}"
        if success.contains and not (there and success.contains.encode() in marker.read_bytes()):
            return Status.FAILED, f"its marker {path!r} does not contain {success.contains!r}"
    return Status.OK, None


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return "unknown"

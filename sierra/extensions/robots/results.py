"""The result of a run on robots, from what the robots have reported and left: one folder, and rows of `robots`.

The logs of all robots become one file each: every robot gets its share of what is kept, however much others print. The part
of a robot whose program has failed comes last, because the end of a log is shown with the reason of a failure.

Also: one record of the files that the programs of a run used on all of its robots, from the records of their workers.

The name of a file begins with the robot's: `{robot tb1}/usr/bin/python3`. Files of the project keep their names, because all
robots have the same.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import shutil
import signal
from collections.abc import Iterable, Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, Field

from sierra.extensions.hosts.clock import Clock
from sierra.extensions.robots import clock_changes
from sierra.extensions.robots.agent_messages import Text
from sierra.extensions.robots.trial import OVER, STOPPED, Part, Trial
from sierra.model import IN_PROJECT
from sierra.store.layout import RUN_OUTPUT
from sierra.util.json_types import RecordValue
from sierra.util.kept_log import KEPT, kept_of, shares
from sierra.util.lazy_definitions import dataclass
from sierra.util.regular_files import read_regular
from sierra.worker import remote_folder
from sierra.worker.job import Job
from sierra.worker.journal import End, OutputFile
from sierra.worker.layout import LOGS, OBSERVED
from sierra.worker.outputs import MOST_NAMED, describe, described, list_files

MOST_OBSERVED_BYTES = 64 << 20
Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
Name = Annotated[str, AfterValidator(lambda name: remote_folder.text(remote_folder.raw(name)))]
"""The name of a file, which may have bytes that are no text."""
Use = Literal["executed", "read", "found", "missed", "listed", "linked", "link"]


class _Observed(BaseModel):
    """The parts of a worker's record that count: see `sierra.worker.observed_record.as_record`."""

    method: Text
    reason: Text | None
    notes: list[Text]
    distributions: list[Text]
    files: list[tuple[Name, Use, Sha256 | None, Annotated[int, Field(ge=0, lt=1 << 63)] | None]]


def merge_observed(parts: Iterable[Part], folder: Path) -> bool:
    """Write the record of a run to its folder; return whether there is one. Call it before the files of parts are moved."""
    records = {part.name: _observed_by(part) for part in parts if part.started}
    known = {name: own for name, own in records.items() if own is not None}
    if not known:
        return False
    missing = [f"{name} was not observed" for name in records.keys() - known.keys()]
    reasons = [*dict.fromkeys(own.reason for own in known.values() if own.reason), *sorted(missing)]
    record = {
        "method": next(iter(known.values())).method,
        "reason": "; ".join(reasons) or None,
        "notes": [f"{name}: {note}" for name, own in known.items() for note in own.notes],
        "distributions": list(dict.fromkeys(line for own in known.values() for line in own.distributions)),
        "files": sorted({file for name, own in known.items() for file in _named_files(name, own)}, key=lambda file: file[:2]),
        "written": [],
    }
    (folder / OBSERVED).write_text(json.dumps(record), encoding="ascii")
    return True


def _observed_by(part: Part) -> _Observed | None:
    """Return the record of one robot; None if there is none, or if it is not what a worker writes."""
    if part.files is None or part.end is None or not part.end.get("observed"):
        return None
    path = part.files / OBSERVED
    with contextlib.suppress(OSError, ValueError, RecursionError):
        if not path.is_symlink() and path.stat().st_size <= MOST_OBSERVED_BYTES:
            return _Observed.model_validate(json.loads(read_regular(path)))  # pydantic's own JSON has no bytes that are no text
    return None


def _named_files(robot: str, one: _Observed) -> Iterator[tuple[str, str, str | None, int | None]]:
    for path, use, sha256, size in one.files:
        yield path if path.startswith(IN_PROJECT) else f"{{robot {robot}}}{path}", use, sha256, size


INTERRUPTED = "interrupted"
LATE_S = 1.0
"""The seconds that a program may begin after the common start before it is noted."""
SPARE = 64
"""Bytes for the line that says how much of a log is left out."""


@dataclass(frozen=True, slots=True)
class Times:
    """The beginning and the end of a part, by this host's clock, in seconds since the epoch."""

    began: float
    ended: float


def result(trial: Trial, job: Job, folder: Path) -> End:
    """Return the result of a trial whose files are in `folder`/PLACE, and are moved to one folder of a run there.

    The outputs of each robot are in `output`/PLACE. `stdout` and `stderr` have those of all robots: see `join_logs`.
    A run that the user has ended may have an error, too: if a person's stop is its planned end, it has failed nevertheless.
    """
    started = [part for part in trial.parts if part.started]
    ends = [part.end for part in started if part.end is not None]
    error = failure(trial)
    observed = merge_observed(trial.parts, folder)
    outputs, left_out = _moved(trial.parts, folder)
    known = [times for part in started if (times := times_of(part))]
    at = trial.at_ns / 1e9
    limits = (end["stopped"] for end in ends if end["stopped"] not in (None, INTERRUPTED))
    stopped = INTERRUPTED if trial.stopped == STOPPED else next(limits, None)
    bad = _first_failed(started) if trial.stopped != OVER else None
    whole = bool(ends) and len(ends) == len(trial.parts)
    record: End = {
        "event": "end",
        "run": job["run"],
        "execution": job["execution"],
        "directory": str(folder),
        "started": min((times.began for times in known), default=at),
        "ended": max((times.ended for times in known), default=at),
        "exit_code": bad["exit_code"] if bad else 0 if whole else None,
        "signal": bad["signal"] if bad else None,
        "user_s": _sum(end["user_s"] for end in ends) if whole else None,
        "system_s": _sum(end["system_s"] for end in ends) if whole else None,
        "max_rss_bytes": max((end["max_rss_bytes"] or 0 for end in ends), default=None) if whole else None,
        "host": ",".join(part.name for part in trial.parts),
        "slot": 0,
        "stopped": stopped,
        "outputs": outputs,
        "error": error if stopped in (None, INTERRUPTED) else None,
    }
    if observed:
        record["observed"] = True
    if left_out:
        record["left_out"] = left_out[:MOST_NAMED]
    if left := list(dict.fromkeys(name for end in ends for name in end.get("left_running", ()))):
        record["left_running"] = left[:MOST_NAMED]
    if ports := [port for end in ends for port in end.get("ports", ())]:
        record["ports"] = ports
    if after := [seconds for end in ends if (seconds := end.get("after_marker")) is not None]:
        record["after_marker"] = max(after)
    return record


def _first_failed(parts: Iterable[Part]) -> End | None:
    """Return the end of the program that has failed; that of one that was only stopped if none has."""
    ends = [(part.failure is None, part.place, end) for part in parts if (end := part.end) is not None]
    bad = [one for one in ends if one[2]["exit_code"] or one[2]["signal"] is not None]
    return min(bad, key=lambda one: one[:2])[2] if bad else None


def failure(trial: Trial) -> str | None:
    """Return what happened to which robot, in one line; None if the run has ended well on all of them."""
    troubles = [f"{part.name} {text}" for part in trial.parts if (text := _trouble(part, trial))]
    if own := clock_changes.failure_here(trial.course, trial.table.clock_drift):
        troubles.append(f"this machine {own}")
    if not troubles and trial.stopped not in (None, OVER, STOPPED):
        troubles = [str(trial.stopped)]
    elif troubles and trial.stopped not in (None, OVER, STOPPED) and len(trial.parts) > 1:
        troubles.append("the others were stopped")
    troubles += [f"{part.name} {text}" for part in trial.parts if (text := _cut(part, trial))]
    return "; ".join(troubles) or None


def _trouble(part: Part, trial: Trial) -> str | None:
    """Return what went wrong with one robot; None if nothing did, or if it was only told to stop."""
    if part.lost is not None:
        return f"was lost: {part.lost}" + ("" if part.files else "; its outputs are missing")
    if part.failure:
        return f"has failed: {part.failure}"
    if not part.started or part.end is None:
        report = part.ended or {}
        return f"has not begun its program: {(*report.get('problems', ()), report.get('why') or part.problem)[0]}"
    if part.moving:
        return f"may be moving: {part.moving}"
    if part.ended and part.ended["why"] and part.ended["why"].startswith("lost the driver"):
        return f"{part.ended['why']}"
    if part.problem and part.files is None:
        return f"has kept its outputs: {part.problem}"
    return _changed(part) or clock_changes.failure(part, trial.course, trial.table.clock_drift)


def _cut(part: Part, trial: Trial) -> str | None:
    """Return that a program was killed when it did not end as it was told to; None if it was not."""
    end = part.end
    if end is None or not (part.ended or {}).get("why") or end["signal"] != signal.SIGKILL:
        return None
    return f"was killed {trial.table.grace:g} s after the stop, so that its files may be cut; raise grace in [runners.robots]"


def _changed(part: Part) -> str | None:
    """Return that files differ from those that the robot's worker has hashed; None if they do not."""
    end = part.end
    if end is None or part.files is None:
        return None
    there = {name: path for path, name in list_files(str(part.files / RUN_OUTPUT))[0]}
    for file in end["outputs"]:
        name = file["path"]
        if name not in there or describe(there[name], name)["sha256"] != file["sha256"]:
            return f"has changed {name!r} after its end"
    return None


def _moved(parts: Iterable[Part], folder: Path) -> tuple[list[OutputFile], list[str]]:
    """Move the outputs and logs of all parts to one folder; return the outputs, and the entries that are no files."""
    output = folder / RUN_OUTPUT
    output.mkdir(parents=True)
    several = [part for part in parts if part.files is not None]
    join_logs(several, folder)
    for part in several:
        source = Path(str(part.files), RUN_OUTPUT)
        if source.is_dir():
            source.rename(output / str(part.place))
        shutil.rmtree(str(part.files), ignore_errors=True)
    files, others = list_files(str(output))
    reported = itertools.chain.from_iterable(
        (f"{part.place}/{name}" for name in part.end.get("left_out", ())) for part in several if part.end
    )
    return list(described(files, lambda: None)), [*others, *reported]


def times_of(part: Part) -> Times | None:
    """Return when a part began and ended; None if it is unknown."""
    end = part.end
    if end is None or part.clock is None:
        return None
    offset = part.clock.offset_ns / 1e9
    return Times(end["started"] - offset, end["ended"] - offset)


def rows(trial: Trial, job: Job) -> Iterator[tuple[str, Mapping[str, RecordValue]]]:
    """Yield the rows of `robots` of a trial."""
    for part in trial.parts:
        facts = part.hello.get("facts", {})
        end, times = part.end, times_of(part)
        yield (
            "robots",
            {
                "execution": job["execution"],
                "place": part.place,
                "robot_group": part.group,
                "robot": part.name,
                "status": _status(part),
                "reason": _remarks(part, trial),
                "host": facts.get("host"),
                "machine": facts.get("machine"),
                "processor": facts.get("cpu"),
                "kernel": facts.get("kernel"),
                "boot_id": part.hello.get("boot"),
                "environment": part.hello.get("environment"),
                "firmware": part.before.get("firmware"),
                "calibration_sha256": part.before.get("calibration"),
                "battery_start": part.before.get("battery"),
                "battery_end": part.after.get("battery"),
                "offset_start_ns": part.clock.offset_ns if part.clock else None,
                "offset_end_ns": part.clock_after.offset_ns if part.clock_after else None,
                "clock_start_ns": part.clock.at_ns if part.clock else None,
                "clock_end_ns": part.clock_after.at_ns if part.clock_after else None,
                "rtt_ns": _slower(part.clock, part.clock_after),
                "clock_remark": _clock(part, trial),
                "start_skew_ns": _skew_ns(times, trial),
                "started": datetime.fromtimestamp(times.began, UTC) if times else None,
                "ended": datetime.fromtimestamp(times.ended, UTC) if times else None,
                "exit_code": end["exit_code"] if end else None,
                "signal": end["signal"] if end else None,
                "isolation": part.hello.get("isolation"),
                "uneven_ns": clock_changes.error_ns(part, trial.course),
            },
        )


def _status(part: Part) -> str:
    if part.lost is not None:
        return "lost"
    why = part.ended["why"] or "" if part.ended else ""
    if part.failure or part.moving or not part.started or why.startswith("lost"):
        return "failed"
    return "stopped" if why else "ok"


def _remarks(part: Part, trial: Trial) -> str | None:
    """Return everything that is worth knowing about how a part ended."""
    ended = part.ended or {}
    why = [ended["why"]] if ended.get("why") else []
    failed = [text for text in (part.lost, part.failure, part.problem) if text]
    more = [text for text in (_cut(part, trial), _late(part, trial), _clock(part, trial)) if text]
    return "; ".join(dict.fromkeys((*failed, *why, *ended.get("problems", ()), *more))) or None


def _clock(part: Part, trial: Trial) -> str | None:
    """Return why stamps of a robot cannot be converted; None if they can."""
    return clock_changes.remark(part, trial.course, trial.table.clock_error)


def _late(part: Part, trial: Trial) -> str | None:
    """Return how late a program has begun, or may have begun because its container was not started before; None if in time."""
    delay = part.end.get("delay_s") if part.end else None
    if delay is not None:
        return f"its program began up to {delay:.2f} s after the common start, with its container"
    skew = (_skew_ns(times_of(part), trial) or 0) / 1e9
    return f"its program began {skew:.1f} s after the common start" if skew > LATE_S else None


def _skew_ns(times: Times | None, trial: Trial) -> int | None:
    """Return by how much a part began after the common start."""
    return round((times.began - trial.at_ns / 1e9) * 1e9) if times else None


def notes(trial: Trial) -> Iterator[str]:
    """Yield what the user must know, whether the run has succeeded or not."""
    moved: dict[str, list[str]] = {}
    for part in trial.parts:
        ended = part.ended or {}
        for problem in ended.get("problems", ()):
            yield f"{part.name}: {problem}"
        if late := _late(part, trial):
            yield f"{part.name}: {late}"
        if clock := _clock(part, trial):
            moved.setdefault(clock, []).append(part.name)
    for clock, names in moved.items():  # that of this machine concerns all robots
        yield f"{', '.join(names)}: {clock}, so that stamps cannot be converted to one time axis"


def _slower(*clocks: Clock | None) -> int | None:
    return max((one.rtt_ns for one in clocks if one), default=None)


def _sum(values: Iterable[float | None]) -> float | None:
    known = list(values)
    return None if None in known else sum(value or 0.0 for value in known)


def join_logs(parts: Iterable[Part], folder: Path) -> None:
    """Write `stdout` and `stderr` of all parts whose files were pulled into a folder, each part below the robot's name."""
    pulled = sorted((part for part in parts if part.files is not None), key=lambda part: part.failure is not None)
    for name in LOGS:
        logs = [(f"==> {part.name} <==\n".encode(), str(part.files / name)) for part in pulled if part.files]
        (folder / name).write_bytes(b"".join(_joined(logs)))


def _joined(logs: Iterable[tuple[bytes, str]]) -> Iterator[bytes]:
    """Yield the parts of a joint log, from titles and paths."""
    filled = [(title, path, size) for title, path in logs if (size := kept_of(path, 0)[1])]
    room = KEPT - sum(len(title) + SPARE for title, _, _ in filled)
    for (title, path, _), share in zip(filled, shares([size for _, _, size in filled], room), strict=True):
        kept = kept_of(path, share)[0]
        yield title + kept + (b"" if kept.endswith(b"\n") else b"\n")

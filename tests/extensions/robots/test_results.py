"""Tests of the result of a run on robots, from what these have reported and left."""

from __future__ import annotations

import json
import queue
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from sierra.config.output_tables import Success
from sierra.extensions.hosts.clock import Clock
from sierra.extensions.robots import results
from sierra.extensions.robots.agent_link import AgentLink
from sierra.extensions.robots.fleet_table import FleetTable
from sierra.extensions.robots.runner import member_limits
from sierra.extensions.robots.trial import STOPPED, Part, Trial
from sierra.ingest.observations import observed
from sierra.ingest.success import judge
from sierra.model import Limits, Status
from sierra.runners.journal_reader import result_of
from sierra.worker.layout import LOGS, OBSERVED
from sierra.worker.outputs import describe
from tests.support.local_link import LocalLink

JOB: Any = {"run": "ab" * 32, "execution": "cd" * 32}
END = {
    **JOB,
    "started": 100.0,
    "ended": 110.0,
    "exit_code": 0,
    "signal": None,
    "stopped": "interrupted",
    "error": None,
    "outputs": [],
    "user_s": 1.0,
    "system_s": 1.0,
    "max_rss_bytes": 1,
}


def trial_of(folder: Path) -> Trial:
    """Return a trial of two robots that was ended by a person, and whose files were pulled."""
    parts = []
    for place, name in enumerate(("ada", "bob"), 1):
        (folder / str(place) / "output").mkdir(parents=True)
        for log in LOGS:
            (folder / str(place) / log).touch()
        agent = AgentLink(name, LocalLink(name, folder / "home"), 1.0, queue.SimpleQueue())
        ended = {"started": True, "why": STOPPED, "end": dict(END), "problems": []}
        clock = Clock(0, 1000, 0)
        parts.append(Part(place, "robot", agent, {}, JOB, clock=clock, started=True, ended=ended, files=folder / str(place)))
    table = FleetTable(fleet={"ada": {"host": "ada"}, "bob": {"host": "bob"}}, stop=[])
    trial = Trial(
        "1", parts, table, queue.SimpleQueue(), stopping=lambda: None, notice=lambda text: None, may_begin=lambda: True
    )
    trial.stopped, trial.at_ns = STOPPED, round(END["started"] * 1e9)
    return trial


def test_a_run_that_a_person_ends_is_only_interrupted(tmp_path: Path):
    end = results.result(trial_of(tmp_path), JOB, tmp_path)
    assert (end["stopped"], end["error"]) == ("interrupted", None)


def test_remarks_on_the_ends_of_all_robots_are_those_of_the_run(tmp_path: Path):
    trial = trial_of(tmp_path)
    for part, left, seconds in zip(trial.parts, (["rosmaster"], ["rosmaster", "gzserver"]), (0.5, 2.0), strict=True):
        assert part.ended
        part.ended["end"] |= {"left_running": left, "after_marker": seconds}
    result = result_of(results.result(trial, JOB, tmp_path))
    assert (result.left_running, result.after_marker) == (("rosmaster", "gzserver"), 2.0)


def test_the_marker_of_another_place_ends_no_program():
    limits = Limits(after_marker_s=1.0, marker="2/done.json")
    assert [member_limits(limits, place).marker for place in (1, 2)] == [None, "done.json"]
    assert member_limits(limits, 1) == Limits()
    assert member_limits(replace(limits, marker="stdout"), 1).marker == "stdout"


def test_a_robot_that_is_gone_after_its_files_were_copied_is_only_remarked(tmp_path: Path):
    trial = trial_of(tmp_path)
    trial.stopped, trial.parts[1].problem = None, "no answer for 10 s"
    assert results.result(trial, JOB, tmp_path)["error"] is None
    rows = {row["robot"]: row for _, row in results.rows(trial, JOB)}
    assert [rows[name]["reason"] for name in ("ada", "bob")] == [STOPPED, f"no answer for 10 s; {STOPPED}"]


@pytest.mark.parametrize(("late_s", "said"), [(0.9, None), (3.0, "its program began 3.0 s after the common start")])
def test_a_program_that_begins_late_is_noted_in_a_run_that_is_good(tmp_path: Path, late_s: float, said: str | None):
    trial = trial_of(tmp_path)
    trial.stopped, trial.at_ns = None, round((END["started"] - late_s) * 1e9)
    for part in trial.parts:
        part.ended = {**(part.ended or {}), "why": None, "end": {**END, "stopped": None}}
    trial.parts[0].clock = Clock(round(late_s * 1e9), 1000, 0)  # its clock is ahead, so that it has begun in time
    assert results.result(trial, JOB, tmp_path)["error"] is None
    rows = {row["robot"]: row for _, row in results.rows(trial, JOB)}
    assert [rows[name]["reason"] for name in ("ada", "bob")] == [None, said]
    assert list(results.notes(trial)) == ([f"bob: {said}"] if said else [])


@pytest.mark.parametrize("path", ["/proc/kmsg", "../../2/stdout", "here.csv"])
def test_reports_name_only_files_that_were_copied(tmp_path: Path, path: str):
    """A file outside the folder may never end, or belong to somebody else."""
    trial = trial_of(tmp_path)
    report = trial.parts[1].end
    assert report is not None
    report["outputs"] = [describe("/dev/null", path)]
    assert results.failure(trial) == f"bob has changed {path!r} after its end"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"files": None, "problem": "no space left"}, "bob has kept its outputs: no space left"),
        ({"lost": "no answer for 7 s"}, "bob was lost: no answer for 7 s"),
    ],
)
def test_outputs_that_are_missing_are_an_error_also_if_a_person_ends_the_run(tmp_path: Path, change: Any, said: str):
    """`[trials] stop = "ends"` makes such a run a success, and it must not be one without all of its robots."""
    trial = trial_of(tmp_path)
    for name, value in change.items():
        setattr(trial.parts[1], name, value)
    end = results.result(trial, JOB, tmp_path)
    assert (end["stopped"], end["error"]) == ("interrupted", said)
    assert judge(result_of(end), {}, Success())[0] is Status.INTERRUPTED
    as_planned = result_of({**end, "stopped": None})
    assert judge(as_planned, {}, Success()) == (Status.FAILED, said)


@pytest.mark.parametrize(("path", "known"), [("/usr/bin/a\udcff", True), ("/usr/bin/\ud800", False)])
def test_a_record_of_used_files_counts_only_if_its_names_are_names_of_files(tmp_path: Path, path: str, known: bool):
    trial = trial_of(tmp_path)
    record = {"method": "maps", "reason": None, "notes": [], "distributions": [], "files": [[path, "executed", "0" * 64, 1]]}
    for part in trial.parts:
        assert part.end is not None
        assert part.files is not None
        part.end["observed"] = True
        (part.files / OBSERVED).write_text(json.dumps(record))
    end = results.result(trial, JOB, tmp_path)
    assert end.get("observed", False) == known
    found = observed(result_of(end))
    assert ([row.path for row in found.read] if found else []) == (
        [f"{{robot {name}}}/usr/bin/a\\xff" for name in ("ada", "bob")] if known else []
    )

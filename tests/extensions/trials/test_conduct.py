"""Supervised trials: decisions before and verdicts after each, repetitions, and what counts of what was measured."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path

import pytest

import sierra
from sierra.errors import Missing, UsageError
from sierra.execution import execute_missing
from sierra.extensions.trials import supervised_by
from sierra.extensions.trials.supervisor import Agreeing, Attendant, Ended, Start, Trial, Verdict
from sierra.runners.base import Beat
from tests import projects, robots

TRIALS = """
[trials]
supervised = true
countdown = 0
arena = "hall 2"
files = ["arena.xml"]
poses = [[0, 1, 90]]
[trials.commands]
firmware = "echo 1.2.3"
"""
CONFIG = f'observe = "none"\n{projects.CONFIG}{TRIALS}'
VALID, FELL = Verdict(valid=True), Verdict(valid=False, reason="a robot fell", note="twice")
ROWS = "SELECT position, block, valid, t.reason, status FROM trials t JOIN executions e USING (execution) ORDER BY position"


class Gone:
    """The person presses Ctrl-C."""


class Script:
    """A supervisor that follows a list: the verdict on a trial that is started, or the decision not to start it."""

    def __init__(self, *steps: Start | Verdict | Gone, stops: Callable[[], bool] = lambda: False) -> None:
        self._steps = list(steps)
        self.unready_because: list[str] = []
        self._stops = stops
        self.trials: list[Trial] = []
        self.ended: list[Ended] = []

    def begin(self, trials: int) -> str | None:
        return "Ann"

    def attending(self, trial: Trial) -> AbstractContextManager[Attendant]:
        self.trials.append(trial)
        return contextlib.nullcontext(self)

    def decide(self, *, ready: bool) -> Start | None:
        assert ready, "a runner of this machine prepares nothing"
        return self._steps.pop(0) if isinstance(self._steps[0], Start) else Start.GO

    def watch(self, seconds: float, beats: Sequence[Beat]) -> bool:
        return self._stops() or seconds > 60

    def ending(self, beats: Sequence[Beat], collecting_s: float | None) -> None:
        raise AssertionError("a runner of this machine collects nothing")

    def unready(self, reason: str) -> Start | None:
        self.unready_because.append(reason)
        step = self._steps.pop(0)
        return step if isinstance(step, Start) else None

    def verdict(self, trial: Trial, ended: Ended) -> Verdict:
        self.ended.append(ended)
        step = self._steps.pop(0)
        if not isinstance(step, Verdict):
            raise KeyboardInterrupt
        return step


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return projects.make(tmp_path / "project", CONFIG)


def has_written(root: Path) -> bool:
    """Check whether the running trial has written all its lines."""
    return any(file.read_text().count("\n") == 6 for file in root.glob(".sierra/work/*/*/output/swarm.csv"))


def execute(root: Path, script: Script | Agreeing, runs: int = 1) -> sierra.Summary:
    with supervised_by(script):
        return sierra.open(root).run("population_size=1,2", runs=runs, figures=False)


@pytest.mark.integration
def test_an_invalid_trial_is_kept_and_repeated_at_the_end_of_its_block(root: Path) -> None:
    script = Script(FELL, VALID, VALID, VALID, VALID)
    summary = execute(root, script, runs=2)
    assert (summary.executed, summary.failed, summary.missing, summary.interrupted) == (4, 0, 0, False)
    first, second, again, *_ = script.trials
    assert (again.run, again.block, again.attempt) == (first.run, first.block, 1) != (second.run, second.block, 0)
    assert [(trial.position, trial.total) for trial in script.trials] == [(1, 4), (2, 5), (3, 5), (4, 5), (5, 5)]
    rows = projects.sql(root, ROWS)
    assert [list(row.values()) for row in rows[:3]] == [
        [0, 0, False, "a robot fell", "invalid"],
        [1, 0, True, None, "ok"],
        [2, 0, True, None, "ok"],
    ]
    assert projects.sql(root, "SELECT count(DISTINCT run) AS runs, count(*) AS counting FROM effective") == [
        {"runs": 4, "counting": 4}
    ]
    assert not sierra.open(root).maintenance.fsck().findings


@pytest.mark.integration
def test_a_supervisor_gets_the_pause_that_is_left(root: Path) -> None:
    pause(root, 1000)
    script = Script(VALID, VALID)
    execute(root, script)
    first, second = script.trials
    assert first.wait_s == 0
    assert 500 < second.wait_s <= 1000


@pytest.mark.integration
def test_a_pause_passes_between_the_end_of_a_trial_and_the_start_of_the_next(root: Path) -> None:
    pause(root, 1)
    assert execute(root, Agreeing("Ann")).executed == 2
    times = "SELECT epoch(started) AS began, epoch(started) + wall_s AS ended FROM executions ORDER BY started"
    first, second = projects.sql(root, times)
    assert second["began"] - first["ended"] > 0.99


def pause(root: Path, seconds: float) -> None:
    """Declare the pause between the trials of a project."""
    config = root / "sierra.toml"
    config.write_text(config.read_text().replace("countdown = 0", f"countdown = 0\npause = {seconds}"))


class WhileAnotherAsks(Script):
    """A supervisor that judges a trial after another session has requested the same batch."""

    def __init__(self, root: Path, *steps: Verdict) -> None:
        super().__init__(*steps)
        self._root = root

    def verdict(self, trial: Trial, ended: Ended) -> Verdict:
        with pytest.raises(Missing, match=r"process \d+ on .* executes these supervised trials; stop it, or wait"):
            execute(self._root, Agreeing("Bob"))
        return super().verdict(trial, ended)


@pytest.mark.integration
def test_a_second_session_does_not_wait_for_trials_of_another_person(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(execute_missing, "ENDING_S", 0.0)
    summary = execute(root, WhileAnotherAsks(root, VALID, VALID))
    assert (summary.executed, summary.failed, summary.missing) == (2, 0, 0)
    assert projects.sql(root, "SELECT count(*) AS n FROM trials WHERE valid AND operator = 'Ann'") == [{"n": 2}]
    assert not sierra.open(root).maintenance.fsck().findings


@pytest.mark.integration
def test_a_trial_is_recorded_with_the_operator_and_what_is_declared(root: Path) -> None:
    execute(root, Script(VALID, Verdict(valid=True, note="fine")))
    row = projects.sql(root, "SELECT * FROM trials ORDER BY position")[1]
    digest = hashlib.sha256((root / "arena.xml").read_bytes()).hexdigest()
    assert {name: row[name] for name in ("operator", "note", "arena", "order_rule", "stopped")} == {
        "operator": "Ann",
        "note": "fine",
        "arena": "hall 2",
        "order_rule": "blocked",
        "stopped": False,
    }
    assert [json.loads(row[name]) for name in ("poses", "facts", "files")] == [
        {"1": [0.0, 1.0, 90.0]},
        {"firmware": "1.2.3"},
        {"arena.xml": digest},
    ]


@pytest.mark.integration
def test_each_trial_names_the_robots_that_take_part_now_and_shows_the_same_area(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    robots.register(monkeypatch)
    more = "[targets.robots.trials]\nsupervised = true\n[targets.robots.trials.draw_poses]\n"
    declared = 'count = "population_size"\nx = [0, 4]\ny = [-1, 1]\n'
    root = robots.project(tmp_path / "p", more + declared)

    class Moving(Script):
        def verdict(self, trial: Trial, ended: Ended) -> Verdict:
            monkeypatch.setattr(robots, "NAMES", ("tb3-00", "spare", *robots.NAMES[2:]))
            return super().verdict(trial, ended)

    script = Moving(FELL, VALID, VALID)
    with supervised_by(script):
        sierra.open(root).run("population_size=1,2", runs=1, target="robots", figures=False)
    first, *others = script.trials
    assert first.robots == {place: f"tb3-0{place}" for place in range(1, len(first.poses) + 1)}
    assert [one.robots[1] for one in others] == ["spare", "spare"]
    for row in projects.sql(root, "SELECT position, robot FROM robots JOIN trials USING (execution) WHERE place = 1"):
        assert row["robot"] == script.trials[row["position"]].robots[1]


@pytest.mark.integration
def test_what_was_measured_is_kept_when_the_person_leaves(root: Path) -> None:
    summary = execute(root, Script(VALID, Gone()))
    assert (summary.executed, summary.interrupted) == (2, True)
    assert [(row["valid"], row["reason"], row["status"]) for row in projects.sql(root, ROWS)] == [
        (True, None, "ok"),
        (False, "nobody has judged it", "invalid"),
    ]
    script = Script(VALID)
    assert execute(root, script).reused == 1
    assert [(row["position"], row["status"]) for row in projects.sql(root, ROWS)] == [(0, "ok"), (1, "invalid"), (2, "ok")]


@pytest.mark.integration
def test_skipped_runs_are_asked_for_the_next_time(root: Path) -> None:
    summary = execute(root, Script(Start.SKIP, VALID))
    assert (summary.executed, summary.missing, summary.interrupted) == (1, 1, False)
    assert execute(root, Script(Start.ABORT)).interrupted
    assert execute(root, Script(VALID)).missing == 0


@pytest.mark.integration
def test_a_trial_that_the_person_stops_has_failed_unless_that_is_its_planned_end(tmp_path: Path) -> None:
    endless = "import signal, sys, time\nsignal.signal(15, lambda *_: sys.exit(0))\n"
    simulator = f"{endless}{projects.SIMULATOR}time.sleep(600)\n"
    for stop, status in (("fails", "stopped"), ("ends", "ok")):
        config = CONFIG.replace("countdown = 0", f'countdown = 0\nstop = "{stop}"')
        root = projects.make(tmp_path / stop, config, simulator=simulator)
        script = Script(VALID, Start.ABORT, stops=partial(has_written, root))
        execute(root, script)
        assert [(one.stopped, one.status) for one in script.ended] == [(True, status)]
        assert projects.sql(root, "SELECT e.status, stopped FROM trials JOIN executions e USING (execution)") == [
            {"status": status, "stopped": True}
        ]
        assert projects.sql(root, "SELECT size > 0 AS kept FROM artifacts WHERE path = 'swarm.csv'") == [{"kept": True}]


@pytest.mark.integration
def test_a_trial_that_is_stopped_before_it_begins_is_asked_for_again(root: Path) -> None:
    stops = iter([True])
    script = Script(VALID, Start.ABORT, stops=lambda: next(stops, False))
    execute(root, script)
    first, _, again = script.trials
    assert (again.run, again.attempt, again.position) == (first.run, 1, 2)
    assert len(projects.sql(root, ROWS)) == 1


@pytest.mark.integration
def test_a_table_that_differs_from_others_is_noticed_in_the_last_trial_too(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project", CONFIG.replace("countdown = 0", 'countdown = 0\norder = "as-designed"'))
    last = sierra.open(root).plan("population_size=1", runs=3).batch.runs[-1]
    (root / "sim.py").write_text(projects.SIMULATOR.replace("range(5)", f"range(4 if seed == {last.seed} else 5)"))
    with supervised_by(Agreeing()):
        summary = sierra.open(root).run("population_size=1", runs=3, figures=False)
    assert (summary.executed, summary.failed) == (3, 1)
    assert [row["status"] for row in projects.sql(root, ROWS)] == ["ok", "ok", "mismatch"]


@pytest.mark.integration
def test_a_failed_trial_stays_failed_or_is_repeated(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project", CONFIG, simulator="import sys\nsys.exit('motor is hot')\n")
    script = Script(FELL, VALID, VALID)
    summary = execute(root, script)
    assert [one.reason for one in script.ended] == ["exit status 1"] * 3
    assert (summary.failed, len(script.trials)) == (2, 3)
    assert {row["status"] for row in projects.sql(root, ROWS)} == {"failed"}


@pytest.mark.nightly
def test_fail_fast_does_not_count_a_trial_that_is_repeated(root: Path) -> None:
    with supervised_by(Script(FELL, VALID, VALID)):
        summary = sierra.open(root).run("population_size=1,2", runs=1, figures=False, fail_fast=True)
    assert (summary.executed, summary.failed) == (2, 0)


@pytest.mark.integration
def test_without_a_supervisor_nothing_is_executed_but_finished_runs_are_reused(root: Path) -> None:
    project = sierra.open(root)
    with pytest.raises(Missing, match="trials are supervised here"):
        project.run("population_size=1,2", runs=1, figures=False)
    assert not (root / ".sierra").exists()
    with supervised_by(Agreeing()):
        with pytest.raises(UsageError, match="one after the other; leave out --jobs 2"):
            project.run("population_size=1,2", runs=1, figures=False, jobs=2)
        with pytest.raises(UsageError, match="runs on 'slurm' begin when the cluster has room"):
            project.run("population_size=1,2", runs=1, figures=False, runner="slurm")
    assert execute(root, Agreeing("Bob")).executed == 2
    assert project.run("population_size=1,2", runs=1, figures=False).reused == 2


@pytest.mark.integration
def test_a_trial_that_cannot_begin_is_tried_again_skipped_or_ends_the_session(root: Path, tmp_path: Path) -> None:
    (root / "sierra.toml").write_text(CONFIG.replace("echo 1.2.3", f"cat {tmp_path}/version"))
    script = Script(Start.GO, Start.SKIP, Start.ABORT)
    summary = execute(root, script)
    assert (summary.executed, summary.failed, summary.interrupted, script.trials) == (0, 0, True, [])
    assert [reason.partition(":")[0] for reason in script.unready_because] == ["[trials.commands] firmware"] * 3

    class Repairing(Script):
        def unready(self, reason: str) -> Start | None:
            (tmp_path / "version").write_text("1.2.4")
            return super().unready(reason)

    repairing = Repairing(Start.GO, VALID, VALID)
    assert execute(root, repairing).executed == 2
    assert [(trial.position, trial.total, trial.facts) for trial in repairing.trials] == [
        (position, 2, {"firmware": "1.2.4"}) for position in (1, 2)
    ]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ('"echo 1.2.3"', r"\[trials.commands\] firmware: .*false ended with status 1"),
        ("arena.xml", r"\[trials\] files: absent.yaml cannot be read: No such file"),
    ],
)
def test_facts_that_cannot_be_recorded_are_an_error_before_a_trial(root: Path, change: str, message: str) -> None:
    config = CONFIG.replace(f'files = ["{change}"]', 'files = ["absent.yaml"]').replace(
        change, '"false"' if "echo" in change else change
    )
    (root / "sierra.toml").write_text(config)
    with pytest.raises(Missing, match=message):
        execute(root, Agreeing())
    assert projects.sql(root, "SELECT count(*) AS n FROM executions") == [{"n": 0}]


@pytest.mark.integration
def test_a_trial_that_is_recovered_after_a_failure_does_not_count(root: Path) -> None:
    def fail() -> bool:
        """Fail once the run has ended, before it is recorded."""
        if any('"end"' in file.read_text() for file in root.glob(".sierra/work/*/journal.jsonl")):
            raise RuntimeError("the screen broke")
        return False

    with pytest.raises(RuntimeError):
        execute(root, Script(VALID, stops=fail))
    assert [(row["valid"], row["reason"], row["status"]) for row in projects.sql(root, ROWS)] == [
        (False, "nobody has judged it", "invalid")
    ]

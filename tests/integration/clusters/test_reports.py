"""Reports of all commands about a batch that is or was on a cluster."""

from __future__ import annotations

import json
import re
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from sierra.runners.cluster import submission_record
from sierra.runners.schedulers.base import State, Task
from sierra.worker.result_log import Started
from tests.batches import packed
from tests.clusters import Slurm
from tests.conftest import Simulated
from tests.integration.clusters.test_commands import QUERY, WAITS, Waiting, until


@pytest.fixture
def waiting(simulate: Callable[..., Simulated], tmp_path: Path, slurm: Slurm) -> Waiting:
    gate = tmp_path / "gate"
    project = simulate(WAITS.format(gate=gate))
    config = project.folder / "sierra.toml"
    config.write_text(config.read_text() + "[runners.slurm]\narray_tasks = 3\ncpus = 2\n")
    return Waiting(project, gate, slurm)


def later(waiting: Waiting) -> None:
    """Make jobs wait in SLURM for an hour."""
    config = waiting.project.folder / "sierra.toml"
    config.write_text(config.read_text() + 'directives = ["--begin=now+1hour"]\n')


# while the batch is on the cluster


@pytest.mark.nightly
def test_status_shows_the_schedulers_reason_for_queued_array_tasks(waiting: Waiting) -> None:
    later(waiting)
    waiting.submit()
    until(lambda: waiting.status()[0]["waits"].endswith("BeginTime"), "nodes have been tried out")
    [now] = waiting.status()
    assert (now["queued"], now["running"], now["stuck"]) == (3, 0, None)
    assert re.search(r"  3 queued \((.*: )?BeginTime\)  ", waiting.project.quick("status").stdout)


@pytest.mark.nightly
def test_reasons_are_shortened_and_the_most_frequent_are_first() -> None:
    comment = "Not Running: Insufficient amount of resource: ncpus (R: 48 A: 12 T: 4096) on any of the hosts"
    reasons = ["Priority", comment, "Resources", comment, "", "Licenses"]
    told = submission_record.waits(Task("1", place, State.QUEUED, reason) for place, reason in enumerate(reasons))
    assert told == f"{comment[:69]}…, Priority and 2 more"
    assert submission_record.waits([Task("1", 0, State.RUNNING, "Prolog"), Task("1", 1, State.ENDED, "TIMEOUT")]) == ""


@pytest.mark.nightly
def test_progress_messages_say_why_array_tasks_are_queued(waiting: Waiting) -> None:
    later(waiting)
    asking = waiting.project.start("run", *QUERY, "--on", "slurm", stdin=subprocess.DEVNULL)
    said = ""
    while "BeginTime" not in said:
        said = asking.stderr.readline()
        assert said, "it has ended"
    asking.send_signal(signal.SIGINT)
    waiting.project.end_of(asking)
    assert re.fullmatch(r"0/6 runs, [13] array tasks? queued \(BeginTime\)\n", said)


@pytest.mark.nightly
def test_why_ls_show_and_dry_runs_report_runs_on_a_cluster(waiting: Waiting) -> None:
    left = waiting.submit()
    waiting.project.until_executed(6)
    where = rf"on slurm now, job {left['jobs'][0]} \(session {left['session'][:8]}\): 3 running"
    for words in (("why", waiting.batch()), ("run", *QUERY, "-n"), ("run", *QUERY, "-n", "--explain")):
        said = waiting.project.quick(*words).stdout
        assert re.search(f"^{where}$", said, re.MULTILINE), said
    listed = waiting.project.quick("ls").stdout
    assert f"on slurm now (job {left['jobs'][0]})" in listed
    [row] = json.loads(waiting.project.quick("ls", "--json").stdout)
    assert row["clusters"] == json.loads(waiting.project.quick("show", waiting.batch(), "--json").stdout)["clusters"]
    assert row["clusters"] == [{name: left[name] for name in ("session", "runner", "jobs", "array_tasks", "runs", "since")}]
    assert (
        "if the query is repeated now:\n  6 runs: on a cluster now: followed, not executed again\n"
        in waiting.project.quick("why", waiting.batch()).stdout
    )
    waiting.open()
    until(lambda: waiting.alive() == 0, "the jobs end")
    over = f"on slurm now, job {left['jobs'][0]} (session {left['session'][:8]}): the jobs are gone; sierra ls --jobs records"
    assert over in waiting.project.quick("run", *QUERY, "-n").stdout
    assert len(waiting.project.work()) == 1, "nothing is recorded, or taken over, by who only asks"


def test_a_dry_run_does_not_propose_runs_that_are_on_a_cluster(waiting: Waiting) -> None:
    waiting.submit()
    told = json.loads(waiting.project.quick("run", "size=1,2,3,4", "--runs", "2", "--on", "slurm", "-n", "--json").stdout)
    assert (told["runs"], told["to_execute"], told["on_clusters"], told["reused"]) == (8, 2, 6, 0)
    assert told["proposal"]["runs"] == 2
    again = waiting.project.quick("run", *QUERY, "--on", "slurm", "-n").stdout
    assert "0 of 6 runs would execute, 6 are on a cluster and would be followed" in again
    assert "#SBATCH" not in again


@pytest.mark.nightly
def test_a_dry_run_reports_a_probe_only_if_one_is_needed(
    waiting: Waiting, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    waiting.open()
    for said in (True, False):
        told = waiting.project.quick("run", *QUERY, "speed=1,2", "--on", "slurm", "-n").stderr
        assert ("nodes were not checked within a day" in told) == said
        waiting.project.quick("run", *QUERY, "--on", "slurm", "--no-figures")


# after the batch is recorded


@pytest.mark.nightly
@pytest.mark.parametrize("detached", [False, True])
def test_the_recorded_number_of_slots_is_that_of_the_submission(waiting: Waiting, detached: bool) -> None:
    waiting.open()
    words = ("run", *QUERY, "--on", "slurm", "--no-figures", "-j", "7")
    assert waiting.project.quick(*words, *["--detach"] * detached).returncode == 0
    if detached:
        assert waiting.project.quick("attach", waiting.batch(), "--no-figures").returncode == 0
    assert waiting.project.sql("SELECT runner, slots, executed FROM sessions") == [
        {"runner": "slurm", "slots": 6, "executed": 6}
    ]


@pytest.mark.nightly
def test_show_lists_attempts_including_those_that_were_cut_off(waiting: Waiting) -> None:
    asking = waiting.follow()
    until(lambda: len(packed(waiting.project.folder, Started)) == 6, "elements tell that runs have begun")
    [job] = {name.partition("_")[0] for name, state in waiting.slurm.states().items() if state == "RUNNING"}
    waiting.slurm.command("scontrol", "requeue", f"{job}_0")
    waiting.slurm.release_requeued()
    waiting.project.until_executed(8, asking)
    waiting.open()
    done = waiting.project.end_of(asking)
    assert done.returncode == 0, done.stderr
    shown = json.loads(waiting.project.quick("show", waiting.batch(), "--json").stdout)["attempts"]
    assert [(one["array_task"], one["state"]) for one in shown] == [(0, "cut off"), *((n, "finished") for n in range(3))]
    [execution] = waiting.project.sql(
        "SELECT run, execution FROM executions JOIN attempts a USING (attempt) WHERE a.array_task = 0 ORDER BY run LIMIT 1"
    )
    for one in execution.values():
        first, second = json.loads(waiting.project.quick("show", one[:12], "--json").stdout)["attempts"]
        assert (first["state"], first["interrupted_runs"], first["executed"]) == ("cut off", 2, False)
        assert (second["state"], second["error"], second["executed"]) == ("finished", None, True)
        assert second["node"] in waiting.slurm.names
        assert first["job"] == f"{job}_0"
        text = waiting.project.quick("show", one[:12]).stdout
        assert "attempts:" in text
        assert "cut off" in text

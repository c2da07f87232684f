"""Commands for clusters: batches are submitted, detached, found, attached and cancelled from any shell."""

from __future__ import annotations

import json
import os
import pty
import re
import select
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from sierra.runners.cluster.result_log_reader import Ended
from sierra.worker import result_log
from sierra.worker.result_log import Started
from tests import projects
from tests.batches import packed
from tests.clusters import Slurm
from tests.conftest import Simulated
from tests.waiting import PATIENCE_S, until

QUERY = ("size=1,2,3", "--runs", "2")
WAITS = """
while [ ! -e "{gate}" ] && [ ! -e "{gate}.$SIERRA_RUN_ID" ]; do sleep 0.02; done
printf 't,v\\n1,1\\n2,4\\n' > swarm.csv
"""
NOWHERE = {"SLURM_CONF": "/nowhere/slurm.conf"}


class Waiting:
    """A project whose runs wait until a gate is open, and its cluster."""

    def __init__(self, simulated: Simulated, gate: Path, slurm: Slurm) -> None:
        self.project, self.gate, self.slurm = simulated, gate, slurm

    def open(self) -> None:
        self.gate.touch()

    def submit(self, *words: str) -> dict[str, Any]:
        """Submit a query detached; return its status."""
        done = self.project.quick("run", *(words or QUERY), "--on", "slurm", "--detach", "--json")
        assert done.returncode == 0, done.stderr
        [left] = json.loads(done.stdout)["detached"]
        found: dict[str, Any] = left
        return found

    def follow(self, *words: str, **more: Any) -> subprocess.Popen[str]:
        """Start a query that follows its jobs; wait until all three array tasks have begun a run."""
        asking = self.project.start("run", *QUERY, "--on", "slurm", "--no-figures", *words, **more)
        self.project.until_executed(3, asking)
        return asking

    def status(self) -> list[dict[str, Any]]:
        done = self.project.quick("status", "--json")
        assert done.returncode == 0, done.stderr
        found: list[dict[str, Any]] = json.loads(done.stdout)
        return found

    def batch(self) -> str:
        [row] = self.project.sql("SELECT batch FROM batches")
        return str(row["batch"])[:8]

    def alive(self) -> int:
        """Return the number of tasks on the cluster, including those that are ending."""
        return sum(state in ("PENDING", "RUNNING", "COMPLETING") for state in self.slurm.states().values())

    def good(self) -> int:
        return len(self.project.sql("SELECT DISTINCT run FROM executions WHERE status = 'ok'"))


@pytest.fixture
def waiting(simulate: Callable[..., Simulated], tmp_path: Path, slurm: Slurm) -> Waiting:
    gate = tmp_path / "gate"
    project = simulate(WAITS.format(gate=gate))
    config = project.folder / "sierra.toml"
    config.write_text(config.read_text() + "[runners.slurm]\narray_tasks = 3\n")
    return Waiting(project, gate, slurm)


# detaching and attaching


def test_a_detached_run_returns_immediately_and_names_the_next_commands(waiting: Waiting) -> None:
    done = waiting.project.ask("run", *QUERY, "--on", "slurm", "--detach")
    batch = waiting.batch()
    assert done.returncode == 0
    assert "6 runs: 0 executed, 0 reused, 6 pending" in done.stdout
    assert re.search(r"^session [0-9a-f]{16}: 3 array tasks in job \d+ on slurm$", done.stdout, re.MULTILINE)
    assert f"sierra attach {batch}" in done.stdout
    assert f"sierra cancel {batch}" in done.stdout


def test_attach_follows_a_detached_batch_to_its_end(waiting: Waiting) -> None:
    waiting.submit()
    waiting.open()
    done = waiting.project.quick("attach")
    assert done.returncode == 0, done.stderr
    assert f"note: batch {waiting.batch()}" in done.stderr
    assert ", the last one with cluster jobs\n" in done.stderr
    assert "6 runs: 6 executed, 0 reused\n" in done.stdout
    assert "figures:" in done.stdout
    assert waiting.status() == []
    again = waiting.project.quick("run", *QUERY)
    assert "6 runs: 0 executed, 6 reused" in again.stdout
    assert waiting.project.executed().total() == 6


def test_attach_gives_nodes_the_programs_of_this_version(waiting: Waiting) -> None:
    waiting.submit()
    waiting.project.until_executed(3)
    [program] = waiting.project.folder.glob(".sierra/work/*/worker.pyz")
    program.unlink()
    attached = waiting.project.start("attach", "--no-figures")
    until(program.exists)
    waiting.open()
    _, errors = attached.communicate(timeout=PATIENCE_S)
    assert attached.returncode == 0, errors
    assert waiting.good() == 6


def test_attach_lists_accepted_ends_as_run_does(waiting: Waiting) -> None:
    script, config = waiting.project.folder / "sim.sh", waiting.project.folder / "sierra.toml"
    script.write_text(script.read_text() + 'grep -q \'size="2"\' "$1" && exit 3; exit 0\n')
    config.write_text(config.read_text() + '[success]\naccept = ["exit 3"]\n')
    waiting.submit()
    waiting.open()
    done = waiting.project.quick("attach", waiting.batch(), "--no-figures")
    assert done.returncode == 0, done.stderr
    last = "ended as [success] accept names: exit 3 in 2 of 6 runs"
    assert last in done.stdout
    assert last in waiting.project.quick("run", *QUERY, "--no-figures").stdout


@pytest.mark.nightly
def test_a_part_of_a_batch_is_detached_attached_and_completed(waiting: Waiting) -> None:
    left = waiting.submit(*QUERY, "--only", "size>=2")
    assert left["runs"] == 4
    waiting.open()
    done = waiting.project.quick("attach", waiting.batch(), "--no-figures")
    assert done.returncode == 0, done.stderr
    assert "6 runs: 4 executed, 0 reused, 2 left out\n" in done.stdout
    assert waiting.project.sql("SELECT executed, reused, missing FROM sessions") == [{"executed": 4, "reused": 0, "missing": 2}]
    preview = waiting.project.quick("run", *QUERY, "--on", "slurm", "-n", "--only", "size=1", "--json")
    assert json.loads(preview.stdout)["proposal"]["runs"] == 2
    rest = waiting.project.quick("run", *QUERY, "--on", "slurm", "--no-figures", "--json")
    assert [json.loads(rest.stdout)[name] for name in ("executed", "reused", "missing")] == [2, 4, 0]


@pytest.mark.nightly
def test_a_target_on_a_cluster_is_detached_and_recorded_with_its_name(waiting: Waiting) -> None:
    config = waiting.project.folder / "sierra.toml"
    config.write_text(config.read_text() + '[targets.field]\nrunner = "slurm"\nlimits.wall = 500\n')
    done = waiting.project.quick("run", *QUERY, "--target", "field", "--detach")
    assert done.returncode == 0, done.stderr
    listed = waiting.project.quick("status")
    assert [word in listed.stdout for word in (" target ", " field ")] == [True, True], listed.stdout
    waiting.open()
    done = waiting.project.quick("attach", waiting.batch(), "--json", "--no-figures")
    assert (done.returncode, json.loads(done.stdout)["target"], json.loads(done.stdout)["executed"]) == (0, "field", 6)
    assert waiting.project.sql("SELECT target, runner, executed FROM sessions") == [
        {"target": "field", "runner": "slurm", "executed": 6}
    ]


@pytest.mark.nightly
def test_attach_accepts_the_prefix_of_a_session_id(waiting: Waiting) -> None:
    left = waiting.submit()
    waiting.open()
    done = waiting.project.quick("attach", left["session"][:6], "--json", "--no-figures")
    assert (done.returncode, json.loads(done.stdout)["executed"]) == (0, 6)


@pytest.mark.nightly
def test_attach_reports_failed_runs_with_their_logs(waiting: Waiting) -> None:
    script = waiting.project.folder / "sim.sh"
    script.write_text(script.read_text() + "echo the arena is too small >&2; exit 4\n")
    waiting.submit()
    waiting.open()
    done = waiting.project.quick("attach", waiting.batch())
    assert done.returncode == 1
    assert "exit status 4" in done.stdout
    assert "the arena is too small" in done.stdout


def test_status_shows_progress_and_records_finished_runs(waiting: Waiting) -> None:
    left = waiting.submit()
    until(lambda: len(packed(waiting.project.folder, Started)) == 3, "elements tell that runs have begun")
    [now] = waiting.status()
    assert {name: now[name] for name in left} == left
    assert (now["done"], now["running"], now["queued"], now["attended"]) == (0, 3, 0, None)
    waiting.open()
    until(lambda: waiting.alive() == 0, "the jobs end")
    [now] = waiting.status()
    assert (now["done"], now["failed"], now["ended"]) == (6, 0, True)
    assert waiting.good() == 6
    assert waiting.project.work() == []
    late = waiting.project.quick("attach", waiting.batch())
    assert late.returncode == 2
    assert "has no jobs on a cluster; sierra ls --jobs lists cluster jobs, sierra ls lists recorded batches" in late.stderr


@pytest.mark.nightly
def test_status_without_cluster_jobs_is_not_an_error(waiting: Waiting) -> None:
    done = waiting.project.quick("status")
    assert (done.returncode, done.stdout) == (0, "no cluster jobs\n")
    assert not (waiting.project.folder / ".sierra").exists()


@pytest.mark.nightly
def test_status_works_with_an_unreachable_scheduler(waiting: Waiting) -> None:
    waiting.submit()
    done = waiting.project.end_of(waiting.project.start("status", env={**os.environ, **NOWHERE}))
    assert done.returncode == 0
    assert "unreachable" in done.stdout
    assert "Traceback" not in done.stderr


@pytest.mark.nightly
def test_status_reports_jobs_that_never_begin_with_the_schedulers_reason(waiting: Waiting) -> None:
    waiting.submit("size=1", "--runs", "1")
    [job] = waiting.status()[0]["jobs"]
    waiting.project.until_executed(1)
    waiting.slurm.command("scontrol", "requeuehold", job)
    until(lambda: "cannot start: " in waiting.project.quick("status").stdout, "it is held")


@pytest.mark.nightly
@pytest.mark.parametrize(
    "command", [("run", *QUERY, "--on", "slurm"), ("attach", "{batch}"), ("status",), ("cancel", "{batch}")]
)
def test_results_that_cannot_be_read_are_not_deleted(waiting: Waiting, command: tuple[str, ...]) -> None:
    waiting.submit()
    waiting.open()
    until(lambda: waiting.alive() == 0, "the jobs end")
    [folder] = waiting.project.work()
    later = folder / "results" / "0.a.pack"
    later.write_bytes(result_log.line_of({"event": "start", "when": 1}))
    done = waiting.project.quick(*(word.format(batch=waiting.batch()) for word in command))
    assert done.returncode == (0 if command == ("status",) else 1)
    assert "another version of SIERRA" in done.stderr
    later.unlink()
    assert waiting.project.quick("run", *QUERY, "--on", "slurm", "--no-figures").returncode == 0
    assert (waiting.good(), waiting.project.executed().total()) == (6, 6)


# interrupted


def test_an_interrupt_without_a_terminal_detaches(waiting: Waiting) -> None:
    asking = waiting.follow()
    asking.send_signal(signal.SIGINT)
    done = waiting.project.end_of(asking)
    assert done.returncode == 130
    assert "[D/c]" not in done.stderr
    assert f"sierra attach {waiting.batch()}" in done.stdout
    assert waiting.alive() == 3


@pytest.mark.nightly
@pytest.mark.parametrize(("answer", "stays"), [("\n", True), ("d\n", True), ("c\n", False), ("^C", True)])
def test_an_interrupt_on_a_terminal_asks_to_detach_or_cancel(waiting: Waiting, answer: str, stays: bool) -> None:
    process, said = on_a_terminal(waiting, answer)
    assert process == 130, said
    assert "detach or cancel? [D/c]" in said
    assert ("sierra attach" in said) == stays
    assert (waiting.alive() > 0) == stays
    assert len(waiting.project.work()) == stays


def on_a_terminal(waiting: Waiting, answer: str) -> tuple[int, str]:
    """Follow on a terminal, interrupt after runs have begun, answer or interrupt again; return exit code and output."""
    terminal, theirs = pty.openpty()
    asking = waiting.project.start("run", *QUERY, "--on", "slurm", "--no-figures", stdin=theirs, stdout=theirs, stderr=theirs)
    os.close(theirs)
    said, interrupted, answered = "", False, False
    while select.select([terminal], [], [], PATIENCE_S)[0]:
        try:
            said += os.read(terminal, 65536).decode()
        except OSError:  # it has ended
            break
        if not interrupted and "running" in said:
            asking.send_signal(signal.SIGINT)
            interrupted = True
        elif not answered and "[D/c]" in said:
            answered = True
            asking.send_signal(signal.SIGINT) if answer == "^C" else os.write(terminal, answer.encode())
    os.close(terminal)
    return asking.wait(PATIENCE_S), said


# while another process follows


@pytest.mark.nightly
def test_attach_refuses_a_batch_that_another_process_follows(waiting: Waiting) -> None:
    asking = waiting.follow()
    [now] = waiting.status()
    assert f"process {asking.pid} on " in now["attended"]
    done = waiting.project.quick("attach", waiting.batch())
    assert done.returncode == 3
    assert f"is followed by process {asking.pid} on " in done.stderr
    detached = waiting.project.quick("run", *QUERY, "--on", "slurm", "--detach")
    assert detached.returncode == 0
    assert "other processes already execute 6 runs" in detached.stderr
    waiting.open()
    assert waiting.project.end_of(asking).returncode == 0


@pytest.mark.nightly
def test_cancel_ends_a_batch_that_another_process_follows(waiting: Waiting) -> None:
    asking = waiting.follow()
    done = waiting.project.quick("cancel", waiting.batch())
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith("0 runs kept, 6 not executed\n")
    followed = waiting.project.end_of(asking)
    assert followed.returncode == 130
    assert "6 runs: 0 executed, 0 reused, 6 not executed" in followed.stdout
    assert waiting.alive() == 0


# cancelling


def test_cancel_keeps_finished_runs(waiting: Waiting) -> None:
    """The runs are not observed: they look for a file that appears later, and so they would execute again."""
    config = waiting.project.folder / "sierra.toml"
    config.write_text(f'observe = "none"\n{config.read_text()}')
    left = waiting.submit()
    waiting.project.until_executed(3)
    for run in waiting.project.executed():
        waiting.gate.with_name(f"gate.{run}").touch()
    until(lambda: len(packed(waiting.project.folder, Ended)) == 3, "elements tell that runs have ended")
    waiting.project.until_executed(6)
    done = waiting.project.quick("cancel")
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"session {left['session']}: 3 runs kept, 3 not executed\n"
    assert (waiting.alive(), waiting.good(), waiting.project.work()) == (0, 3, [])
    waiting.open()
    again = waiting.project.quick("run", *QUERY, "--on", "slurm", "--no-figures")
    assert "6 runs: 3 executed, 3 reused" in again.stdout


@pytest.mark.nightly
@pytest.mark.parametrize("command", ["attach", "cancel"])
def test_an_id_without_cluster_jobs_is_an_error(waiting: Waiting, command: str) -> None:
    waiting.open()
    waiting.project.quick("run", "size=1", "--runs", "1", "--no-figures")
    for named in (waiting.batch(), "abcdef"):
        done = waiting.project.quick(command, named)
        assert done.returncode == 2
        assert named in done.stderr


# before anything is submitted


def test_a_dry_run_shows_the_script_that_is_submitted_later(waiting: Waiting) -> None:
    waiting.project.quick("status")
    told = json.loads(waiting.project.quick("run", *QUERY, "--on", "slurm", "--detach", "-n", "--json").stdout)["proposal"]
    assert not (waiting.project.folder / ".sierra").exists()
    assert waiting.alive() == 0
    left = waiting.submit()
    session, [job] = left["session"], left["jobs"]
    expected = told["script"].replace("sierra-SESSION", f"sierra-{session[:8]}").replace("SESSION", session)
    submitted = waiting.slurm.command("scontrol", "write", "batch_script", job, "-").splitlines()
    beside = ("#SBATCH --dependency=", "#SBATCH --kill-on-invalid-dep=")
    assert [line for line in submitted if line and not line.startswith(beside)] == expected.splitlines()
    [folder] = waiting.project.work()
    probed = json.loads((folder / "submission.json").read_text())["probed"]
    assert any("a dependency in the script" in note for note in told["notes"]) == probed
    assert (told["array_tasks"], told["runs"]) == (left["array_tasks"], left["runs"])
    waiting.project.until_executed(3)
    files = [path for path in folder.rglob("*") if path.is_file()]
    assert abs(told["files"] - len(files)) <= 4, files


@pytest.mark.nightly
def test_a_dry_run_estimates_from_the_times_of_earlier_runs(waiting: Waiting) -> None:
    waiting.open()
    first = waiting.project.quick("run", "size=1", "--runs", "1", "--on", "slurm", "--dry-run").stdout
    assert "core-hours: unknown, no run has been timed yet" in first
    assert "files, unknown size" in first
    waiting.project.quick("run", "size=1", "--runs", "1", "--no-figures")
    later = waiting.project.quick("run", *QUERY, "--on", "slurm", "--dry-run", "--explain").stdout
    assert "on slurm (slurm " in later
    assert "3 array tasks of up to 2 runs, each 1 core for 10:00" in later
    assert re.search(r"core-hours: about [\d.e-]+, at most 0\.5 ", later)
    assert re.search(r"^array_tasks +3 +set in sierra.toml$", later, re.MULTILINE)
    assert re.search(r"^wall +600 +6 times the expected time, at least 10 minutes$", later, re.MULTILINE)
    told = r"^time of a run +[\d.]+ to [\d.]+ s, mean [\d.]+ s +1 of 3 experiments were timed; the others are estimated"
    assert re.search(told, later, re.MULTILINE)
    assert "#SBATCH --array=0-2" in later


@pytest.mark.nightly
@pytest.mark.parametrize("cluster", ["slurm", "pbs"])
def test_a_dry_run_works_without_a_scheduler_and_reports_unknown_limits(tmp_path: Path, cluster: str) -> None:
    root = projects.make(tmp_path / "project")
    tools = tmp_path / "bin"
    tools.mkdir()
    for program in ("python3", "git", "sh"):
        (tools / program).symlink_to(subprocess.check_output(["which", program], text=True).strip())
    done = projects.sierra(root, "run", "population_size.Log8", "--on", cluster, "-n", environment={"PATH": str(tools)})
    assert done.returncode == 0, done.stderr
    assert f"on {cluster} ({cluster}): 8 array tasks of up to 1 run," in done.stdout
    assert "the site's limits are unknown" in done.stderr


# invalid requests


@pytest.mark.nightly
def test_local_runs_cannot_be_detached(tmp_path: Path) -> None:
    done = projects.quick(projects.make(tmp_path / "project"), "run", "population_size.Log8", "--detach")
    assert done.returncode == 2
    assert "'local'" in done.stderr


@pytest.mark.nightly
def test_the_error_for_an_unknown_runner_names_the_known_ones(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project", projects.CONFIG + '[runners.big]\nscheduler = "slurm"\n')
    for more in ((), ("--dry-run",)):
        done = projects.quick(root, "run", "population_size.Log8", "--on", "bog", *more)
        assert done.returncode == 2
        assert "unknown runner 'bog'; known are local, collected, robots, slurm, pbs, lab, big" in done.stderr

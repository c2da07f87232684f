"""Runs on robots with real sshd, and the faults that they must survive.

After each fault, no program is left on any robot within its lease, the result says which robot it was, and the next run works.
"""

from __future__ import annotations

import contextlib
import secrets
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from sierra.errors import Missing
from sierra.extensions.hosts.fabric import Fabric
from sierra.extensions.hosts.openssh import OpenSsh, OpenSshOptions
from sierra.extensions.robots.trial import Trial
from sierra.model import Limits
from sierra.runners.links.base import LinkOptions
from tests.support.robot_fleet import Fleet, Proxy
from tests.support.robot_runs import Runs, job
from tests.tiers import at_night
from tests.waiting import until

pytestmark = pytest.mark.integration

SLEEP = ("1", "sleep", "2", "sleep", "3", "sleep")
LEASE_S = 4.0
Fault = Callable[[Fleet], None]


@pytest.fixture
def runs(fleet: Fleet, tmp_path: Path) -> Iterator[Runs]:
    made = with_hosts(fleet, tmp_path, {})
    yield made
    for name in fleet.names:
        if fleet.robots[name].process is not None:
            until(partial(is_idle, fleet, name), partial(fleet.commands, name))


def with_hosts(fleet: Fleet, folder: Path, hosts: dict[str, str]) -> Runs:
    """Return runs on the fleet; `hosts` are other names of its robots in the configuration of OpenSSH."""
    options = LinkOptions(ssh_config=str(fleet.ssh_config), connect=6.0, lost=4.0)
    homes = {name: robot.home for name, robot in fleet.robots.items()}
    stop = ["sh", "-c", "echo stopped >> ~/stops"]
    own = {"disk_min": 1_000_000, "grace": 1.0, "lease": LEASE_S, "stop": stop}
    return Runs(folder, homes, lambda name, _: Fabric(hosts.get(name, name), options), **own)


def is_idle(fleet: Fleet, name: str) -> bool:
    return not [line for line in fleet.commands(name) if "go.py" in line]


@contextlib.contextmanager
def gate(fleet: Fleet) -> Iterator[list[str]]:
    """Yield words of a run whose programs end, with success, only when this context is left."""
    name = f"gate-{secrets.token_hex(4)}"
    try:
        yield [word for place in "123" for word in (place, f"0@/run/robot/{name}")]
    finally:
        for robot in fleet.robots.values():
            (robot.own / name).touch()


def test_programs_start_together_by_the_clock_of_each_robot(runs: Runs, fleet: Fleet):
    fleet.set_clock(fleet.names[1], 137)
    results = runs.run(job(1), job(2))
    assert [(one.exit_code, one.error) for one in results] == [(0, None)] * 2
    assert [file.path for file in results[0].outputs] == ["1/here.csv", "2/here.csv", "3/here.csv"]
    rows = [row for table, row in runs.rows if table == "robots"]
    assert [row["host"] for row in rows] == [*fleet.names, *fleet.names]
    assert [row["robot"] for row in rows if abs(row["offset_start_ns"]) > 100e9] == [fleet.names[1]] * 2
    assert all(abs(row["offset_start_ns"] - row["offset_end_ns"]) < 10e9 for row in rows)
    skews = [row["start_skew_ns"] for row in rows]
    assert max(skews) - min(skews) < 60e9, "`make bench` has the time on a machine without other work"
    counts = [(robot.home / "stops").read_text().count("stopped\n") for robot in fleet.robots.values()]
    assert counts == [1 + 2 * 2] * 3, "at the beginning, and at the first sign and at the end of both runs"


def test_programs_are_ended_after_the_marker_of_their_robot(runs: Runs):
    marked = Limits(grace_s=1.0, after_marker_s=0.3, marker="here.csv")
    [good] = runs.run(replace(job(1, *SLEEP), limits=marked))
    assert (good.exit_code, good.error, good.stopped, good.after_marker) == (0, None, None, 0.3)


@pytest.mark.parametrize("kind", ["fabric", "openssh"])
def test_robots_whose_python3_is_too_old_use_another_python_for_everything(
    runs: Runs, fleet: Fleet, monkeypatch: pytest.MonkeyPatch, kind: str
):
    for name in fleet.names:
        there = fleet.enter(name, "sh", "-c", "command -v python3").strip()
        programs = fleet.robots[name].home / "bin"
        programs.mkdir()
        for program, script in (
            ("python3", "echo python3 was called >> ~/called; exit 1"),
            ("python-new", f'exec {there} "$@"'),
        ):
            (programs / program).write_text(f"#!/bin/sh\n{script}\n")
            (programs / program).chmod(0o755)
        fleet.configure(name, "SetEnv PATH=/home/robot/bin:/usr/local/bin:/usr/bin:/bin")
    if kind == "openssh":
        options = OpenSshOptions(ssh_config=str(fleet.ssh_config))
        monkeypatch.setattr(runs, "make_link", lambda name, _: OpenSsh(name, options))
    runs.table = runs.table.model_copy(update={"python": "python-new"})
    [result] = runs.run(job(1, python="python-new"))
    assert [file.path for file in result.outputs] == ["1/here.csv", "2/here.csv", "3/here.csv"]
    assert not any((robot.home / "called").exists() for robot in fleet.robots.values())


@pytest.mark.parametrize(
    ("key", "said"),
    [
        ("", r"^rb\d: there is no key for the login; make one \(ssh-keygen\) or load it \(ssh-add\)$"),
        ("encrypted", r"^rb\d: the key needs a passphrase; load it into an agent \(ssh-add\)$"),
    ],
    ids=["no-key", "encrypted-key"],
)
def test_a_login_without_a_usable_key_is_refused(
    runs: Runs, fleet: Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, key: str, said: str
):
    monkeypatch.setenv("HOME", str(tmp_path))  # without keys in ~/.ssh
    monkeypatch.delenv("SSH_AUTH_SOCK", raising=False)
    shutil.copy(fleet.key, tmp_path / "encrypted")
    subprocess.run(["ssh-keygen", "-q", "-p", "-P", "", "-N", "a secret", "-f", tmp_path / "encrypted"], check=True)
    line = f"  IdentityFile {fleet.key}\n"
    text = fleet.ssh_config.read_text()
    assert line in text
    fleet.ssh_config.write_text(text.replace(line, f"  IdentityFile {tmp_path / key}\n" if key else ""))
    with pytest.raises(Missing, match=said):
        runs.run(job(1))
    assert not any(list(robot.home.iterdir()) for robot in fleet.robots.values())


def power_cut(fleet: Fleet) -> None:
    fleet.power_cut(fleet.names[1])


def reboot(fleet: Fleet) -> None:
    fleet.reboot(fleet.names[1])


def radio_down(fleet: Fleet) -> None:
    fleet.radio(fleet.names[1], up=False)


@pytest.mark.parametrize("fault", [power_cut, radio_down])
@pytest.mark.parametrize("step", ["_arm", "_start", *at_night(["_check", "_measure"])])
def test_a_robot_that_is_lost_before_the_start_prevents_it(
    runs: Runs, fleet: Fleet, monkeypatch: pytest.MonkeyPatch, step: str, fault: Fault
):
    monkeypatch.setattr(Trial, step, after(getattr(Trial, step), lambda: fault(fleet)))
    with pytest.raises(Missing, match=r"^rb2: "):
        runs.run(job(1))
    assert runs.begun() == []
    monkeypatch.undo()
    fleet.heal()
    assert [one.error for one in runs.run(job(2))] == [None]


def test_a_clock_that_is_set_between_its_measurement_and_the_start_prevents_it(
    runs: Runs, fleet: Fleet, monkeypatch: pytest.MonkeyPatch
):
    fleet.set_clock("rb2", 5)
    monkeypatch.setattr(Trial, "_start", after(Trial._start, lambda: fleet.set_clock("rb2", -25)))
    with pytest.raises(Missing, match=r"^rb2: its wall clock has moved by -30 s since it was measured, just before the start$"):
        runs.run(job(1))
    assert runs.begun() == []
    monkeypatch.undo()
    assert [one.error for one in runs.run(job(2))] == [None]


def after(step: Callable[..., None], fault: Callable[[], None]) -> Callable[..., None]:
    """Return a step of a run before which a fault happens."""

    def faulty(trial: Trial, *words: float) -> None:
        fault()
        step(trial, *words)

    return faulty


@pytest.mark.parametrize("fault", [power_cut, reboot, radio_down])
def test_a_robot_that_is_lost_in_the_middle_stops_the_others(runs: Runs, fleet: Fleet, fault: Fault):
    runner = runs.submit(job(1, *SLEEP))
    runs.all_begun()
    fault(fleet)
    until(lambda: is_idle(fleet, "rb1") and is_idle(fleet, "rb3"), "the others have stopped")
    if fault is radio_down:
        until(lambda: is_idle(fleet, "rb2"), "it has stopped by its lease")
        assert (fleet.robots["rb2"].home / "stops").exists()
    [result] = runs.follow(runner)
    assert result.error
    assert result.error.startswith("rb2 was lost: ")
    assert result.error.endswith("; the others were stopped")
    assert {"1/here.csv", "3/here.csv"} <= {file.path for file in result.outputs}
    assert [runs.rows_by_place[place]["status"] for place in (1, 2, 3)] == ["stopped", "lost", "stopped"]
    fleet.heal()
    assert [one.error for one in runs.run(job(2))] == [None]


@pytest.mark.nightly
def test_a_short_silence_is_survived(runs: Runs, fleet: Fleet):
    runs.table = runs.table.model_copy(update={"lease": 5.0})
    runner = runs.submit(job(1, "1", "0", "2", "nap", "3", "nap"))
    runs.all_begun()
    fleet.radio("rb2", up=False)
    time.sleep(3)
    fleet.radio("rb2", up=True)
    [result] = runs.follow(runner)
    assert result.error is None
    assert "rb2 does not answer; its run goes on for 5 s at most, its lease" in runs.notes


def test_a_robot_that_is_lost_while_its_files_are_pulled_fails_the_run(
    runs: Runs, fleet: Fleet, monkeypatch: pytest.MonkeyPatch
):
    finish = Trial.finish
    monkeypatch.setattr(Trial, "finish", lambda trial, *more: (power_cut(fleet), finish(trial, *more)))
    [result] = runs.run(job(1))
    assert result.error
    assert result.error.startswith("rb2 has kept its outputs: ")
    assert [file.path for file in result.outputs] == ["1/here.csv", "3/here.csv"]
    monkeypatch.undo()
    fleet.boot("rb2")
    assert [one.error for one in runs.run(job(2))] == [None]
    assert "rb2: removed what an earlier run had left" in runs.notes


@pytest.mark.parametrize("fault", [Proxy.cut, Proxy.stall])
def test_a_connection_that_stalls_or_is_cut_stops_the_robots(fleet: Fleet, tmp_path: Path, fault: Callable[[Proxy], None]):
    with Proxy(fleet.robots["rb2"].address) as proxy:
        runs = with_hosts(fleet, tmp_path, {"rb2": fleet.through("rb2", proxy.port)})
        runner = runs.submit(job(1, *SLEEP))
        runs.all_begun()
        fault(proxy)
        until(lambda: all(is_idle(fleet, name) for name in fleet.names), "all have stopped")
        proxy.stall(stalled=False)
        [result] = runs.follow(runner)
        assert result.error
        assert result.error.startswith("rb2 was lost: ")
        assert [file.path for file in result.outputs] == ["1/here.csv", "2/here.csv", "3/here.csv"]


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        (lambda fleet: fleet.fill_disk("rb2"), "rb2: .*(no space left|No space left|bytes free)"),
        (lambda fleet: fleet.read_only("rb2"), "rb2: .*[Rr]ead-only"),
        (lambda fleet: fleet.forget_host_key("rb2"), "rb2: the host key of .* is not known"),
        (lambda fleet: fleet.new_host_key("rb2"), "rb2: its host key differs"),
        (lambda fleet: fleet.refuse_logins("rb2"), "rb2: it refuses the login"),
        (lambda fleet: fleet.configure("rb2", "PasswordAuthentication yes", "PubkeyAuthentication no"), "rb2: .*ssh-copy-id "),
        (lambda fleet: fleet.configure("rb2", "MaxSessions 1"), "rb2: .* a run needs two sessions at once"),
    ],
    ids=["full disk", "read-only disk", "unknown key", "changed key", "refused login", "passwords only", "one session"],
)
def test_a_robot_that_cannot_be_used_is_named_in_one_line(runs: Runs, fleet: Fleet, fault: Fault, said: str):
    fault(fleet)
    with pytest.raises(Missing, match=said) as raised:
        runs.run(job(1))
    assert "\n" not in str(raised.value)
    assert runs.begun() == []


def test_a_disk_that_is_full_in_the_middle_fails_the_run(runs: Runs, fleet: Fleet):
    with gate(fleet) as until_open:
        runner = runs.submit(job(1, *until_open))
        runs.all_begun()
        fleet.fill_disk("rb2")
    [result] = runs.follow(runner)
    assert result.error
    assert result.error.startswith("rb2 ")
    assert {"1/here.csv", "3/here.csv"} <= {file.path for file in result.outputs}
    assert runs.rows_by_place[2]["status"] == "failed"
    fleet.heal()
    assert [one.error for one in runs.run(job(2))] == [None]


@pytest.mark.nightly
def test_a_full_disk_of_this_machine_fails_the_run(runs: Runs):
    folder = runs.session.root
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", folder], check=True)
    try:
        [result] = runs.run(job(1, "1", "writes"))
        assert result.error
        assert result.error.startswith("rb1 has kept its outputs: ")
        assert "no space left" in result.error.lower()
        assert {file.path for file in result.outputs} == {"2/here.csv", "3/here.csv"}
    finally:
        subprocess.run(["umount", "--lazy", folder], check=True)
    assert [one.error for one in runs.run(job(2))] == [None]


@pytest.mark.nightly
def test_a_slow_network_is_used(runs: Runs, fleet: Fleet):
    fleet.slow("rb2")
    runs.table = runs.table.model_copy(update={"lease": 5.0, "clock_error": 1.0})
    assert [one.error for one in runs.run(job(1))] == [None]


@pytest.mark.each_case
@pytest.mark.parametrize("limit", [None, 10.0])
def test_a_step_of_the_clock_is_a_remark_or_a_failure(runs: Runs, fleet: Fleet, limit: float | None):
    runs.table = runs.table.model_copy(update={"clock_drift": limit})
    fleet.set_clock("rb2", 5)
    with gate(fleet) as until_open:
        runner = runs.submit(job(1, *until_open))
        runs.all_begun()
        fleet.set_clock("rb2", -20)
    [result] = runs.follow(runner)
    if limit is None:
        assert result.error is None
    else:
        assert result.error
        assert result.error.startswith("rb2 has a clock that moved by -25 s during the run, more than clock_drift = 10 in ")
    assert runs.rows_by_place[2]["clock_remark"].startswith("its wall clock has moved by -25")
    assert runs.rows_by_place[2]["clock_remark"] in runs.rows_by_place[2]["reason"]
    assert runs.rows_by_place[1]["clock_remark"] is None
    assert any(note.startswith("rb2: its wall clock has moved by -25") for note in runs.notes)
    took = {place: row["ended"] - row["started"] for place, row in runs.rows_by_place.items()}
    assert abs(took[2] - took[1]).total_seconds() < 10, "a step in the middle changes no times"
    assert result.ended > result.started


def test_a_clock_that_is_set_after_the_start_was_confirmed_changes_no_times(
    runs: Runs, fleet: Fleet, monkeypatch: pytest.MonkeyPatch
):
    fleet.set_clock("rb2", 5)
    monkeypatch.setattr("sierra.extensions.robots.runner.LEADS_S", (1.0,))
    monkeypatch.setattr(Trial, "_supervise", after(Trial._supervise, lambda: fleet.set_clock("rb2", -20)))
    began = time.time()
    [result] = runs.run(job(1))
    assert result.error is None
    first, second = (runs.rows_by_place[place] for place in (1, 2))
    assert second["clock_remark"].startswith("its wall clock has moved by -25")
    assert began < second["started"].timestamp() < second["ended"].timestamp() < time.time()
    assert 0 <= second["start_skew_ns"] < first["start_skew_ns"] + 10e9
    assert began < result.started < result.ended < time.time()


def test_programs_that_ignore_sigterm_write_much_and_fork_for_ever_are_ended(runs: Runs, fleet: Fleet):
    fleet.fill_disk("rb1", free=40 << 20)
    runner = runs.submit(job(1, "1", "deaf", "2", "forks", "3", "sleep"))
    runs.all_begun()
    runner.stop()
    until(lambda: all(is_idle(fleet, name) for name in fleet.names), "all have stopped")
    assert [one.stopped for one in runs.follow(runner)] == ["interrupted"]

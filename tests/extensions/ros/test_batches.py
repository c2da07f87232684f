"""The platform `ros` with the real ROS 1 of Debian: the example, failures of nodes, and processes that are killed."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from rosbags.highlevel import AnyReader

from tests import projects
from tests.waiting import PATIENCE_S, until

pytestmark = pytest.mark.integration

STUBBORN = "for number in (2, 15):\n    signal.signal(number, signal.SIG_IGN)\ntime.sleep(1000)\n"
NODES = {
    "dies": "print('its last words', flush=True)\nrospy.sleep(0.2)\nraise SystemExit(3)\n",
    "ends": "rospy.sleep(0.2)\n",
    "stubborn": STUBBORN,
    "waits": "rospy.spin()\n",
}
SCENARIOS = {
    "fine": "",
    "waits": '<node pkg="walkers" type="waits" name="waits"/>',
    "stubborn": '<node pkg="walkers" type="stubborn" name="stubborn"/>',
    "dies": '<node pkg="walkers" type="dies" name="dies"/>',
    "ends": '<node pkg="walkers" type="ends" name="ends" required="true"/>',
    "package": '<node pkg="nowhere" type="dies" name="lost"/>',
    "program": '<node pkg="walkers" type="nothing" name="lost"/>',
    "invalid": '<node pkg="walkers" name="lost"/>',
}
REASONS = {
    "dies": "the node /robot0/dies died early: exit code 3",
    "ends": "the required node /robot0/ends ended before the time was over",
    "package": "the package nowhere of the node /robot0/lost is unknown; packages names folders with packages",
    "program": "the package walkers has no executable file nothing, which the node /robot0/lost names",
    "invalid": "the launch file cannot be read",
}


@pytest.fixture
def demo(require: Callable[..., str], tmp_path: Path) -> Path:
    """Return the example of ROS, whose runs are short."""
    require("roslaunch")
    done = projects.quick(tmp_path, "init", "--example", "ros", "demo")
    assert done.returncode == 0, done.stderr
    edited(tmp_path / "demo", 'platform = "ros"', 'platform = "ros"\nobserve = "none"')
    return edited(tmp_path / "demo", "length = 3.0", "length = 1.0")


def edited(root: Path, before: str, after: str) -> Path:
    """Replace a text in sierra.toml."""
    text = (root / "sierra.toml").read_text()
    assert before in text
    (root / "sierra.toml").write_text(text.replace(before, after))
    return root


def with_scenarios(root: Path) -> Path:
    """Add nodes that do what a node should not, and a scenario for each."""
    scripts = root / "packages" / "walkers" / "scripts"
    for name, body in NODES.items():
        stubborn = ", disable_signals=True" if body is STUBBORN else ""
        (scripts / name).write_text(
            f"#!/usr/bin/python3\nimport signal, time\nimport rospy\nrospy.init_node('{name}'{stubborn})\n{body}"
        )
        (scripts / name).chmod(0o755)
    added = "changes = [{{ add = \"/launch/group[@ns='robot0']\", xml = '{}' }}]"
    keys = {name: added.format(more) if more else "" for name, more in SCENARIOS.items()}
    tables = (f"[scenarios.{name}]\n{key}\n" for name, key in keys.items())
    with (root / "sierra.toml").open("a") as file:
        file.write("\n" + "".join(tables))
    return root


def pids(root: Path, word: str = "") -> list[int]:
    """Return the processes of runs of a project whose command contains a word."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            ours = f"{root}/.sierra/work".encode() in (process / "environ").read_bytes()
            if ours and word.encode() in (process / "cmdline").read_bytes():
                found.append(int(process.name))
        except OSError:  # it has ended
            continue
    return found


def test_two_runs_at_once_are_apart_and_a_replay_is_identical(demo: Path) -> None:
    done = projects.quick(demo, "run", "population_size=1,3", "--runs", "1", "--jobs", "2")
    assert done.returncode == 0, done.stdout + done.stderr
    rows = projects.sql(
        demo, "SELECT population_size AS n, count(DISTINCT robot) AS robots, count(*) AS rows FROM walk GROUP BY n ORDER BY n"
    )
    assert [tuple(row.values()) for row in rows] == [(1, 1, 21), (3, 3, 63)]
    first = "SELECT x, y FROM walk WHERE time = 0 ORDER BY population_size, robot"
    places = [(row["x"], row["y"]) for row in projects.sql(demo, first)]
    assert (len(set(places)), places[0]) == (3, places[1])  # robot 0 begins at the same place in both
    assert len(list((demo / "figures").glob("*/*.png"))) == 1
    batch = str(projects.sql(demo, "SELECT batch FROM batches")[0]["batch"])
    replayed = projects.quick(demo, "replay", batch[:10])
    assert "identical (2 runs: 2 identical)" in replayed.stdout, replayed.stdout + replayed.stderr
    assert pids(demo) == []


def test_a_run_fails_for_each_reason_and_only_then(demo: Path) -> None:
    with_scenarios(demo)
    edited(demo, "length = 1.0", "length = 1000.0")  # a busy machine needs long for the end of a node
    says = partial(projects.quick, demo, "run", "--runs", "1", "--jobs", "2", "--no-figures")
    early = says("scenario=dies,ends")
    edited(demo, "length = 1000.0", "length = 1.0")
    done = says(f"scenario={','.join(SCENARIOS.keys() - {'dies', 'ends'})}")
    assert (early.returncode, done.returncode) == (1, 1), early.stdout + done.stdout + done.stderr
    query = "SELECT points.scenario, status, run FROM executions JOIN points USING (run)"
    ended = {str(row["scenario"]): row for row in projects.sql(demo, query)}
    assert [name for name in SCENARIOS if ended[name]["status"] == "ok"] == ["fine", "waits", "stubborn"]
    logs = {name: projects.quick(demo, "files", str(ended[name]["run"]), "stderr").stdout for name in REASONS}
    for name, reason in REASONS.items():
        assert logs[name].splitlines()[-1] == f"ros: {reason}", logs[name]
    assert "its last words" in logs["dies"]
    assert pids(demo) == []


def test_nothing_is_left_of_a_run_whose_program_is_killed(demo: Path) -> None:
    edited(demo, "length = 1.0", "length = 60.0")
    process = projects.start(demo, "run", "population_size=1", "--runs", "1", "--no-figures")
    until(lambda: pids(demo, "sierra_timekeeper"))
    [launcher] = [pid for pid in pids(demo, "/usr/bin/roslaunch") if os.getsid(pid) == pid]
    [driver] = [int(re.findall(r"\) \S (\d+)", Path(f"/proc/{launcher}/stat").read_text())[0])]
    os.kill(driver, signal.SIGKILL)
    process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 1
    assert pids(demo) == []


@pytest.mark.nightly
def test_nothing_is_left_of_a_sierra_that_is_killed_with_its_worker(demo: Path) -> None:
    edited(demo, "length = 1.0", "length = 60.0")
    process = projects.start(demo, "run", "population_size=1", "--runs", "1", "--no-figures", start_new_session=True)
    until(lambda: pids(demo, "sierra_timekeeper"))
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    assert projects.quick(demo, "status").returncode == 0
    until(lambda: not pids(demo))


def test_a_bag_is_closed_and_begins_with_the_run(demo: Path) -> None:
    edited(demo, "wait_for", 'record = ["/no/.*|/(robot0|robot1)/pose"]\nwait_for')
    done = projects.quick(demo, "run", "population_size=2", "--runs", "1", "--no-figures")
    assert done.returncode == 0, done.stdout + done.stderr
    run = str(projects.sql(demo, "SELECT run FROM runs")[0]["run"])
    names = projects.quick(demo, "files", run).stdout
    assert "output/run.bag" in names
    assert ".active" not in names
    assert projects.quick(demo, "files", run, "run.bag", "--to", "found").returncode == 0
    [bag] = demo.glob("found/**/run.bag")
    with AnyReader([bag]) as reader:
        assert {topic: found.msgcount for topic, found in reader.topics.items()} == {"/robot0/pose": 21, "/robot1/pose": 21}

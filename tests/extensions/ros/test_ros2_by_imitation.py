"""The driver of ROS 2 where there is a `ros2`: an imitation, which prints and records as the real one does.

The formats of messages are those of `launch` (ROS 2 Humble and newer). The rest of ROS 2 is real, but without the package mcap.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

import sierra.extensions.ros
from tests import projects
from tests.extensions.ros import bags, ros2
from tests.waiting import PATIENCE_S, until

pytestmark = pytest.mark.integration

DRIVER = Path(sierra.extensions.ros.__file__).parent / "drivers" / "ros_driver.py"
IMITATION = """\
import os, shutil, signal, subprocess, sys, time
import xml.etree.ElementTree as tree

if sys.argv[1:3] == ["bag", "record"]:
    plugin, folder, topics = sys.argv[3:5], sys.argv[6], sys.argv[7:]
    assert (plugin, sys.argv[5], topics) == (["-s", "mcap"], "-o", ["--regex", "/.*/odom"]), sys.argv
    programs = os.path.dirname(os.path.abspath(__file__))
    recorded = os.path.join(programs, "recorded", "run")

    def close(number, frame):
        if not os.path.exists(os.path.join(programs, "never_closes")):
            shutil.copytree(recorded, folder, dirs_exist_ok=True)
        os._exit(0)

    signal.signal(signal.SIGINT, close)
    os.mkdir(folder)
    with open(os.path.join(folder, "run.mcap"), "wb") as file:
        file.write(open(os.path.join(recorded, "run.mcap"), "rb").read()[:100])
    signal.pause()

assert sys.argv[1:3] == ["launch", "--noninteractive"], sys.argv
assert os.path.exists(os.environ["FASTDDS_DEFAULT_PROFILES_FILE"])
with open(os.path.join(os.environ["SIERRA_OUTPUT"], "domain"), "w") as file:
    file.write(os.environ["ROS_DOMAIN_ID"])
nodes, told = {}, []
signal.signal(signal.SIGINT, lambda number, frame: told.append(number))  # before the first node, as `ros2 launch` does

def start(name, words):
    name = f"{name}-{len(nodes) + 1}"
    process = nodes[name] = subprocess.Popen(words, start_new_session=True)
    print(f"[INFO] [{name}]: process started with pid [{process.pid}]", flush=True)

launch = tree.parse(sys.argv[3])
for node in launch.iter("node"):
    start(node.get("name"), ["sh", "-c", node.get("exec")])

while not told:
    for name, process in list(nodes.items()):
        if process.poll() is not None:
            del nodes[name]
            ended = f"has died [pid {process.pid}, exit code {process.returncode}, cmd 'x']." if process.returncode else (
                f"has finished cleanly [pid {process.pid}]")
            level = "ERROR" if process.returncode else "INFO"
            if "silent" not in name:
                print(f"[{level}] [{name}]: process {ended}", flush=True)
    time.sleep(0.02)
for process in nodes.values():
    process.poll() is None and os.killpg(process.pid, signal.SIGINT)
for process in nodes.values():
    process.wait()
"""
SETTINGS = """\
platform = "ros"
template = "swarm.launch.xml"
platforms.ros = { ros = 2, length = 0.5, record = ["/.*/odom"], barrier = false }
observe = "none"
outputs.walk = { file = "*.csv" }
outputs.odom = { file = "run/*.mcap", format = "bag", topics = ["/{model}/odom"] }
"""
WITHOUT_MCAP = """\
import importlib.util
find = importlib.util.find_spec
importlib.util.find_spec = lambda name, *more: None if name == "mcap" else find(name, *more)
"""


@pytest.fixture
def programs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, require: Callable[..., str]) -> dict[str, str]:
    """Return variables with which `ros2` is the imitation."""
    ros2.find(monkeypatch, require)
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(WITHOUT_MCAP)
    (tmp_path / "bin").mkdir()
    python = f'#!/bin/sh\nPYTHONPATH={tmp_path / "site"} exec {ros2.PROGRAMS / "python3"} "$@"\n'
    (tmp_path / "bin" / "python3").write_text(python)
    (tmp_path / "bin" / "python3").chmod(0o755)
    (tmp_path / "bin" / "ros2").write_text(f"#!{sys.executable}\n{IMITATION}")
    (tmp_path / "bin" / "ros2").chmod(0o755)
    (tmp_path / "tmp").mkdir()
    return {**os.environ, "PATH": f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}", "TMPDIR": str(tmp_path / "tmp")}


def start(folder: Path, programs: dict[str, str], *options: str, **nodes: str) -> subprocess.Popen[str]:
    """Start a run whose nodes are shell commands, by name."""
    folder.mkdir()
    lines = "".join(f'<node pkg="p" exec="{command}" name="{name}"/>' for name, command in nodes.items())
    (folder / "input.launch.xml").write_text(f"<launch>{lines}</launch>")
    words = (str(folder / "input.launch.xml"), str(folder), "ros2", "--ros", "2", "--no-barrier", *options)
    return subprocess.Popen(
        [sys.executable, DRIVER, *words], env=programs, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def end_of(process: subprocess.Popen[str]) -> tuple[int, str]:
    """Return the exit status and the last line on standard error."""
    _, errors = process.communicate(timeout=PATIENCE_S)
    return process.returncode, (errors.splitlines() or [""])[-1]


def test_two_runs_have_two_domains_and_end_after_their_length(tmp_path: Path, programs: dict[str, str]) -> None:
    begin = time.monotonic()
    one, two = (start(tmp_path / name, programs, "--length", "1.0", talker="sleep 1000") for name in ("one", "two"))
    assert (end_of(one), end_of(two)) == ((0, ""), (0, ""))
    assert time.monotonic() - begin >= 1.0
    assert (tmp_path / "one" / "domain").read_text() != (tmp_path / "two" / "domain").read_text()


@pytest.mark.parametrize(
    ("options", "nodes", "message"),
    [
        ((), {"talker": "exit 3"}, "ros: the node /talker died early: exit code 3"),
        ((), {"silent": "exit 3"}, "ros: the node /silent ended early, and the launcher did not report it"),
        ((), {}, "ros: after 1 s, no node was started"),
        (
            ("--await", "talker"),
            {"talker": "sleep 1000"},
            "ros: awaited nodes have not ended 1 s after the length of the run: /talker",
        ),
        (("--setup", "/nowhere"), {}, "ros: the setup script /nowhere failed: exit status 1"),
    ],
)
def test_a_run_fails_with_its_reason(
    tmp_path: Path, programs: dict[str, str], options: tuple[str, ...], nodes: dict[str, str], message: str
) -> None:
    length, patience = ("600.0", "600.0") if "exit 3" in nodes.values() else ("0.5", "1.0")
    process = start(tmp_path / "run", programs, "--length", length, "--patience", patience, *options, **nodes)
    assert end_of(process) == (1, message)


@pytest.mark.parametrize("closes", [False, True])
@pytest.mark.each_case
def test_a_bag_that_its_recorder_did_not_close_fails_its_run(tmp_path: Path, programs: dict[str, str], closes: bool) -> None:
    bags.record(tmp_path / "bin" / "recorded", "mcap", bags.odometry())
    if not closes:
        (tmp_path / "bin" / "never_closes").touch()
    options = ("--length", "0.5", "--record", "/.*/odom", "--bag", "run")
    process = start(tmp_path / "run", programs, *options, talker="sleep 1000")
    assert end_of(process) == ((0, "") if closes else (1, "ros: the bag run is missing or was not closed"))
    assert (tmp_path / "run" / "run" / "run.mcap").stat().st_size  # there from the start


@pytest.mark.nightly
def test_awaited_nodes_end_a_run(tmp_path: Path, programs: dict[str, str]) -> None:
    options = ("--length", "100.0", "--await", "walker")
    awaited = start(tmp_path / "one", programs, *options, walker="sleep 0.5", talker="sleep 1000")
    assert end_of(awaited) == (0, "")


def test_all_robots_are_awaited_though_the_launcher_calls_their_nodes_alike(tmp_path: Path, programs: dict[str, str]) -> None:
    (tmp_path / "run").mkdir()
    node = '<node pkg="p" exec="{}" name="walker"/>'
    launch = node.format("sleep 0.1") + node.format("sleep 4; echo x &gt; $SIERRA_OUTPUT/second")
    (tmp_path / "run" / "input.launch.xml").write_text(f"<launch>{launch}</launch>")
    words = ("input.launch.xml", ".", "ros2", "--ros", "2", "--no-barrier", "--length", "100.0", "--await", "walker")
    done = subprocess.run([sys.executable, DRIVER, *words], env=programs, cwd=tmp_path / "run", check=False)
    assert (done.returncode, (tmp_path / "run" / "second").exists()) == (0, True)


def test_a_run_that_is_told_to_end_ends_its_nodes(tmp_path: Path, programs: dict[str, str]) -> None:
    process = start(tmp_path / "run", programs, "--length", "100.0", talker="echo $$ > $SIERRA_OUTPUT/pid; exec sleep 1000")
    until(lambda: (tmp_path / "run" / "pid").read_text().strip())
    process.send_signal(signal.SIGTERM)
    assert end_of(process) == (1, "ros: was told to end by signal 15")
    until(lambda: not Path(f"/proc/{(tmp_path / 'run' / 'pid').read_text().strip()}").exists())


def test_a_batch_of_robots_of_ros_2(tmp_path: Path, programs: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", programs["PATH"])
    root = tmp_path / "project"
    root.mkdir()
    node = '<node pkg="p" exec="printf \'n\\n1\\n\' &gt; $SIERRA_OUTPUT/$$.csv; sleep 1000" name="walker"/>'
    text = f'<launch><group><push_ros_namespace namespace="robot"/>{node}</group></launch>'
    (root / "swarm.launch.xml").write_text(text)
    bags.record(tmp_path / "bin" / "recorded", "mcap", bags.odometry())
    (root / "sierra.toml").write_text(SETTINGS)
    summary, _ = projects.run(root, "population_size=1,3", "--runs", "2", "--jobs", "2")
    assert (summary["executed"], summary["failed"]) == (4, 0)
    rows = projects.sql(root, "SELECT population_size AS size, count(*) AS rows FROM walk GROUP BY size ORDER BY size")
    assert [tuple(row.values()) for row in rows] == [(1, 2), (3, 6)]
    assert projects.sql(root, "SELECT count(DISTINCT execution) AS runs, count(*) AS rows FROM odom") == [
        {"runs": 4, "rows": 24}
    ]

"""The driver of Gazebo, with a stand-in for gzserver that has its messages and its bad habits."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import sierra.extensions.gazebo
from tests.extensions.gazebo.stand_in import STAND_IN
from tests.waiting import PATIENCE_S, until

DRIVERS = Path(sierra.extensions.gazebo.__file__).parent / "drivers"
WORLD = """\
<sdf version="1.6">
  <world name="arena">
    <physics type="ode"><max_step_size>0.1</max_step_size></physics>
    <light name="sun"/>
    <model name="wall"><static>true</static></model>
    <model name="robot"><pose>1 2 0.1 0 0 0</pose><link name="body"/></model>
    <population name="crowd">
      <model_count>3</model_count><box><size>1 1 1</size></box><model name="ant"><link name="body"/></model>
    </population>
  </world>
</sdf>
"""
VERSION = bytes.fromhex("0a0b67617a65626f2031312e31")
"""The content of `version_init`, as Gazebo 11.1 of Debian sends it."""
STATS = bytes.fromhex("1204080110001a0908d6441080c6868f0122040800100028013064")
"""The message WorldStatistics of the same Gazebo after 100 steps."""


BRIEF = ("deaf", "hangs", "loses")
"""Faults of the stand-in for which the driver waits as long as it is told to."""


def start(folder: Path, faults: str = "", seed: int = 3, **variables: str) -> subprocess.Popen[str]:
    folder.mkdir(exist_ok=True)
    (folder / "arena.world").write_text(WORLD)
    (folder / "output").mkdir()
    words = [sys.executable, DRIVERS / "gazebo_driver.py", folder / "arena.world", folder / "output", "--server", STAND_IN]
    times = ["--seed", str(seed), "--length", "1", "--interval", "0.5"]
    return subprocess.Popen(
        [*words, *times],
        cwd=folder / "output",
        env={
            **os.environ,
            "STAND_IN": faults,
            "GAZEBO_DRIVER_PATIENCE": "3" if faults in BRIEF else str(PATIENCE_S),
            "HOME": str(folder),
            **variables,
        },
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def end(folder: Path, process: subprocess.Popen[str]) -> tuple[int, str, list[dict[str, str]]]:
    """Return the exit status of a driver, its errors, and the rows of its table."""
    _, errors = process.communicate(timeout=2 * PATIENCE_S)
    table = folder / "output" / "poses.csv"
    rows = list(csv.DictReader(table.read_text().splitlines())) if table.exists() else []
    assert not [path.name for path in folder.rglob("*") if path.suffix in (".unfinished", ".pyc")]
    return process.returncode, errors, rows


@pytest.mark.integration
def test_the_table_has_all_robots_at_all_times_and_repeats(tmp_path: Path) -> None:
    seeds = {"one": 3, "two": 3, "three": 4}
    started = {name: start(tmp_path / name, seed=seed) for name, seed in seeds.items()}
    (status, errors, rows), again, other = (end(tmp_path / name, process) for name, process in started.items())
    names = ["ant_clone_0", "ant_clone_1", "ant_clone_2", "robot"]
    assert (status, errors) == (0, "")
    assert [(row["time"], row["model"]) for row in rows] == [(time, name) for time in ("0.0", "0.5", "1.0") for name in names]
    assert [float(rows[3][name]) for name in ("x", "y", "z", "roll", "pitch", "yaw")] == [1, 2, 0.1, 0, 0, 0]
    assert (again[2] == rows, len(other[2]) == 12, other[2] != rows) == (True, True, True)


LATER = pytest.mark.integration


@pytest.mark.parametrize("fault", ["deaf", *(pytest.param(one, marks=LATER) for one in ("aborts", "writes", "other"))])
def test_bad_habits_of_gazebo_change_no_result(tmp_path: Path, fault: str) -> None:
    status, errors, rows = end(tmp_path, start(tmp_path, fault))
    assert (status, len(rows)) == (0, 12), errors
    assert ("signal 6, which changes nothing" in errors, "ignores SIGINT" in errors) == (fault == "aborts", fault == "deaf")


@pytest.mark.integration
@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("loses", "Gazebo has loaded 5 of 6 models and lights; missing: ant_clone_2"),
        ("lacks", "Gazebo reports an error: [Plugin.hh:178] Failed to load plugin libNoSuch.so"),
        ("dies", "gzserver ended too early: exit status 1; see its messages above"),
        pytest.param("runs", "Gazebo made step 6, but should have stopped after step 5", marks=LATER),
        pytest.param("unstable", "the physics became unstable: 'ant_clone_0' is nowhere at 0.5 s", marks=LATER),
        pytest.param(
            "aborts,writes",
            "gzserver wrote walk.txt, but did not end as it should (signal 6): the file may be incomplete",
            marks=LATER,
        ),
        pytest.param("hangs", "Gazebo does nothing: no answer for 3 s, waiting for step 10", marks=LATER),
    ],
)
def test_a_run_that_is_not_complete_fails_in_one_line_and_has_no_table(tmp_path: Path, fault: str, message: str) -> None:
    status, errors, rows = end(tmp_path, start(tmp_path, fault))
    assert (status, rows, message in errors.splitlines()[-1]) == (1, [], True), errors


def test_a_driver_that_is_ended_ends_gzserver(tmp_path: Path) -> None:
    process = start(tmp_path, "hangs,deaf", GAZEBO_DRIVER_PATIENCE="60")
    assert process.stdout is not None
    assert process.stdout.readline() == "gazebo 11.1\n"
    [server] = [int(pid) for pid in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()]
    process.send_signal(signal.SIGTERM)
    assert "the run was ended by SIGTERM" in process.communicate(timeout=PATIENCE_S)[1]
    until(lambda: not Path(f"/proc/{server}").exists())


def test_the_messages_of_gazebo_are_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(DRIVERS)
    from gazebo_transport import Fields, TransportError, message  # type: ignore[import-not-found]

    assert Fields(VERSION).text(1) == "gazebo 11.1"
    stats = Fields(STATS)
    assert (stats.number(6), stats.number(5), stats.inner(3).number(1)) == (100, 1, 8790)
    assert message(multi_step_3=300) == bytes.fromhex("18ac02")
    with pytest.raises(TransportError, match="cut off"):
        Fields(STATS[:-1])

"""The controller of the example `robots`: the same poses give the same motion on robots and in MuJoCo, without the two."""

from __future__ import annotations

import csv
import math
import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

import sierra
from sierra.config import project_file

EXAMPLE = Path(sierra.__file__).parent / "extensions" / "robots" / "examples" / "robots"
STARTS = project_file.load(EXAMPLE).config.platforms["ros"]["poses"]
SPEED = 0.3
MOVED = [[0.1, 0.0, 2.8], [0.4, -0.2, -2.0]]
"""Poses that robot 0 and the others have reached, relative to where they started."""


class Ros:
    """An imitation of rclpy: robot 0 executes a node, and two others tell where they are, all for one tick."""

    def __init__(self, folder: Path) -> None:
        self.parameters = {"sierra_length": 0.1, "sierra_population_size": 3, "sierra_output": str(folder), "speed": SPEED}
        self.heard: dict[str, Callable[[Any], None]] = {}
        self.sent: dict[str, list[Any]] = {}
        self.timers: list[Callable[[], None]] = []

    def node(self, name: str) -> SimpleNamespace:
        return SimpleNamespace(
            get_namespace=lambda: "/robot0",
            declare_parameter=lambda name, default: SimpleNamespace(value=self.parameters[name]),
            create_publisher=lambda kind, topic, depth: SimpleNamespace(
                publish=self.sent.setdefault(topic, []).append, wait_for_all_acked=lambda timeout: True
            ),
            create_subscription=lambda kind, topic, callback, profile: self.heard.update({topic: callback}),
            create_timer=self.timer,
        )

    def timer(self, period: float, callback: Callable[[], None]) -> SimpleNamespace:
        self.timers.append(callback)
        return SimpleNamespace(cancel=lambda: self.timers.remove(callback))

    def spin(self, node: SimpleNamespace) -> None:
        self.ring()
        self.heard["odom"](odometry("base_link", MOVED[0]))
        for name, start in (("robot1", STARTS[1]), ("robot2", STARTS[2])):
            self.heard["/poses"](odometry(name, placed(start, MOVED[1])))
        self.ring()
        assert self.sent["cmd_vel"] == []
        self.heard["/sierra/started"](SimpleNamespace(data=True))
        while True:
            self.ring()

    def ring(self) -> None:
        for timer in list(self.timers):
            timer()

    def modules(self) -> dict[str, ModuleType]:
        def twist() -> SimpleNamespace:
            return SimpleNamespace(linear=SimpleNamespace(), angular=SimpleNamespace())

        contents: dict[str, dict[str, object]] = {
            "rclpy": {"init": lambda signal_handler_options: None, "spin": self.spin, "shutdown": lambda: None},
            "rclpy.duration": {"Duration": lambda seconds: seconds},
            "rclpy.node": {"Node": self.node},
            "rclpy.qos": {"QoSProfile": SimpleNamespace, "DurabilityPolicy": SimpleNamespace(TRANSIENT_LOCAL=1)},
            "rclpy.signals": {"SignalHandlerOptions": SimpleNamespace(NO=0)},
            "rclpy.utilities": {"remove_ros_args": lambda words: words},
            "geometry_msgs.msg": {"Twist": twist},
            "nav_msgs.msg": {"Odometry": SimpleNamespace},
            "std_msgs.msg": {"Bool": SimpleNamespace},
        }
        modules = {name.partition(".")[0]: ModuleType(name.partition(".")[0]) for name in contents}
        modules |= {name: ModuleType(name) for name in contents}
        for name, content in contents.items():
            modules[name].__dict__.update(content)
        return modules


def odometry(name: str, pose: list[float]) -> SimpleNamespace:
    turned = SimpleNamespace(z=math.sin(pose[2] / 2), w=math.cos(pose[2] / 2))
    place = SimpleNamespace(position=SimpleNamespace(x=pose[0], y=pose[1]), orientation=turned)
    return SimpleNamespace(child_frame_id=name, header=SimpleNamespace(), pose=SimpleNamespace(pose=place))


def placed(start: list[float], pose: list[float]) -> list[float]:
    """Return a pose relative to the start in the frame of the arena, by complex numbers."""
    place = complex(start[0], start[1]) + complex(pose[0], pose[1]) * np.exp(1j * start[2])
    return [place.real, place.imag, start[2] + pose[2]]


def driven_by_ros(folder: Path, gathering: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> tuple[float, float]:
    """Return the speed and the turn that the node commands to robot 0 in its first tick."""
    ros = Ros(folder)
    monkeypatch.setitem(sys.modules, "gathering", SimpleNamespace(**gathering))
    for name, module in ros.modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(sys, "argv", ["gather", *map(str, STARTS[0])])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(EXAMPLE / "packages" / "gathering" / "scripts" / "gather"))
    assert ended.value.code is None
    command, last = ros.sent["cmd_vel"]
    assert (last.linear.x, last.angular.z) == (0, 0)
    return command.linear.x, command.angular.z


def driven_by_mujoco(control: Callable[..., None]) -> list[float]:
    """Return the speeds of the wheels of robot 0 before the first step."""
    poses = [placed(start, MOVED[min(robot, 1)]) for robot, start in enumerate(STARTS)]
    model = SimpleNamespace(
        jnt_type=np.array([0, 3, 3] * 3),
        jnt_qposadr=np.array([0, 7, 8, 9, 16, 17, 18, 25, 26]),
        actuator=lambda name: SimpleNamespace(id=2 * int(name[-1]) + name.startswith("right")),
        numeric=lambda name: SimpleNamespace(data=[SPEED]),
        opt=SimpleNamespace(timestep=0.01),
    )
    bodies = [[x, y, 0.04, math.cos(heading / 2), 0, 0, math.sin(heading / 2), 0, 0] for x, y, heading in poses]
    data = SimpleNamespace(qpos=np.array(bodies).ravel(), ctrl=np.zeros(6))
    control(model, data, None)
    return list(data.ctrl[:2])


def test_the_same_poses_give_the_same_motion_and_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    gathering = runpy.run_path(str(EXAMPLE / "gathering.py"))
    forward, turn = driven_by_ros(tmp_path, gathering, monkeypatch)
    assert forward > 0.1
    assert abs(turn) > 0.1
    assert driven_by_mujoco(gathering["control"]) == pytest.approx(gathering["wheels"](forward, turn))
    with (tmp_path / "robot0.csv").open() as of_ros, (tmp_path / "path.csv").open() as of_mujoco:
        [on_robot], simulated = list(csv.DictReader(of_ros)), list(csv.DictReader(of_mujoco))
    assert [row.pop("robot") for row in simulated] == ["1", "2", "3"]
    del on_robot["late"], simulated[0]["late"]
    assert {name: float(value) for name, value in on_robot.items()} == pytest.approx(
        {name: float(value) for name, value in simulated[0].items()}
    )


@pytest.mark.parametrize(
    ("others", "forward", "turn"),
    [
        ([], 0, 0),
        ([(0.3, 0.0, 0.0)], 0, 0),
        ([(1.0, 0.0, 0.0)], SPEED, 0),
        ([(0.0, 1.0, 0.0), (0.0, 3.0, 0.0)], 0, 1.5),
        ([(1.0, -0.1, 0.0)], SPEED * math.cos(math.atan(0.1)), -2 * math.atan(0.1)),
    ],
    ids=["alone", "near", "ahead", "left", "right"],
)
def test_a_robot_turns_to_the_centre_of_the_others_and_stops_near_it(
    others: list[tuple[float, float, float]], forward: float, turn: float
) -> None:
    command = runpy.run_path(str(EXAMPLE / "gathering.py"))["command"]
    assert command((0.0, 0.0, 0.0), others, SPEED) == pytest.approx((forward, turn), abs=1e-12)

"""The program that starts nodes where there is no `ros2 launch`. Nodes here are programs that tell how they were started."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.extensions.ros.ros2 import DRIVERS

pytestmark = pytest.mark.integration

TELLER = f"""\
#!{sys.executable}
import json, os, sys, yaml
files = [word for before, word in zip(sys.argv, sys.argv[1:]) if before == "--params-file"]
words = ["FILE" if word in files else word for word in sys.argv[1:]]
parameters = [yaml.safe_load(open(file)) if not file.endswith("given.yaml") else file for file in files]
print(json.dumps([words, parameters, os.environ.get("COLOUR", "")]))
"""
INCLUDED = """\
<launch>
  <arg name="who" default="nobody"/>
  <push_ros_namespace namespace="$(var who)"/>
  <node pkg="p" exec="tell" name="included"/>
</launch>
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with an installed package and a launch file to be included."""
    (tmp_path / "share/ament_index/resource_index/packages").mkdir(parents=True)
    (tmp_path / "share/ament_index/resource_index/packages/p").touch()
    (tmp_path / "lib/p").mkdir(parents=True)
    (tmp_path / "lib/p/tell").write_text(TELLER)
    (tmp_path / "lib/p/tell").chmod(0o755)
    (tmp_path / "lib/p/data").write_text("")
    (tmp_path / "other.launch.xml").write_text(INCLUDED)
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "other.launch.xml").write_text(INCLUDED)
    (tmp_path / "given.yaml").write_text("/**: {ros__parameters: {a: 1}}\n")
    return tmp_path


def launched(folder: Path, elements: str) -> subprocess.CompletedProcess[str]:
    """Start a launch file, and end it when all nodes have ended."""
    (folder / "a.launch.xml").write_text(f"<launch>\n{elements}\n</launch>\n")
    words = [sys.executable, str(DRIVERS / "ros2_launcher.py"), str(folder / "a.launch.xml")]
    environment = {**os.environ, "AMENT_PREFIX_PATH": str(folder), "COLOUR": "red", "TMPDIR": str(folder)}
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)
    lines: list[str] = []
    assert process.stdout is not None
    nodes = max(1, elements.count("<node") + elements.count("<include"))
    while sum("process has" in line for line in lines) < nodes and (line := process.stdout.readline()):
        lines.append(line)
    process.send_signal(signal.SIGINT)
    rest, errors = process.communicate()
    return subprocess.CompletedProcess(words, process.returncode, "".join(lines) + rest, errors)


def told(folder: Path, elements: str) -> list[Any]:
    """Return what nodes tell: their names, their words, their parameters and the variable COLOUR."""
    done = launched(folder, elements)
    assert done.returncode == 0, done.stderr
    lines = [
        line.partition("] ") for line in done.stdout.splitlines() if line.endswith("]") and "] [" in line and "pid" not in line
    ]
    return sorted([name.lstrip("["), *json.loads(text)] for name, _, text in lines)


NODE = '<node pkg="p" exec="tell" name="n"{}>{}</node>'


@pytest.mark.parametrize(
    ("elements", "expected"),
    [
        ('<node pkg="p" exec="tell"/>', ["tell-1", ["--ros-args"], [], "red"]),
        (NODE.format(" args=\"-a 'b c'\"", ""), ["n-1", ["-a", "b c", "--ros-args", "-r", "__node:=n"], [], "red"]),
        (
            '<let name="x" value="one two"/>' + NODE.format(' args="$(var x) $(env COLOUR) $(env NONE blue)"', ""),
            ["n-1", ["one two", "red", "blue", "--ros-args", "-r", "__node:=n"], [], "red"],
        ),
        (
            '<arg name="x" default="c"/><group><push_ros_namespace namespace="a"/>'
            '<group><push-ros-namespace namespace="b"/>' + NODE.format(' namespace="$(var x)"', "") + "</group></group>",
            ["a/b/c/n-1", ["--ros-args", "-r", "__node:=n", "-r", "__ns:=/a/b/c"], [], "red"],
        ),
        (
            NODE.format(' namespace="/z"', '<remap from="x" to="y"/><env name="COLOUR" value="green"/>'),
            ["z/n-1", ["--ros-args", "-r", "__node:=n", "-r", "__ns:=/z", "-r", "x:=y"], [], "green"],
        ),
        (
            '<group><set_env name="COLOUR" value="pink"/></group><let name="no" value="false"/>'
            + NODE.format("", '<remap if="$(var no)" from="x" to="y"/>')
            + '<group unless="true"><timer/></group>',
            ["n-1", ["--ros-args", "-r", "__node:=n"], [], "red"],
        ),
        (
            NODE.format("", '<param name="a" value="1"/><param name="b" value="1" type="str"/>'),
            [
                "n-1",
                ["--ros-args", "-r", "__node:=n", "--params-file", "FILE", "--params-file", "FILE"],
                [{"/**": {"ros__parameters": {"a": 1}}}, {"/**": {"ros__parameters": {"b": "1"}}}],
                "red",
            ],
        ),
        (
            '<set_parameter name="s" value="0.5"/>'
            + NODE.format(
                ' namespace="q"', '<param name="a"><param name="b" value="[1, 2]"/><param name="c" value="true"/></param>'
            ),
            [
                "q/n-1",
                ["--ros-args", "-r", "__node:=n", "-r", "__ns:=/q", "-p", "s:=0.5", "--params-file", "FILE"],
                [{"/q/n": {"ros__parameters": {"a": {"b": [1, 2], "c": True}}}}],
                "red",
            ],
        ),
        (
            '<include file="$(dirname)/other.launch.xml"><arg name="who" value="me"/></include>',
            ["me/included-1", ["--ros-args", "-r", "__node:=included", "-r", "__ns:=/me"], [], "red"],
        ),
    ],
)
@pytest.mark.each_case
def test_nodes_are_started_as_launch_ros_starts_them(folder: Path, elements: str, expected: list[Any]) -> None:
    assert told(folder, elements) == [expected]


@pytest.mark.parametrize(
    ("elements", "message"),
    [
        ("<timer/>", "a.launch.xml, line 2: <timer> needs the real ros2 launch, which is not on PATH"),
        (NODE.format(' respawn="true"', ""), "a.launch.xml, line 2: <node> has the attribute respawn, which needs the real"),
        (NODE.format(' args="$(eval 1)"', ""), "line 2: <node> args: $(eval 1) needs the real ros2 launch"),
        (NODE.format(' args="$(var x)"', ""), "line 2: <node> args: $(var x) has no value; declare it by <arg> or <let>"),
        (NODE.format(' if="maybe"', ""), "line 2: <node> if: 'maybe' is neither true nor false"),
        (NODE.format("", "<param/>"), "line 2: <param> lacks the attribute name"),
        (
            NODE.format("", '<param from="none.yaml"/>'),
            "line 2: <param> from: none.yaml is relative; write $(dirname)/none.yaml",
        ),
        (NODE.format("", '<param from="/none.yaml"/>'), "line 2: <param> from: /none.yaml does not exist"),
        ('<let name="x" value="5"/>' + NODE.format("", "<param name='a' value=\"'$(var x)'\"/>"), "has quotes beside"),
        ('<let name="x" value="5"/>' + NODE.format(" args=\"'$(var x) b'\"", ""), "has quotes or several blanks beside"),
        ('<let name="x" value="5"/>' + NODE.format(' args=" $(var x)"', ""), "has quotes or several blanks beside"),
        (NODE.format(' args="a\\ b"', ""), "has a backslash, which needs the real ros2 launch"),
        (NODE.format(' args="$(env  NONE x)"', ""), "has quotes or several blanks beside"),
        (NODE.format(' args="$(env NONE x&apos;y)"', ""), "has quotes or several blanks beside"),
        ('<group><set_parameter name="a" value="1"/></group>', "<set_parameter> in a group needs the real ros2 launch"),
        ('<set_parameter name="a" value="[1, 2]"/>', "<set_parameter> value: '[1, 2]' needs the real ros2 launch"),
        ('<let name="ros_namespace" value="/z"/>', "<let> sets ros_namespace, which needs the real ros2 launch"),
        ('<let name="x" value="0"/><group scoped="$(var x)"/>', "<group> has a substitution in scoped"),
        (
            '<include file="other.launch.xml"/>',
            "<include> file: other.launch.xml is relative; write $(dirname)/other.launch.xml",
        ),
        (
            '<include file="$(dirname)/sub/other.launch.xml"/>' + NODE.format(' args="$(dirname)"', ""),
            "$(dirname) needs the real ros2 launch",
        ),
        ('<arg name="x"/>', "line 2: <arg> x has no value; give it a default"),
        ('<node pkg="q" exec="tell"/>', "line 2: <node> pkg: the package 'q' is unknown"),
        ('<node pkg="p" exec="data"/>', "line 2: <node> exec: the package p has no executable file data"),
        ('\n<include file="/other.launch.py"/>', "line 3: <include> names other.launch.py, which is not XML"),
        ('<include file="$(dirname)/a.launch.xml"/>', "is the 20th file in another; it seems to include itself"),
        ("<node", "a.launch.xml, line 3: is not XML"),
        ("text", "<launch> has the text 'text'"),
    ],
)
@pytest.mark.each_case
def test_what_it_does_not_know_is_refused_with_its_line(folder: Path, elements: str, message: str) -> None:
    done = launched(folder, elements)
    assert done.returncode == 1
    assert done.stderr.startswith("Unable to launch ")
    assert message in done.stderr
    assert "process started" not in done.stdout


def test_a_file_of_parameters_is_given_as_it_is(folder: Path) -> None:
    [[_, words, files, _]] = told(folder, NODE.format("", '<param from="$(dirname)/given.yaml"/>'))
    assert words[-2:] == ["--params-file", "FILE"]
    assert files == [str(folder / "given.yaml")]


def test_without_ros_2_one_line_says_what_is_missing(tmp_path: Path) -> None:
    (tmp_path / "a.launch.xml").write_text("<launch/>")
    words = [sys.executable, str(DRIVERS / "ros_driver.py"), "a.launch.xml", ".", "ros2", "--ros", "2", "--length", "1"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith("ros: no ROS 2: name its setup script in [platforms.ros], or install it by pip install")
    assert done.stderr.count("\n") == 1

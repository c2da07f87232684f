"""Runs that record bags: several tables of one bag, a bag that was cut off, and all that reads recorded files."""

from __future__ import annotations

import contextlib
import json
import shutil
import sqlite3
from pathlib import Path

import pytest

from tests import projects
from tests.projects import quick, sql

pytest.importorskip("rosbags")

from tests.extensions.ros import bags
from tests.extensions.ros.bags import Recorded, odometry

SIMULATOR = """\
import shutil, sys

count = int(open(sys.argv[1]).read().split('<swarm count="')[1].split('"')[0])
content = open({bag!r}, "rb").read()
open("run.{kind}", "wb").write(content[:len(content) * 2 // 3] if count == 3 else content)
"""
OUTPUTS = """
[outputs.odom]
file = "run.{kind}"
format = "bag"
topics = ["/{{robot}}/odom"]
mismatch = "ragged"
units = {{ received_ns = "ns", header_stamp_ns = "ns" }}

[outputs.goal]
file = "run.{kind}"
format = "bag"
topics = ["/goal"]
"""


def project(folder: Path, kind: str = "mcap", more: str = "") -> Path:
    messages = [*odometry(2, 3), Recorded("/goal", "std_msgs/msg/Float64", 9, {"data": 0.5})]
    bag = bags.record(folder.with_name("bags"), kind, messages)
    config = projects.CONFIG.replace("runs = 2", "runs = 1") + OUTPUTS.format(kind=kind) + more
    return projects.make(folder, config, simulator=SIMULATOR.format(bag=str(bag), kind=kind))


@pytest.mark.integration
def test_bag_becomes_several_tables_and_a_cut_one_fails_the_run(tmp_path: Path) -> None:
    here = project(tmp_path / "p")
    ended = quick(here, "run", "population_size=1,3", "--no-figures")
    assert ended.returncode == 1
    [failed] = sql(here, "SELECT status, reason FROM executions WHERE status <> 'ok'")
    assert failed["status"] == "mismatch"
    assert str(failed["reason"]).startswith("run.mcap: is truncated: it does not end as an MCAP file")
    assert sql(here, 'SELECT robot, count(*) AS n, sum("pose.pose.position.x") AS x FROM odom GROUP BY ALL ORDER BY ALL') == [
        {"robot": "tb0", "n": 3, "x": 3.0},
        {"robot": "tb1", "n": 3, "x": 3.75},
    ]
    assert sql(here, "SELECT topic, data, population_size FROM goal") == [{"topic": "/goal", "data": 0.5, "population_size": 1}]
    kept = "SELECT output, kind, rows, counted_rows FROM artifacts WHERE path = 'run.mcap' ORDER BY ALL"
    assert [tuple(row.values()) for row in sql(here, kept)] == [
        ("goal", "file", None, None),
        ("goal", "table", 1, 1),
        ("odom", "file", None, None),
        ("odom", "table", 6, 6),
    ]
    refused = quick(here, "stats", "odom", "pose.pose.position.x").stderr
    assert "a run has rows of 2 topics, each at times of its own: choose one topic by `where`" in refused
    assert quick(here, "fsck").returncode == 0
    [run] = sql(here, "SELECT run FROM executions WHERE status <> 'ok'")
    recovered = quick(here, "files", str(run["run"]), "*.mcap", "--to", str(tmp_path / "out"), "--recover")
    assert recovered.returncode == 0
    [note] = [line for line in recovered.stderr.splitlines() if "odom.partial.parquet" in line]
    assert "messages written; is truncated" in note or "nothing was written" in note
    assert "needs --to" in quick(here, "files", str(run["run"]), "--recover").stderr


OWN = """
[source]
paths = ["sim.py"]

[outputs.state]
file = "run.db3"
format = "bag"
topics = ["/state"]
messages = ["packages"]
"""


def with_own_messages(folder: Path) -> Path:
    """Return a project whose runs leave a database of ROS before Iron, with a type whose definition is in the project."""
    from rosbags.typesys import get_types_from_msg

    store = bags.get_typestore(bags.Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg("float64 x\nfloat64 y\n", "own_msgs/msg/State"))
    messages = [Recorded("/state", "own_msgs/msg/State", 9, {"x": 0.5, "y": 2.0})]
    bag = bags.record(folder.with_name("bags"), "db3", messages, store=store)
    with contextlib.closing(sqlite3.connect(bag)) as database, database:
        database.execute("DROP TABLE message_definitions")
        database.execute("UPDATE topics SET type_description_hash = ''")
    config = projects.CONFIG.replace("runs = 2", "runs = 1") + OWN
    here = projects.make(folder, config, simulator=SIMULATOR.format(bag=str(bag), kind="db3"))
    (here / "packages" / "any" / "msg").mkdir(parents=True)
    (here / "packages" / "any" / "package.xml").write_text("<package><name> own_msgs </name></package>")
    (here / "packages" / "any" / "msg" / "State.msg").write_text("float64 x\nfloat64 y\n")
    return here


@pytest.mark.integration
def test_changed_definition_reads_again_and_a_replay_uses_the_recorded_one(tmp_path: Path) -> None:
    here = with_own_messages(tmp_path / "p")
    state = here / "packages" / "any" / "msg" / "State.msg"
    projects.run(here, "population_size=1")
    assert sql(here, "SELECT x, y FROM state") == [{"x": 0.5, "y": 2.0}]
    assert projects.run(here, "population_size=1")[0]["reevaluated"] == 0
    state.write_text("float64 x\nuint64 bits\n")
    summary, _ = projects.run(here, "population_size=1")
    assert (summary["executed"], summary["reevaluated"]) == (0, 1)
    assert sql(here, "SELECT x, bits FROM state") == [{"x": 0.5, "bits": 1 << 62}]
    [batch] = sql(here, "SELECT batch FROM batches")
    state.write_text("float32 x\n")
    replayed = quick(here, "replay", str(batch["batch"]))
    assert (replayed.returncode, "identical" in replayed.stdout) == (0, True)
    state.unlink()
    assert quick(here, "replay", str(batch["batch"])).returncode == 0


@pytest.mark.parametrize(
    ("files", "why"),
    [
        ({}, "messages: the folder 'packages' has no files PACKAGE/msg/NAME.msg"),
        ({"a/msg/S-1.msg": b""}, "packages/a/msg/S-1.msg: 'a/msg/S-1' is not the name of a type, such as my_msgs/msg/State"),
        ({"a/msg/S.msg": b"\xff"}, "messages: cannot read packages/a/msg/S.msg: it is not UTF-8 text"),
        ({"a/msg/S.msg": b"#" * 70_000}, "messages: packages/a/msg/S.msg has more than 65536 bytes"),
        ({"a/msg/S.msg": b"float64 x; import os"}, "the definition of the type 'a/msg/S': is damaged"),
        ({"a/msg/S.msg": b"", "a/package.xml": b"<package>"}, "packages/a/package.xml:1:"),
        ({"a/msg/S.msg": b"", "a/package.xml": b"<package/>"}, "packages/a/package.xml does not name its package"),
        ({"a/msg/S.msg": b"", "a/package.xml": b"<p><name>../b</name></p>"}, "'../b/msg/S' is not the name of a type"),
        (
            {"a/msg/S.msg": b"int8 x", "b/msg/S.msg": b"int8 y", "b/package.xml": b"<p><name>a</name></p>"},
            "packages/a/msg/S.msg and packages/b/msg/S.msg define the type 'a/msg/S' differently",
        ),
    ],
)
def test_definitions_that_cannot_be_used_are_named_before_anything_runs(
    tmp_path: Path, files: dict[str, bytes], why: str
) -> None:
    config = projects.CONFIG + OWN
    here = projects.make(tmp_path / "p", config)
    (here / "packages").mkdir()
    for name, content in files.items():
        path = here / "packages" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    ended = quick(here, "run", "population_size=1")
    assert (ended.returncode, len(ended.stderr.splitlines())) == (2, 1)
    assert "[outputs.state]: " in ended.stderr
    assert why in ended.stderr


@pytest.mark.nightly
def test_topics_of_a_bag_are_proposed_and_declared(tmp_path: Path) -> None:
    config = projects.CONFIG.replace("runs = 2", "runs = 1")
    image = Recorded("/tb0/camera", "sensor_msgs/msg/Image", 9, {"data": [1, 2]})
    path = Recorded("/path", "nav_msgs/msg/Path", 9, {"poses": [{}, {}]})
    bag = bags.record(tmp_path / "bags", "db3", [*odometry(2, 3), image, path])
    here = projects.make(tmp_path / "p", config, simulator=SIMULATOR.format(bag=str(bag), kind="db3"))
    assert quick(here, "run", "population_size=1", "--no-figures").returncode == 0
    shown = quick(here, "outputs").stdout
    assert 'topic /{robot}/odom (nav_msgs/msg/Odometry, 6 messages); declare [outputs.odom] file = "run.db3"' in shown
    assert "topic /tb0/camera (sensor_msgs/msg/Image, 1 message): 'data' has bytes, such as those of images" in shown
    assert quick(here, "outputs", "--write").returncode == 0
    assert 'units = {received_ns = "ns", header_stamp_ns = "ns"}' in (here / "sierra.toml").read_text()
    again = quick(here, "run", "population_size=1", "--no-figures")
    assert (again.returncode, "0 executed" in again.stdout or "reused" in again.stdout) == (0, True)
    assert sql(here, "SELECT robot, count(*) AS n FROM odom GROUP BY ALL ORDER BY ALL") == [
        {"robot": "tb0", "n": 3},
        {"robot": "tb1", "n": 3},
    ]
    assert sql(here, 'SELECT "poses.length" AS poses FROM path') == [{"poses": 2}]
    note = "output 'path' has the number of items of lists in 'poses.length'; the items are only in its files"
    assert note in again.stdout + again.stderr


@pytest.mark.integration
def test_replay_compares_the_messages_and_not_when_they_were_received(tmp_path: Path) -> None:
    here = project(tmp_path / "p", more="").resolve()
    config = (here / "sierra.toml").read_text().replace("units =", 'volatile = ["received_ns"]\nunits =')
    (here / "sierra.toml").write_text(config.replace('topics = ["/goal"]', 'topics = ["/goal"]\nvolatile = ["received_ns"]'))
    assert quick(here, "run", "population_size=1", "--no-figures").returncode == 0
    [batch] = sql(here, "SELECT batch FROM batches")
    bag = tmp_path / "bags" / "run" / "run.mcap"

    def recorded_again(later: int, data: float) -> None:
        shutil.rmtree(bag.parent)
        goal = Recorded("/goal", "std_msgs/msg/Float64", 9, {"data": data})
        bags.record(tmp_path / "bags", "mcap", [one._replace(received=one.received + later) for one in (*odometry(2, 3), goal)])

    recorded_again(5, 0.5)
    same = quick(here, "replay", str(batch["batch"]))
    assert (same.returncode, "equal" in same.stdout) == (0, True)
    recorded_again(5, 0.75)
    other = quick(here, "replay", str(batch["batch"]))
    assert other.returncode == 1
    assert "run.mcap (goal): row 0" in other.stdout or "'data' was 0.5 and is 0.75" in other.stdout


@pytest.mark.nightly
def test_recorded_bags_are_replayed_exported_and_read_again(tmp_path: Path) -> None:
    here = project(tmp_path / "p", "bag")
    assert quick(here, "run", "population_size=1", "--no-figures").returncode == 0
    [batch] = sql(here, "SELECT left(batch, 10) AS id FROM batches")
    replayed = quick(here, "replay", str(batch["id"]))
    assert (replayed.returncode, "identical" in replayed.stdout) == (0, True)
    assert quick(here, "files", str(batch["id"]), "--to", str(tmp_path / "out")).returncode == 0
    [exported] = (tmp_path / "out").rglob("run.bag")
    assert exported.read_bytes() == (tmp_path / "bags" / "run.bag").read_bytes()
    config = here / "sierra.toml"
    config.write_text(config.read_text().replace('["/goal"]', '["/goal", "/tb1/*"]'))
    unlike = quick(here, "run", "population_size=1", "--no-figures")
    assert (unlike.returncode, "have different fields" in unlike.stdout) == (1, True)
    config.write_text(config.read_text().replace('["/goal", "/tb1/*"]', '["/tb1/*"]'))
    again = quick(here, "run", "population_size=1", "--no-figures")
    assert again.returncode == 0
    assert sql(here, "SELECT count(*) AS n FROM goal") == [{"n": 3}]
    assert quick(here, "fsck").returncode == 0
    shown = json.loads(quick(here, "try", "--json", "population_size=1").stdout)
    assert [(one["table"], one["rows"]) for one in shown["files"]] == [("odom", 6), ("goal", 3)]


def test_robots_have_a_column_of_their_own(tmp_path: Path) -> None:
    here = project(tmp_path / "p", more='[robots]\ncount = "population_size"\ncommand = "python3 sim.py {input}"\n')
    ended = quick(here, "run", "population_size=1")
    assert ended.returncode == 2
    assert "[outputs.odom]: the column robot is the place of a robot; use another name in braces" in ended.stderr

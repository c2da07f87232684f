"""All kinds of inputs in one project, on each runner and in each engine: each run gets all of them, and so does its replay.

The project has three templates, files beside them, folders in values, arguments, variables of the environment, a service, and
commands before and after the command.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from tests import containers, projects

pytestmark = pytest.mark.real

SIMULATOR = """\
import json, os, socket, sys
from pathlib import Path

world, params, notes, port, noise = Path(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[3]), sys.argv[4], sys.argv[5]
arena = world.read_text()
settings = json.loads(params.read_text())
told = dict(line.split(" ", 1) for line in notes.read_text().splitlines())


def attribute(name):
    return arena.split(name + '="')[1].split('"')[0]


with socket.create_connection(("127.0.0.1", int(port))) as server:
    answer = int(server.recv(1))
values = {
    "count": int(attribute("count")),
    "speed": settings["speed"],
    "seed": settings["seed"],
    "mesh": int((world.parent / attribute("mesh")).read_text()),
    "map": int((params.parent / settings["map"]).read_text()),
    "area": int(Path(attribute("area")).read_text()),
    "wall": int(Path(told["walls"]).read_text()),
    "answer": answer,
    "made": int(Path("made").read_text()),
    "noise": int(noise.partition("=")[2]),
    "gain": int(os.environ["SIM_GAIN"]),
}
with open(settings["log"], "w") as file:
    print("t", *values, sep=",", file=file)
    print(0, *values.values(), sep=",", file=file)
"""
SERVER = """\
import socket, sys

server = socket.create_server(("127.0.0.1", int(sys.argv[1])))
while True:
    client, _ = server.accept()
    client.sendall(b"7")
    client.close()
"""
CONFIG = """\
templates = { world = "sim/world.xml", params = "config/params.json", notes = "notes.txt" }
files = ["sim/parts", "maps/*.map"]
command = "python3 sim.py {input.world} {input.params} {input.notes} {services.echo.port}"
seed = "params:/seed"
runs = 1
before = "sh -c 'cat \\"$1\\" > made' sh {project}/data/made"
after = "sh -c 'cat log.csv > again.csv'"
changes = [
    { set = "world://arena/@area", value = "{project}/data/area" },
    { set = "params:/log", value = "{output}/log.csv" },
]
[variables]
population_size = "world://swarm/@count"
speed = "params:/speed"
noise = { argument = "--noise={value}" }
gain = { environment = "SIM_GAIN" }
[services.echo]
command = "python3 {project}/server.py {port}"
ready = { port = "{port}" }
[outputs.log]
file = "log.csv"
time = "t"
[outputs.again]
file = "again.csv"
time = "t"
[runners.slurm]
array_tasks = 2
[runners.pbs]
array_tasks = 2
"""
FILES = {
    "sim.py": SIMULATOR,
    "server.py": SERVER,
    "sierra.toml": CONFIG,
    "sim/world.xml": '<arena area="none"><swarm count="1" mesh="parts/mesh"/></arena>\n',
    "sim/parts/mesh": "11\n",
    "config/params.json": '{"seed": 0, "speed": 1, "map": "../maps/one.map", "log": "none"}\n',
    "maps/one.map": "13\n",
    "notes.txt": "walls {{project}}/data/walls\n",
    "data/walls": "17\n",
    "data/area": "19\n",
    "data/made": "23\n",
}
QUERY = ("run", "population_size=1,2", "speed=3", "noise=4", "gain=5", "--no-figures")
FIXED = {"speed": 3, "noise": 4, "gain": 5, "mesh": 11, "map": 13, "wall": 17, "area": 19, "made": 23, "answer": 7}
"""What each run must have read, apart from its seed and the size of the population."""


def make(folder: Path) -> Path:
    for name, content in FILES.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(content)
    return folder


def contain(root: Path, engine: str, archive: Path) -> None:
    """Let the runs of a project execute in an image."""
    with (root / "sierra.toml").open("a") as file:
        file.write(f'[container]\nimage = "{archive}"\nengine = "{engine}"\n')
    pinned = projects.quick(root, "image", "pin")
    assert pinned.returncode == 0, pinned.stderr


@pytest.mark.parametrize(
    ("runner", "engine"),
    [
        ("local", "none"),
        ("local", "podman"),
        ("local", "apptainer"),
        ("slurm", "none"),
        pytest.param("slurm", "podman", marks=pytest.mark.nightly),
        ("slurm", "apptainer"),
        ("pbs", "none"),
        pytest.param("pbs", "podman", marks=pytest.mark.nightly),
        pytest.param("pbs", "apptainer", marks=pytest.mark.nightly),
    ],
)
def test_each_run_and_its_replay_get_all_inputs(
    tmp_path: Path, require: Callable[..., str], request: pytest.FixtureRequest, runner: str, engine: str
) -> None:
    root = make(tmp_path / "project")
    if runner != "local":
        request.getfixturevalue("slurm")
    if runner == "pbs":
        require("qsub")
    if engine != "none":
        require("busybox-static, as /bin/busybox", there=containers.BUSYBOX.exists())
        require("Debian's python3, as /usr/bin/python3", there=containers.PYTHON.exists())
        require("mksquashfs" if engine == "apptainer" else "podman")
        require(engine)
        contain(root, engine, containers.python(tmp_path))
    done = projects.quick(root, *QUERY, "--on", runner)
    assert done.returncode == 0, done.stdout + done.stderr
    read = projects.sql(root, 'SELECT population_size, "count", seed, * EXCLUDE (seed) FROM log ORDER BY population_size')
    assert [(row["population_size"], row["count"]) for row in read] == [(1, 1), (2, 2)]
    assert all({name: row[name] for name in FIXED} == FIXED for row in read), read
    seeds = {row["seed"] for row in projects.sql(root, "SELECT seed FROM runs")}
    assert {row["seed"] for row in read} == seeds
    assert projects.sql(root, "SELECT count(*) AS n FROM again JOIN log USING (execution)") == [{"n": 2}]
    isolated = "SELECT DISTINCT coalesce(i.engine, 'none') AS engine FROM executions LEFT JOIN isolations i USING (isolation)"
    assert projects.sql(root, isolated) == [{"engine": engine}]
    for folder in ("maps", "sim", "data"):
        shutil.rmtree(root / folder)
    replayed = projects.quick(root, "replay", str(projects.sql(root, "SELECT batch FROM batches")[0]["batch"]))
    assert (replayed.returncode, "identical (2 runs: 2 identical" in replayed.stdout) == (0, True), (
        replayed.stdout + replayed.stderr
    )

"""Files of the project beside the inputs of runs: `files` in `sierra.toml`."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from sierra.worker.shared_files import BESIDE_NS, LINKED, SharedFiles
from tests.projects import quick, run, sql

SIMULATOR = """\
import os, sys
from pathlib import Path

here = Path(sys.argv[1])
speed = (here.parent / here.read_text().split('include="')[1].split('"')[0]).read_text().strip()
mesh = here.parent / "meshes" / "a.stl"
with open("out.csv", "w") as file:
    print("tick,speed,mesh,new", file=file)
    print(0, speed, len(mesh.read_bytes()), (mesh.parent / "new").exists(), sep=",", file=file)
with mesh.open("ab") as file:  # a run may change its copy
    file.write(b"changed")
(mesh.parent / "new").write_text("left")
"""
TEMPLATE = '<world include="../conf/speed.txt"><swarm count="1" seed="0"/></world>\n'
CONFIG = """\
template = "sim/world.xml"
command = "python3 sim.py {input}"
files = ["conf", "sim/meshes/*.stl"]
seed = "//@seed"
runs = 2
[source]
paths = ["sim.py"]
[variables]
population_size = "//@count"
"""


def make(folder: Path, config: str = CONFIG) -> Path:
    for name in ("conf/inner", "sim/meshes"):
        (folder / name).mkdir(parents=True)
    (folder / "sim.py").write_text(SIMULATOR)
    (folder / "sim" / "world.xml").write_text(TEMPLATE)
    (folder / "conf" / "speed.txt").write_text("0.5\n")
    (folder / "conf" / "inner" / "tool.sh").write_text("#!/bin/sh\n")
    (folder / "conf" / "inner" / "tool.sh").chmod(0o755)
    (folder / "sim" / "meshes" / "a.stl").write_bytes(b"mesh")
    (folder / "sierra.toml").write_text(config)
    return folder


def outputs(root: Path) -> list[tuple[object, ...]]:
    return [(row["speed"], row["mesh"], row["new"]) for row in sql(root, "SELECT speed, mesh, new FROM out")]


@pytest.mark.integration
def test_each_run_has_its_own_copy_beside_its_input(tmp_path: Path) -> None:
    root = make(tmp_path / "p")
    _, noted = run(root, "population_size=1,2")
    assert "runs wrote files beside their input: {run}/sim/meshes/new" in noted
    assert outputs(root) == [(0.5, 4, False)] * 4
    assert (root / "sim" / "meshes" / "a.stl").read_bytes() == b"mesh"
    rows = sql(root, "SELECT name, size, executable FROM shared_files ORDER BY name")
    assert [(row["name"], row["size"], row["executable"]) for row in rows] == [
        ("conf/inner/tool.sh", 10, True),
        ("conf/speed.txt", 4, False),
        ("sim/meshes/a.stl", 4, False),
    ]
    assert quick(root, "fsck").returncode == 0


@pytest.mark.integration
def test_contents_are_part_of_the_identity_and_stored_once(tmp_path: Path) -> None:
    root = make(tmp_path / "p")
    run(root, "population_size=1")
    (root / "conf" / "speed.txt").write_text("0.25\n")
    assert run(root, "population_size=1")[0]["executed"] == 2
    (root / "conf" / "speed.txt").write_text("0.5\n")
    (root / "sim" / "meshes" / "note.txt").write_text("no pattern names it")
    assert run(root, "population_size=1")[0]["executed"] == 0
    copies = (
        "SELECT count(*) AS n FROM objects WHERE sha256 = (SELECT sha256 FROM shared_files WHERE name LIKE '%.stl' LIMIT 1)"
    )
    assert sql(root, copies)[0]["n"] == 1


@pytest.mark.nightly
def test_their_change_is_the_reason_for_new_runs(tmp_path: Path) -> None:
    root = make(tmp_path / "p")
    run(root, "population_size=1")
    (root / "conf" / "speed.txt").write_text("0.7\n")
    told = quick(root, "run", "population_size=1", "--explain", "--dry-run").stdout
    assert "file beside the inputs: conf/speed.txt has changed" in told
    run(root, "population_size=1")
    old, new = (row["batch"] for row in sql(root, "SELECT batch FROM batches ORDER BY lamport"))
    differences = quick(root, "diff", old, new)
    assert "file beside the inputs: conf/speed.txt has changed" in differences.stdout
    assert differences.returncode == 1


def test_a_name_that_is_not_utf8_is_one_line(tmp_path: Path) -> None:
    root = make(tmp_path / "p")
    (root / "conf" / os.fsdecode(b"\xff")).write_text("")
    done = quick(root, "run", "population_size=1", "--dry-run")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "is not UTF-8" in done.stderr


@pytest.mark.integration
def test_a_replay_takes_them_from_the_store(tmp_path: Path) -> None:
    root = make(tmp_path / "p")
    summary, _ = run(root, "population_size=1")
    shutil.rmtree(root / "conf")
    (root / "sim" / "meshes" / "a.stl").write_bytes(b"another mesh")
    assert quick(root, "gc", "--yes").returncode == 0
    done = quick(root, "replay", summary["batch"])
    assert done.returncode == 0, done.stderr
    assert "2 identical" in done.stdout


@pytest.mark.integration
def test_removed_batches_leave_the_files_of_others(tmp_path: Path) -> None:
    root = make(tmp_path / "p")
    first, _ = run(root, "population_size=1")
    (root / "conf" / "speed.txt").write_text("0.25\n")
    second, _ = run(root, "population_size=1")
    assert quick(root, "rm", first["batch"], "--yes").returncode == 0
    assert quick(root, "fsck").returncode == 0
    assert sql(root, "SELECT count(DISTINCT shared) AS n FROM shared_files")[0]["n"] == 1
    assert "2 identical" in quick(root, "replay", second["batch"]).stdout


@pytest.mark.integration
def test_a_variable_chooses_one_of_the_files(tmp_path: Path) -> None:
    words = 'command = "python3 sim.py {input} {run}/maps/{arena}.txt"\nfiles = ["conf", "sim/meshes/*.stl", "maps"]'
    config = CONFIG.replace('command = "python3 sim.py {input}"\nfiles = ["conf", "sim/meshes/*.stl"]', words)
    root = make(tmp_path / "p", config + "arena = {}\n")
    (root / "sim.py").write_text('import sys\nprint("wall", open(sys.argv[2]).read(), sep="\\n", file=open("out.csv", "w"))\n')
    (root / "maps").mkdir()
    for name, wall in (("lab", "3"), ("hall", "7")):
        (root / "maps" / f"{name}.txt").write_text(wall)
    _, notes = run(root, "arena=lab,hall")
    assert "are not detected" not in notes
    assert quick(root, "run", "arena=hall", "-n").stdout.count("0 of 2") == 1
    rows = sql(root, "SELECT DISTINCT r.arena, wall FROM out JOIN runs r USING (run) ORDER BY wall")
    assert rows == [{"arena": "lab", "wall": 3}, {"arena": "hall", "wall": 7}]


@pytest.mark.parametrize(
    ("files", "told"),
    [
        ('["none"]', "files: 'none' matches no file of the project"),
        ('["*.none"]', "files: '*.none' matches no file of the project"),
        (
            '["sim/{arena}/a.stl"]',
            "name the folder 'sim' here, and {run}/sim/{arena}/a.stl in the command",
        ),
        ('["../x"]', "should be a path within the project"),
        ('["/etc"]', "should be a path within the project"),
        ('["link"]', "files: link is a link, or in one; name the files themselves"),
        ('["linked"]', "files: linked/one is a link; name the files themselves"),
        ('["output"]', "files: output/x: the folder of a run has its own 'output'; move the file to another folder"),
        ('["sim"]', "files: each run has a generated sim/input.xml in its folder; rename the file"),
        ('["pipe"]', "files: pipe is not a file"),
    ],
)
def test_a_mistake_is_one_line(tmp_path: Path, files: str, told: str) -> None:
    root = make(tmp_path / "p", CONFIG.replace('["conf", "sim/meshes/*.stl"]', files))
    (root / "link").symlink_to("conf")
    (root / "linked").mkdir()
    (root / "linked" / "one").symlink_to("../sim.py")
    (root / "output").mkdir()
    (root / "output" / "x").write_text("")
    (root / "sim" / "input.xml").write_text("")
    os.mkfifo(root / "pipe")
    done = quick(root, "run", "population_size=1", "--dry-run")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert told in done.stderr


@pytest.mark.integration
def test_files_do_not_count_as_output_of_a_run(tmp_path: Path) -> None:
    root = make(tmp_path / "p", CONFIG + "[limits]\noutput = 100000\n")
    (root / "sim" / "meshes" / "a.stl").write_bytes(b"0" * 400000)
    assert run(root, "population_size=1")[0]["failed"] == 0


def test_a_changed_large_file_is_noticed(tmp_path: Path) -> None:
    folder = tmp_path / "shared"
    folder.mkdir()
    large = folder / "large"
    large.write_bytes(b"0" * LINKED)
    large.chmod(0o444)
    os.utime(large, ns=(BESIDE_NS, BESIDE_NS))
    files = SharedFiles(str(folder))
    assert files.changed() is None
    large.chmod(0o644)
    assert files.changed() == "a run has changed large, which all runs share"
    large.unlink()
    assert files.changed() == "a run has removed large, which all runs share"

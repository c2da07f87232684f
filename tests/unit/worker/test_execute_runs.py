"""`execute_runs.py` executes the jobs of a package on the standard library, and compares bytes without a wrong verdict."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import sierra
from sierra.packages import members
from sierra.packages.members import MANIFEST
from sierra.worker import execute_runs, gpus, package_plan
from tests import containers, projects
from tests.pythons import python_of
from tests.unit.packages.test_pack import TOML
from tests.unit.worker.test_package_plan import BATCH, LINE, made

SIMULATOR = (
    projects.SIMULATOR
    + """
import os, subprocess, time
assert open(os.environ["SIERRA_RUN_DIR"] + "/mesh.txt").read() == "a mesh"
subprocess.run([sys.argv[2]], check=True)
with open("clock.csv", "w") as file:
    print("tick,wall", 0, sep="\\n", end=f",{time.time()}\\n", file=file)
if os.path.exists(os.path.dirname(os.path.abspath(__file__)) + "/broken"):
    sys.exit("it is broken")
"""
)
CONFIG = (
    projects.CONFIG.replace("{input}", "{input} {project}/tool.sh").replace(
        "runs = 2\n",
        'runs = 2\nfiles = ["mesh.txt"]\nbefore = [["sh", "-c", "[ {arch} = $(uname -m) ] && echo {seed} > before.txt"]]\n',
    )
    + """
[outputs.swarm]
file = "swarm.csv"
[outputs.clock]
file = "clock.csv"
volatile = ["wall"]
"""
)


ABOUT = '[package]\ntitle = "x"\nauthors = [{ name = "A B" }]\nlicense = "MIT"\n'


def said(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str]:
    status = execute_runs.main(list(map(str, arguments)))
    return status, "".join(capsys.readouterr())


@pytest.mark.parametrize(
    ("line", "batch"),
    [
        (LINE, {"project": "../elsewhere"}),
        (LINE, {"jobs": "/etc/passwd"}),
        (LINE, {"files": {"a": {"member": "../../etc/passwd", "program": False}}}),
        (LINE, {"beside": {"../a": {"member": "project/a", "program": False}}}),
        (LINE, {"limits": 3}),
        (LINE, {"limits": {"marker": "../../etc/passwd", "after_marker_s": 1}}),
        (LINE, {"limits": {"wall_s": "stdout"}}),
        (LINE, {"limits": {"gpus": 0}}),
        (LINE, {"limits": {"gpus": "nan"}}),
        (LINE, {"limits": {"gpus": "inf"}}),
        (LINE, {"batch": "../../elsewhere"}),
        (LINE, {"environment": {"A": 1}}),
        ([1], {}),
        ({**LINE, "argv": "rm"}, {}),
        ({**LINE, "argv": []}, {}),
        ({**LINE, "files": {"../input.xml": ""}}, {}),
        ({**LINE, "files": {"input.xml": {"0": "there is no line before"}}}, {}),
        ({**LINE, "outputs": {"swarm.csv": None}}, {}),
        ({**LINE, "ended": float("inf")}, {}),
        ({**LINE, "ended": "x"}, {}),
    ],
)
def test_a_wrong_plan_or_job_is_one_line_and_executes_nothing(
    line: Any, batch: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status, printed = said(capsys, made(tmp_path / "x", line, **batch), tmp_path / "work", "--yes")
    assert (status, printed.count("\n")) == (1, 1)
    assert not (tmp_path / "work").exists()


def test_a_report_is_never_written_through_a_link(tmp_path: Path) -> None:
    (tmp_path / "victim").write_text("mine")
    (tmp_path / "reproduction.md").symlink_to(tmp_path / "victim")
    execute_runs.write_report(tmp_path / "reproduction.md", "ab" * 32, "LEVEL 2: *x*", ["a"], ["b"], 2, 0.0)
    assert (tmp_path / "victim").read_text() == "mine"
    assert "**LEVEL 2: \\*x\\***" in (tmp_path / "reproduction.md").read_text()


def test_outputs_that_match_a_pattern_are_compared_by_order(tmp_path: Path) -> None:
    patterns = {"patterns": ["log_*.csv"], "named": ["log_last.csv"]}
    batch = package_plan.Batch(tmp_path, {**BATCH, **patterns})
    found = {"log_10.csv": "a", "log_11.csv": "b", "log_last.csv": "c", "x.csv": "d"}
    recorded = {"log_9.csv": "a", "log_10.csv": "b", "log_last.csv": "c", "y.csv": "d"}
    assert execute_runs.renamed(found, recorded, batch) == {
        "log_9.csv": "a",
        "log_10.csv": "b",
        "log_last.csv": "c",
        "x.csv": "d",
    }
    fewer = {"log_11.csv": "a", "log_last.csv": "c"}
    assert execute_runs.renamed(fewer, recorded, batch) == {"log_9.csv": "a", "log_last.csv": "c"}


def test_what_is_missing_is_named_before_anything_is_asked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    needs = [{"name": "no-such-simulator", "version": "3.0"}]
    status, printed = said(capsys, made(tmp_path / "x", LINE, needs=needs), tmp_path / "work", "--yes")
    assert (status, "no-such-simulator is not installed (recorded: 3.0)" in printed) == (3, True)
    requires = {"requires": ["no-such-package>=4"]}
    own = {**LINE, "argv": [package_plan.PYTHON_MARK]}
    status, printed = said(capsys, made(tmp_path / "y", own, **requires), tmp_path / "work", "--yes")
    assert (status, "has no package no-such-package>=4" in printed) == (3, True)
    status, printed = said(capsys, made(tmp_path / "z", LINE), tmp_path / "work", "--engine", "podman", "--yes")
    assert (status, "recorded without a container image" in printed) == (3, True)
    status, printed = said(capsys, made(tmp_path / "o", LINE, obstacle="its containers had access"), tmp_path / "work")
    assert (status, "needs level 3: its containers had access" in printed) == (3, True)
    assert not (tmp_path / "work").exists()


def test_runs_that_request_gpus_get_their_own_or_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    prints = {**LINE, "argv": ["sh", "-c", "echo $CUDA_VISIBLE_DEVICES $XLA_PYTHON_CLIENT_MEM_FRACTION > seen"]}
    prints["outputs"] = {"seen": hashlib.sha256(b"1 0.45\n").hexdigest()}
    shares, whole = (made(tmp_path / name, prints, limits={"gpus": limit}) for name, limit in (("x", 0.5), ("y", 2)))
    for folder in (shares, whole):
        (folder / "project").mkdir()
    monkeypatch.setattr(gpus, "of_this_machine", lambda environment: gpus.Gpus("CUDA_VISIBLE_DEVICES", ("1",)))
    status, printed = said(capsys, shares, tmp_path / "work", "--yes")
    assert (status, "1 identical" in printed) == (0, True), printed
    status, printed = said(capsys, whole, tmp_path / "work", "--yes")
    assert (status, "request 2 GPUs each ([limits] gpus), but this machine has 1 GPU (1)" in printed) == (3, True), printed


def test_without_a_gpu_runs_that_request_one_execute_without_and_it_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    prints = {**LINE, "argv": ["sh", "-c", "echo ${CUDA_VISIBLE_DEVICES-none} > seen"]}
    prints["outputs"] = {"seen": hashlib.sha256(b"none\n").hexdigest()}
    shares = made(tmp_path / "x", prints, limits={"gpus": 0.5})
    (shares / "project").mkdir()
    monkeypatch.setattr(gpus, "of_this_machine", lambda environment: gpus.Gpus("CUDA_VISIBLE_DEVICES", ()))
    status, printed = said(capsys, shares, tmp_path / "work", "--yes")
    assert (status, "1 identical" in printed) == (0, True), printed
    assert "note: [limits] gpus = 0.5 is not heeded: this machine has no GPU, so the runs get none" in printed


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An extracted package whose runs use an ignored program, a file beside the input, a command before, and a clock."""
    root = projects.make(tmp_path_factory.mktemp("level") / "it's a project", CONFIG + TOML, simulator=SIMULATOR)
    (root / "mesh.txt").write_text("a mesh")
    (root / ".gitignore").write_text("tool.sh\n.sierra\n")
    (root / "tool.sh").write_text("#!/bin/sh\n")
    (root / "tool.sh").chmod(0o755)
    projects.commit(root)
    batch = sierra.open(root).run("population_size=1,2", figures=False).batch
    assert sierra.open(root).packages.pack(batch, report=False, path=root.parent / "x.zip") is not None
    with zipfile.ZipFile(root.parent / "x.zip") as file:
        file.extractall(root.parent / "x")
    shutil.rmtree(root)
    return root.parent / "x"


def changed(package: Path, folder: Path, change: Callable[[Path], object]) -> Path:
    """Return a changed copy of a package, with a manifest that fits."""
    shutil.copytree(package, folder, ignore=shutil.ignore_patterns("reproduction", "__pycache__"))
    change(folder)
    paths = (path for path in folder.rglob("*") if path.is_file() and path.name != MANIFEST)
    hashes = {path.relative_to(folder).as_posix(): sha256_of(path) for path in paths}
    (folder / MANIFEST).write_bytes(members.written(hashes))
    return folder


def sha256_of(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def executed(folder: Path, *arguments: str, python: str = sys.executable) -> tuple[int, str]:
    command = [python, "reproduce.py", "--execute", "--level=2", *arguments]
    done = subprocess.run(
        command,
        cwd=folder,
        env={"PATH": "/usr/bin:/bin"},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
    assert "Traceback" not in done.stderr
    return done.returncode, done.stdout + done.stderr


@pytest.mark.integration
def test_runs_are_executed_without_sierra_and_a_clock_is_not_comparable(
    require: Callable[..., str], package: Path, tmp_path: Path
) -> None:
    oldest = python_of("3.8")
    require("Python 3.8", there=oldest is not None)
    status, printed = executed(package)
    assert (status, "nothing was executed: nobody can be asked here" in printed) == (3, True)
    assert not (package / "reproduction").exists()
    status, printed = executed(package, "--yes", f"--work={tmp_path / 'work'}", python=str(oldest))
    assert (status, "LEVEL 2: 4 of 4 runs executed again: 4 not comparable" in printed) == (3, True)
    assert "clock.csv differs at the byte level (volatile: wall); level 3 compares values" in printed
    assert not (package / "reproduction").exists()


@pytest.mark.integration
@pytest.mark.each_case
@pytest.mark.parametrize(
    ("rules", "end"),
    [
        ("[limits]\nafter_marker = 0.2", "import time\nprint('finished', flush=True)\ntime.sleep(60)\n"),
        ("exit_status = [139]", "import os\nprint('finished', flush=True)\nos.kill(os.getpid(), 11)\n"),
    ],
    ids=["after its marker", "by a signal"],
)
def test_a_bad_end_that_counts_counts_without_sierra_too(rules: str, end: str, tmp_path: Path) -> None:
    success = f'[success]\nmarker = "stdout"\ncontains = "finished"\n{rules}\n'
    root = projects.make(tmp_path / "p", projects.CONFIG + success + ABOUT, simulator=projects.SIMULATOR + end)
    batch = sierra.open(root).run("population_size=1", runs=2, figures=False).batch
    assert sierra.open(root).packages.pack(batch, report=False, path=tmp_path / "x.zip") is not None
    with zipfile.ZipFile(tmp_path / "x.zip") as file:
        file.extractall(tmp_path / "x")
    status, printed = executed(tmp_path / "x", "--yes", f"--work={tmp_path / 'work'}")
    assert (status, "2 runs executed again: 2 identical" in printed) == (0, True), printed


def without_clock(folder: Path) -> None:
    """Let the simulator write the same time always, and the record say so."""
    program = folder / "project/sim.py"
    program.write_text(program.read_text().replace("time.time()", "0"))
    digest = hashlib.sha256(b"tick,wall\n0,0\n").hexdigest()
    [jobs] = (folder / "execution").glob("*.jsonl")
    lines = [json.loads(line) for line in jobs.read_text().splitlines()]
    for line in lines:
        line["outputs"]["clock.csv"] = digest
    jobs.write_text("".join(json.dumps(line) + "\n" for line in lines))


@pytest.mark.integration
def test_identical_bytes_are_the_verdict_only_if_all_are(package: Path, tmp_path: Path) -> None:
    same = changed(package, tmp_path / "same", without_clock)
    status, printed = executed(same, "--yes", "--budget=30m")
    assert (status, "LEVEL 2: 4 of 4 runs executed again: 4 identical" in printed) == (0, True)
    assert [path.name for path in (same / "reproduction").iterdir()] == ["reproduction.md"]
    assert "4 identical" in (same / "reproduction/reproduction.md").read_text()
    status, printed = executed(same, "--yes", "--runs=1")
    assert (status, "LEVEL 2: 2 of 4 runs executed again: 2 identical" in printed) == (0, True)

    def other(folder: Path) -> None:
        without_clock(folder)
        (folder / "project/sim.py").write_text((folder / "project/sim.py").read_text().replace("count * tick", "count + tick"))

    status, printed = executed(changed(package, tmp_path / "other", other), "--yes")
    assert (status, "4 different" in printed, "swarm.csv differs" in printed) == (1, True, True)
    broken = changed(package, tmp_path / "broken", lambda folder: (folder / "project/broken").write_text(""))
    status, printed = executed(broken, "--yes")
    assert (status, "4 failed" in printed, "it is broken" in printed) == (1, True, True)
    (same / "project/sim.py").write_text("changed after packing")
    status, printed = executed(same, "--yes")
    assert (status, "NOT VERIFIED" in printed, "LEVEL 2" in printed) == (1, True, False)


@pytest.mark.integration
def test_the_image_of_a_package_is_loaded_and_runs_have_no_network(require: Callable[..., str], tmp_path: Path) -> None:
    require("podman")
    marked = containers.host(tmp_path, containers.BUSYBOX, Path("/bin/true"))  # an image that no other test has
    simulator = containers.SIMULATOR + "ls /sys/class/net > network.txt\n"
    command = "/bin/busybox sh sim.sh {input}"
    tools = 'sed() { /bin/busybox sed "$@"; }; ls() { /bin/busybox ls "$@"; }\n'
    root = containers.make(tmp_path / "project", marked, command=command, simulator=tools + simulator)
    (root / "sierra.toml").write_text((root / "sierra.toml").read_text().replace("[container]", f"{TOML}\n[container]"))
    batch = sierra.open(root).run("population_size=1,2", runs=1, figures=False, engine="podman").batch
    sierra.open(root).packages.pack(batch, report=False, path=tmp_path / "x.zip")
    with zipfile.ZipFile(tmp_path / "x.zip") as file:
        file.extractall(tmp_path / "x")
    image = json.loads((tmp_path / "x/execution/plan.json").read_text())["batches"][0]["image"]["id"]
    subprocess.run(["podman", "rmi", "--force", image], check=True, capture_output=True)
    status, printed = executed(tmp_path / "x", "--yes")
    assert (status, f"podman has no image {image}" in printed, "LEVEL 2" in printed) == (3, True, False)

    def with_image(folder: Path) -> None:
        (folder / "environment/images").mkdir()
        shutil.copy(marked, folder / f"environment/images/{image.replace(':', '-')}.tar")

    packed = changed(tmp_path / "x", tmp_path / "packed", with_image)
    status, printed = executed(packed, "--yes")
    assert (status, "LEVEL 2: 2 of 2 runs executed again: 2 identical" in printed) == (0, True)
    assert "in podman containers without network" in printed
    assert sierra.open(root).sql("SELECT count(*) AS n FROM artifacts WHERE path = 'network.txt'").to_pylist() == [{"n": 2}]

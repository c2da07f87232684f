"""A folder of inputs that another system executes by `execute.sh`: the same results as here, whatever happens meanwhile."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.projects import CONFIG, make, quick, run, sql, start, values
from tests.waiting import until

pytestmark = pytest.mark.integration
QUERY = ("population_size=1,2", "--runs", "2")
NODE = {"PATH": os.environ["PATH"], "HOME": "/nowhere"}
"""The variables of a machine without SIERRA and without its settings."""


def written(project: Path, *words: str) -> Path:
    """Return the folder with the inputs of a query, beside the project."""
    folder = project.parent / "inputs"
    done = quick(project, "run", *(words or QUERY), "--inputs", str(folder))
    assert done.returncode == 0, done.stderr
    return folder


def execute(folder: Path, *words: str, shell: str = "sh") -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*shell.split(), "execute.sh", *words], cwd=folder, env=NODE, capture_output=True, text=True, check=False
    )


def ended(folder: Path) -> list[str]:
    return sorted(str(path.parent.relative_to(folder)) for path in folder.rglob("ended.json"))


@pytest.fixture
def project(tmp_path: Path) -> Path:
    package = '[package]\ntitle = "A study"\nauthors = [{ name = "Ada Lovelace" }]\nlicense = "MIT"\n'
    return make(tmp_path / "project", CONFIG + package)


def test_the_results_are_those_of_executions_here(project: Path) -> None:
    folder = written(project)
    for shard in ("0/2", "1/2"):
        done = execute(folder, shard)
        assert (done.returncode, done.stderr) == (0, "")
    moved = folder.rename(project.parent / "moved")
    done = quick(project, "collect", str(moved), "--no-figures")
    assert (done.returncode, f"collected from {moved}: 4 of 4 runs" in done.stdout) == (0, True)
    replayed = quick(project, "replay", "--json")
    assert (replayed.returncode, json.loads(replayed.stdout)["verdict"]) == (0, "identical")
    assert run(project, *QUERY)[0]["executed"] == 4
    results = (
        "SELECT run, result FROM executions WHERE purpose = 'run' AND programs {} (SELECT programs FROM programs WHERE {})"
    )
    elsewhere = "name = 'programs of another system'"
    collected, here = (sql(project, results.format(word, elsewhere) + " ORDER BY run") for word in ("IN", "NOT IN"))
    assert collected == here
    assert len(here) == 4
    for words in (("fsck",), ("package", "--yes", "-o", "../batch.zip")):
        checked = quick(project, *words)
        assert checked.returncode == 0, checked.stderr


@pytest.mark.parametrize("shell", ["dash", "bash --posix", "busybox sh"])
def test_each_shell_executes_the_runs(shell: str, project: Path) -> None:
    if shutil.which(shell.split()[0]) is None:
        pytest.skip(f"{shell} is not installed")
    folder = written(project)
    assert execute(folder, "0/1", shell=shell).returncode == 0
    assert quick(project, "collect", "../inputs", "--no-figures").returncode == 0
    assert values(project, "SELECT count(*) FROM executions WHERE status = 'ok' AND wall_s < 100 AND exit_code = 0") == {4}


PROGRAM = """
import json, os, signal, sys
count = open(sys.argv[1]).read().split('<swarm count="')[1][0]
if count == "2":
    sys.exit(7)
if count == "3":
    os.kill(os.getpid(), signal.SIGSEGV)
own = ("PATH", "HOME", "TMPDIR", "SIERRA_RUN_DIR", "LC_CTYPE")
given = {name: value for name, value in os.environ.items() if name not in own}
json.dump([sys.argv[2:], given, os.path.isdir(os.environ["TMPDIR"]), sys.stdin.read()], open("seen.json", "w"))
print("said")
"""


def test_words_and_variables_arrive_as_they_are(tmp_path: Path) -> None:
    odd = "a'; echo foo #\\n$HOME `id` \\\\"
    config = CONFIG.replace('"python3 sim.py {input}"', f'["python3", "sim.py", "{{input}}", "{odd}", ""]')
    config += f'[environment]\nset = {{ ODD = "{odd}", "A.B" = "x" }}\n'
    project = make(tmp_path / "o'dd $project", config, simulator=PROGRAM)
    folder = written(project, "population_size=1", "--runs", "1")
    assert execute(folder, "runs/0/0/").returncode == 0
    said, given, has_tmp, read = json.loads((folder / "runs/0/0/output/seen.json").read_text())
    text = odd.replace("\\n", "\n").replace("\\\\", "\\")
    command = json.loads((folder / "runs/0/0/command.json").read_text())
    assert (said, has_tmp, read) == ([text, ""], True, "")
    assert {name: given.get(name) for name in command["environment"]} == command["environment"]
    assert (given["ODD"], given["A.B"]) == (text, "x")
    assert (folder / "runs/0/0/stdout").read_text() == "said\n"


def test_failures_and_signals_are_recorded_as_here(tmp_path: Path) -> None:
    project = make(tmp_path / "project", simulator=PROGRAM)
    folder = written(project, "population_size=2,3", "--runs", "1")
    assert execute(folder, "0/1").returncode == 0
    assert quick(project, "collect", "../inputs", "--no-figures").returncode == 1
    assert quick(project, "run", "population_size=2,3", "--runs", "1", "--no-figures").returncode == 1
    ends = sql(project, "SELECT status, reason, exit_code, signal, count(*) AS n FROM executions GROUP BY ALL ORDER BY ALL")
    assert [(row["exit_code"], row["signal"], row["n"] >= 2) for row in ends] == [(None, 11, True), (7, None, True)]


def test_a_run_that_has_ended_is_not_executed_again(project: Path) -> None:
    folder = written(project)
    assert execute(folder, "runs/0/0", "runs/1/1").returncode == 0
    assert ended(folder) == ["runs/0/0", "runs/1/1"]
    record = folder / "runs/0/0/ended.json"
    before = record.read_bytes()
    (folder / "runs/0/0/output/old").write_text("old")
    assert execute(folder, "0/4").returncode == 0
    assert record.read_bytes() == before
    assert execute(folder, "--again", "0/4").returncode == 0
    assert record.read_bytes() != before
    assert not (folder / "runs/0/0/output/old").exists()


@pytest.mark.parametrize(
    "words", [(), ("4/4",), ("1/2", "0/2"), ("1/",), ("/2",), ("01/2",), ("..",), ("runs/0",), ("runs/0/7",), ("runs/0/0/..",)]
)
def test_other_arguments_are_refused_and_nothing_is_executed(words: tuple[str, ...], project: Path) -> None:
    folder = written(project)
    done = execute(folder, *words)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("usage: sh execute.sh")
    assert ended(folder) == []


def test_a_run_that_a_shell_cannot_execute_is_reported(tmp_path: Path) -> None:
    project = make(tmp_path / "project", CONFIG.replace("{input}", "{input} --port {port}"))
    folder = written(project)
    done = execute(folder, "runs/0/0")
    assert done.returncode == 1
    assert done.stderr == (
        "execute.sh: runs/0/0 has no command.sh; "
        "a run with ports, a checkpoint, robots or programs around it must be executed in another way\n"
    )
    assert not (folder / "runs/0/0/command.sh").exists()


def test_a_killed_script_leaves_no_record(tmp_path: Path) -> None:
    simulator = "import os, time\nopen('begun', 'w').close()\nos.kill(os.getppid(), 9)\ntime.sleep(0.2)\n"
    project = make(tmp_path / "project", simulator=simulator)
    folder = written(project)
    assert execute(folder, "0/1").returncode == -signal.SIGKILL
    assert ended(folder) == []
    assert "4 runs not ended" in quick(project, "collect", "../inputs").stdout


KILLED = """
import os, signal, sys
import sierra
from sierra.extensions import collect
from sierra.extensions.collect import runner
described = runner._described
def killed(directory):
    if directory.name == "3":
        os.kill(os.getpid(), signal.SIGKILL)
    return described(directory)
runner._described = killed
collect.collect(sierra.open("."), "../inputs", figures=False)
"""


def test_a_killed_collect_leaves_nothing_half_recorded(project: Path) -> None:
    folder = written(project)
    execute(folder, "0/1")
    killed = subprocess.run([sys.executable, "-c", KILLED], cwd=project, check=False)
    assert killed.returncode == -signal.SIGKILL
    done = quick(project, "collect", "../inputs", "--no-figures", "--json")
    assert (done.returncode, json.loads(done.stdout)["collected"]["failed"]) == (0, 0)
    assert sql(project, "SELECT count(*) AS n, count(DISTINCT run) AS d FROM executions") == [{"n": 4, "d": 4}]
    assert quick(project, "fsck").returncode == 0


def test_two_collects_at_once_record_each_run_once(project: Path) -> None:
    folder = written(project, "population_size=1,2", "--runs", "10")
    execute(folder, "0/1")
    both = [start(project, "collect", "../inputs", "--no-figures") for _ in range(2)]
    for process in both:
        out, err = process.communicate(timeout=200)
        assert process.returncode == 0, (out, err)
    assert sql(project, "SELECT count(*) AS n, count(DISTINCT run) AS d FROM executions") == [{"n": 20, "d": 20}]


def test_devices_that_a_scheduler_has_allotted_arrive(tmp_path: Path) -> None:
    from sierra.worker.devices import DEVICES

    project = make(tmp_path / "project", simulator="import os\nopen('seen', 'w').write(repr(dict(os.environ)))\n")
    folder = written(project, "population_size=1", "--runs", "1")
    devices = {name: f"0, {name}" for name in DEVICES}
    subprocess.run(["sh", "execute.sh", "0/1"], cwd=folder, env={**NODE, **devices, "OTHER": "1"}, check=True)
    seen = (folder / "runs/0/0/output/seen").read_text()
    assert [name for name in DEVICES if f"'{name}': '0, {name}'" not in seen] == []
    assert "OTHER" not in seen


WAITS = """
import pathlib, sys, time
go = pathlib.Path(__file__).parent.parent / "go"
print("begun", flush=True)
while not go.exists():
    time.sleep(0.01)
open("out.csv", "w").write("a\\n1\\n")
"""


@pytest.fixture
def waiting(tmp_path: Path) -> Path:
    """Return the folder of two runs that end when there is a file `go` beside it."""
    return written(make(tmp_path / "project", simulator=WAITS), "population_size=1,2", "--runs", "1")


def begin(folder: Path, shell: str = "sh") -> subprocess.Popen[str]:
    """Begin to execute all runs of a folder, in a process group of their own; return when the first one has begun."""
    words = [*shell.split(), "execute.sh", "0/1"]
    shell_process = subprocess.Popen(words, cwd=folder, env=NODE, text=True, start_new_session=True)
    log = folder / "runs/0/0/stdout"
    until(lambda: log.exists() and log.read_text() == "begun\n")
    return shell_process


def marks(folder: Path) -> list[str]:
    return [str(path.relative_to(folder)) for path in folder.glob("runs/*/.*")]


def test_a_run_that_another_process_executes_is_left_out_and_stays_whole(waiting: Path) -> None:
    first = begin(waiting)
    (waiting / "runs/0/0/output/kept").write_text("kept")
    second = execute(waiting, "--again", "runs/0/0")
    assert second.returncode == 1
    assert f"execute.sh: runs/0/0: process {first.pid} on " in second.stderr
    assert "executes it; if nothing does any more, remove runs/0/.0.running\n" in second.stderr
    (waiting.parent / "go").touch()
    assert first.wait() == 0
    assert (waiting / "runs/0/0/output/kept").exists()
    assert (ended(waiting), marks(waiting)) == (["runs/0/0", "runs/1/0"], [])


def test_a_run_whose_process_was_killed_is_executed_again(waiting: Path) -> None:
    first = begin(waiting)
    os.killpg(first.pid, signal.SIGKILL)
    first.wait()
    assert marks(waiting) == ["runs/0/.0.running"]
    (waiting.parent / "go").touch()
    done = execute(waiting, "0/1")
    assert (done.returncode, done.stderr, marks(waiting)) == (0, "", [])
    assert ended(waiting) == ["runs/0/0", "runs/1/0"]


@pytest.mark.parametrize("shell", ["dash", "bash", "busybox sh"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_is_not_recorded_as_ended_and_no_other_begins(
    shell: str, number: signal.Signals, waiting: Path
) -> None:
    if shutil.which(shell.split()[0]) is None:
        pytest.skip(f"{shell} is not installed")
    process = begin(waiting, shell)
    os.killpg(process.pid, number)
    assert process.wait() == 128 + number
    assert (ended(waiting), marks(waiting), (waiting / "runs/1/0/stdout").exists()) == ([], [], False)

"""`{checkpoint}`: a folder of the run that survives if it is cut off, and that its next execution gets."""

from __future__ import annotations

import json
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

import sierra
from sierra.execution import expected_durations
from sierra.ingest.observations import CONTINUED
from sierra.store.segments import Writer
from sierra.store.store import Store
from sierra.worker import checkpoints
from tests.projects import quick, sql, start
from tests.waiting import until

SIMULATOR = """\
import json, os, pathlib, signal, sys, time

given = json.loads(pathlib.Path(sys.argv[1]).read_text())
folder = pathlib.Path(sys.argv[2])
assert folder.is_dir() and given["folder"] == os.environ["KEPT"] == sys.argv[2]
state = folder / "state"
step = int(state.read_text()) if state.exists() else 0
state.write_text(str(step + 1))
print("step\\n%d" % step, file=open("out.csv", "w"))
ends = json.loads(os.environ["ENDS"])
end = ends[min(step, len(ends) - 1)]
if end == "hang":
    time.sleep(60)
if end == "kill":
    os.kill(os.getpid(), signal.SIGKILL)
if end == "crash":
    os.kill(os.getpid(), signal.SIGSEGV)
sys.exit(end)
"""
CONFIG = """\
template = "in.json"
command = "python3 sim.py {input} {checkpoint}"
seed = "/seed"
changes = [{ set = "/folder", value = "{checkpoint}" }]
[environment]
set = { KEPT = "{checkpoint}", ENDS = '%s' }
[limits]
wall = %s
[variables]
population_size = "/count"
"""
ONE = ("population_size=1", "--runs", "1")


def make(folder: Path, *ends: int | str, wall: float = 30, config: str = CONFIG) -> Path:
    """Write a project whose run ends in these ways, one after the other, as far as its checkpoint survives."""
    folder.mkdir(parents=True)
    (folder / "sim.py").write_text(SIMULATOR)
    (folder / "in.json").write_text('{"count": 1, "seed": 0, "folder": ""}')
    (folder / "sierra.toml").write_text(config % (json.dumps(ends), wall))
    return folder


def steps(root: Path) -> list[int]:
    return [row["step"] for row in sql(root, "SELECT step FROM out")]


def kept(root: Path) -> list[str]:
    return [path.name for path in (root / ".sierra").glob("checkpoints/*")]


def resumed(root: Path) -> list[str]:
    """Return the statuses of the executions that continued from a checkpoint."""
    query = "SELECT e.status FROM endings JOIN executions e USING (execution) WHERE kind = 'resumed' ORDER BY e.lamport"
    return [row["status"] for row in sql(root, query)]


def tried(root: Path) -> str:
    done = quick(root, "run", *ONE, "--no-figures", "--json")
    [row] = sql(root, "SELECT status FROM executions ORDER BY lamport DESC LIMIT 1")
    assert done.returncode == (row["status"] != "ok"), done.stderr
    return str(row["status"])


@pytest.mark.integration
def test_a_run_that_was_cut_off_continues_and_says_so(tmp_path: Path) -> None:
    root = make(tmp_path / "p", "hang", "kill", 0, wall=1)
    assert (tried(root), resumed(root)) == ("timeout", [])
    [folder] = kept(root)
    assert tried(root) == "failed"  # by a signal from outside
    assert kept(root) == [folder]
    assert (tried(root), kept(root)) == ("ok", [])
    assert resumed(root) == ["failed", "ok"]
    [batch] = sql(root, "SELECT batch FROM batches")
    assert "1 of 1 run continued from the checkpoint" in quick(root, "show", batch["batch"]).stdout
    used = "SELECT path FROM files_read UNION SELECT path FROM files_written"
    assert not [row for row in sql(root, used) if "state" in row["path"] or "checkpoint" in row["path"]]
    assert steps(root) == [2]
    [row] = sql(root, "SELECT DISTINCT run FROM executions")
    assert folder.startswith(row["run"])


@pytest.mark.integration
def test_a_run_that_continued_is_not_reused_after_an_edit_of_a_file_that_only_its_beginning_read(
    tmp_path: Path, require: Callable[..., str]
) -> None:
    require("strace")
    root = make(tmp_path / "p", "kill", 0)
    reading = "if step == 0:\n    (pathlib.Path(__file__).parent / 'map.txt').read_text()\n"
    (root / "sim.py").write_text(SIMULATOR.replace("state.write_text", f"{reading}state.write_text"))
    (root / "map.txt").write_text("wall")
    assert tried(root) == "failed"
    assert (tried(root), resumed(root)) == ("ok", ["ok"])
    observed = "SELECT method, o.reason FROM observations o JOIN executions e USING (execution) WHERE status = 'ok'"
    (root / "map.txt").write_text("door")
    assert "1 of 1 run would execute" in quick(root, "run", *ONE, "--dry-run").stdout
    assert sql(root, observed) == [{"method": "strace", "reason": CONTINUED}]


@pytest.mark.integration
@pytest.mark.parametrize("fault", [3, pytest.param("crash", marks=pytest.mark.each_case)])
def test_a_checkpoint_from_which_a_run_fails_is_not_used_again(tmp_path: Path, fault: int | str) -> None:
    root = make(tmp_path / "p", fault, fault, 0)
    assert tried(root) == "failed"
    assert len(kept(root)) == 1
    assert (tried(root), kept(root)) == ("failed", [])  # it had continued
    assert tried(root) == "failed"
    assert resumed(root) == ["failed"]


@pytest.mark.integration
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_run_continues_after_its_session_was_ended(tmp_path: Path, number: int) -> None:
    root = make(tmp_path / "p", "hang", 0)
    running = start(root, "run", *ONE, "--no-figures")
    until(lambda: list(root.glob(".sierra/checkpoints/*/files/state")))
    running.send_signal(number)
    running.wait()
    running.communicate()
    assert (tried(root), resumed(root), steps(root)) == ("ok", ["ok"], [1])
    assert kept(root) == []


@pytest.mark.integration
def test_the_checkpoint_is_in_no_id_and_a_replay_begins_anew(tmp_path: Path) -> None:
    root = make(tmp_path / "p", "hang", 0, 0, wall=1)
    assert tried(root) == "timeout"
    assert tried(root) == "ok"
    (root / "sierra.toml").write_text(CONFIG % ('["hang", 0, 0]', 1))
    [batch] = sql(root, "SELECT batch FROM batches")
    replayed = quick(root, "replay", batch["batch"])
    assert replayed.returncode == 1, replayed.stdout  # it hangs again, because it begins anew
    assert "ran longer than its limit" in replayed.stdout
    assert kept(root) == []
    other = make(tmp_path / "elsewhere" / "q", "hang", 0, 0, wall=1)
    run_there = quick(other, "run", *ONE, "--dry-run", "--json")
    assert batch["batch"] in run_there.stdout


@pytest.mark.integration
def test_a_run_that_executes_twice_at_once_shares_no_checkpoint(tmp_path: Path) -> None:
    root = make(tmp_path / "p", "hang", 0)
    first = start(root, "run", *ONE, "--no-figures")
    until(lambda: list(root.glob(".sierra/checkpoints/*/files/state")))
    [folder] = (root / ".sierra/checkpoints").iterdir()
    assert not checkpoints.discard(str(folder))
    again = {
        "run": "r",
        "execution": "e",
        "argv": ["a", checkpoints.TEXT],
        "environment": {},
        "files": {},
        "limits": {"grace_s": 0},
    }
    with checkpoints.claimed({**again, "checkpoint": str(folder)}) as job:  # type: ignore[typeddict-item]
        assert "claim" not in job
        own = tmp_path / "run"
        (own / "home").mkdir(parents=True)
        assert checkpoints.prepared(job, str(own))["resumed"] is False
        assert (own / "home/.sierra-checkpoint").is_dir()
    first.send_signal(signal.SIGINT)
    first.wait()
    first.communicate()


@pytest.mark.integration
def test_a_checkpoint_of_code_that_changed_meanwhile_is_not_used(tmp_path: Path) -> None:
    root = make(tmp_path / "p", "hang", 0)
    code = (root / "sim.py").read_text()
    running = start(root, "run", *ONE, "--no-figures")
    until(lambda: list(root.glob(".sierra/checkpoints/*/files/state")))
    (root / "sim.py").write_text(code + "\n# changed\n")
    running.send_signal(signal.SIGINT)
    running.wait()
    running.communicate()
    assert kept(root) == []


@pytest.mark.integration
def test_only_the_duration_of_a_whole_run_is_learnt(tmp_path: Path) -> None:
    root = make(tmp_path / "p", 3, 0)
    assert (tried(root), tried(root), resumed(root)) == ("failed", "ok", ["ok"])
    project = sierra.open(root)
    plan = project.plan("population_size=1", runs=1)
    runs = [run.id for run in plan.batch.runs]
    assert expected_durations.expected(plan, project.store, set(runs))[1] is None
    assert expected_durations.recorded(project.store, runs) is None


WITHOUT = CONFIG.replace("{input} {checkpoint}", "{input} x").replace('KEPT = "{checkpoint}", ', "") % ("[0]", 30)
NOWHERE = WITHOUT.replace('"{checkpoint}"', '"x"')


@pytest.mark.parametrize(
    ("config", "query", "continues"),
    [
        pytest.param(WITHOUT, "population_size=1", True, id="only in an input"),
        pytest.param(NOWHERE.replace("{ ENDS", '{ KEPT = "{checkpoint}", ENDS'), "population_size=1", True, id="variable"),
        pytest.param(NOWHERE, "population_size=1", False, id="nowhere"),
        pytest.param(NOWHERE.replace("{input} x", "{input} {{checkpoint}}"), "population_size=1", False, id="a text"),
        pytest.param(
            NOWHERE.replace("{input} x", "{input} {checkpoint}") + "checkpoint = {}\n", "checkpoint=7", False, id="a value"
        ),
    ],
)
def test_a_run_may_take_longer_than_an_array_task_if_it_continues(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, config: str, query: str, continues: bool
) -> None:
    root = make(tmp_path / "p", 0)
    (root / "sierra.toml").write_text(config)
    project = sierra.open(root)
    plan = project.plan(query, runs=1)
    known = [expected_durations.Timed({axis.name: 1.0 for axis in plan.batch.axes}, 9.0)]
    monkeypatch.setattr(expected_durations, "_timed", lambda plan, store, runner: iter(known))
    _, times = expected_durations.expected(plan, Store.create(project.paths.store), {run.id for run in plan.batch.runs})
    assert times is not None
    assert times.continues is continues


@pytest.mark.integration
def test_a_run_that_is_removed_begins_anew(tmp_path: Path) -> None:
    root = make(tmp_path / "p", 3, 0)
    assert (tried(root), len(kept(root))) == ("failed", 1)
    [batch] = sql(root, "SELECT batch FROM batches")
    assert quick(root, "rm", batch["batch"], "--yes").returncode == 0
    assert kept(root) == []


@pytest.mark.integration
def test_no_recorded_run_has_a_checkpoint_that_a_crash_would_leave(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = make(tmp_path / "p", 0)
    left: list[list[str]] = []
    publish = Store.publish

    def crash(store: Store, writer: Writer) -> None:
        publish(store, writer)
        left.append(kept(root))

    monkeypatch.setattr(Store, "publish", crash)
    assert tried(root) == "ok"
    assert left
    assert not any(left)


@pytest.mark.integration
def test_gc_removes_checkpoints_and_fsck_names_what_is_none(tmp_path: Path) -> None:
    root = make(tmp_path / "p", "hang", 0, wall=1)
    assert tried(root) == "timeout"
    (root / ".sierra/checkpoints/mine").mkdir()
    checked = quick(root, "fsck")
    assert "checkpoints/mine" in checked.stdout
    assert "is not a run's checkpoint" in checked.stdout
    assert "1 checkpoint of runs that were cut off" in quick(root, "gc", "--dry-run").stdout
    assert quick(root, "gc", "--yes").returncode == 0
    assert kept(root) == ["mine"]


def test_a_folder_that_sierra_has_not_made_is_not_removed(tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    (folder / "files").mkdir(parents=True)
    assert not checkpoints.discard(str(folder))
    (folder / "mark").write_text("other\n")
    assert not checkpoints.discard(str(folder))
    assert (folder / "files").is_dir()
    link = tmp_path / "link"
    link.symlink_to(folder)
    (folder / "mark").write_text("link\n")
    assert not checkpoints.discard(str(link))


def test_inputs_name_the_placeholder(tmp_path: Path) -> None:
    root = make(tmp_path / "p", 0)
    assert quick(root, "inputs", *ONE, "--to", "in").returncode == 0
    [inputs] = (root / "in").rglob("input.json")
    assert '"folder": "{checkpoint}"' in inputs.read_text()
    command = json.loads((inputs.parent / "command.json").read_text())
    assert command["argv"][-1] == command["environment"]["KEPT"] == "{checkpoint}"
    executed = subprocess.run(["sh", "execute.sh", "0/1"], cwd=root / "in", capture_output=True, text=True, check=False)
    assert (executed.returncode, "no command.sh; a run with ports, a checkpoint," in executed.stderr) == (1, True)


def test_a_variable_of_that_name_keeps_its_meaning(tmp_path: Path) -> None:
    config = CONFIG.replace("[variables]", "[variables]\ncheckpoint = {}")
    root = make(tmp_path / "p", 0, config=config)
    assert quick(root, "inputs", "checkpoint=7", "--runs", "1", "--to", "in").returncode == 0
    [path] = (root / "in").rglob("command.json")
    assert json.loads(path.read_text())["argv"][-1] == "7"


def test_robots_have_no_checkpoint(tmp_path: Path) -> None:
    config = CONFIG + "[robots]\ncount = 2\n"
    root = make(tmp_path / "p", 0, config=config)
    done = quick(root, "run", *ONE, "--dry-run")
    assert done.returncode == 2
    assert "runs on robots have no checkpoint" in done.stderr

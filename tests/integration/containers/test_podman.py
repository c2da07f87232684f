"""Runs in containers with real podman: identical results, isolation, reliable ends, and correct records."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests import containers, images
from tests.projects import SIERRA, quick, sierra
from tests.tiers import at_night
from tests.waiting import PATIENCE_S, until

pytestmark = pytest.mark.real
RUN = ("run", "population_size=1,2", "--no-figures", "-j2")


@pytest.fixture(scope="session")
def busybox(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if not containers.BUSYBOX.exists():
        return Path("/nowhere")
    return containers.busybox(tmp_path_factory.mktemp("busybox"))


@pytest.fixture(scope="session")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if not containers.PYTHON.exists() or not containers.BUSYBOX.exists():
        return Path("/nowhere")
    return containers.python(tmp_path_factory.mktemp("python"))


@pytest.fixture(autouse=True)
def podman(require: Callable[..., str]) -> str:
    require("busybox-static, as /bin/busybox", there=containers.BUSYBOX.exists())
    require("Debian's python3, as /usr/bin/python3", there=containers.PYTHON.exists())
    return require("podman")


def rows(folder: Path, statement: str) -> list[dict[str, Any]]:
    done = quick(folder, "sql", "--json", statement)
    assert done.returncode == 0, done.stderr
    answer: list[dict[str, Any]] = json.loads(done.stdout)
    return answer


def says(folder: Path, *words: str, code: int = 0) -> str:
    """Run a command; check its exit code and return its output."""
    done = quick(folder, *words)
    assert done.returncode == code, done.stdout + done.stderr
    assert "fault in SIERRA" not in done.stderr
    return done.stdout + done.stderr


# ---------------------------------------------------------------- execution and records


def test_a_batch_executes_in_its_image_and_sql_reports_it(tmp_path: Path, busybox: Path) -> None:
    folder = containers.make(tmp_path / "a project, with 'blanks' and: colons", busybox)
    assert "4 runs: 4 executed" in says(folder, *RUN)
    assert "0 executed, 4 reused" in says(folder, *RUN)
    [batch] = rows(folder, "SELECT engine, count(*) AS n FROM sessions WHERE executed > 0 GROUP BY ALL")
    assert batch == {"engine": "podman", "n": 1}
    [one] = rows(
        folder,
        "SELECT DISTINCT i.engine, i.mode, i.network, i.image = r.image AS same, r.host_access, m.kind FROM executions "
        "JOIN isolations i USING (isolation) "
        "JOIN batches USING (batch) JOIN specs r USING (spec) JOIN images m ON m.image = i.image",
    )
    assert one == {"engine": "podman", "mode": "run", "network": "none", "same": True, "host_access": [], "kind": "oci"}
    values = rows(folder, "SELECT DISTINCT population_size AS n FROM swarm WHERE tick = 2 ORDER BY n")
    assert values == [{"n": 1}, {"n": 2}]
    assert containers.left(folder) == []


RENDERS = """
if [ -n "$2" ]; then mkdir "$2"; for tick in 0 1 2; do printf 'P1 1 1 %s' $((tick % 2)) > "$2/$tick.pbm"; done; fi
"""


@pytest.mark.nightly
def test_runs_in_an_image_are_captured_in_it(tmp_path: Path, busybox: Path) -> None:
    folder = containers.make(tmp_path / "project", busybox)
    with (folder / "sim.sh").open("a") as simulator:
        simulator.write(RENDERS)
    says(folder, *RUN)
    config = (folder / "sierra.toml").read_text()
    capture = '[capture]\narguments = "{output}/frames"\nfiles = "frames/{tick}.pbm"\n'
    (folder / "sierra.toml").write_text(config + capture)
    says(folder, "capture")
    [one] = rows(
        folder,
        "SELECT count(*) AS n, min(frames) AS frames, min(verdict) AS verdict, min(i.engine) AS engine "
        "FROM captures JOIN executions USING (execution) JOIN isolations i USING (isolation)",
    )
    assert one == {"n": 2, "frames": 3, "verdict": "identical", "engine": "podman"}
    (folder / "sierra.toml").write_text(f"{config}{capture}display = true\n")
    assert "the program 'Xvfb' is not in the image" in says(folder, "capture", code=3)
    assert containers.left(folder) == []


TOLD = """\
{ echo what,said
grep -c : /proc/net/dev | sed 's/^/interfaces,/'
hostname | sed 's/^/host,/'
grep CapEff /proc/self/status | sed 's/.*\\t/capabilities,/'
grep NoNewPrivs /proc/self/status | sed 's/.*\\t/privileges,/'
date +%Z | sed 's/^/zone,/'
touch /file 2>/dev/null && echo root,writable || echo root,kept
touch "$SIERRA_RUN_DIR/file" 2>/dev/null && echo inputs,writable || echo inputs,kept
echo >> "$1" 2>/dev/null && echo input,writable || echo input,kept
touch "$PROJECT/file" 2>/dev/null && echo project,writable || echo project,kept
touch "$HOME/file" "$TMPDIR/file" /tmp/other && echo own,writable || echo own,kept
echo "threads,$OMP_NUM_THREADS"
echo "secret,$SECRET"
echo "value,$VALUE"
ls / | grep -cE '^(home|root|work|usr)$' | sed 's/^/folders,/'
ls "$HOME" | wc -l | sed 's/^/home,/'
} > told.csv
"""


def what_is_told(folder: Path) -> dict[str, Any]:
    """Return the surroundings that a run of the simulator TOLD reports."""
    with (folder / "sierra.toml").open("a") as file:
        file.write('[environment.set]\nPROJECT = "{project}"\nVALUE = \'a=b "c" $HOME\'\n[outputs.told]\nfile = "told.csv"\n')
    assert "2 executed" in says(folder, "run", "population_size=1", "--no-figures", "-j1")
    return {row["what"]: row["said"] for row in rows(folder, "SELECT DISTINCT what, said FROM told")}


@pytest.mark.parametrize("isolation", ["run", pytest.param("worker", marks=pytest.mark.nightly)])
def test_each_run_in_a_container_gets_ports_of_its_own(tmp_path: Path, python: Path, isolation: str) -> None:
    simulator = 'echo tick,value,other > swarm.csv\necho "0,$2,$P" >> swarm.csv\n'
    folder = containers.make(
        tmp_path / "project", python, f'isolation = "{isolation}"', command="sh sim.sh {input} {port}", simulator=simulator
    )
    config = (folder / "sierra.toml").read_text()
    (folder / "sierra.toml").write_text(f'{config}\n[environment]\nset = {{ P = "{{port2}}" }}\n')
    says(folder, *RUN)
    found = rows(folder, "SELECT value, other FROM swarm")
    assert len(found) == 4
    assert all(20_000 <= row["value"] != row["other"] >= 20_000 for row in found)


KEEPING = """\
import os, pathlib, signal, sys

state = pathlib.Path(sys.argv[2], "state")
step = int(state.read_text()) if state.exists() else 0
state.write_text(str(step + 1))
pathlib.Path("out.csv").write_text("step\\n%d\\n" % step)
if not step:
    os.kill(os.getpid(), signal.SIGKILL)
"""
"""A simulator that is killed once, and then continues."""


def continues(folder: Path) -> None:
    """Check that a run of KEEPING continues from its checkpoint in a container."""
    (folder / "sim.py").write_text(KEEPING)
    run = ("run", "population_size=1", "--runs", "1", "--no-figures")
    says(folder, *run, code=1)
    says(folder, *run)
    assert rows(folder, "SELECT step FROM out") == [{"step": 1}]
    assert rows(folder, "SELECT count(*) AS n FROM endings WHERE kind = 'resumed'") == [{"n": 1}]
    assert list((folder / ".sierra/checkpoints").iterdir()) == []


CHECKPOINT = "python3 sim.py {input} {checkpoint}"


@pytest.mark.nightly
@pytest.mark.parametrize("around", [False, True], ids=["alone", "with a command before"])
def test_a_run_in_a_container_that_was_cut_off_continues(tmp_path: Path, python: Path, *, around: bool) -> None:
    folder = containers.make(tmp_path / "a project, with 'blanks' and: colons", python, command=CHECKPOINT)
    if around:
        config = folder / "sierra.toml"
        config.write_text('before = [["python3", "-c", "pass"]]\n' + config.read_text())
    continues(folder)


def test_runs_that_share_a_container_have_no_checkpoint(tmp_path: Path, python: Path) -> None:
    folder = containers.make(tmp_path / "p", python, 'isolation = "worker"', command=CHECKPOINT)
    (folder / "sim.py").write_text(KEEPING)
    assert "needs a container for each run" in says(folder, *RUN, code=2)


def isolated(isolation: str) -> dict[str, Any]:
    """Return the expected surroundings, except the number of folders with names of the host."""
    return {
        "interfaces": "1",
        "host": "run",
        "capabilities": "0000000000000000",
        "privileges": "1",
        "zone": "UTC",
        "root": "kept",
        "inputs": "kept" if isolation == "run" else "writable",
        "input": "kept" if isolation == "run" else "writable",
        "project": "kept",
        "own": "writable",
        "threads": "1",
        "secret": None,
        "value": 'a=b "c" $HOME',
        "home": "1",
    }


SOCKETS = """\
python3 -c '
import os, socket, tempfile
socket.socket(socket.AF_UNIX).bind(tempfile.mkdtemp(prefix="pymp-") + "/listener-12345678")
open("told.csv", "w").write("what,said\\nsocket,1\\n")'
"""


def check_sockets(folder: Path) -> None:
    """Check that the runs of the simulator SOCKETS can make sockets in their TMPDIR, and leave nothing there."""
    says(folder, "run", "population_size=1", "--runs", "1", "--no-figures")
    assert rows(folder, "SELECT said FROM told") == [{"said": 1}]
    assert not list(folder.glob(".sierra/work/*/"))


@pytest.mark.parametrize("isolation", ["run", "worker"])
def test_sockets_can_be_made_in_tmpdir_in_a_project_with_a_long_path(tmp_path: Path, python: Path, isolation: str) -> None:
    check_sockets(containers.make(tmp_path / ("x" * 120), python, f'isolation = "{isolation}"', simulator=SOCKETS))


@pytest.mark.each_case
@pytest.mark.parametrize("isolation", ["run", "worker"])
def test_runs_are_isolated_by_default(tmp_path: Path, python: Path, isolation: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SECRET", "s3cret")
    folder = containers.make(tmp_path / "project", python, f'isolation = "{isolation}"', simulator=TOLD)
    told = what_is_told(folder)
    assert told.pop("folders") == "2"
    assert told == isolated(isolation)
    [row] = rows(folder, "SELECT DISTINCT mode, host FROM isolations JOIN executions USING (isolation)")
    assert (row["mode"], row["host"] != "run") == (isolation, True)


def test_runs_in_containers_are_not_observed_and_a_note_says_so(tmp_path: Path, busybox: Path) -> None:
    root = containers.make(tmp_path / "project", busybox)
    config = (root / "sierra.toml").read_text()
    done = quick(root, "run", "population_size=1", "--no-figures")
    assert (done.returncode, "observe" in done.stderr) == (0, False), done.stderr
    (root / "sierra.toml").write_text(f'observe = "all"\n{config}')
    done = quick(root, "run", "population_size=2", "--no-figures")
    assert (done.returncode, 'observe = "all" has no effect on runs in containers' in done.stderr) == (0, True), done.stderr
    counted = quick(root, "sql", "--format", "json", "SELECT count(*) AS n FROM observations")
    assert json.loads(counted.stdout) == [{"n": 0}]


@pytest.mark.nightly
def test_runs_do_not_share_a_container_of_an_image_without_python(tmp_path: Path, busybox: Path) -> None:
    folder = containers.make(tmp_path / "project", busybox, 'isolation = "worker"')
    assert "each run gets its own container" in says(folder, *RUN)
    assert rows(folder, "SELECT mode FROM isolations") == [{"mode": "run"}]


def test_outputs_belong_to_the_caller_and_work_folders_are_removed(tmp_path: Path, busybox: Path) -> None:
    folder = containers.make(tmp_path / "project", busybox, simulator=SIMULATOR_LOCKED)
    says(folder, *RUN)
    assert sorted(path.name for path in (folder / ".sierra" / "work").iterdir()) == ["lock", "mark"]


SIMULATOR_LOCKED = containers.SIMULATOR + "mkdir deep; echo x > deep/file; chmod 000 deep\n"


# ---------------------------------------------------------------- how runs end

HANGS = containers.SIMULATOR + "echo finished; sleep 77\n"
AFTER_MARKER = '[success]\nmarker = "stdout"\ncontains = "finished"\n[limits]\nafter_marker = 0.2\nwall = 60\n'


def ends_after_marker(folder: Path) -> None:
    """Check that runs which hang are ended after their marker, and count."""
    with (folder / "sierra.toml").open("a") as file:
        file.write(AFTER_MARKER)
    assert "4 runs: 4 executed" in says(folder, *RUN)
    [found] = rows(
        folder,
        "SELECT count(*) AS n, min(kind) AS kind, min(status) AS status, max(wall_s) < 40 AS soon "
        "FROM executions JOIN endings USING (execution)",
    )
    assert found == {"n": 4, "kind": "after marker", "status": "ok", "soon": True}


@pytest.mark.each_case
@pytest.mark.parametrize("isolation", ["run", "worker"])
def test_runs_that_hang_after_their_marker_are_ended_and_count(tmp_path: Path, python: Path, isolation: str) -> None:
    folder = containers.make(tmp_path / "project", python, f'isolation = "{isolation}"', simulator=HANGS)
    ends_after_marker(folder)
    assert containers.left(folder) == []


PRINTED = "[outputs.printed]\nfile = 'stdout'\nlines = 'score=(?P<score>\\S+)'\n"


@pytest.mark.each_case
@pytest.mark.parametrize("isolation", ["run", "worker"])
def test_what_runs_print_in_a_container_becomes_a_table(tmp_path: Path, python: Path, isolation: str) -> None:
    simulator = containers.SIMULATOR + "echo begin; echo score=0.5\n"
    folder = containers.make(tmp_path / "project", python, f'isolation = "{isolation}"', simulator=simulator)
    with (folder / "sierra.toml").open("a") as file:
        file.write(PRINTED)
    assert "4 runs: 4 executed" in says(folder, *RUN)
    assert rows(folder, "SELECT score, count(*) AS runs FROM printed GROUP BY score") == [{"score": 0.5, "runs": 4}]


@pytest.mark.each_case
@pytest.mark.parametrize(("isolation", "around"), [("worker", ""), ("run", 'after = "true"\n')])
def test_processes_that_still_run_in_a_container_are_named(tmp_path: Path, python: Path, isolation: str, around: str) -> None:
    simulator = containers.SIMULATOR + "setsid sleep 78 &\nsleep 0.5\n"  # the process has its name when the program ends
    folder = containers.make(tmp_path / "project", python, f'isolation = "{isolation}"', simulator=simulator)
    config = (folder / "sierra.toml").read_text()
    (folder / "sierra.toml").write_text(around + config)
    assert "in 4 of 4 runs processes were still running when the command ended, and were ended: sleep 78" in says(folder, *RUN)


ENDS = """\
case $(sed -n 's/.*count="\\([0-9]*\\)".*/\\1/p' "$1") in
1) exit 7;;
2) kill -SEGV $$;;
3) exit 125;;
4) exit 255;;
5) echo "ERROR: no" >&2; exit 127;;
6) exec sleep {mark};;
7) trap '' TERM; while true; do sleep 0.1; done;;
8) python3 -c 'x = bytearray(200000000); import time; time.sleep(2)';;
9) (sleep {mark} &); (setsid sleep {mark} &);;
esac
echo tick,coverage > swarm.csv
echo 0,1 >> swarm.csv
"""


ENDED = {
    1: ("failed", 7, None),
    2: ("failed", None, 11),
    3: ("failed", 125, None),
    4: ("failed", 255, None),
    5: ("failed", 127, None),
    6: ("timeout", None, 15),
    7: ("timeout", None, 9),
    9: ("ok", 0, None),
}
"""The status, exit status and signal of each run (for the eighth, the memory limit)."""


@pytest.mark.each_case
@pytest.mark.parametrize("isolation", ["run", "worker"])
@pytest.mark.parametrize("memory", ["120 MB", *at_night(["{120 + population_size} MB"])])
def test_all_kinds_of_ends_of_runs_are_distinguished(tmp_path: Path, python: Path, isolation: str, memory: str) -> None:
    mark = f"61.{os.getpid()}"
    simulator = ENDS.replace("{mark}", mark)
    folder = containers.make(tmp_path / "project", python, f'isolation = "{isolation}"', simulator=simulator)
    with (folder / "sierra.toml").open("a") as file:
        file.write(f'[limits]\nwall = 3.0\ngrace = 1.0\nmemory = "{memory}"\n')
    says(folder, "run", "population_size=1,2,3,4,5,6,7,8,9", "--runs", "1", "--no-figures", code=1)
    ended = rows(
        folder, 'SELECT population_size AS n, status, exit_code, "signal" FROM executions JOIN points USING (run) ORDER BY n'
    )
    found = {row["n"]: (row["status"], row["exit_code"], row["signal"]) for row in ended}
    assert found[8][0] == "memory"
    del found[8]
    assert found == ENDED
    assert containers.left(folder) == []
    assert list(containers.sleepers(mark)) == []


BURNS = "python3 -c 'import time; x = b\"1\" * 60000000\nwhile time.process_time() < 0.8: pass'\n" + containers.SIMULATOR


@pytest.mark.nightly
@pytest.mark.parametrize("isolation", ["run", "worker"])
def test_the_recorded_cpu_time_and_memory_exclude_the_engine(tmp_path: Path, python: Path, isolation: str) -> None:
    folder = containers.make(tmp_path / "project", python, f'isolation = "{isolation}"', simulator=BURNS)
    says(folder, "run", "population_size=1", "--runs", "1", "--no-figures")
    [used] = rows(folder, "SELECT user_s + system_s AS cpu, max_rss_bytes FROM executions")
    assert 0.7 < used["cpu"] < 1.0
    assert 60e6 < used["max_rss_bytes"] < 90e6


def test_a_command_missing_from_the_image_is_reported_before_any_run_executes(tmp_path: Path, busybox: Path) -> None:
    folder = containers.make(tmp_path / "project", busybox, command="simulate {input}")
    assert "the program 'simulate' is not in the image" in says(folder, *RUN, code=3)
    assert rows(folder, "SELECT count(*) AS n FROM executions") == [{"n": 0}]


# ---------------------------------------------------------------- killed processes

SLEEPS = containers.SIMULATOR + "sleep {mark}\n"


@pytest.fixture
def sleeping(tmp_path: Path, python: Path, request: pytest.FixtureRequest) -> Iterator[tuple[Path, subprocess.Popen[str], str]]:
    """Yield a batch whose two runs sleep in containers, and the mark of their processes."""
    mark = f"62.{os.getpid()}"
    folder = containers.make(
        tmp_path / "project", python, f'isolation = "{request.param}"', simulator=SLEEPS.replace("{mark}", mark)
    )
    words = [str(SIERRA), "run", "population_size=1", "--no-figures", "-j2"]
    asking = subprocess.Popen(
        words, cwd=folder, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True
    )
    until(lambda: len(list(containers.sleepers(mark))) >= 2 or asking.poll() is not None, "two runs sleep")
    assert asking.poll() is None
    yield folder, asking, mark
    asking.kill()
    asking.communicate()


def of(folder: Path, what: str) -> list[int]:
    """Return the processes of a batch on the host: its worker, or the clients of its containers."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            words = (process / "cmdline").read_bytes().split(b"\0")
        except OSError:
            continue
        if any(os.fsencode(folder / ".sierra") in word for word in words):
            client = words[0].endswith(b"podman")
            if client == (what == "clients") and b"conmon" not in words[0]:
                found.append(int(process.name))
    return found


def await_none(folder: Path, mark: str, seconds: float = PATIENCE_S / 2) -> None:
    until(lambda: not list(containers.sleepers(mark)) + containers.left(folder), "nothing is left", seconds)


@pytest.mark.parametrize(
    ("sleeping", "killed"),
    [
        *(("run", killed) for killed in ("sierra", "interrupted")),
        ("worker", "sierra"),
        *(pytest.param("run", killed, marks=pytest.mark.nightly) for killed in ("worker", "clients")),
        *(pytest.param("worker", killed, marks=pytest.mark.nightly) for killed in ("worker", "clients", "interrupted")),
    ],
    indirect=["sleeping"],
)
def test_no_container_survives_a_kill_and_the_batch_can_be_completed(
    sleeping: tuple[Path, subprocess.Popen[str], str], killed: str
) -> None:
    folder, asking, mark = sleeping
    if killed == "sierra":
        asking.kill()
    elif killed == "interrupted":
        os.killpg(asking.pid, signal.SIGINT)
    else:
        for pid in of(folder, killed):
            os.kill(pid, signal.SIGKILL)
    said, _ = asking.communicate(timeout=PATIENCE_S)
    assert asking.returncode == {"sierra": -9, "worker": 3, "clients": 1, "interrupted": 130}[killed], said
    assert "Traceback" not in said
    await_none(folder, mark)
    ended = {row["status"] for row in rows(folder, "SELECT status FROM executions")}
    assert ended == ({"failed"} if killed == "clients" else set())
    (folder / "sim.sh").write_text(containers.SIMULATOR)
    assert "2 executed" in says(folder, "run", "population_size=1", "--no-figures")


@pytest.mark.parametrize("sleeping", ["run"], indirect=True)
def test_the_next_run_command_ends_orphaned_containers(
    sleeping: tuple[Path, subprocess.Popen[str], str],
) -> None:
    folder, asking, mark = sleeping
    os.kill(asking.pid, signal.SIGSTOP)  # else it, or the worker after its end, may end the runs before they are killed
    for pid in (*of(folder, "worker"), *of(folder, "clients"), asking.pid):
        os.kill(pid, signal.SIGKILL)
    asking.wait()
    time.sleep(0.5)
    assert len(list(containers.sleepers(mark))) >= 2
    (folder / "sim.sh").write_text(containers.SIMULATOR)
    assert "2 executed" in says(folder, "run", "population_size=1", "--no-figures")
    await_none(folder, mark)


# ---------------------------------------------------------------- runs that share a container

MEDDLES = """\
case $(sed -n 's/.*count="\\([0-9]*\\)".*/\\1/p' "$1") in
1) (env -i setsid sh -c 'while sleep 0.05; do echo tick,coverage > /run/sierra/runs/2/output/swarm.csv; done' sh {mark} &)
   busybox readlink /proc/$PPID/fd/0 && exit 8;;
2) printf 'a line that is cut short' > /proc/1/fd/1
   echo '{"event":"end","exit_code":0,"outputs":[]}' > /proc/1/fd/1
   sleep 1
   [ -e /run/sierra/runs/.cid ] || [ -e /run/sierra/runs/../log ] && exit 9;;
3) cd /; for file in /run/sierra/runs/*/output/swarm.csv; do [ -f "$file" ] && echo tick,coverage > "$file"; done;;
4) cd /; mv "$SIERRA_RUN_DIR" /run/sierra/runs/old; ln -s /etc "$SIERRA_RUN_DIR"; exit 0;;
esac
cd "$SIERRA_RUN_DIR/output"
"""


def test_runs_that_share_a_container_cannot_change_records_of_others(tmp_path: Path, python: Path) -> None:
    mark = f"of-nobody-{os.getpid()}"
    meddles = MEDDLES.replace("{mark}", mark) + containers.SIMULATOR
    folder = containers.make(tmp_path / "project", python, 'isolation = "worker"', simulator=meddles)
    says(folder, "run", "population_size=1,2,3,4", "--runs", "1", "--no-figures", "-j1", code=1)
    ended = rows(folder, "SELECT population_size AS n, status, reason FROM executions JOIN points USING (run) ORDER BY n")
    assert [(row["n"], row["status"]) for row in ended] == [(1, "ok"), (2, "ok"), (3, "ok"), (4, "failed")], ended
    assert "its folder is gone" in ended[3]["reason"]
    values = rows(folder, "SELECT population_size AS n, count(*) AS rows FROM swarm GROUP BY ALL ORDER BY n")
    assert values == [{"n": 1, "rows": 3}, {"n": 2, "rows": 3}, {"n": 3, "rows": 3}]
    assert list(containers.sleepers(mark)) == []
    assert says(folder, "fsck").startswith("sound")


@pytest.mark.parametrize("engine", ["podman", "apptainer"])
def test_files_that_a_run_leaves_in_a_shared_container_are_removed(
    tmp_path: Path, python: Path, engine: str, require: Callable[..., str]
) -> None:
    require(engine)
    places = "/tmp /var/tmp /dev /dev/shm /dev/mqueue /run /run/sierra /run/sierra/runs"
    writes = f"""\
echo tick,place,found > swarm.csv
for place in {places}; do
    test -e $place/left && echo 0,$place,1 >> swarm.csv
    echo 1 2>/dev/null > $place/left
    mkdir -p $place/folder/inner 2>/dev/null && chmod 0 $place/folder
done
echo 1,none,0 >> swarm.csv
"""
    folder = containers.make(tmp_path / "project", python, 'isolation = "worker"', simulator=writes)
    assert "3 executed" in says(folder, "run", "population_size=1", "--runs", "3", "--no-figures", "-j1", "--engine", engine)
    assert rows(folder, "SELECT DISTINCT place FROM swarm") == [{"place": "none"}]


def test_a_run_fails_if_its_container_has_no_space_left(tmp_path: Path, python: Path) -> None:
    fills = 'grep -q \'count="1"\' "$1" && cat /dev/zero 2>/dev/null > /dev/shm/full\n' + containers.SIMULATOR
    folder = containers.make(tmp_path / "project", python, 'isolation = "worker"', simulator=fills)
    says(folder, "run", "population_size=1,2", "--runs", "1", "--no-figures", "-j1", code=1)
    ended = rows(folder, "SELECT population_size AS n, status, reason FROM executions JOIN points USING (run) ORDER BY n")
    assert [(row["n"], row["status"]) for row in ended] == [(1, "failed"), (2, "ok")]
    assert "no space was left in its container: /dev/shm" in ended[0]["reason"]


@pytest.mark.nightly
def test_a_run_that_stops_the_worker_in_its_container_is_ended(tmp_path: Path, python: Path) -> None:
    simulator = 'grep -q \'count="1"\' "$1" && kill -STOP $PPID && sleep 100\n' + containers.SIMULATOR
    folder = containers.make(tmp_path / "project", python, 'isolation = "worker"', simulator=simulator)
    with (folder / "sierra.toml").open("a") as file:
        file.write("[limits]\nwall = 2.0\ngrace = 0.5\n")
    says(folder, "run", "population_size=1,2", "--runs", "1", "--no-figures", "-j1", code=1)
    ended = rows(folder, "SELECT population_size AS n, status FROM executions JOIN points USING (run) ORDER BY n")
    assert ended == [{"n": 1, "status": "timeout"}, {"n": 2, "status": "ok"}]
    assert containers.left(folder) == []


# ---------------------------------------------------------------- identity


def ids(folder: Path, *words: str) -> set[str]:
    """Return the ids of the runs of a batch that would execute."""
    import sierra as package

    plan = package.open(folder).plan("population_size=1,2", **dict(zip(words[::2], words[1::2], strict=True)))
    return {run.id for run in plan.batch.runs}


def test_only_container_settings_that_may_change_results_are_part_of_the_identity(tmp_path: Path, busybox: Path) -> None:
    folder = containers.make(tmp_path / "project", busybox)
    (folder / "data").mkdir()
    (folder / "data" / "map").write_text("1")
    plain, config = ids(folder), (folder / "sierra.toml").read_text()
    seen = [plain, ids(folder, "engine", "none")]
    for more in ("network = true", 'devices = ["/dev/null"]', "gpu = true", 'mounts = { "/data" = "data" }'):
        (folder / "sierra.toml").write_text(config + more + "\n")
        seen.append(ids(folder))
    for k, one in enumerate(seen):
        assert all(one.isdisjoint(other) for other in seen[:k])
    for more in ("cpus = 1.0", "pids = 100", 'isolation = "worker"', 'engine = "apptainer"'):
        (folder / "sierra.toml").write_text(config + more + "\n")
        assert ids(folder) == plain


def test_a_mount_is_read_only_and_changes_of_its_content_execute_runs_again(tmp_path: Path, busybox: Path) -> None:
    writes = 'echo tick,coverage > swarm.csv; echo "0,$(cat /data/map)" >> swarm.csv\n'
    simulator = f"touch /data/x 2>/dev/null && exit 9\n{writes}"
    folder = containers.make(tmp_path / "project", busybox, f'mounts = {{ "/data" = "{tmp_path}/maps" }}', simulator=simulator)
    (tmp_path / "maps").mkdir()
    (tmp_path / "maps" / "map").write_text("1")
    assert "4 executed" in says(folder, *RUN)
    (tmp_path / "maps" / "map").write_text("2")
    assert "4 executed" in says(folder, *RUN)
    assert "4 reused" in says(folder, *RUN)
    shutil.rmtree(tmp_path / "maps")
    assert "/data" in says(folder, *RUN, "--runs", "3", code=3)


@pytest.mark.nightly
@pytest.mark.parametrize("engine", ["podman", "apptainer"])
def test_another_file_system_below_the_project_is_read_only(
    tmp_path: Path, busybox: Path, engine: str, require: Callable[..., str]
) -> None:
    require(engine)
    require("root", there=os.geteuid() == 0)
    simulator = "touch /run/sierra/project/'other one'/file 2>/dev/null && exit 9\n" + containers.SIMULATOR
    folder = containers.make(tmp_path / "project", busybox, simulator=simulator)
    (folder / "other one").mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "none", folder / "other one"], check=True)
    try:
        (folder / "other one" / "map").write_text("1")
        assert "4 executed" in says(folder, *RUN, "--engine", engine)
    finally:
        subprocess.run(["umount", folder / "other one"], check=True)


@pytest.mark.nightly
def test_moved_files_and_changed_links_of_a_mount_execute_runs_again(tmp_path: Path, busybox: Path) -> None:
    writes = 'echo tick,coverage > swarm.csv; echo "0,$(cat /data/latest/map)" >> swarm.csv\n'
    folder = containers.make(tmp_path / "project", busybox, f'mounts = {{ "/data" = "{tmp_path}/maps" }}', simulator=writes)
    old, new = tmp_path / "maps" / "old", tmp_path / "maps" / "new"
    for place, text in ((old, "1"), (new, "2")):
        place.mkdir(parents=True)
        (place / "map").write_text(text)
    latest = tmp_path / "maps" / "latest"
    latest.symlink_to("old")
    assert "4 executed" in says(folder, *RUN)
    old.rename(tmp_path / "aside")
    new.rename(old)
    (tmp_path / "aside").rename(new)
    assert "4 executed" in says(folder, *RUN)
    latest.unlink()
    latest.symlink_to("new")
    assert "4 executed" in says(folder, *RUN)
    assert rows(folder, "SELECT DISTINCT coverage FROM swarm") == [{"coverage": 1}]


def test_a_path_out_of_the_project_is_refused_in_a_container(tmp_path: Path, busybox: Path) -> None:
    folder = containers.make(tmp_path / "project", busybox, command="sh {project}/../sim.sh {input}")
    assert "[container] mounts" in says(folder, *RUN, code=2)


@pytest.mark.nightly
def test_variables_of_an_image_are_used_literally_and_checked_against_the_lock(tmp_path: Path) -> None:
    shell = [("bin/busybox", containers.BUSYBOX.read_bytes()), ("bin/sh -> busybox", ""), ("bin/env -> busybox", "")]
    layer = images.layer(*((name, "") for name in containers.FOLDERS), *shell)
    archive = images.docker_archive(
        tmp_path / "image.tar", [layer], images.config([layer], config={"Env": ["FORM={{seed}} {python}", "PATH=/bin"]})
    )
    writes = 'echo tick,coverage,form > swarm.csv; echo "0,1,$FORM" >> swarm.csv\n'
    folder = containers.make(tmp_path / "project", archive, simulator=writes)
    says(folder, *RUN)
    assert rows(folder, "SELECT DISTINCT form FROM swarm") == [{"form": "{{seed}} {python}"}]
    lock = folder / "sierra.lock"
    lock.write_text(lock.read_text().replace("{{seed}} {python}", "other"))
    assert "the variables of" in says(folder, *RUN, "--runs", "3", code=3)


@pytest.mark.nightly
@pytest.mark.parametrize("engine", ["podman", "apptainer"])
def test_a_volume_of_an_image_is_read_only(tmp_path: Path, engine: str, require: Callable[..., str]) -> None:
    require(engine)
    shell = [("bin/busybox", containers.BUSYBOX.read_bytes()), ("bin/sh -> busybox", "")]
    layer = images.layer(*((name, "") for name in (*containers.FOLDERS, "data/")), *shell)
    archive = images.docker_archive(
        tmp_path / "image.tar", [layer], images.config([layer], config={"Volumes": {"/data": {}}, "Env": ["PATH=/bin"]})
    )
    writes = "echo tick,kept > swarm.csv; if (: > /data/file) 2>/dev/null; then echo 0,1; else echo 0,0; fi >> swarm.csv\n"
    folder = containers.make(tmp_path / "project", archive, simulator=writes)
    says(folder, *RUN, "--engine", engine)
    assert rows(folder, "SELECT DISTINCT kept FROM swarm") == [{"kept": 0}]


@pytest.mark.nightly
def test_volumes_that_podman_gives_to_all_containers_are_refused(
    tmp_path: Path, busybox: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "seen").mkdir()
    conf = tmp_path / "containers.conf"
    conf.write_text(f'[containers]\nvolumes = ["{tmp_path}/seen:/seen"]\n')
    folder = containers.make(tmp_path / "project", busybox)
    monkeypatch.setenv("CONTAINERS_CONF", str(conf))
    assert f"{conf} gives volumes to all containers" in says(folder, *RUN, code=3)
    conf.write_text('[containers]\nvolumes = []\npidns = "host"\nipcns = "host"\numask = "0077"\n')
    alone = "test $$ -lt 100 && test $(umask) = 0022 || exit 9\n" + containers.SIMULATOR
    (folder / "sim.sh").write_text(alone)
    assert "4 executed" in says(folder, *RUN)


# ---------------------------------------------------------------- replay


def test_a_batch_is_replayed_in_its_image_and_on_a_host_with_the_same_programs(tmp_path: Path) -> None:
    archive = containers.host(tmp_path, Path("/usr/bin/gawk") if Path("/usr/bin/gawk").exists() else Path("/usr/bin/mawk"))
    program = "/usr/bin/gawk" if Path("/usr/bin/gawk").exists() else "/usr/bin/mawk"
    folder = containers.make(tmp_path / "project", archive, command=f"{program} -f sim.awk {{input}}")
    script = 'BEGIN { print "tick,coverage" > "swarm.csv"; print "0," exp(1.5) > "swarm.csv" }'
    (folder / "sim.awk").write_text(script)
    says(folder, *RUN)
    [batch] = rows(folder, "SELECT batch FROM batches")
    assert "identical (4 runs: 4 identical)" in says(folder, "replay", batch["batch"])
    assert "identical (4 runs: 4 identical)" in says(folder, "replay", batch["batch"], "--engine", "none")
    assert rows(folder, "SELECT engine FROM replays ORDER BY ended") == [{"engine": "podman"}, {"engine": "none"}]
    assert rows(folder, "SELECT count(*) AS n FROM isolations") == [{"n": 1}]


@pytest.mark.nightly
def test_a_replay_on_a_host_with_other_programs_names_them(tmp_path: Path, busybox: Path) -> None:
    folder = containers.make(tmp_path / "project", busybox)
    says(folder, *RUN)
    [batch] = rows(folder, "SELECT batch FROM batches")
    said = says(folder, "replay", batch["batch"], "--engine", "none")
    assert f"note: not executed in a container, and with other programs than in image {busybox}: " in said
    assert "in the image" in said
    assert "identical (4 runs: 4 identical)" in said
    assert rows(folder, "SELECT engine, verdict FROM replays") == [{"engine": "none", "verdict": "identical"}]


@pytest.mark.nightly
def test_a_missing_image_is_named(tmp_path: Path, busybox: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    archive = shutil.copy(busybox, tmp_path / "image.tar")
    folder = containers.make(tmp_path / "project", archive)
    says(folder, *RUN)
    archive.unlink()
    assert str(archive) in says(folder, *RUN, code=3)


@pytest.mark.nightly
def test_a_missing_podman_is_reported_in_one_line(tmp_path: Path, busybox: Path) -> None:
    folder = containers.make(tmp_path / "project", busybox)
    done = sierra(folder, *RUN, environment={"PATH": str(tmp_path)})
    assert (done.returncode, "podman" in done.stderr, len(done.stderr.splitlines())) == (3, True, 1), done.stderr


@pytest.mark.nightly
def test_two_concurrent_sessions_share_the_runs(tmp_path: Path, busybox: Path) -> None:
    folder = containers.make(tmp_path / "project", busybox, simulator=containers.SIMULATOR + "sleep 0.5\n")
    words = [str(SIERRA), "run", "population_size=1,2,3,4", "--no-figures", "-j2", "--json"]
    both = [subprocess.Popen(words, cwd=folder, text=True, stdout=subprocess.PIPE) for _ in range(2)]
    executed = [json.loads(one.communicate(timeout=120)[0])["executed"] for one in both]
    assert sum(executed) == 8
    assert rows(folder, "SELECT count(*) AS n FROM executions WHERE status = 'ok'") == [{"n": 8}]
    assert containers.left(folder) == []


@pytest.mark.nightly
def test_fsck_finds_a_batch_in_an_image_sound(tmp_path: Path, busybox: Path) -> None:
    folder = containers.make(tmp_path / "project", busybox)
    says(folder, *RUN)
    assert says(folder, "fsck").startswith("sound")


@pytest.mark.parametrize(("asked", "lacking"), [('devices = ["/dev/nothing"]', "/dev/nothing"), ("gpu = true", "NVIDIA")])
def test_a_missing_device_is_reported_before_any_run_executes(tmp_path: Path, busybox: Path, asked: str, lacking: str) -> None:
    if Path("/proc/driver/nvidia").exists():
        pytest.skip("needs a machine without NVIDIA's driver")
    folder = containers.make(tmp_path / "project", busybox, asked)
    assert lacking in says(folder, *RUN, code=3)
    assert rows(folder, "SELECT count(*) AS n FROM executions") == [{"n": 0}]


def test_a_limit_of_gpus_needs_containers_that_may_use_some(tmp_path: Path, busybox: Path) -> None:
    folder = containers.make(tmp_path / "project", busybox)
    config = folder / "sierra.toml"
    config.write_text(f"{config.read_text()}\n[limits]\ngpus = 1\n")
    assert "the containers of runs can use no GPU; add gpu = true to [container]" in says(folder, *RUN, code=2)


@pytest.mark.nightly
def test_a_run_is_tried_in_its_image_without_a_record(tmp_path: Path, busybox: Path) -> None:
    folder = containers.make(tmp_path / "project", busybox, simulator="echo hello\n" + containers.SIMULATOR)
    said = says(folder, "try", "population_size=2")
    assert said.startswith("hello\n--\nresult  ok\n")
    assert "swarm.csv" in said
    assert rows(folder, "SELECT count(*) AS n FROM executions") == [{"n": 0}]
    assert containers.left(folder) == []


@pytest.mark.nightly
def test_commands_of_inputs_have_the_paths_in_the_image(tmp_path: Path, busybox: Path) -> None:
    folder = containers.make(tmp_path / "project", busybox)
    assert "start the container yourself" in says(folder, "inputs", "population_size=2", "--to", "../inputs")
    command = json.loads((tmp_path / "inputs" / "runs" / "0" / "0" / "command.json").read_text())
    assert command["argv"] == ["sh", "/run/sierra/project/sim.sh", "../input.xml"]
    assert command["image_id"] in (folder / "sierra.lock").read_text()


# ---------------------------------------------------------------- refusals, and stopped processes


def test_a_request_without_a_device_of_its_runs_leaves_no_record(tmp_path: Path, busybox: Path) -> None:
    folder = containers.make(tmp_path / "project", busybox, 'devices = ["/dev/no-such-device"]')
    for _ in range(2):
        assert "submitted before" not in says(folder, *RUN, code=3)
        assert json.loads(quick(folder, "ls", "--json").stdout) == []
    assert not list((folder / ".sierra" / "segments").iterdir())


def test_a_run_that_stops_the_worker_in_its_container_does_not_hang(tmp_path: Path, python: Path) -> None:
    simulator = f"{containers.SIMULATOR}kill -STOP $PPID; sleep 1\n"
    folder = containers.make(tmp_path / "project", python, 'isolation = "worker"', simulator=simulator)
    assert "4 runs: 4 executed, 0 reused" in says(folder, *RUN)

"""Tests of the agent on a robot, as a process that this test drives through pipes, without SSH."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import secrets
import select
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from sierra.containers import held_start
from sierra.extensions.robots import agent as agent_programs
from sierra.extensions.robots.agent.records import AGENT
from sierra.util import worker_zip
from sierra.worker import on_host
from sierra.worker.processes import birth, marked, stat_of
from tests.waiting import PATIENCE_S, soon, until

IGNORES = "import signal, time; signal.signal(15, signal.SIG_IGN); print('on', flush=True); time.sleep(60)"
DAEMON = """
import os, time
if os.fork() == 0:
    os.setsid()
    if os.fork() == 0:
        open("daemon", "w").write(str(os.getpid()))
        time.sleep(60)
    os._exit(0)
while not os.path.exists("daemon"): time.sleep(0.01)
time.sleep(60)
"""


class Driver:
    """The driver of one agent."""

    def __init__(self, program: Path, folder: Path, lock: str) -> None:
        argv = [sys.executable, "-I", "-S", str(program), AGENT, str(folder), lock]
        self.process = subprocess.Popen(argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0)
        self.folder = folder
        folder.mkdir(exist_ok=True)
        self.attempt = secrets.token_hex(6)
        self.lines = bytearray()
        self.ended = False

    def send(self, do: str, **fields: Any) -> None:
        assert self.process.stdin
        self.process.stdin.write(json.dumps({"do": do, **fields}).encode() + b"\n")

    def receive(self, *events: str) -> dict[str, Any]:
        """Return the next event with one of these names, and renew the lease until then; other events are dropped."""
        assert self.process.stdout
        give_up = time.monotonic() + PATIENCE_S
        while time.monotonic() < give_up:
            line, found, rest = self.lines.partition(b"\n")
            if found:
                self.lines = rest
                record = json.loads(line)
                if record["event"] in events:
                    return dict(record)
                assert record["event"] != "refused", record
                continue
            if select.select([self.process.stdout], [], [], 0.05)[0]:
                data = os.read(self.process.stdout.fileno(), 65536)
                assert data, f"the agent ended before {events}"
                self.lines += data
            else:
                self.send("beat")
        raise AssertionError(f"none of {events}")

    def hello(self, **options: Any) -> dict[str, Any]:
        who = {"session": self.attempt, "text": f"tester {self.attempt}"}
        self.send("hello", **{"who": who, "lease": PATIENCE_S, **options})
        return self.receive("hello")

    def arm(self, code: str, **more: Any) -> None:
        self.arm_job(lambda: job(code, self.attempt, **more))

    def arm_job(self, make: Callable[[], dict[str, Any]]) -> None:
        self.make = make
        self.send("arm", attempt=self.attempt, job=make())
        self.receive("armed")

    def go(self, seconds: float = 0.1) -> float:
        """Give the armed run a start so much later; return it. On a busy machine, it may be late: then give it more time."""
        at = time.time_ns() + int(seconds * 1e9)
        self.send("at", attempt=self.attempt, at=at)
        if self.receive("gated", "late")["event"] == "gated":
            return at / 1e9
        self.remove()
        self.arm_job(self.make)
        return self.go(2 * seconds)

    def start(self, code: str, **more: Any) -> float:
        self.arm(code, **more)
        at = self.go()
        self.receive("started")
        return at

    def remove(self) -> None:
        """Wait for the end of the run, remove its folder, and begin a new attempt."""
        self.receive("ended")
        self.discard()

    def discard(self) -> None:
        self.send("done", attempt=self.attempt)
        self.receive("removed")
        self.attempt = secrets.token_hex(6)

    @property
    def output(self) -> Path:
        return self.folder / "runs" / self.attempt / "1" / "output"

    def is_alone(self) -> bool:
        """Return whether no process of the run is alive."""
        return not marked([b"SIERRA_EXECUTION=" + self.attempt.encode()])


def has_ended(pid: int) -> bool:
    return stat_of(pid)[:1] in ([], [b"Z"])


def job(code: str, execution: str, grace: float = 0.3, **limits: float) -> dict[str, Any]:
    return {
        "run": "ab" * 32,
        "execution": execution,
        "argv": [sys.executable, "-I", "-c", code],
        "environment": {"PATH": os.environ["PATH"], "SIERRA_EXECUTION": execution},
        "files": {},
        "limits": {"grace_s": grace, **limits},
    }


Start = Callable[..., Driver]


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the zip with the agent, as on a robot."""
    path = tmp_path_factory.mktemp("programs") / "worker.pyz"
    path.write_bytes(worker_zip.packed(Path(agent_programs.__file__).parent))
    return path


@pytest.fixture
def agent(program: Path, tmp_path: Path) -> Iterator[Start]:
    """Return a function that starts an agent; all of one test are on the same robot."""
    lock = f"sierra-test-{secrets.token_hex(6)}"
    drivers: list[Driver] = []

    def start() -> Driver:
        drivers.append(Driver(program, tmp_path / "robot", lock))
        return drivers[-1]

    yield start
    for driver in drivers:
        driver.process.kill()
        driver.process.wait()
        for pipe in (driver.process.stdin, driver.process.stdout):
            with contextlib.suppress(OSError):
                assert pipe
                pipe.close()
        until(driver.is_alone, "the run of a killed agent is gone")


def test_a_file_that_changed_since_it_was_verified_is_reported(agent: Start, tmp_path: Path) -> None:
    file, driver = tmp_path / "image", agent()
    file.write_text("1")
    driver.hello()
    state = on_host.state(str(file))[1:]
    for words in ("1", "2"):
        file.write_text(words) if words == "2" else None
        driver.send("check", unchanged={str(file): state})
        failed = driver.receive("checked")["failed"]
        assert failed == ([] if words == "1" else [f"{file} has changed since it was verified"])


def test_a_run_starts_at_its_time_and_leaves_its_outputs(agent: Start):
    driver = agent()
    given = {"HOME": os.environ["HOME"], "LIDAR": "front"}  # the first one is as in the login
    stop = ["sh", "-c", "echo $GREETING > ../../../stopped"]
    hello = driver.hello(setup="export GREETING='a  b'", stop=stop, variables=given)
    assert {"GREETING": "a  b", **given}.items() <= hello["variables"].items()

    def delay() -> float:
        driver.arm("open('x', 'w').write('1')")
        at = driver.go(0.2)
        ended = driver.receive("ended")
        assert ended["end"]["exit_code"] == 0
        assert ended["why"] is None
        assert ended["problems"] == []
        assert ended["end"]["started"] >= at
        assert [file["path"] for file in ended["end"]["outputs"]] == ["x"]
        driver.send("arm", attempt=driver.attempt, job=job("", driver.attempt))
        assert driver.receive("refused")["reason"] == f"attempt {driver.attempt} was armed before"
        driver.discard()
        assert list((driver.folder / "runs").iterdir()) == []
        return float(ended["end"]["started"] - at)

    assert soon(delay, 0.1)


def test_a_late_start_and_a_lost_driver_start_nothing(agent: Start):
    driver = agent()
    driver.hello()
    driver.arm("open('x', 'w')")
    driver.send("at", attempt=driver.attempt, at=time.time_ns() - 1)
    assert driver.receive("late")["by"] > 0
    assert driver.receive("ended")["started"] is False

    driver.attempt = "other"
    driver.arm("open('x', 'w')")
    driver.go(30)
    assert driver.process.stdin
    driver.process.stdin.close()
    assert driver.process.wait(PATIENCE_S) == 0
    assert not driver.output.exists()


@pytest.mark.integration
def test_a_lost_lease_ends_the_run_and_executes_the_stop_command(agent: Start):
    driver = agent()
    driver.hello(lease=2.0, stop=["touch", str(driver.folder / "stopped")])
    driver.start(f"import time; time.sleep({2 * PATIENCE_S})")
    assert driver.process.wait(PATIENCE_S) == 0
    assert driver.is_alone()
    assert (driver.folder / "stopped").exists()
    report = json.loads((driver.folder / "runs" / driver.attempt / "ended.json").read_text())
    assert report["why"] == "lost the driver: it was not heard of for 2 s"

    after = agent()
    [left] = after.hello(keep=[driver.attempt])["leftovers"]
    assert (left["attempt"], left["ended"], left["report"]) == (driver.attempt, 0, report)
    assert (driver.folder / "runs" / driver.attempt).exists()


@pytest.mark.parametrize("code", [IGNORES, DAEMON], ids=["ignores SIGTERM", "daemon"])
def test_everything_ends_within_the_grace_time(agent: Start, code: str):
    driver = agent()
    times = driver.folder / "stops"
    driver.hello(grace=0.3, stop=["sh", "-c", f"echo stop >> {times}"])
    assert times.read_text() == "stop\n"

    def seconds_to_end() -> float:
        driver.start(code)
        until(lambda: any(driver.output.iterdir()) or (driver.output.parent / "stdout").read_text(), "the program is on")
        times.unlink()
        driver.send("stop", attempt=driver.attempt, why="the operator stopped it")
        began = time.monotonic()
        ended = driver.receive("ended")
        took = time.monotonic() - began
        assert ended["why"] == "the operator stopped it"
        assert driver.is_alone()
        assert times.read_text() == "stop\nstop\n", "at the first sign, and when the last process is gone"
        driver.discard()
        return took

    assert soon(seconds_to_end, 2.5)


MOVES = """
import os, signal, sys, time
def drive():
    with open("SPEEDS", "a") as file:
        file.write("0.5\\n")
for number in (signal.SIGTERM, signal.SIGXCPU):
    signal.signal(number, lambda *_: end())
def end():
    give_up = time.monotonic() + SECONDS
    while time.monotonic() < give_up:
        drive()
        time.sleep(0.02)
    os._exit(0)
drive()
open("on", "w").close()
HOW
"""
"""A controller that sends its speed until it has ended, which takes so long after a signal, as launchers of ROS do."""
LEAVES = """
if os.fork() == 0:
    os.setsid()
    os.fork()
    end()
os._exit(0)
"""


def controller(driver: Driver, how: str = "time.sleep(600)", seconds: float = 0.5) -> str:
    speeds = str(driver.folder / "speeds")
    return MOVES.replace("SPEEDS", speeds).replace("SECONDS", str(seconds)).replace("HOW", how)


def stands(driver: Driver) -> bool:
    return (driver.folder / "speeds").read_text().splitlines()[-1] == "0"


def stop_of(driver: Driver) -> list[str]:
    """Return a command that stops the motor, unless there is a file `broken`."""
    return ["sh", "-c", 'test ! -e "$0/broken" && echo 0 >> "$0/speeds"', str(driver.folder)]


@pytest.mark.integration
@pytest.mark.each_case
@pytest.mark.parametrize("how", ["stop", "lease", "agent", "wall", "end", "child", "worker", "exit"])
def test_a_robot_stands_however_its_run_ends(agent: Start, how: str) -> None:
    driver = agent()
    driver.hello(grace=5.0, stop=stop_of(driver), lease=1.0 if how == "lease" else PATIENCE_S)
    assert stands(driver)
    code = {"end": "", "child": LEAVES, "exit": "sys.exit(3)"}.get(how, "time.sleep(600)")
    limits = {"wall_s": 0.3} if how == "wall" else {}
    driver.start(controller(driver, code), grace=5.0, **limits)
    until((driver.output / "on").exists)
    known = json.loads((driver.output.parents[1] / "process.json").read_text())
    match how:
        case "stop":
            driver.send("stop", attempt=driver.attempt, why="the base station's program has ended")
        case "agent" | "worker":
            os.kill(driver.process.pid if how == "agent" else known["pid"], signal.SIGKILL)
    if how in ("lease", "agent"):
        driver.process.wait(PATIENCE_S)
        until(lambda: driver.is_alone() and stands(driver))
    else:
        ended = driver.receive("ended")
        assert ended["moving"] is None
    assert driver.is_alone()
    assert stands(driver)


@pytest.mark.integration
def test_a_limit_stops_the_robot_before_its_program_has_ended(agent: Start) -> None:
    driver = agent()
    stopped = driver.folder / "stopped"
    driver.hello(stop=["touch", str(stopped)])
    stopped.unlink()
    driver.start(IGNORES, grace=60.0, wall_s=0.3)
    until(stopped.exists)
    assert not driver.is_alone()
    driver.send("stop", attempt=driver.attempt, why="the test is over")
    driver.receive("ended")


def test_a_disk_without_room_for_a_file_does_not_hinder_the_stop(agent: Start, tmp_path: Path) -> None:
    driver = agent()
    speeds = tmp_path / "speeds"
    driver.hello(stop=["sh", "-c", f"echo 0 >> {speeds}"])
    driver.start("import time; time.sleep(600)")
    speeds.unlink()
    shutil.rmtree(driver.folder / "runs")
    (driver.folder / "runs").write_text("no folder any more")
    driver.send("stop", attempt=driver.attempt, why="the test is over")
    assert driver.receive("ended")["moving"] is None
    assert speeds.read_text() == "0\n0\n"


@pytest.mark.integration
@pytest.mark.each_case
@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ("exit 1", "ended with status 1"),
        ("echo no motor; exit 3", "ended with status 3: no motor"),
        ("sleep 1000", "did not end within 0.2 s"),
    ],
)
def test_a_stop_command_that_fails_or_hangs_is_reported(agent: Start, wrong: str, said: str):
    driver = agent()
    broken = driver.folder / "broken"
    driver.hello(grace=0.2, stop=["sh", "-c", f"test ! -e {broken} || {{ {wrong}; }}"], stop_limit=0.2)
    driver.start("import time; time.sleep(60)")
    broken.touch()
    driver.send("stop", attempt=driver.attempt, why="a test")
    ended = driver.receive("ended")
    assert ended["problems"] == [f"the stop command {said}"]
    assert ended["moving"] == f"the stop command {said}"
    assert driver.is_alone()
    driver.send("bye")
    driver.process.wait(PATIENCE_S)
    after = agent()
    after.send("hello", who={}, stop=["sh", "-c", wrong], stop_limit=0.2)
    assert after.receive("refused")["reason"] == f"may be moving: the stop command {said}"


def test_a_stop_command_is_executed_though_the_setup_line_fails(agent: Start) -> None:
    driver = agent()
    driver.send("hello", who={}, setup="false", stop=stop_of(driver))
    assert driver.receive("refused")["reason"] == "its setup line ended with status 1: "
    assert stands(driver)


def test_a_robot_that_cannot_execute_programs_is_refused(agent: Start) -> None:
    driver = agent()
    (driver.folder / "probe.sh").mkdir()
    driver.send("hello", who={})
    assert "probe.sh: Is a directory" in driver.receive("refused")["reason"]


@pytest.mark.integration
def test_a_worker_executes_several_runs(agent: Start) -> None:
    driver = agent()
    driver.hello()
    pids = set()
    for number in range(3):
        driver.start(f"open('x', 'w').write('{number}')")
        ended = driver.receive("ended")
        assert [file["path"] for file in ended["end"]["outputs"]] == ["x"]
        assert (driver.output / "x").read_text() == str(number)
        pids.add(json.loads((driver.output.parents[1] / "process.json").read_text())["pid"])
        driver.discard()
    assert len(pids) == 1


def test_a_robot_has_one_driver(agent: Start):
    first = agent()
    first.hello()
    second = agent()
    second.send("hello", who={"session": "other"})
    assert second.receive("refused")["reason"] == f"in use by tester {first.attempt}"
    first.send("bye")
    first.process.wait(PATIENCE_S)
    assert second.hello()["leftovers"] == []


@pytest.mark.integration
@pytest.mark.each_case
@pytest.mark.parametrize("step", ["armed", "gated", "started", "gone"])
def test_what_a_killed_agent_leaves_is_ended_and_reported(agent: Start, step: str):
    driver = agent()
    driver.hello(grace=0.2, stop=stop_of(driver))
    driver.arm(DAEMON, grace=0.2)
    if step != "armed":
        driver.go(30 if step == "gated" else 0.1)
    if step in ("started", "gone"):
        driver.receive("started")
        until((driver.output / "daemon").exists)
    driver.process.send_signal(signal.SIGKILL)
    driver.process.wait()
    pid = json.loads((driver.output.parents[1] / "process.json").read_text())["pid"]
    if step == "gone":
        until(lambda: driver.is_alone() and has_ended(pid))
    after = agent()
    hello = after.hello(stop=stop_of(driver))
    assert [(one["attempt"], one["report"]) for one in hello["leftovers"]] == [(driver.attempt, None)]
    assert hello["leftovers"][0]["who"]["session"] == driver.attempt
    assert driver.is_alone()
    assert stands(driver)
    until(lambda: has_ended(pid), "the worker is gone, which would start the run")
    assert (driver.output / "daemon").exists() == (step in ("started", "gone")), "nothing starts later, and nothing is lost"
    after.send("done", attempt=driver.attempt)
    after.receive("removed")
    assert list((driver.folder / "runs").iterdir()) == []


@pytest.mark.integration
def test_the_stop_of_a_killed_agent_does_not_disturb_the_next_run(agent: Start) -> None:
    driver = agent()
    log = driver.folder / "log"
    slow = ["sh", "-c", f"echo begin >> {log}; sleep 0.5; echo end >> {log}"]
    driver.hello(stop=slow)
    driver.start("import time; time.sleep(600)")
    driver.process.kill()
    driver.process.wait()
    after = agent()
    after.hello(stop=slow)
    lines = log.read_text()
    assert lines.splitlines() == ["begin", "end"] * (lines.count("begin"))
    time.sleep(1.5)
    assert log.read_text() == lines


def test_the_process_id_of_a_run_of_another_boot_belongs_to_another(agent: Start) -> None:
    driver = agent()
    folder = driver.folder / "runs" / "0"
    folder.mkdir(parents=True)
    with subprocess.Popen(["sleep", "60"], env={**os.environ, "SIERRA_EXECUTION": driver.attempt}) as other:
        try:
            known = {"pid": other.pid, "born": birth(other.pid), "executions": [driver.attempt], "client": None}
            (folder / "process.json").write_text(json.dumps({**known, "boot": "another"}))
            [left] = driver.hello(stop=stop_of(driver))["leftovers"]
            unknown = dict.fromkeys(("report", "who", "execution", "place"))
            assert left == {"attempt": "0", "ended": 0, "files": False, **unknown}
            assert stands(driver)
            assert other.poll() is None
        finally:
            other.kill()


def test_refusals_are_one_line(agent: Start, tmp_path: Path):
    driver = agent()
    driver.send("hello", who={}, setup="echo no such robot >&2; false")
    assert driver.receive("refused")["reason"] == "its setup line ended with status 1: no such robot"
    driver.send("hello", who={}, setup="export SPEED=1; exit 0")
    assert driver.receive("refused")["reason"].startswith("its setup line ended the shell (by exit or exec), so that the var")
    driver.hello(battery=str(tmp_path / "battery"), checks=[["sh", "-c", "echo no topic; exit 3"]])
    driver.send("check")
    assert driver.receive("checked")["unread"] == {"battery": f"{tmp_path}/battery: No such file or directory"}
    for words in ("nan", "-1", "12000 mV"):  # the lowest charge that is allowed would let nan and millivolts pass
        (tmp_path / "battery").write_text(words)
        driver.send("check")
        assert driver.receive("checked")["unread"] == {"battery": f"{words!r} is not a charge from 0 to 100 %"}
    (tmp_path / "battery").write_text("81%\n")
    driver.send("check")
    checked = driver.receive("checked")
    assert checked["battery"] == 81
    assert checked["failed"] == ["sh -c echo no topic; exit 3: no topic"]
    assert checked["firmware"] is checked["calibration"] is None
    calibration = tmp_path / "calibration.yaml"
    driver.hello(firmware=["echo", "1.4", "2"], calibration=str(calibration))
    driver.send("check")
    assert driver.receive("checked")["unread"] == {"calibration": f"{calibration}: No such file or directory"}
    calibration.write_text("radius: 1\n")
    driver.send("check")
    checked = driver.receive("checked")
    assert (checked["firmware"], checked["calibration"]) == ("1.4 2", hashlib.sha256(b"radius: 1\n").hexdigest())
    driver.hello(firmware=["true"])
    driver.send("check")
    assert driver.receive("checked")["unread"] == {"firmware": "true: status 0"}
    driver.send("at", attempt="x", at=0)
    assert driver.receive("refused")["reason"] == "attempt x is not armed"
    assert driver.process.stdin
    driver.process.stdin.write(b'{"do": 5}\n')
    assert driver.receive("refused")["reason"] == "unknown request 5"


CLIENT = """
import os, sys, time
time.sleep(0.4)
print(time.time(), file=sys.stderr, flush=True)
os.execve("/bin/sh", sys.argv[1:], {"PATH": os.environ["PATH"], "SIERRA_EXECUTION": os.environ["EXECUTION"]})
"""
"""A client that takes long to start its container; it prints when it does so."""


def contained(execution: str, script: str, *, held: bool = True) -> dict[str, Any]:
    """Return a job whose client executes a script, which waits for the common start if it is held."""
    started = held_start.waiting(("/bin/sh", "-c", script), {}) if held else ("/bin/sh", "-c", script)
    argv = [word.replace("/run/sierra/run", "\0") for word in started]
    order = job("", execution)
    client: dict[str, Any] = {
        "argv": [sys.executable, "-I", "-c", CLIENT, "sh", *argv[1:]],
        "environment": {"PATH": os.environ["PATH"], "EXECUTION": execution},
        "stop": ["touch", "\0/ended"],
    }
    return {**order, "client": {**client, "start_pipe": held_start.host_pipe()} if held else client}


@pytest.mark.integration
@pytest.mark.parametrize("held", [True, False])
def test_a_container_is_started_before_the_common_start_if_its_program_can_wait(agent: Start, held: bool) -> None:
    driver = agent()
    driver.hello()
    script = "date +%s.%N; ls -A ..; sleep 0.3; tr '\\0' '\\n' < /proc/$$/environ; exit 3"
    driver.arm_job(lambda: contained(driver.attempt, script, held=held))
    time.sleep(0.2)
    assert (driver.output.parent / "stdout").read_bytes() == b""
    driver.go()
    end = driver.receive("ended")["end"]
    lines = (driver.output.parent / "stdout").read_text().splitlines()
    assert end["exit_code"] == 3
    container_started = float((driver.output.parent / "stderr").read_text())
    assert (container_started < end["started"]) == held
    assert end["started"] <= float(lines[0]) <= end["ended"]
    assert ("delay_s" not in end) == held
    if held:
        assert lines[1:6] == ["home", "output", "stderr", "stdout", "tmp"], "the pipe is gone"
        assert sorted(lines[6:]) == [f"PATH={os.environ['PATH']}", f"SIERRA_EXECUTION={driver.attempt}"]
    else:
        assert end["delay_s"] > 0.2


def test_a_container_that_waits_is_ended_if_the_run_is_stopped(agent: Start) -> None:
    driver = agent()
    driver.hello()
    driver.arm_job(lambda: contained(driver.attempt, "touch ../begun"))
    driver.send("stop", attempt=driver.attempt, why="tests end")
    report = driver.receive("ended")
    assert (report["started"], report["end"], report["why"], report["problems"]) == (False, None, "tests end", [])
    assert driver.is_alone()
    assert not driver.output.parent.exists()


def test_a_container_that_ends_before_the_common_start_is_reported_before_the_run_is_armed(agent: Start) -> None:
    driver = agent()
    driver.hello()
    order = contained(driver.attempt, "true")
    order["client"]["argv"] = ["sh", "-c", "echo no such image >&2; exit 125"]
    driver.send("arm", attempt=driver.attempt, job=order)
    report = driver.receive("ended")
    driver.receive("armed")
    assert (report["started"], report["end"]) == (False, None)
    assert report["problems"] == [
        "its worker ended with status 3: worker: its container ended before the run began: no such image"
    ]

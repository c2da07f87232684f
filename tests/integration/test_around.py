"""Services and commands around a run: in which order they run, when the run has failed, and that nothing stays alive."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import sierra
from tests import containers, projects
from tests.clusters import Slurm
from tests.waiting import until

SERVER = """\
import socket, sys

server = socket.socket()
server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
server.bind(("127.0.0.1", int(sys.argv[1])))
server.listen()
print("waits", flush=True)
while True:
    client, _ = server.accept()
    client.sendall(b"7")
    client.close()
"""
CLIENT = """\
import os, socket, sys
from pathlib import Path

with socket.create_connection(("127.0.0.1", int(sys.argv[2]))) as server:
    answer = server.recv(1).decode()
assert os.environ["URL"] == "http://localhost:" + sys.argv[2]
count = Path(sys.argv[1]).read_text().split('<swarm count="')[1].split('"')[0]
Path("swarm.csv").write_text("tick,coverage\\n0,%s\\n" % (int(count) * int(answer) + int(Path("mesh").read_text())))
print("from the command")
"""
CONFIG = """\
template = "arena.xml"
command = "python3 sim.py {input} {services.echo.port}"
runs = 2
before = [["sh", "-c", "echo 5 > mesh; echo from before"]]
after = "sh -c 'cp swarm.csv again.csv; echo from after'"
[environment.set]
URL = "http://localhost:{services.echo.port}"
[seed]
set = "//random/@seed"
[variables]
population_size = "//swarm/@count"
[limits]
wall = 100
grace = 1
[services.echo]
command = "python3 server.py {port}"
ready = { port = "{port}" }
"""
TAIL = """\
[seed]
set = "//random/@seed"
[variables]
population_size = "//swarm/@count"
[limits]
wall = 100
grace = 1
"""
QUERY = ("run", "population_size=1,2", "--no-figures")
ONE = ("run", "population_size=1", "--no-figures")
LOOP = "while :; do sleep 0.1; done"


def make(folder: Path, config: str = CONFIG, *, simulator: str = CLIENT) -> Path:
    """Write a project with a server."""
    projects.make(folder, config, simulator=simulator)
    (folder / "server.py").write_text(SERVER)
    return folder


def simple(folder: Path, service: str, *, around: str = "", command: str = "sh -c 'echo t,v; echo 1,2' {input}") -> Path:
    """Write a project with one run, a service with these keys, and a command."""
    service = f"[services.it]\n{service}\n" if service else ""
    lines = f'template = "arena.xml"\ncommand = "{command}"\nruns = 1\n{around}\n{TAIL}{service}'
    return make(folder, lines)


def says(root: Path, *words: str, code: int = 0) -> str:
    done = projects.sierra(root, *(words or ONE))
    assert done.returncode == code, done.stdout + done.stderr
    return done.stdout + done.stderr


def rows(root: Path, statement: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = sierra.open(root).sql(statement).to_pylist()
    return found


def failure(root: Path) -> str:
    """Execute the only run, which must fail; return the recorded reason."""
    says(root, code=1)
    [row] = rows(root, "SELECT status, reason FROM executions")
    assert row["status"] == "failed"
    return str(row["reason"])


def log(root: Path, name: str) -> str:
    """Return a log of the last execution; an empty one is not recorded."""
    [row] = rows(root, "SELECT execution FROM executions ORDER BY started DESC LIMIT 1")
    if not rows(root, f"SELECT path FROM artifacts WHERE execution = '{row['execution']}' AND path = '{name}'"):
        return ""
    return says(root, "files", row["execution"], name)


def alive(mark: str) -> list[int]:
    """Return the processes with this word in their command."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = path.read_bytes().split(b"\0")
        except OSError:
            continue
        if mark.encode() in words:
            found.append(int(path.parent.name))
    return found


def test_services_and_commands_are_executed_in_their_order_and_recorded(tmp_path: Path) -> None:
    root = make(tmp_path / "project")
    assert "4 executed" in says(root, *QUERY, "--jobs", "2")
    assert rows(root, "SELECT coverage FROM again ORDER BY coverage") == [{"coverage": c} for c in (12, 12, 19, 19)]
    errors = log(root, "stderr").splitlines()
    assert errors == [
        "== before: sh -c echo 5 > mesh; echo from before",
        "from before",
        "[echo] waits",
        *errors[3:],
    ] or errors == [
        "[echo] waits",
        "== before: sh -c echo 5 > mesh; echo from before",
        "from before",
        *errors[3:],
    ]
    assert errors[3:] == ["== after: sh -c cp swarm.csv again.csv; echo from after", "from after"]
    assert log(root, "stdout") == "from the command\n"
    assert "0 executed, 4 reused" in says(root, *QUERY)
    assert says(root, "fsck").startswith("sound")


def test_a_replay_executes_what_was_recorded_around_the_command(tmp_path: Path) -> None:
    root = projects.commit(make(tmp_path / "project"))
    says(root, *QUERY)
    make(root, CONFIG.replace("echo 5", "echo 6"))
    (root / "server.py").unlink()
    [batch] = rows(root, "SELECT batch FROM batches")
    assert "identical (4 runs: 4 identical)" in says(root, "replay", batch["batch"])


@pytest.mark.nightly
def test_an_observation_has_the_files_of_all_that_is_executed_but_not_of_the_conductor(
    tmp_path: Path, require: Callable[..., str]
) -> None:
    require("strace")
    root = simple(
        tmp_path / "project",
        'command = "sh wait.sh"\nready = { output = "ready" }',
        around='before = "sh mesh.sh"\nafter = "cp t.csv again.csv"\nobserve = "all"',
        command="sh sim.sh {input}",
    )
    for name, script in {
        "wait": f"echo ready; {LOOP}",
        "mesh": "echo 5 > mesh",
        "sim": "(echo t,v; echo 1,$(cat mesh)) > t.csv",
    }.items():
        (root / f"{name}.sh").write_text(script)
    (root / "unused.txt").write_text("1")
    says(root)
    read = {row["path"] for row in rows(root, "SELECT path FROM files_read WHERE use IN ('read', 'executed')")}
    assert {"{project}/wait.sh", "{project}/mesh.sh", "{project}/sim.sh"} <= read
    assert any(path.endswith("/cp") for path in read)
    assert not [path for path in read if "conductor" in path or "python" in path]
    assert rows(root, "SELECT DISTINCT method, reason FROM observations") == [{"method": "strace", "reason": None}]
    (root / "unused.txt").write_text("2")
    assert "0 executed, 1 reused" in says(root)
    (root / "mesh.sh").write_text("echo 6 > mesh")
    assert "1 executed, 0 reused" in says(root)


@pytest.mark.parametrize(
    "ready",
    [
        '{ file = "sign" }',
        '{ output = "^now [0-9]+$" }',
        '{ command = ["test", "-s", "{output}/sign"] }',
    ],
)
def test_a_command_is_executed_when_the_service_is_ready(tmp_path: Path, ready: str) -> None:
    script = f"echo not yet; sleep 0.5; echo 1 > part; mv part sign; echo now 1; {LOOP}"
    root = simple(
        tmp_path / "project",
        f'command = ["sh", "-c", "{script}"]\nready = {ready}',
        command="sh -c 'cat sign; echo $0 > seen.txt' {input}",
    )
    says(root)
    assert log(root, "stdout") == "1\n"


@pytest.mark.nightly
def test_a_before_that_fails_ends_the_run(tmp_path: Path) -> None:
    root = simple(tmp_path / "project", "", around='before = [["true"], ["sh", "-c", "exit 4"], ["touch", "late"]]')
    assert failure(root) == "before: 'sh -c exit 4' failed: exit status 4; the run's command was not executed"
    assert rows(root, "SELECT exit_code FROM executions") == [{"exit_code": 4}]
    assert log(root, "stdout") == ""
    assert rows(root, "SELECT path FROM artifacts WHERE path LIKE '%late'") == []


def test_an_after_that_fails_makes_the_run_fail(tmp_path: Path) -> None:
    root = simple(tmp_path / "project", "", around="after = \"sh -c 'echo broken >&2; exit 3'\"")
    assert failure(root) == "after: 'sh -c echo broken >&2; exit 3' failed: exit status 3"
    assert "broken" in log(root, "stderr")


@pytest.mark.nightly
def test_after_a_command_that_failed_nothing_is_executed_whatever_counts_as_success_later(tmp_path: Path) -> None:
    root = simple(tmp_path / "project", "", around='after = "touch late"', command="sh -c 'exit 2' {input}")
    assert failure(root) == "exit status 2; the commands in `after` were not executed"
    with (root / "sierra.toml").open("a") as config:
        config.write("[success]\nexit_status = [2]\n")
    assert "1 executed" in says(root)
    assert [row["status"] for row in rows(root, "SELECT status FROM executions ORDER BY started")] == ["failed", "ok"]
    assert len(rows(root, "SELECT path FROM artifacts WHERE path LIKE '%late'")) == 1


@pytest.mark.parametrize(
    ("service", "reason"),
    [
        ('command = "sleep 1000"\nready = { file = "never" }\ntimeout = 0.5', "service 'it' was not ready after 0.5 s"),
        ('command = "sleep 1000"\nready = { command = "sleep 1000" }\ntimeout = 0.5', "service 'it' was not ready after 0.5 s"),
        ('command = "sh -c \'exit 3\'"\nready = { file = "x" }', "service 'it' ended before the run: exit status 3"),
        (
            'command = ["sh", "-c", "touch x; sleep 1000 &"]\nready = { command = "sleep 1" }',
            "service 'it' ended before the run: exit status 0; a service must stay in the foreground",
        ),
        (
            'command = "sleep 1000"\nready = { file = "/etc/passwd" }',
            "service 'it': /etc/passwd exists before it starts; use {port}",
        ),
    ],
)
def test_a_service_that_is_never_ready_makes_the_run_fail(tmp_path: Path, service: str, reason: str) -> None:
    root = simple(tmp_path / "project", service)
    assert failure(root).startswith(reason)
    assert log(root, "stdout") == ""


@pytest.mark.nightly
def test_a_service_that_ends_too_early_makes_the_run_fail_although_the_command_succeeds(tmp_path: Path) -> None:
    root = simple(
        tmp_path / "project",
        'command = ["sh", "-c", "echo ready; while ! test -e go; do sleep 0.05; done; exit 7"]\nready = { output = "ready" }',
        command="sh -c 'trap \\\"exit 0\\\" TERM; touch go; while :; do sleep 0.05; done' {input}",
    )
    assert failure(root) == "service 'it' ended before the run: exit status 7"


@pytest.mark.nightly
def test_a_port_that_another_program_uses_is_not_taken_for_the_service(tmp_path: Path) -> None:
    import socket

    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        root = simple(tmp_path / "project", f'command = "sleep 1000"\nready = {{ port = {port} }}')
        assert failure(root) == f"service 'it': port {port} is used by another program; use {{port}}"


@pytest.mark.parametrize(
    "script",
    [
        "echo ready; setsid sleep 98765 & wait",
        "(setsid sleep 98765 >/dev/null 2>&1 &); echo ready; exec sleep 98765",
        "trap '' TERM; echo ready; sleep 98765; sleep 98765",
    ],
    ids=["a child in a session", "a daemon", "SIGTERM is ignored"],
)
def test_nothing_of_a_service_stays_alive_after_the_run(tmp_path: Path, script: str) -> None:
    mark = str(98765 + os.getpid())
    root = simple(
        tmp_path / "project", f'command = ["sh", "-c", "{script.replace("98765", mark)}"]\nready = {{ output = "ready" }}'
    )
    says(root)
    assert not alive(mark)


@pytest.mark.nightly
def test_a_service_gets_time_to_end_after_sigterm(tmp_path: Path) -> None:
    script = "trap 'echo bye > bye.txt; echo bye; exit' TERM; echo ready; while :; do sleep 0.05; done"
    root = simple(tmp_path / "project", f'command = ["sh", "-c", "{script}"]\nready = {{ output = "ready" }}')
    says(root)
    assert "[it] bye" in log(root, "stderr")
    assert len(rows(root, "SELECT path FROM artifacts WHERE path LIKE '%bye.txt'")) == 1


@pytest.mark.nightly
@pytest.mark.parametrize("ready", ['{ file = "never" }', '{ output = "ready" }'])
def test_the_time_limit_of_a_run_includes_everything_around_its_command(tmp_path: Path, ready: str) -> None:
    mark = str(87654 + os.getpid())
    root = simple(
        tmp_path / "project",
        f'command = ["sh", "-c", "trap \'\' TERM; echo ready; sleep {mark}; sleep {mark}"]\nready = {ready}\ntimeout = 500',
        command=f"sleep {mark}",
    )
    (root / "sierra.toml").write_text((root / "sierra.toml").read_text().replace("wall = 100", "wall = 1.5"))
    says(root, code=1)
    assert rows(root, "SELECT status FROM executions") == [{"status": "timeout"}]
    assert not alive(mark)


def test_nothing_stays_alive_when_sierra_is_killed(tmp_path: Path) -> None:
    mark = str(76543 + os.getpid())
    script = f"(setsid sleep {mark} >/dev/null 2>&1 &); trap '' TERM; echo ready; while :; do sleep {mark}; done"
    root = simple(
        tmp_path / "project",
        f'command = ["sh", "-c", "{script}"]\nready = {{ output = "ready" }}',
        command=f"sh -c 'touch {tmp_path}/begun; sleep {mark}' {{input}}",
    )
    session = projects.start(root, *ONE)
    until(lambda: (tmp_path / "begun").exists())
    until(lambda: len(alive(mark)) >= 3)
    os.kill(session.pid, signal.SIGKILL)
    session.communicate()
    until(lambda: not alive(mark), lambda: f"{alive(mark)} have ended")
    assert "fsck" not in says(root, "fsck")


@pytest.mark.nightly
def test_an_interrupted_run_ends_its_services(tmp_path: Path) -> None:
    mark = str(65432 + os.getpid())
    root = simple(
        tmp_path / "project",
        f'command = ["sh", "-c", "echo ready; sleep {mark}; true"]\nready = {{ output = "ready" }}',
        command=f"sh -c 'touch {tmp_path}/begun; sleep {mark}' {{input}}",
    )
    session = projects.start(root, *ONE)
    until(lambda: (tmp_path / "begun").exists())
    os.kill(session.pid, signal.SIGINT)
    session.communicate()
    assert not alive(mark)
    assert {row["status"] for row in rows(root, "SELECT status FROM executions")} <= {"interrupted"}


@pytest.mark.nightly
def test_a_conductor_that_is_killed_is_no_success(tmp_path: Path) -> None:
    root = simple(tmp_path / "project", "", around='after = "true"', command="sh -c 'kill -9 $PPID; sleep 1000' {input}")
    assert failure(root) == "the program that executes its services and commands has ended without a report"


@pytest.mark.real
@pytest.mark.parametrize(("engine", "isolation"), [("podman", "run"), ("podman", "worker"), ("apptainer", "run")])
def test_services_are_in_the_container_of_their_run(
    tmp_path: Path, engine: str, isolation: str, require: Callable[..., str]
) -> None:
    require(engine)
    require("busybox-static, as /bin/busybox", there=containers.BUSYBOX.exists())
    archive = containers.python(tmp_path)
    boxed = f'[container]\nimage = "{archive}"\nengine = "{engine}"\nisolation = "{isolation}"\n'
    config = CONFIG.replace("cp swarm.csv", "cat swarm.csv >")
    root = make(tmp_path / "project", config + boxed)
    says(root, "image", "pin")
    assert "4 executed" in says(root, *QUERY)
    assert rows(root, "SELECT DISTINCT coverage FROM again ORDER BY coverage") == [{"coverage": 12}, {"coverage": 19}]
    assert "[echo] waits" in log(root, "stderr")
    make(root, config.replace("echo 5 > mesh", "exit 9") + boxed)
    says(root, *ONE, code=1)
    [row] = rows(root, "SELECT DISTINCT reason FROM executions WHERE status <> 'ok'")
    assert row["reason"].startswith("before: ")


@pytest.mark.parametrize("scope", ["run", "batch"])
def test_services_run_on_the_nodes_of_a_cluster(tmp_path: Path, slurm: Slurm, scope: str) -> None:
    config = f'{CONFIG}scope = "{scope}"\n[runners.slurm]\narray_tasks = 2\n'
    root = projects.commit(make(tmp_path / "project", config))
    assert "4 executed" in says(root, *QUERY, "--on", "slurm")
    assert rows(root, "SELECT DISTINCT coverage FROM again ORDER BY coverage") == [{"coverage": 12}, {"coverage": 19}]
    assert "== after: " in log(root, "stderr")


@pytest.mark.nightly
def test_runs_at_the_same_time_have_displays_of_their_own(tmp_path: Path, require: Callable[..., str]) -> None:
    require("Xvfb")
    ask = """
import os, socket
from pathlib import Path
with socket.socket(socket.AF_UNIX) as display:
    display.connect("/tmp/.X11-unix/X" + os.environ["DISPLAY"][1:])
    display.sendall(b"l\\0\\x0b\\0" + bytes(8))
    Path("answer.csv").write_text("display,answer\\n%s,%d\\n" % (os.environ["DISPLAY"][1:], display.recv(1)[0]))
"""
    config = f"""
template = "arena.xml"
command = "python3 sim.py {{input}}"
runs = 4
{TAIL}
[environment.set]
DISPLAY = ":{{services.display.port}}"
[services.display]
command = "Xvfb :{{port}} -screen 0 640x480x24"
ready = {{ file = "/tmp/.X11-unix/X{{port}}" }}
"""
    root = make(tmp_path / "project", config, simulator=ask)
    says(root, *ONE, "--jobs", "4")
    answers = rows(root, "SELECT count(DISTINCT display) AS displays, min(answer) AS answer FROM answer")
    assert answers == [{"displays": 4, "answer": 1}]
    assert not [path for path in Path("/tmp/.X11-unix").glob("X2????") if alive(f":{path.name[1:]}")]


@pytest.mark.nightly
def test_a_command_that_is_stopped_is_reported_although_the_conductor_is_not(tmp_path: Path) -> None:
    root = simple(tmp_path / "project", "", around='after = "true"\nobserve = "none"', command="sh -c 'kill -STOP $$' {input}")
    (root / "sierra.toml").write_text((root / "sierra.toml").read_text().replace("wall = 100", "wall = 9"))
    assert "stopped" in says(root, code=1)
    assert rows(root, "SELECT status FROM executions") == [{"status": "timeout"}]


def shared(
    folder: Path, script: str, ready: str = '{ output = "ready" }', command: str = "sh sim.sh {input}", timeout: int = 300
) -> Path:
    """Write a project with four runs that share a service."""
    service = f'command = ["sh", "-c", "{script}"]\nready = {ready}\nscope = "batch"\ntimeout = {timeout}'
    root = simple(folder, service, command=command)
    config = root / "sierra.toml"
    config.write_text(config.read_text().replace("runs = 1", "runs = 4"))
    (root / "sim.sh").write_text("echo done")
    return root


def test_runs_share_a_service_of_the_batch(tmp_path: Path, require: Callable[..., str]) -> None:
    require("strace")
    mark = str(54321 + os.getpid())
    root = shared(tmp_path / "project", f"echo x >> {tmp_path}/starts; echo ready; sleep {mark}; true")
    assert "4 executed" in says(root, *ONE, "--jobs", "2")
    assert (tmp_path / "starts").read_text() == "x\n"
    assert not alive(mark)
    assert rows(root, "SELECT DISTINCT reason FROM observations") == [{"reason": None}]
    assert "0 executed, 4 reused" in says(root)


def test_a_shared_service_has_a_short_tmpdir_until_the_batch_ends(tmp_path: Path) -> None:
    mark, where = str(54322 + os.getpid()), tmp_path / "where"
    root = shared(tmp_path / ("x" * 120), f"echo $TMPDIR > {where}; touch $TMPDIR/left; echo ready; sleep {mark}; true")
    (root / "sim.sh").write_text(f'test -e "$(cat {where})/left"')
    assert "4 executed" in says(root, *ONE, "--jobs", "2")
    folder = Path(where.read_text().strip())
    assert len(str(folder)) <= 75
    assert not folder.exists()
    assert not alive(mark)


def serving(folder: Path, *, observe: str = "first") -> Path:
    """Write a project with four runs and a server that they share: it reads a file outside the project for each answer."""
    config = CONFIG.replace("runs = 2", f'runs = 4\nobserve = "{observe}"')
    root = make(folder / "project", config + 'scope = "batch"\n')
    (folder / "rate").write_text("7")
    answer = f"open({str(folder / 'rate')!r}, 'rb').read(1)"
    (root / "server.py").write_text(SERVER.replace('b"7"', answer))
    return root


@pytest.mark.nightly
def test_a_change_of_a_file_that_only_a_shared_service_reads_executes_its_runs_again(
    tmp_path: Path, require: Callable[..., str]
) -> None:
    require("strace")
    root = serving(tmp_path)
    assert "4 executed" in says(root, *ONE)
    assert rows(root, "SELECT DISTINCT coverage FROM swarm") == [{"coverage": 12}]
    read = rows(root, f"SELECT DISTINCT use FROM files_read WHERE path = '{tmp_path}/rate'")
    assert read == [{"use": "read"}]
    assert "0 executed, 4 reused" in says(root, *ONE)
    (tmp_path / "rate").write_text("3")
    said = says(root, *ONE)
    assert "4 executed" in said
    assert f"files that they used have changed: {tmp_path}/rate" in said
    assert rows(root, "SELECT DISTINCT coverage FROM swarm") == [{"coverage": 8}]
    assert "0 executed, 4 reused" in says(root, *ONE)


@pytest.mark.nightly
def test_a_note_names_a_shared_service_whose_files_are_not_known_when_its_runs_are_reused(tmp_path: Path) -> None:
    root = serving(tmp_path, observe="none")
    assert "not observed" not in says(root, *ONE)
    (tmp_path / "rate").write_text("3")
    for _ in range(2):
        said = says(root, *ONE)
        assert "0 executed, 4 reused" in said
        assert "runs are reused that shared 'echo', of which it was not observed what files it reads" in said


@pytest.mark.nightly
def test_a_service_that_cannot_be_observed_while_it_starts_is_started_once_more_without_it(
    tmp_path: Path, require: Callable[..., str]
) -> None:
    require("strace")
    root = shared(
        tmp_path / "project", f"echo x >> {tmp_path}/starts; mount >/dev/null; strace true; echo ready; sleep 99; true"
    )
    assert "4 executed" in says(root, *ONE)
    assert (tmp_path / "starts").read_text() == "x\nx\n"
    [row] = rows(root, "SELECT DISTINCT reason FROM observations")
    assert row["reason"].startswith("services that all runs share were not observed: ")


@pytest.mark.nightly
def test_runs_fail_when_the_tracer_of_a_shared_service_is_killed(tmp_path: Path, require: Callable[..., str]) -> None:
    require("strace")
    mark = str(21098 + os.getpid())
    kill = f"kill -9 $(sed -n s/TracerPid://p /proc/$(pgrep -xf 'sleep {mark}')/status)"
    root = shared(tmp_path / "project", f"echo ready; sleep {mark}; true", command="sh sim.sh {seed} {input}")
    (root / "sim.sh").write_text(f"test -e ../../seen && {kill}; touch ../../seen; sleep 1")
    says(root, *ONE, "--jobs", "1", code=1)
    found = [row["reason"] for row in rows(root, "SELECT reason FROM executions ORDER BY started")]
    assert found[0] is None
    assert all(reason for reason in found[1:])
    assert not alive(mark)


def test_runs_fail_from_when_a_shared_service_has_ended(tmp_path: Path) -> None:
    script = "echo ready; while ! test -e ../../end; do sleep 0.05; done; echo broken; exit 3"
    root = shared(tmp_path / "project", script, command="sh sim.sh {seed} {input}")
    (root / "sim.sh").write_text("test -e ../../seen && touch ../../end && sleep 1000; touch ../../seen")
    says(root, *ONE, "--jobs", "1", code=1)
    found = [row["reason"] for row in rows(root, "SELECT reason FROM executions ORDER BY started")]
    assert found[:2] == [None, "service 'it', which all runs share, ended before the run"]
    assert {*found[2:]} <= {found[1], "service 'it' ended before the run: exit status 3"}
    assert "[it] broken" in log(root, "stderr")


@pytest.mark.nightly
def test_no_run_succeeds_if_a_shared_service_is_never_ready(tmp_path: Path) -> None:
    mark = str(43210 + os.getpid())
    root = shared(tmp_path / "project", f"echo other; sleep {mark}; true", timeout=1)
    says(root, *ONE, code=1)
    assert rows(root, "SELECT DISTINCT reason FROM executions") == [{"reason": "service 'it' was not ready after 1 s"}]
    assert log(root, "stdout") == ""
    assert not alive(mark)


@pytest.mark.nightly
def test_a_shared_service_ends_when_sierra_is_killed(tmp_path: Path) -> None:
    mark = str(32109 + os.getpid())
    root = shared(
        tmp_path / "project",
        f"(setsid sleep {mark} >/dev/null 2>&1 &); echo ready; sleep {mark}; true",
        command=f"sh -c 'touch {tmp_path}/begun; sleep {mark}' {{input}}",
    )
    session = projects.start(root, *ONE)
    until(lambda: (tmp_path / "begun").exists())
    os.kill(session.pid, signal.SIGKILL)
    session.communicate()
    until(lambda: not alive(mark), lambda: f"{alive(mark)} have ended")


@pytest.mark.nightly
@pytest.mark.real
def test_what_a_container_cannot_do_is_refused_before_anything_runs(tmp_path: Path, require: Callable[..., str]) -> None:
    require("podman")
    require("busybox-static, as /bin/busybox", there=containers.BUSYBOX.exists())
    root = containers.make(tmp_path / "project", containers.busybox(tmp_path), 'engine = "podman"')
    plain = (root / "sierra.toml").read_text()
    (root / "sierra.toml").write_text(f'before = "true"\n{plain}')
    assert "services, before and after need python3 in the image" in says(root, code=3)
    service = '[services.it]\ncommand = "sleep 9"\nready = { output = "x" }\nscope = "batch"\n'
    (root / "sierra.toml").write_text(f"{plain}{service}")
    assert '[services.it]: scope = "batch" is not possible in containers' in says(root, code=2)
    (root / "sierra.toml").write_text(f'before = "no-such-program"\n{plain}')
    assert "the program 'no-such-program' is not in the image" in says(root, code=3)


@pytest.mark.nightly
def test_commands_around_get_values_of_variables_also_in_a_replay(tmp_path: Path) -> None:
    around = 'before = "sh mesh.sh {population_size} {seed}"'
    root = simple(tmp_path / "project", "", around=around, command="sh sim.sh {input}")
    (root / "mesh.sh").write_text("echo $1 > mesh")
    (root / "sim.sh").write_text("(echo t,v; echo 1,$(cat mesh)) > t.csv")
    says(root, *QUERY)
    assert rows(root, "SELECT v FROM t ORDER BY v") == [{"v": 1}, {"v": 2}]
    [batch] = rows(root, "SELECT batch FROM batches")
    assert "identical (2 runs: 2 identical)" in says(root, "replay", batch["batch"])
    assert says(root, "fsck").startswith("sound")

"""The worker alone: it reads jobs from stdin, writes events to its journal, and leaves no process running."""

from __future__ import annotations

import base64
import contextlib
import hashlib
import json
import os
import re
import resource
import shlex
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from sierra.util import worker_zip
from sierra.worker import checkpoints
from sierra.worker import temporary_folders as folders
from sierra.worker.devices import DEVICES, devices, with_own_devices
from sierra.worker.files import check_room
from sierra.worker.job import CONDUCTED
from sierra.worker.journal import Journal
from sierra.worker.processes import cpu_of, number_in, stat_of
from sierra.worker.program import PROGRAM
from sierra.worker.running import STALLED_S
from sierra.worker.temporary_folders import Temporary, temporary_folders
from tests.support import elf
from tests.waiting import PATIENCE_S, until


def job(*argv: str, name: str = "one", limits: dict[str, Any] | None = None, **more: Any) -> dict[str, Any]:
    """Return a job that executes `argv`, with `limits` in the worker's format."""
    environment = {
        "PATH": os.defpath,
        "HOME": "\0/home",
        "TMPDIR": "\0/tmp",
        "SIERRA_RUN_DIR": "\0",
        "SIERRA_EXECUTION": name,
        "MARK": os.environ["MARK"],
    }
    given = {"run": name, "execution": name, "argv": argv, "environment": environment, "files": {}, "limits": limits or {}}
    return {**given, **more}


def python(code: str, **more: Any) -> dict[str, Any]:
    """Return a job that executes Python."""
    return job(sys.executable, "-I", "-S", "-c", code, **more)


def shell(code: str, *, words: tuple[str, ...] = (), **more: Any) -> dict[str, Any]:
    """Return a job that executes a shell script, with these words as `$1` and so on."""
    return job("/bin/sh", "-c", code, *(("sh", *words) if words else ()), **more)


class Worker:
    """A worker as a process; the test holds the sender's end of its pipe."""

    def __init__(self, folder: Path, slots: int, starter: tuple[str, ...] = ()) -> None:
        self.folder = folder
        folder.mkdir(exist_ok=True)
        command = [*starter, sys.executable, "-I", "-S", PROGRAM, str(folder), str(slots)]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE)
        assert self.process.stdin is not None
        self.pipe = self.process.stdin

    def send(self, *jobs: dict[str, Any]) -> None:
        for one in jobs:
            self.pipe.write(json.dumps(one).encode() + b"\n")
        self.pipe.flush()

    def finish(self) -> int:
        self.send({"end": True})
        return self.wait()

    def wait(self) -> int:
        return self.process.wait(PATIENCE_S)

    def said(self) -> str:
        assert self.process.stderr is not None
        return self.process.stderr.read().decode()

    def events(self, kind: str) -> list[dict[str, Any]]:
        lines = (self.folder / "journal.jsonl").read_bytes().split(b"\n")
        return [event for event in map(json.loads, lines[:-1]) if event["event"] == kind]

    def until_started(self, count: int = 1) -> None:
        until(lambda: len(self.events("start")) >= count)


@pytest.fixture(autouse=True)
def mark(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Yield a mark of all processes of this test; no process may be left at the end."""
    monkeypatch.setenv("MARK", str(tmp_path))
    return f"MARK={tmp_path}"


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Worker]]:
    """Yield a function that starts workers; close their pipes at the end."""
    workers: list[Worker] = []

    def start(slots: int = 1, *, folder: Path = tmp_path / "a'; echo work", starter: tuple[str, ...] = ()) -> Worker:
        workers.append(Worker(folder, slots, starter))
        return workers[-1]

    yield start
    for one in workers:
        with contextlib.suppress(OSError):
            one.pipe.close()
        if one.process.poll() is None:
            one.process.kill()
            one.process.wait()
        assert one.process.stderr is not None
        one.process.stderr.close()


@pytest.fixture
def execute(start: Callable[..., Worker]) -> Callable[..., dict[str, Any]]:
    """Return a function that executes one job and returns the event of its end from the journal."""

    def execute(one: dict[str, Any]) -> dict[str, Any]:
        worker = start()
        worker.send(one)
        code = worker.finish()
        assert code == 0, worker.said()
        (end,) = worker.events("end")
        return end

    return execute


def marked(mark: str, but: int = 0) -> list[int]:
    """Return the processes with the mark in their environment, except this one."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if mark.encode() in (process / "environ").read_bytes().split(b"\0"):
                found.append(int(process.name))
    return [pid for pid in found if pid not in (os.getpid(), but)]


def stdout(end: dict[str, Any]) -> str:
    return (Path(end["directory"]) / "stdout").read_text()


# ---------------------------------------------------------------- surroundings and records of a run


def test_a_run_has_its_own_folder_home_and_tmp(execute: Callable[..., dict[str, Any]]) -> None:
    code = "import os; print(os.getcwd(), os.environ['HOME'], os.environ['TMPDIR'], os.environ['SIERRA_RUN_DIR'], sep='\\n')"
    code += "; print(os.path.isdir(os.environ['HOME']) and os.path.isdir(os.environ['TMPDIR']))"
    end = execute(python(code))
    folder = end["directory"]
    output, home, temporary, run, exist = stdout(end).splitlines()
    assert [output, home, run, exist] == [f"{folder}/output", f"{folder}/home", folder, "True"]
    assert re.fullmatch(re.escape(tempfile.gettempdir()) + r"/sierra-[0-9a-f]{8}/1/tmp", temporary)
    assert not Path(temporary).parents[1].exists()
    assert sorted(path.name for path in Path(folder).iterdir()) == ["output", "stderr", "stdout"]


SOCKET = (
    "import os, socket, tempfile; socket.socket(socket.AF_UNIX).bind(tempfile.mkdtemp(prefix='pymp-') + '/listener-12345678')"
)


@pytest.mark.parametrize("length", [90, 200])
def test_sockets_can_be_made_in_tmpdir_however_long_the_path_of_the_project_is(
    start: Callable[..., Worker], tmp_path: Path, length: int
) -> None:
    worker = start(folder=tmp_path / ("x" * (length - len(str(tmp_path)) - 1)))
    worker.send(python(SOCKET))
    assert worker.finish() == 0
    [end] = worker.events("end")
    assert end["exit_code"] == 0, (Path(end["directory"]) / "stderr").read_text()


@pytest.fixture
def temporary(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Yield a folder with a short path that is the system's temporary folder for the workers of a test."""
    with tempfile.TemporaryDirectory(prefix="t-", dir="/tmp") as folder:
        monkeypatch.setenv("TMPDIR", folder)
        yield Path(folder)


def test_a_run_leaves_no_temporary_files_and_nobody_else_can_read_them(
    temporary: Path, execute: Callable[..., dict[str, Any]]
) -> None:
    look = 'mkdir "$TMPDIR/a"; echo x > "$TMPDIR/a/b"; chmod 500 "$TMPDIR/a"; dirname "$TMPDIR"; stat -c %a "$TMPDIR/../.."'
    end = execute(shell(look))
    place, mode = stdout(end).splitlines()
    assert (Path(place).parents[1], mode) == (temporary, "700")
    assert list(temporary.iterdir()) == []


@pytest.mark.integration
def test_temporary_files_count_for_the_limit_of_outputs(temporary: Path, execute: Callable[..., dict[str, Any]]) -> None:
    end = execute(shell('head -c 300000 /dev/zero > "$TMPDIR/big"; sleep 1000', limits={"output_bytes": 100_000}))
    assert end["stopped"] == "output"


FULL = """
import os, runpy, sys
real, full = os.statvfs, os.statvfs_result([4096] * 4 + [0] * 6)
os.statvfs = lambda path: full if str(path).endswith("/files") else real(path)
sys.argv = sys.argv[4:]
sys.path.insert(0, sys.argv[0])
runpy.run_path(sys.argv[0], run_name="__main__")
"""


def test_a_run_whose_checkpoint_has_no_space_left_is_not_recorded(start: Callable[..., Worker], tmp_path: Path) -> None:
    worker = start(starter=(sys.executable, "-c", FULL))
    worker.send(job("true", checkpoints.TEXT, checkpoint=str(tmp_path / "kept")))
    assert worker.finish() == 4
    assert worker.events("end") == []
    assert "No space left on device" in worker.said()


def test_programs_around_a_run_hold_the_lock_of_its_checkpoint(execute: Callable[..., dict[str, Any]], tmp_path: Path) -> None:
    find = ["sh", "-c", "readlink /proc/$$/fd/* | grep -c kept/mark || true"]
    plan = {"services": [], "before": [find], "argv": [*find, checkpoints.TEXT], "after": [], "success": [0], "grace": 5.0}
    end = execute(job(CONDUCTED, json.dumps(plan), checkpoint=str(tmp_path / "kept")))
    assert stdout(end) == "1\n"


@pytest.mark.integration
def test_a_run_waits_for_its_checkpoint_and_says_if_it_does_not_get_it(start: Callable[..., Worker], tmp_path: Path) -> None:
    kept = str(tmp_path / "kept")
    first, second, third = start(), start(folder=tmp_path / "second"), start(folder=tmp_path / "third")
    first.send(
        shell('echo 1 > "$1/state"; until [ -e ../../go ]; do sleep 0.02; done', words=(checkpoints.TEXT,), checkpoint=kept)
    )
    until(lambda: Path(kept, "files/state").exists())
    third.send(shell("ls -A $1", words=(checkpoints.TEXT,), checkpoint=kept, limits={"grace_s": 0.1}))
    assert third.finish() == 0
    [said] = third.events("stalled")
    assert said["unkept"] == "another execution of the run still uses it"
    assert stdout(third.events("end")[0]) == ""
    second.send(shell("ls -A $1", words=(checkpoints.TEXT,), checkpoint=kept, limits={"grace_s": 1000}))
    until(lambda: (second.folder / "journal.jsonl").exists())
    (first.folder / "go").touch()
    assert (first.finish(), second.finish()) == (0, 0)
    assert stdout(second.events("end")[0]) == "state\n"
    assert second.events("stalled") == []


def test_a_tmpdir_that_the_job_names_stays_as_it_is(execute: Callable[..., dict[str, Any]]) -> None:
    one = shell('echo "$TMPDIR"')
    one["environment"]["TMPDIR"] = "/var/tmp"
    assert stdout(execute(one)) == "/var/tmp\n"


def test_temporary_files_of_a_killed_worker_are_removed_by_the_next_one(
    temporary: Path, start: Callable[..., Worker], tmp_path: Path
) -> None:
    killed, living = start(), start(folder=tmp_path / "living")
    killed.send(shell('touch "$TMPDIR/x"; sleep 1000'))
    living.send(shell('touch "$TMPDIR/x"; until [ -e ../../go ]; do sleep 0.02; done; ls "$TMPDIR"'))
    until(lambda: len(list(temporary.glob("sierra-*/1/tmp/x"))) == 2)
    [place] = [mark.parent for mark in temporary.glob("sierra-*/.sierra-runs") if str(killed.folder) in mark.read_text()]
    strange, linked = temporary / "sierra-00000000", temporary / "sierra-11111111"
    strange.mkdir()
    linked.symlink_to(place)
    killed.process.kill()
    killed.wait()
    following = start(folder=tmp_path / "following")
    following.send(shell("true"))
    assert following.finish() == 0
    assert not place.exists()
    (living.folder / "go").touch()
    assert living.finish() == 0
    assert stdout(living.events("end")[0]) == "x\n"
    assert sorted(temporary.iterdir()) == [strange, linked]


def test_runs_use_their_own_folder_if_no_temporary_folder_is_short_and_usable(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(folders, "temporary_folders", list)
    own = Temporary(str(tmp_path))
    assert own.make(str(tmp_path / "1")) is None
    own.close()


def test_a_full_long_or_unwritable_temporary_folder_is_not_used(
    temporary: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert temporary_folders()[0] == str(temporary)
    long = tmp_path / ("x" * 50)
    long.mkdir()
    for unusable in (str(long), f"{temporary}/none", "relative", ""):
        monkeypatch.setenv("TMPDIR", unusable)
        assert unusable not in temporary_folders()
    monkeypatch.setenv("TMPDIR", str(temporary))
    check = check_room
    monkeypatch.setattr(folders, "check_room", lambda folder: check("/dev/full" if folder == str(temporary) else folder))
    monkeypatch.setattr(
        os,
        "statvfs",
        lambda folder, real=os.statvfs: os.statvfs_result([4096] * 4 + [0] * 6) if folder == "/dev/full" else real(folder),
    )
    assert str(temporary) not in temporary_folders()


def test_arguments_get_the_runs_folder_and_input_files_are_written(
    execute: Callable[..., dict[str, Any]],
) -> None:
    content = b"<a/>\n\xff\0"
    end = execute(job("cat", "\0/in put.xml", files={"in put.xml": base64.b64encode(content).decode()}))
    assert Path(end["directory"], "stdout").read_bytes() == content
    assert Path(end["directory"], "in put.xml").read_bytes() == content


def test_stdin_is_empty_and_both_logs_are_kept(execute: Callable[..., dict[str, Any]]) -> None:
    end = execute(shell("cat; echo out; echo err >&2; readlink /proc/self/fd/0"))
    assert stdout(end) == "out\n/dev/null\n"
    assert Path(end["directory"], "stderr").read_text() == "err\n"


def test_the_exit_status_is_recorded(execute: Callable[..., dict[str, Any]]) -> None:
    end = execute(shell("exit 7"))
    assert (end["exit_code"], end["signal"], end["stopped"], end["error"]) == (7, None, None, None)


def test_the_signal_that_ended_a_run_is_recorded(execute: Callable[..., dict[str, Any]]) -> None:
    end = execute(shell("kill -SEGV $$"))
    assert (end["exit_code"], end["signal"], end["stopped"]) == (None, signal.SIGSEGV, None)


def test_a_program_that_cannot_be_started_is_recorded_as_a_result(execute: Callable[..., dict[str, Any]]) -> None:
    end = execute(job("/no/such/program"))
    assert end["error"] == "could not be started: /no/such/program: No such file or directory"


def test_a_program_for_another_processor_is_named_with_both_processors(
    execute: Callable[..., dict[str, Any]], tmp_path: Path
) -> None:
    program, uname = elf.write(tmp_path / "go"), os.uname()
    other = "aarch64"
    if uname.machine == other:
        program, other = elf.write(tmp_path / "go", elf.X86_64), "x86_64"
    end = execute(job(str(program)))
    assert end["error"] == f"could not be started: {program} is a program for {other}, but {uname.nodename} is {uname.machine}"


def test_runs_start_without_ignored_or_blocked_signals(execute: Callable[..., dict[str, Any]]) -> None:
    """Check the first 31 signals; the C library uses those from 32 on."""
    end = execute(shell("grep -E 'SigIgn|SigBlk' /proc/self/status"))
    assert [int(line.split()[1], 16) & 0x7FFFFFFF for line in stdout(end).splitlines()] == [0, 0]


def test_time_and_memory_are_recorded(execute: Callable[..., dict[str, Any]]) -> None:
    end = execute(
        python("import time; a = b'x' * 60_000_000; t = time.process_time()\nwhile time.process_time() < t + 0.2: pass")
    )
    assert 0.2 <= end["user_s"] + end["system_s"] < 5
    assert end["max_rss_bytes"] > 60_000_000
    assert 0.2 <= end["ended"] - end["started"] < PATIENCE_S


# ---------------------------------------------------------------- outputs


def test_outputs_with_any_names_are_hashed(execute: Callable[..., dict[str, Any]]) -> None:
    names = [b"a b.csv", b"new\nline", b"quote'\"", b"\xff\xfe", b"sub/deep/x", "ü".encode()]
    code = f"""
import os
os.makedirs(b"sub/deep")
for name in {names!r}:
    open(name, "wb").write(b"t,v\\n1," + name)
"""
    end = execute(python(code))
    found = {os.fsencode(file["path"]): file for file in end["outputs"]}
    assert found.keys() == set(names)
    for name, file in found.items():
        content = b"t,v\n1," + name
        assert (file["sha256"], file["bytes"]) == (hashlib.sha256(content).hexdigest(), len(content))
        assert (file["lines"], file["ended"], file["head"]) == (content.count(b"\n"), content.endswith(b"\n"), "t,v")


def test_only_regular_files_are_outputs(execute: Callable[..., dict[str, Any]]) -> None:
    code = """
import os, socket
os.mkfifo("pipe")
socket.socket(socket.AF_UNIX).bind("socket")
os.symlink("/etc", "folder")
os.symlink("/etc/passwd", "link")
open("file", "w")
"""
    assert [file["path"] for file in execute(python(code))["outputs"]] == ["file"]


def test_a_run_may_write_thousands_of_files(execute: Callable[..., dict[str, Any]]) -> None:
    end = execute(python("for n in range(5000): open(f'{n:04}.txt', 'w').write(str(n))"))
    assert [file["path"] for file in end["outputs"]] == [f"{n:04}.txt" for n in range(5000)]


@pytest.mark.parametrize(
    "code",
    [
        'rm -r "${SIERRA_RUN_DIR:?}/output"',
        'rm -r "${SIERRA_RUN_DIR:?}"',
        'rm -r "${SIERRA_RUN_DIR:?}"; echo file > "$SIERRA_RUN_DIR"',
        'rm -r "${SIERRA_RUN_DIR:?}/output"; ln -s "$0" "$SIERRA_RUN_DIR/output"',
        'rm -r "${SIERRA_RUN_DIR:?}/home"; ln -s "$0" "$SIERRA_RUN_DIR/home"',
        'rm -r "${SIERRA_RUN_DIR:?}"; ln -s "$0" "$SIERRA_RUN_DIR"',
    ],
)
def test_a_run_that_replaces_its_folder_has_no_outputs_and_harms_no_other_files(
    start: Callable[..., Worker], tmp_path: Path, code: str
) -> None:
    """A replacement of a run's folder may lead to files of others, which the worker must not touch."""
    foreign = tmp_path / "foreign"
    for name in ("home", "tmp", "output"):
        (foreign / name).mkdir(parents=True)
        (foreign / name / "file").write_text("not ours")
    worker = start()
    worker.send(job("/bin/sh", "-c", code, str(foreign)), shell("echo fine", name="two"))
    assert worker.finish() == 0
    first, second = worker.events("end")
    assert (first["outputs"], first["error"]) == ([], None)
    assert stdout(second) == "fine\n"
    assert sorted(str(path.relative_to(foreign)) for path in foreign.glob("*/*")) == ["home/file", "output/file", "tmp/file"]


LOCKING = """
mkdir -p sub/locked "$HOME/cache/x"; echo 1 > sub/locked/a; echo 2 > b; echo 3 > "$HOME/cache/x/y"
chmod 000 b sub/locked/a sub/locked "$HOME/cache/x" "$HOME/cache"; chmod 500 sub; chmod 000 "$SIERRA_RUN_DIR"
"""


AS_NOBODY = """
import os, subprocess, sys
if os.geteuid() == 0:
    os.setgroups([])
    os.setgid(65534)
    os.setuid(65534)
process = subprocess.Popen(["python3", "-I", "-S", *sys.argv[1:], "1"], stdin=subprocess.PIPE)
process.stdin.write(sys.stdin.buffer.read())
process.stdin.flush()
sys.exit(process.wait())
"""


def test_files_without_permissions_are_read_and_removed(tmp_path: Path) -> None:
    """Run as a user without privileges, to whom permissions apply, in a folder that this user can access."""
    given = "".join(json.dumps(one) + "\n" for one in (shell(LOCKING), {"end": True}))
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder, "worker.pyz")
        program.write_bytes(worker_zip.packed())
        command = ["python3", "-I", "-S", "-c", AS_NOBODY, str(program)]
        if os.geteuid() == 0:
            os.chown(folder, 65534, 65534)
        done = subprocess.run([*command, folder], input=given.encode(), check=False, timeout=PATIENCE_S, cwd="/")
        assert done.returncode == 0
        end = json.loads(Path(folder, "journal.jsonl").read_text().splitlines()[-1])
        assert [file["path"] for file in end["outputs"]] == ["b", "sub/locked/a"]
        assert end["error"] is None
        assert not Path(folder, "1", "home").exists()


# ---------------------------------------------------------------- limits


STUBBORN = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('up', flush=True); time.sleep(60)"
ASKED = STUBBORN.replace("signal.SIG_IGN", "lambda *_: print('asked', flush=True)")


@pytest.mark.integration
def test_a_run_that_ignores_sigterm_after_its_time_limit_is_killed(
    execute: Callable[..., dict[str, Any]],
) -> None:
    end = execute(python(STUBBORN, limits={"wall_s": 2.0, "grace_s": 0.4}))
    assert (end["stopped"], end["signal"]) == ("timeout", signal.SIGKILL)
    assert 2.4 <= end["ended"] - end["started"] < 30


@pytest.mark.nightly
def test_the_grace_time_applies_to_a_child_whose_shell_has_ended(execute: Callable[..., dict[str, Any]]) -> None:
    child = """
import signal, sys, time
def last(*_):
    time.sleep(0.5); open("saved", "w").write("all"); sys.exit()
signal.signal(signal.SIGTERM, last); time.sleep(60)
"""
    given = {"wall_s": 2.0, "grace_s": 40}
    end = execute(job("/bin/sh", "-c", '"$0" -ISc "$1"; exit 1', sys.executable, child, limits=given))
    assert end["stopped"] == "timeout"
    assert [file["path"] for file in end["outputs"]] == ["saved"]
    assert end["ended"] - end["started"] < 30


def test_the_memory_limit_applies_to_all_processes_together(execute: Callable[..., dict[str, Any]]) -> None:
    child = "import time; a = b'x' * 50_000_000; time.sleep(30)"
    code = f"import subprocess, sys; [subprocess.Popen([sys.executable, '-c', {child!r}]) for _ in range(3)][0].wait()"
    end = execute(python(code, limits={"memory_bytes": 120_000_000, "grace_s": 1}))
    assert end["stopped"] == "memory"


@pytest.mark.integration
def test_cpu_time_has_a_limit(execute: Callable[..., dict[str, Any]]) -> None:
    end = execute(python("while True: pass", limits={"cpu_s": 0.5, "grace_s": 1}))
    assert end["stopped"] == "cpu"
    assert end["ended"] - end["started"] < 30


def test_logs_count_towards_the_output_limit(execute: Callable[..., dict[str, Any]]) -> None:
    assert execute(shell("yes", limits={"output_bytes": 5_000_000, "grace_s": 1}))["stopped"] == "output"


def test_the_output_limit_is_checked_after_the_end_of_a_run(execute: Callable[..., dict[str, Any]]) -> None:
    assert execute(shell("head -c 10000 /dev/zero > x", limits={"output_bytes": 5000}))["stopped"] == "output"


def test_files_beyond_the_output_limit_are_not_read(execute: Callable[..., dict[str, Any]]) -> None:
    end = execute(shell("echo x > a; truncate -s 1T b; echo y > c", limits={"output_bytes": 5000}))
    assert end["stopped"] == "output"
    assert [file["path"] for file in end["outputs"]] == ["a", "c"]


@pytest.mark.nightly
def test_a_stopped_program_can_handle_sigterm(execute: Callable[..., dict[str, Any]]) -> None:
    script = "trap 'echo saved > x; exit 4' TERM; kill -STOP $$; sleep 60"
    end = execute(shell(script, limits={"wall_s": 1.0, "grace_s": 60}))
    assert (end["stopped"], end["exit_code"]) == ("timeout", 4)
    assert [file["path"] for file in end["outputs"]] == ["x"]


@pytest.mark.integration
def test_a_stopped_program_that_ignores_sigterm_is_killed(execute: Callable[..., dict[str, Any]]) -> None:
    script = "trap '' TERM; while :; do kill -STOP $$; done"
    end = execute(shell(script, limits={"wall_s": 1.0, "grace_s": 0.5}))
    assert (end["stopped"], end["signal"]) == ("timeout", signal.SIGKILL)


@pytest.mark.integration
@pytest.mark.parametrize("observed", [False, True])
def test_a_stalled_run_is_reported_once_each_time_it_stalls(
    start: Callable[..., Worker], require: Callable[..., str], *, observed: bool
) -> None:
    if observed:
        require("strace")
    worker = start()
    more = {"observe": {}} if observed else {}
    worker.send(shell("kill -STOP $$; sleep 4; kill -STOP $$; echo x > x", **more), {"end": True})
    for count in (1, 2):
        until(lambda count=count: len(worker.events("stalled")) == count)  # type: ignore[misc]
        event = worker.events("stalled")[-1]
        assert (event["run"], event["pid"]) == ("one", worker.events("start")[0]["pid"])
        os.kill(event["pid"], signal.SIGCONT)
    assert worker.wait() == 0
    assert worker.events("end")[0]["exit_code"] == 0
    assert len(worker.events("stalled")) == 2
    assert worker.events("end")[0].get("observed", False) is observed


@pytest.mark.nightly
def test_an_observed_run_that_waits_for_its_tracer_is_not_reported_as_stalled(
    start: Callable[..., Worker], require: Callable[..., str]
) -> None:
    require("strace")
    worker = start()
    worker.send(python("import os, time\nwhile not os.path.exists('go'): time.sleep(0.1)", observe={}), {"end": True})
    worker.until_started()
    run = worker.events("start")[0]["pid"]
    until(lambda: number_in(run, b"TracerPid:") > 0)
    tracer = number_in(run, b"TracerPid:")
    os.kill(tracer, signal.SIGSTOP)
    until(lambda: stat_of(run)[0] == b"t")
    time.sleep(2 * STALLED_S)
    assert stat_of(run)[0] == b"t"
    assert worker.events("stalled") == []
    os.kill(tracer, signal.SIGCONT)
    (worker.folder / "1" / "output" / "go").touch()
    assert worker.wait() == 0
    assert worker.events("end")[0]["observed"]


# ---------------------------------------------------------------- no process is left running


ESCAPE = """
import os, sys, time
if os.fork() == 0:
    os.setsid()
    if os.fork() == 0:
        time.sleep(60)
    os._exit(0)
os.wait()
time.sleep(float(sys.argv[1]))
"""


@pytest.mark.parametrize("background", ["sleep 60 & exit 0", "(sleep 60; true) & (trap '' TERM; sleep 60) & exit 0"])
def test_background_processes_of_a_run_are_ended(execute: Callable[..., dict[str, Any]], mark: str, background: str) -> None:
    end = execute(shell(background))
    assert (end["exit_code"], end["stopped"]) == (0, None)
    assert marked(mark) == []


@pytest.mark.integration
def test_processes_that_left_their_group_are_ended_while_other_runs_continue(start: Callable[..., Worker], mark: str) -> None:
    worker = start(2)
    worker.send(job(sys.executable, "-c", ESCAPE, "0.1"), shell("exec sleep 60", name="two"))
    until(lambda: worker.events("end"))
    worker.until_started(2)
    (two,) = [event["pid"] for event in worker.events("start") if event["execution"] == "two"]
    assert set(marked(mark)) == {worker.process.pid, two}
    worker.pipe.close()
    assert worker.wait() == 1


def test_escaped_processes_of_a_run_over_its_time_limit_are_ended(execute: Callable[..., dict[str, Any]], mark: str) -> None:
    end = execute(job(sys.executable, "-c", ESCAPE, "60", limits={"wall_s": 0.5, "grace_s": 1}))
    assert end["stopped"] == "timeout"
    assert marked(mark) == []


def test_a_reused_folder_is_clean_for_the_next_run(start: Callable[..., Worker]) -> None:
    worker = start()
    first = {"in.xml": base64.b64encode(b"a longer one").decode()}
    worker.send(shell('echo x > out; mkdir -p a/b; chmod 700 .; echo "$NOISE" >&2', name="one", files=first, used=None))
    until(lambda: len(worker.events("end")) == 1)
    [end] = worker.events("end")
    assert end["spare"]
    place = Path(end["directory"])
    inode = place.stat().st_ino
    second = {"in.xml": base64.b64encode(b"short").decode()}
    # for three empty folders, ls prints only their names and two empty lines
    look = 'cat ../in.xml; stat -c " %a" .; wc -c < ../stderr; ls -A . "$HOME" "$TMPDIR" | grep -vc :; ls -A ..; echo y > out'
    worker.send(shell(look, name="two", files=second, used=int(place.name)))
    assert worker.finish() == 0
    assert not place.exists()
    [_, end] = worker.events("end")
    folder = Path(end["directory"])
    assert folder.stat().st_ino == inode
    assert end["exit_code"] == 0
    assert [file["path"] for file in end["outputs"]] == ["out"]
    assert (folder / "output" / "out").read_text() == "y\n"
    said = (folder / "stdout").read_text().split()
    assert said == ["short", "755", "0", "2", "home", "in.xml", "output", "stderr", "stdout", "tmp"]


@pytest.mark.integration
@pytest.mark.parametrize(
    "touch",
    [
        'echo x > "$HOME/left"',
        'chmod 777 "$SIERRA_RUN_DIR/tmp"',
        'echo x >> "$SIERRA_RUN_DIR/in.xml"',
        'ln "$SIERRA_RUN_DIR/in.xml" kept',
        'echo x > "$SIERRA_RUN_DIR/beside"',
        'rm "$SIERRA_RUN_DIR/stderr"',
        'rmdir "$HOME"; ln -s / "$HOME"',
        'env -i setsid sleep 1000 & until [ "$(cat /proc/$!/comm)" = sleep ]; do sleep 0.02; done',
        "head -c 3000000 /dev/zero > big",
    ],
)
def test_a_folder_with_other_changes_is_not_reused(start: Callable[..., Worker], touch: str) -> None:
    worker = start()
    files = {"in.xml": base64.b64encode(b"one").decode()}
    worker.send(shell(touch, files=files, used=None), shell("true", name="two", files=files))
    assert worker.finish() == 0
    assert [event.get("spare") for event in worker.events("end")] == [None, None]


LATE = """cd "$HOME"; env -i setsid sh -c 'sleep 0.5; echo late > ../output/late' > /dev/null 2>&1 & sleep 0.2"""
WITHOUT_CTYPES = (
    "import runpy, sys; sys.modules['ctypes'] = None; del sys.argv[:4]; runpy.run_path(sys.argv[0], run_name='__main__')"
)


@pytest.mark.integration
def test_folders_are_not_reused_if_surviving_processes_cannot_be_detected(start: Callable[..., Worker]) -> None:
    worker = start(starter=(sys.executable, "-c", WITHOUT_CTYPES))
    worker.send(shell(LATE, name="one", used=None))
    until(lambda: len(worker.events("end")) == 1)
    [end] = worker.events("end")
    worker.send(shell("sleep 1; echo x > out", name="two", used=int(Path(end["directory"]).name)))
    assert worker.finish() == 0
    assert [file["path"] for file in worker.events("end")[1]["outputs"]] == ["out"]
    assert "spare" not in end


ENDED = """
setsid -f sh -c 'echo "$$" > new; mv new pid'; until [ -e pid ]; do sleep 0.01; done
while grep -qs '^State:.[^Z]' "/proc/$(cat pid)/status"; do sleep 0.01; done
"""


def test_zombies_of_a_run_are_reaped(start: Callable[..., Worker]) -> None:
    worker = start()
    worker.send(shell(ENDED, name="one", used=None), shell("true", name="two", used=None))
    worker.send(shell("ps -o stat= --ppid $PPID | grep -c Z", name="three", used=None))
    assert worker.finish() == 0
    assert [event["spare"] for event in worker.events("end")] == [True] * 3
    assert (Path(worker.events("end")[2]["directory"]) / "stdout").read_text() == "0\n"


WITHOUT_FIRST_THREAD = """
import ctypes, os, subprocess, sys, threading, time
os.setsid()
child = subprocess.Popen(["sleep", "60"], start_new_session=True)
threading.Thread(target=time.sleep, args=(60,)).start()
with open("pids.new", "w") as file:
    print(os.getpid(), child.pid, file=file)
os.rename("pids.new", "pids")
ctypes.CDLL(None).syscall(%d, 0)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="/proc of Linux")
@pytest.mark.parametrize("ending", ["", "kill -9 $(cut -d' ' -f1 pids)"])
def test_a_process_whose_first_thread_has_ended_is_ended_with_its_children(
    execute: Callable[..., dict[str, Any]], ending: str
) -> None:
    """Its state is that of a zombie, and nobody can wait for it; its children become orphans when its last thread ends."""
    number = {"x86_64": 60, "aarch64": 93}.get(os.uname().machine)
    if number is None:
        pytest.skip("the number of exit(2) is not known for this processor")
    program = f"{shlex.quote(sys.executable)} -c {shlex.quote(WITHOUT_FIRST_THREAD % number)}"
    begin = f"{program} & until [ -e pids ]; do sleep 0.01; done"
    waits = "until grep -q '^State:.Z' /proc/$(cut -d' ' -f1 pids)/status; do sleep 0.01; done; cat pids"
    end = execute(shell(f"{begin}; {waits}; {ending or ':'}"))
    assert end["exit_code"] == 0
    assert [pid for pid in stdout(end).split() if Path(f"/proc/{pid}").exists()] == []


def test_processes_that_cleared_their_environment_end_with_the_worker(
    execute: Callable[..., dict[str, Any]], tmp_path: Path
) -> None:
    hidden = tmp_path / "pid"
    code = f'exec env -i setsid -f sh -c \'echo $$ > "{hidden}.new"; mv "{hidden}.new" "{hidden}"; exec sleep 60\''
    execute(shell(code + f"; while ! test -e '{hidden}'; do sleep 0.01; done"))
    assert not hidden.exists() or not Path(f"/proc/{hidden.read_text().strip()}").exists()


# ---------------------------------------------------------------- the end of the worker, or of its starter


@pytest.mark.nightly
def test_a_closed_pipe_stops_runs_even_with_a_full_queue(start: Callable[..., Worker], mark: str) -> None:
    worker = start(2)
    worker.send(*(shell("exec sleep 60", name=str(n)) for n in range(40)))
    worker.until_started(2)
    worker.pipe.close()
    assert worker.wait() == 1
    assert [(end["stopped"], end["signal"]) for end in worker.events("end")] == [("interrupted", signal.SIGTERM)] * 2
    assert marked(mark) == []


def test_a_run_that_gets_the_workers_sigterm_first_is_interrupted(start: Callable[..., Worker], mark: str) -> None:
    worker = start()
    worker.send(*(shell("exec sleep 60", name=str(n)) for n in range(3)))
    worker.until_started()
    [begun] = worker.events("start")
    os.kill(begun["pid"], signal.SIGTERM)
    worker.process.terminate()
    assert worker.wait() == 1
    assert [end["stopped"] for end in worker.events("end")] == ["interrupted"]
    assert len(worker.events("start")) == 1
    assert marked(mark) == []


def test_a_pipe_that_is_closed_after_the_last_job_stops_its_run(start: Callable[..., Worker], mark: str) -> None:
    worker = start()
    worker.send(shell("exec sleep 60"), {"end": True})
    worker.until_started()
    worker.pipe.close()
    assert worker.wait() == 1
    assert marked(mark) == []


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_the_death_of_the_starter_ends_the_worker_and_its_runs(tmp_path: Path, mark: str, number: int) -> None:
    folder = tmp_path / "work"
    folder.mkdir()
    text = json.dumps(shell("exec sleep 60")) + "\n"
    code = f"""
import subprocess, sys
process = subprocess.Popen([sys.executable, {PROGRAM!r}, {str(folder)!r}, "1"], stdin=subprocess.PIPE, start_new_session=True)
process.stdin.write({text!r}.encode()); process.stdin.flush(); process.wait()
"""
    parent = subprocess.Popen([sys.executable, "-c", code])
    until(lambda: b"start" in (folder / "journal.jsonl").read_bytes())
    os.kill(parent.pid, number)
    parent.wait()
    until(lambda: not marked(mark))
    last = json.loads((folder / "journal.jsonl").read_text().splitlines()[-1])
    assert last["stopped"] == "interrupted"


SPARSE = "truncate -s 1T x"
"""A command whose output takes many minutes to read."""


@pytest.mark.integration
def test_a_worker_without_its_starter_reads_no_large_output(start: Callable[..., Worker], mark: str) -> None:
    worker = start()
    worker.send(shell(SPARSE))
    until(lambda: (worker.folder / "1" / "output" / "x").stat().st_size)
    worker.pipe.close()
    assert worker.wait() == 1
    [end] = worker.events("end")
    assert (end["stopped"], end["outputs"]) == ("interrupted", [])
    assert marked(mark) == []


def test_a_worker_reads_no_large_output_after_a_second_sigterm(start: Callable[..., Worker]) -> None:
    worker = start()
    worker.send(shell(SPARSE))
    until(lambda: (worker.folder / "1" / "output" / "x").stat().st_size)
    until(lambda: worker.process.terminate() or worker.process.poll() is not None)  # simultaneous signals are delivered as one
    assert worker.wait() == 1
    assert worker.events("end")[0]["stopped"] == "interrupted"


def test_sigterm_stops_runs_and_starts_no_more(start: Callable[..., Worker], mark: str) -> None:
    worker = start(2)
    worker.send(*(shell("exec sleep 60", name=str(n)) for n in range(40)))
    worker.until_started(2)
    worker.process.terminate()
    assert worker.wait() == 1
    assert [end["stopped"] for end in worker.events("end")] == ["interrupted"] * 2
    assert len(worker.events("start")) == 2
    assert marked(mark) == []


@pytest.mark.nightly
def test_a_second_sigterm_leaves_no_grace_time(start: Callable[..., Worker]) -> None:
    worker = start()
    worker.send(python(ASKED, limits={"grace_s": 60}))
    until(lambda: "up" in (worker.folder / "1" / "stdout").read_text())
    worker.process.terminate()
    until(lambda: "asked" in (worker.folder / "1" / "stdout").read_text())
    assert worker.process.poll() is None
    worker.process.terminate()
    assert worker.process.wait(20) == 1
    assert worker.events("end")[0]["stopped"] == "interrupted"


def test_the_worker_ignores_sigint(start: Callable[..., Worker]) -> None:
    worker = start()
    worker.send(shell("sleep 0.3; echo done"))
    worker.until_started()
    worker.process.send_signal(signal.SIGINT)
    assert worker.finish() == 0
    assert stdout(worker.events("end")[0]) == "done\n"


def test_signals_never_hang_the_worker(start: Callable[..., Worker]) -> None:
    worker = start(2)
    sending = threading.Thread(target=_send_all, args=(worker, [job("true", name=str(n)) for n in range(2000)]))
    sending.start()
    worker.until_started(20)
    for _ in range(200):
        worker.process.terminate()
        time.sleep(0.0005)
    assert worker.wait() == 1
    sending.join()


def _send_all(worker: Worker, jobs: list[dict[str, Any]]) -> None:
    with contextlib.suppress(OSError):
        worker.send(*jobs)


# ---------------------------------------------------------------- no jobs, many jobs, and invalid jobs


def test_a_worker_without_jobs_ends_immediately(start: Callable[..., Worker]) -> None:
    worker = start(4)
    assert worker.finish() == 0
    assert (worker.folder / "journal.jsonl").read_bytes() == b""


def test_input_without_an_end_marker_is_an_error(start: Callable[..., Worker]) -> None:
    worker = start()
    worker.pipe.close()
    assert worker.wait() == 1


def test_jobs_can_be_read_from_a_file(tmp_path: Path) -> None:
    lines = [job("true", name=str(n)) for n in range(5)] + [{"end": True}]
    (tmp_path / "jobs").write_text("".join(json.dumps(one) + "\n" for one in lines))
    with (tmp_path / "jobs").open() as jobs:
        done = subprocess.run([sys.executable, PROGRAM, str(tmp_path), "2"], stdin=jobs, check=False, timeout=PATIENCE_S)
    assert done.returncode == 0
    assert (tmp_path / "journal.jsonl").read_text().count('"event":"end"') == 5


@pytest.mark.parametrize("line", ["{not json", "[]", '{"run": "a"}'])
def test_an_invalid_job_is_reported_and_does_not_hang_the_worker(start: Callable[..., Worker], line: str) -> None:
    worker = start(2)
    worker.pipe.write(line.encode() + b"\n")
    worker.pipe.flush()
    assert worker.wait() == 3
    assert worker.said().startswith("worker: ")


def test_a_second_worker_continues_in_the_same_folder(start: Callable[..., Worker]) -> None:
    for name in ("one", "two"):
        worker = start()
        worker.send(shell(f"echo {name}", name=name))
        assert worker.finish() == 0
    assert [stdout(end) for end in worker.events("end")] == ["one\n", "two\n"]


@pytest.mark.nightly
def test_ten_thousand_runs_need_linear_time_and_little_memory(start: Callable[..., Worker]) -> None:
    worker = start(2)
    count = 10_000
    sending = threading.Thread(target=worker.send, args=([job("/no/such/program", name=str(n)) for n in range(count)]))
    sending.start()
    until(lambda: (worker.folder / str(count // 10)).exists())
    began = sum(cpu_of([worker.process.pid]))
    until(lambda: (worker.folder / str(count // 2)).exists())
    half = sum(cpu_of([worker.process.pid])) - began
    until(lambda: (worker.folder / str(count)).exists())
    whole = sum(cpu_of([worker.process.pid])) - began
    sending.join()
    peak = int(Path(f"/proc/{worker.process.pid}/status").read_text().split("VmHWM:")[1].split()[0])
    assert worker.finish() == 0
    assert len(worker.events("end")) == count
    assert peak < 40_000
    assert whole < 4 * half


def test_every_line_of_the_journal_is_complete_with_concurrent_runs(start: Callable[..., Worker]) -> None:
    worker = start(8)
    worker.send(
        *(shell("for i in 1 2 3 4 5 6 7 8 9; do echo $i > file-with-a-long-name-$i; done", name=str(n)) for n in range(100))
    )
    assert worker.finish() == 0
    assert sorted(int(end["run"]) for end in worker.events("end")) == list(range(100))


@pytest.mark.integration
def test_a_full_disk_is_reported_and_does_not_hang_the_worker(
    start: Callable[..., Worker], tmp_path: Path, require: Any, mark: str
) -> None:
    require("the right to mount a small disk", there=_mounted(tmp_path / "small"))
    try:
        worker = start(2, folder=tmp_path / "small")
        sending = threading.Thread(
            target=_send_all, args=(worker, [shell("head -c 99999 /dev/zero > x", name=str(n)) for n in range(99)])
        )
        sending.start()
        assert worker.wait() == 4
        sending.join()
        assert worker.said().strip().endswith("No space left on device")
        assert [end["error"] for end in worker.events("end")] == [None] * len(worker.events("end"))
        assert marked(mark) == []
    finally:
        subprocess.run(["umount", "--lazy", str(tmp_path / "small")], check=True)


def test_a_disk_without_a_reported_size_is_not_considered_full(
    start: Callable[..., Worker], tmp_path: Path, require: Any
) -> None:
    require("the right to mount", there=_mounted(tmp_path / "disk", "ramfs"))
    try:
        worker = start(folder=tmp_path / "disk")
        worker.send(shell("echo x > out"))
        assert worker.finish() == 0, worker.said()
    finally:
        subprocess.run(["umount", "--lazy", str(tmp_path / "disk")], check=True)


def _mounted(folder: Path, kind: str = "tmpfs") -> bool:
    folder.mkdir()
    command = ["mount", "-t", kind, "-o", "size=1m", "none", str(folder)]
    try:
        return subprocess.run(command, check=False, capture_output=True).returncode == 0
    except OSError:
        return False


def test_the_journal_never_contains_part_of_a_line(tmp_path: Path) -> None:
    journal = Journal(str(tmp_path / "journal"))
    journal.write({"event": "one"})
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (30, limit[1]))
    try:
        with pytest.raises(OSError, match="No space left"):
            journal.write({"event": "two", "more": "x" * 100})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
        signal.signal(signal.SIGXFSZ, before)
    journal.write({"event": "three"})
    assert (tmp_path / "journal").read_text() == '{"event":"one"}\n{"event":"three"}\n'


# ---------------------------------------------------------------- time


def test_the_wall_time_of_a_single_threaded_run_is_at_least_its_cpu_time(start: Callable[..., Worker]) -> None:
    worker = start()
    worker.send(*(job("true", name=f"run {number}") for number in range(40)))
    assert worker.finish() == 0
    ends = worker.events("end")
    assert len(ends) == 40
    assert all(end["ended"] - end["started"] >= end["user_s"] + end["system_s"] for end in ends)


def test_a_clock_that_is_set_back_gives_no_negative_times(tmp_path: Path) -> None:
    code = (
        "import itertools, runpy, sys, time; hours = itertools.count(); clock = time.time\n"
        "time.time = lambda: clock() - 3600 * next(hours)\n"
        f"sys.argv = ['worker', {str(tmp_path)!r}, '1']\n"
        f"runpy.run_path({PROGRAM!r}, run_name='__main__')"
    )
    sent = [shell("sleep 0.1", name="good"), job("/no/such/program", name="bad"), {"end": True}]
    (tmp_path / "jobs").write_text("".join(json.dumps(one) + "\n" for one in sent))
    with (tmp_path / "jobs").open() as lines:
        done = subprocess.run([sys.executable, "-I", "-c", code], stdin=lines, timeout=PATIENCE_S, check=False)
    assert done.returncode == 0
    events = [json.loads(line) for line in (tmp_path / "journal.jsonl").read_text().splitlines()]
    walls = {event["execution"]: event["ended"] - event["started"] for event in events if event["event"] == "end"}
    assert 0 <= walls["bad"] < PATIENCE_S
    assert 0.1 <= walls["good"] < PATIENCE_S


@pytest.mark.parametrize(
    ("allotted", "slots", "parts"),
    [
        ("0,1,2,3", 2, ["0,1", "2,3"]),
        ("GPU-a,GPU-b", 4, ["GPU-a", "GPU-b", "GPU-a", "GPU-b"]),
        ("0,1,2", 2, ["0,1,2", "0,1,2"]),
        ("5", 2, ["5", "5"]),
        ("", 2, ["", ""]),
    ],
)
def test_devices_are_divided_among_slots_if_possible(
    monkeypatch: pytest.MonkeyPatch, allotted: str, slots: int, parts: list[str]
) -> None:
    for name in DEVICES:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", allotted)
    assert [devices(slot, slots) for slot in range(slots)] == [{"CUDA_VISIBLE_DEVICES": part} for part in parts]


def test_a_container_gets_only_the_allocated_devices(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in DEVICES:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3")
    monkeypatch.setenv("HIP_VISIBLE_DEVICES", "4")
    asked = {name: f"\1{name}" for name in ("CUDA_VISIBLE_DEVICES", "ZE_AFFINITY_MASK")}
    client = {
        "argv": ["podman", *(f"--env={name}={value}" for name, value in asked.items()), "true"],
        "environment": {f"OF_{name}": value for name, value in asked.items()},
    }
    job = with_own_devices({"environment": {**asked, "HIP_VISIBLE_DEVICES": "0"}, "client": client}, 0, 1)
    assert job["environment"] == {"CUDA_VISIBLE_DEVICES": "3", "HIP_VISIBLE_DEVICES": "0"}
    assert job["client"]["argv"] == ["podman", "--env=CUDA_VISIBLE_DEVICES=3", "true"]
    assert job["client"]["environment"] == {"OF_CUDA_VISIBLE_DEVICES": "3"}

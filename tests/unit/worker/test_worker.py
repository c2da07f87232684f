"""The worker alone: jobs through its stdin, what happened from its journal, and nothing left running."""

from __future__ import annotations

import ast
import base64
import contextlib
import hashlib
import json
import os
import resource
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

from sierra.worker import worker
from sierra.worker.worker import cpu_of
from tests.waiting import PATIENCE_S, until

PROGRAM = str(Path(worker.__file__))


def job(*argv: str, name: str = "one", limits: dict[str, Any] | None = None, **more: Any) -> dict[str, Any]:
    """A job that executes `argv`; `limits` as the worker knows them."""
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
    """A job that executes Python."""
    return job(sys.executable, "-I", "-S", "-c", code, **more)


def shell(code: str, **more: Any) -> dict[str, Any]:
    """A job that executes a shell script."""
    return job("/bin/sh", "-c", code, **more)


class Worker:
    """A worker as a process; the sender's end of its pipe is in the test's hands."""

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
    """What marks all processes of this test; none may be left when it ends."""
    monkeypatch.setenv("MARK", str(tmp_path))
    return f"MARK={tmp_path}"


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Worker]]:
    """Starts workers, and closes their pipes in the end."""
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
    """Executes one job; what the journal says of its end."""

    def execute(one: dict[str, Any]) -> dict[str, Any]:
        worker = start()
        worker.send(one)
        code = worker.finish()
        assert code == 0, worker.said()
        (end,) = worker.events("end")
        return end

    return execute


def marked(mark: str, but: int = 0) -> list[int]:
    """Processes that have the mark in their environment, without this one."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if mark.encode() in (process / "environ").read_bytes().split(b"\0"):
                found.append(int(process.name))
    return [pid for pid in found if pid not in (os.getpid(), but)]


def stdout(end: dict[str, Any]) -> str:
    return (Path(end["directory"]) / "stdout").read_text()


# ---------------------------------------------------------------- what a run sees, and what is told of it


def test_a_run_has_a_folder_a_home_and_a_tmp_of_its_own(execute: Callable[..., dict[str, Any]]) -> None:
    code = "import os; print(os.getcwd(), os.environ['HOME'], os.environ['TMPDIR'], os.environ['SIERRA_RUN_DIR'], sep='\\n')"
    code += "; print(os.path.isdir(os.environ['HOME']) and os.path.isdir(os.environ['TMPDIR']))"
    end = execute(python(code))
    folder = end["directory"]
    assert stdout(end).splitlines() == [f"{folder}/output", f"{folder}/home", f"{folder}/tmp", folder, "True"]
    assert sorted(path.name for path in Path(folder).iterdir()) == ["output", "stderr", "stdout"]


def test_the_runs_folder_is_filled_into_the_arguments_and_input_files_are_there(
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


def test_the_exit_status_is_told(execute: Callable[..., dict[str, Any]]) -> None:
    end = execute(shell("exit 7"))
    assert (end["exit_code"], end["signal"], end["stopped"], end["error"]) == (7, None, None, None)


def test_the_signal_that_ended_a_run_is_told(execute: Callable[..., dict[str, Any]]) -> None:
    end = execute(shell("kill -SEGV $$"))
    assert (end["exit_code"], end["signal"], end["stopped"]) == (None, signal.SIGSEGV, None)


def test_a_program_that_cannot_be_started_is_a_result(execute: Callable[..., dict[str, Any]]) -> None:
    end = execute(job("/no/such/program"))
    assert end["error"] == "could not be started: /no/such/program: No such file or directory"


def test_no_signal_is_ignored_that_a_program_expects(execute: Callable[..., dict[str, Any]]) -> None:
    """The first 31; those from 32 on are the C library's own."""
    end = execute(shell("grep -E 'SigIgn|SigBlk' /proc/self/status"))
    assert [int(line.split()[1], 16) & 0x7FFFFFFF for line in stdout(end).splitlines()] == [0, 0]


def test_time_and_memory_are_told(execute: Callable[..., dict[str, Any]]) -> None:
    end = execute(
        python("import time; a = b'x' * 60_000_000; t = time.process_time()\nwhile time.process_time() < t + 0.2: pass")
    )
    assert 0.2 <= end["user_s"] + end["system_s"] < 5
    assert end["max_rss_bytes"] > 60_000_000
    assert 0.2 <= end["ended"] - end["started"] < PATIENCE_S


# ---------------------------------------------------------------- outputs


def test_outputs_are_hashed_whatever_they_are_called(execute: Callable[..., dict[str, Any]]) -> None:
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
def test_a_run_that_takes_its_folder_away_has_no_outputs_and_harms_nobody(
    start: Callable[..., Worker], tmp_path: Path, code: str
) -> None:
    """What a run's folder is replaced by may lead to anybody's files; the worker must not touch those."""
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
process = subprocess.Popen(["python3", "-I", "-S", "-c", *sys.argv[1:], "1"], stdin=subprocess.PIPE)
process.stdin.write(sys.stdin.buffer.read())
process.stdin.flush()
sys.exit(process.wait())
"""


def test_what_a_run_has_locked_is_read_and_removed_all_the_same(tmp_path: Path) -> None:
    """As a user without privileges, whom permissions do bind; in a folder that such a user can reach."""
    given = "".join(json.dumps(one) + "\n" for one in (shell(LOCKING), {"end": True}))
    command = ["python3", "-I", "-S", "-c", AS_NOBODY, Path(PROGRAM).read_text()]
    with tempfile.TemporaryDirectory() as folder:
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


def test_a_run_that_takes_too_long_and_heeds_no_request_is_killed_after_the_grace_time(
    execute: Callable[..., dict[str, Any]],
) -> None:
    end = execute(python(STUBBORN, limits={"wall_s": 2.0, "grace_s": 0.4}))
    assert (end["stopped"], end["signal"]) == ("timeout", signal.SIGKILL)
    assert 2.4 <= end["ended"] - end["started"] < 30


def test_the_grace_time_is_also_a_childs_whose_shell_has_gone(execute: Callable[..., dict[str, Any]]) -> None:
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


def test_memory_is_that_of_all_processes_together(execute: Callable[..., dict[str, Any]]) -> None:
    child = "import time; a = b'x' * 50_000_000; time.sleep(30)"
    code = f"import subprocess, sys; [subprocess.Popen([sys.executable, '-c', {child!r}]) for _ in range(3)][0].wait()"
    end = execute(python(code, limits={"memory_bytes": 120_000_000, "grace_s": 1}))
    assert end["stopped"] == "memory"


def test_cpu_time_has_a_limit(execute: Callable[..., dict[str, Any]]) -> None:
    end = execute(python("while True: pass", limits={"cpu_s": 0.5, "grace_s": 1}))
    assert end["stopped"] == "cpu"
    assert end["ended"] - end["started"] < 30


def test_logs_count_as_output(execute: Callable[..., dict[str, Any]]) -> None:
    assert execute(shell("yes", limits={"output_bytes": 5_000_000, "grace_s": 1}))["stopped"] == "output"


def test_a_run_that_has_written_too_much_when_it_ends_is_over_the_limit_too(execute: Callable[..., dict[str, Any]]) -> None:
    assert execute(shell("head -c 10000 /dev/zero > x", limits={"output_bytes": 5000}))["stopped"] == "output"


def test_what_is_beyond_the_limit_on_outputs_is_not_read(execute: Callable[..., dict[str, Any]]) -> None:
    end = execute(shell("echo x > a; truncate -s 1T b; echo y > c", limits={"output_bytes": 5000}))
    assert end["stopped"] == "output"
    assert [file["path"] for file in end["outputs"]] == ["a", "c"]


def test_a_program_that_is_stopped_can_heed_that_it_is_asked_to_end(execute: Callable[..., dict[str, Any]]) -> None:
    script = "trap 'echo saved > x; exit 4' TERM; kill -STOP $$; sleep 60"
    end = execute(shell(script, limits={"wall_s": 1.0, "grace_s": 60}))
    assert (end["stopped"], end["exit_code"]) == ("timeout", 4)
    assert [file["path"] for file in end["outputs"]] == ["x"]


def test_a_program_that_is_stopped_and_heeds_nothing_is_killed(execute: Callable[..., dict[str, Any]]) -> None:
    script = "trap '' TERM; while :; do kill -STOP $$; done"
    end = execute(shell(script, limits={"wall_s": 1.0, "grace_s": 0.5}))
    assert (end["stopped"], end["signal"]) == ("timeout", signal.SIGKILL)


@pytest.mark.integration
def test_a_run_that_stands_still_is_told_of_once_and_again_when_it_does_so_again(start: Callable[..., Worker]) -> None:
    worker = start()
    worker.send(shell("kill -STOP $$; sleep 4; kill -STOP $$; echo x > x"), {"end": True})
    for count in (1, 2):
        until(lambda count=count: len(worker.events("stalled")) == count)  # type: ignore[misc]
        event = worker.events("stalled")[-1]
        assert (event["run"], event["pid"]) == ("one", worker.events("start")[0]["pid"])
        os.kill(event["pid"], signal.SIGCONT)
    assert worker.wait() == 0
    assert worker.events("end")[0]["exit_code"] == 0
    assert len(worker.events("stalled")) == 2


# ---------------------------------------------------------------- nothing is left running


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
def test_what_a_run_leaves_in_the_background_is_ended(
    execute: Callable[..., dict[str, Any]], mark: str, background: str
) -> None:
    end = execute(shell(background))
    assert (end["exit_code"], end["stopped"]) == (0, None)
    assert marked(mark) == []


def test_what_has_left_its_group_is_ended_while_others_go_on(start: Callable[..., Worker], mark: str) -> None:
    worker = start(2)
    worker.send(job(sys.executable, "-c", ESCAPE, "0.1"), shell("exec sleep 60", name="two"))
    until(lambda: worker.events("end"))
    worker.until_started(2)
    (two,) = [event["pid"] for event in worker.events("start") if event["execution"] == "two"]
    assert set(marked(mark)) == {worker.process.pid, two}
    worker.pipe.close()
    assert worker.wait() == 1


def test_what_has_left_a_run_that_took_too_long_is_ended(execute: Callable[..., dict[str, Any]], mark: str) -> None:
    end = execute(job(sys.executable, "-c", ESCAPE, "60", limits={"wall_s": 0.5, "grace_s": 1}))
    assert end["stopped"] == "timeout"
    assert marked(mark) == []


def test_a_spare_folder_serves_another_run_as_good_as_new(start: Callable[..., Worker]) -> None:
    worker = start()
    first = {"in.xml": base64.b64encode(b"a longer one").decode()}
    worker.send(shell('echo x > out; mkdir -p a/b; chmod 700 .; echo "$NOISE" >&2', name="one", files=first, used=None))
    until(lambda: len(worker.events("end")) == 1)
    [end] = worker.events("end")
    assert end["spare"]
    place = Path(end["directory"])
    inode = place.stat().st_ino
    second = {"in.xml": base64.b64encode(b"short").decode()}
    # of three empty folders, ls prints but their names and two empty lines
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


@pytest.mark.parametrize(
    "touch",
    [
        'echo x > "$HOME/left"',
        'chmod 777 "$TMPDIR"',
        'echo x >> "$SIERRA_RUN_DIR/in.xml"',
        'ln "$SIERRA_RUN_DIR/in.xml" kept',
        'echo x > "$SIERRA_RUN_DIR/beside"',
        'rm "$SIERRA_RUN_DIR/stderr"',
        'rmdir "$HOME"; ln -s / "$HOME"',
        'env -i setsid sleep 1000 & until [ "$(cat /proc/$!/comm)" = sleep ]; do sleep 0.02; done',
        "head -c 3000000 /dev/zero > big",
    ],
)
def test_a_folder_in_which_more_was_touched_serves_nobody(start: Callable[..., Worker], touch: str) -> None:
    worker = start()
    files = {"in.xml": base64.b64encode(b"one").decode()}
    worker.send(shell(touch, files=files, used=None), shell("true", name="two", files=files))
    assert worker.finish() == 0
    assert [event.get("spare") for event in worker.events("end")] == [None, None]


LATE = """cd "$TMPDIR"; env -i setsid sh -c 'sleep 0.5; echo late > ../output/late' > /dev/null 2>&1 & sleep 0.2"""
WITHOUT_CTYPES = (
    "import runpy, sys; sys.modules['ctypes'] = None; del sys.argv[:4]; runpy.run_path(sys.argv[0], run_name='__main__')"
)


def test_where_nobody_tells_what_lives_on_no_folder_serves_another_run(start: Callable[..., Worker]) -> None:
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


def test_what_a_run_has_left_that_has_ended_is_put_away(start: Callable[..., Worker]) -> None:
    worker = start()
    worker.send(shell(ENDED, name="one", used=None), shell("true", name="two", used=None))
    worker.send(shell("ps -o stat= --ppid $PPID | grep -c Z", name="three", used=None))
    assert worker.finish() == 0
    assert [event["spare"] for event in worker.events("end")] == [True] * 3
    assert (Path(worker.events("end")[2]["directory"]) / "stdout").read_text() == "0\n"


def test_what_has_even_hidden_whose_it_is_ends_with_the_worker(execute: Callable[..., dict[str, Any]], tmp_path: Path) -> None:
    hidden = tmp_path / "pid"
    code = f'exec env -i setsid -f sh -c \'echo $$ > "{hidden}.new"; mv "{hidden}.new" "{hidden}"; exec sleep 60\''
    execute(shell(code + f"; while ! test -e '{hidden}'; do sleep 0.01; done"))
    assert not hidden.exists() or not Path(f"/proc/{hidden.read_text().strip()}").exists()


# ---------------------------------------------------------------- the end of the worker, or of who started it


def test_a_closed_pipe_ends_what_runs_though_the_queue_is_full(start: Callable[..., Worker], mark: str) -> None:
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


def test_a_pipe_closed_after_the_last_job_ends_what_runs(start: Callable[..., Worker], mark: str) -> None:
    worker = start()
    worker.send(shell("exec sleep 60"), {"end": True})
    worker.until_started()
    worker.pipe.close()
    assert worker.wait() == 1
    assert marked(mark) == []


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_the_death_of_who_started_the_worker_ends_all(tmp_path: Path, mark: str, number: int) -> None:
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
"""Leaves what takes many minutes to read."""


@pytest.mark.integration
def test_a_worker_whose_starter_is_gone_reads_no_large_output(start: Callable[..., Worker], mark: str) -> None:
    worker = start()
    worker.send(shell(SPARSE))
    until(lambda: (worker.folder / "1" / "output" / "x").stat().st_size)
    worker.pipe.close()
    assert worker.wait() == 1
    [end] = worker.events("end")
    assert (end["stopped"], end["outputs"]) == ("interrupted", [])
    assert marked(mark) == []


def test_a_worker_that_is_asked_twice_reads_no_large_output(start: Callable[..., Worker]) -> None:
    worker = start()
    worker.send(shell(SPARSE))
    until(lambda: (worker.folder / "1" / "output" / "x").stat().st_size)
    worker.process.terminate()
    time.sleep(0.2)  # two signals at once are one
    worker.process.terminate()
    assert worker.wait() == 1
    assert worker.events("end")[0]["stopped"] == "interrupted"


def test_sigterm_ends_what_runs_and_starts_nothing_more(start: Callable[..., Worker], mark: str) -> None:
    worker = start(2)
    worker.send(*(shell("exec sleep 60", name=str(n)) for n in range(40)))
    worker.until_started(2)
    worker.process.terminate()
    assert worker.wait() == 1
    assert [end["stopped"] for end in worker.events("end")] == ["interrupted"] * 2
    assert len(worker.events("start")) == 2
    assert marked(mark) == []


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


def test_sigint_is_left_to_who_started_the_worker(start: Callable[..., Worker]) -> None:
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


# ---------------------------------------------------------------- none, many, and what is no job


def test_no_jobs_are_done_at_once(start: Callable[..., Worker]) -> None:
    worker = start(4)
    assert worker.finish() == 0
    assert (worker.folder / "journal.jsonl").read_bytes() == b""


def test_input_without_an_end_is_no_success(start: Callable[..., Worker]) -> None:
    worker = start()
    worker.pipe.close()
    assert worker.wait() == 1


def test_jobs_can_come_from_a_file(tmp_path: Path) -> None:
    lines = [job("true", name=str(n)) for n in range(5)] + [{"end": True}]
    (tmp_path / "jobs").write_text("".join(json.dumps(one) + "\n" for one in lines))
    with (tmp_path / "jobs").open() as jobs:
        done = subprocess.run([sys.executable, PROGRAM, str(tmp_path), "2"], stdin=jobs, check=False, timeout=PATIENCE_S)
    assert done.returncode == 0
    assert (tmp_path / "journal.jsonl").read_text().count('"event":"end"') == 5


@pytest.mark.parametrize("line", ["{not json", "[]", '{"run": "a"}'])
def test_what_is_no_job_is_said_and_hangs_nothing(start: Callable[..., Worker], line: str) -> None:
    worker = start(2)
    worker.pipe.write(line.encode() + b"\n")
    worker.pipe.flush()
    assert worker.wait() == 3
    assert worker.said().startswith("worker: ")


def test_a_second_worker_goes_on_in_the_same_folder(start: Callable[..., Worker]) -> None:
    for name in ("one", "two"):
        worker = start()
        worker.send(shell(f"echo {name}", name=name))
        assert worker.finish() == 0
    assert [stdout(end) for end in worker.events("end")] == ["one\n", "two\n"]


@pytest.mark.nightly
def test_ten_thousand_runs_stay_linear_and_small(start: Callable[..., Worker]) -> None:
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


def test_every_line_of_the_journal_is_whole_though_many_write(start: Callable[..., Worker]) -> None:
    worker = start(8)
    worker.send(
        *(shell("for i in 1 2 3 4 5 6 7 8 9; do echo $i > file-with-a-long-name-$i; done", name=str(n)) for n in range(100))
    )
    assert worker.finish() == 0
    assert sorted(int(end["run"]) for end in worker.events("end")) == list(range(100))


def test_a_full_disk_is_said_and_hangs_nothing(start: Callable[..., Worker], tmp_path: Path, require: Any, mark: str) -> None:
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


def test_a_disk_that_does_not_say_how_large_it_is_is_not_full(
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


def test_the_journal_takes_no_part_of_a_line(tmp_path: Path) -> None:
    journal = worker.Journal(str(tmp_path / "journal"))
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


def test_the_worker_is_one_file_for_python_3_8_on_the_standard_library_alone() -> None:
    tree = ast.parse(Path(PROGRAM).read_text(), feature_version=(3, 8))
    imported = {name.name for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names}
    imported |= {str(node.module) for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert imported <= sys.stdlib_module_names


# ---------------------------------------------------------------- time


def test_no_run_takes_less_time_than_its_one_thread_computed(start: Callable[..., Worker]) -> None:
    worker = start()
    worker.send(*(job("true", name=f"run {number}") for number in range(40)))
    assert worker.finish() == 0
    ends = worker.events("end")
    assert len(ends) == 40
    assert all(end["ended"] - end["started"] >= end["user_s"] + end["system_s"] for end in ends)


def test_a_clock_that_is_set_back_makes_no_time_negative(tmp_path: Path) -> None:
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
def test_each_slot_has_its_part_of_the_devices_where_they_can_be_divided(
    monkeypatch: pytest.MonkeyPatch, allotted: str, slots: int, parts: list[str]
) -> None:
    for name in worker.DEVICES:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", allotted)
    assert [worker.devices(slot, slots) for slot in range(slots)] == [{"CUDA_VISIBLE_DEVICES": part} for part in parts]


def test_a_container_gets_the_devices_that_are_allotted_and_no_others(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in worker.DEVICES:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3")
    monkeypatch.setenv("HIP_VISIBLE_DEVICES", "4")
    asked = {name: f"\1{name}" for name in ("CUDA_VISIBLE_DEVICES", "ZE_AFFINITY_MASK")}
    client = {
        "argv": ["podman", *(f"--env={name}={value}" for name, value in asked.items()), "true"],
        "environment": {f"OF_{name}": value for name, value in asked.items()},
    }
    job = worker.allotted({"environment": {**asked, "HIP_VISIBLE_DEVICES": "0"}, "client": client}, 0, 1)
    assert job["environment"] == {"CUDA_VISIBLE_DEVICES": "3", "HIP_VISIBLE_DEVICES": "0"}
    assert job["client"]["argv"] == ["podman", "--env=CUDA_VISIBLE_DEVICES=3", "true"]
    assert job["client"]["environment"] == {"OF_CUDA_VISIBLE_DEVICES": "3"}

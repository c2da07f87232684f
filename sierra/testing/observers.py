"""Conformance suite for ways to observe runs, as functions that their authors call in tests.

    from sierra.testing import observers as conformance

    def test_it_observes(tmp_path):
        conformance.check(MyWay(), tmp_path)

The suite starts real programs, observes them as the worker does, and compares what was seen with what they did. What a way does
not claim to see (`Way.sees`) is not required; but then no trace of it may be complete. Each claim is one function of a `Trial`,
and can be called alone. A broken claim raises AssertionError with one line, even if Python runs with `-O`.
"""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from sierra.testing.assertions import holds, is_one_line, wait
from sierra.util.lazy_definitions import dataclass
from sierra.worker.file_trace import LISTS, Observation, Trace, Way
from sierra.worker.observed_record import Contents, contents
from sierra.worker.processes import all_processes, state_of

PATIENCE_S = 30.0
SOON_S = 5.0
ODD = (b"new\nline", b'quo"te\\', b"not utf-8 \xff\xfe", b") = 3<x>", b"<a>, b...", "ü €".encode(), b" ", b"x" * 255)
"""Names of files."""
WAIT = """
import os, sys, time
def pause():
    print("ready", flush=True)
    while not os.path.exists(sys.argv[1]):
        time.sleep(0.01)
"""
SURROUNDINGS = """
import json, os, sys
status = dict(line.split(":", 1) for line in open("/proc/self/status") if line.startswith("Sig") and "SigQ" not in line)
print(json.dumps([
    sys.argv, sorted(os.environ.items()), os.getcwd(), os.getpgrp() == os.getpid(), os.getsid(0) == os.getpid(), status,
    sorted(os.listdir("/proc/self/fd"))[:-1], os.nice(0), os.umask(0), sys.stdin.read(),
]))
"""


@dataclass(frozen=True, slots=True)
class Seen:
    """A run that has ended, and what was seen of it."""

    status: int
    out: bytes
    err: bytes
    trace: Trace
    contents: Contents


@dataclass(frozen=True, slots=True)
class Trial:
    """A way to test, and a folder for the runs."""

    way: Way
    folder: Path
    python: str = sys.executable

    def new_folder(self) -> Path:
        """Return a new folder with a folder `output`; its files are older than any run."""
        folder = self.folder / secrets.token_hex(8)
        (folder / "output").mkdir(parents=True)
        return folder

    def run(self, folder: Path, *argv: str, meanwhile: Callable[[Observation, int], None] | None = None) -> Seen:
        """Observe a program as the worker does. `meanwhile` is called while the program waits for the file `go`."""
        wait_for_tick(folder)
        log = folder.with_suffix(".log")
        output = folder / "output"
        observation = self.way.begin(str(log), str(output))
        environment = {"PATH": os.environ["PATH"], "LANG": "C.UTF-8"}
        words = observation.prefixed(argv, environment, str(output))
        with (folder / "stdout").open("wb") as out, (folder / "stderr").open("wb") as err:
            process = subprocess.Popen(
                words, stdin=subprocess.DEVNULL, stdout=out, stderr=err, cwd=output, env=environment, start_new_session=True
            )
        try:
            if meanwhile:
                said = folder / "stdout"
                wait(lambda: b"ready" in said.read_bytes() or process.poll() is not None, lambda: "it never waits", PATIENCE_S)
                meanwhile(observation, process.pid)
                (folder / "go").touch()
            status = process.wait(PATIENCE_S)
        finally:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(process.pid, signal.SIGKILL)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(SOON_S)
        observation.end()
        trace = observation.trace(str(folder / "stderr"))
        known = contents(trace, observation.began)
        return Seen(status, (folder / "stdout").read_bytes(), (folder / "stderr").read_bytes(), trace, known)

    def script(self, folder: Path, text: str, *words: str, meanwhile: Callable[[Observation, int], None] | None = None) -> Seen:
        """Observe a Python program; its first argument is the file that it waits for."""
        command = (self.python, "-I", "-S", "-c", WAIT + text, str(folder / "go"), *words)
        seen = self.run(folder, *command, meanwhile=meanwhile)
        holds(seen.status != 1, f"the program failed: {seen.err.decode(errors='replace').splitlines()[-1:]}")
        return seen

    def sees(self, *lists: str) -> bool:
        return self.way.sees.issuperset(lists)


def wait_for_tick(folder: Path) -> int:
    """Wait until a file that is made now is younger than all of a folder, and return its time: the clock has coarse ticks."""
    newest = max(path.lstat().st_ctime_ns for path in (folder, *folder.rglob("*")))
    probe = folder.with_suffix(".tick")
    created = 0

    def later() -> bool:
        nonlocal created
        probe.unlink(missing_ok=True)
        probe.touch()
        created = probe.stat().st_ctime_ns
        return created > newest

    wait(later, lambda: "the clock of the file system stands still", PATIENCE_S, 0.002)
    probe.unlink()
    return created


def check(way: Way, folder: Path, python: str = sys.executable) -> None:
    """Check all claims. `folder` is an empty folder, and `python` an interpreter that may be executed."""
    trial = Trial(way, folder, python)
    for claim in CLAIMS:
        claim(trial)


def says_whether_it_can_be_used(trial: Trial) -> None:
    """Check that the way works here, and repeats at once what it said first."""
    trouble = trial.way.trouble()
    if trouble is not None:
        is_one_line(trouble)
    holds(trouble is None, f"it cannot be used here: {trouble}")
    took = []
    for _ in range(3):
        began = time.monotonic()
        holds(trial.way.trouble() is None, "the answer differs when it is requested again")
        took.append(time.monotonic() - began)
    holds(min(took) < 1, "it was probed again, although nothing has changed")
    holds(trial.way.sees <= LISTS, f"it claims unknown lists: {sorted(trial.way.sees - LISTS)}")


def keeps_the_exit_status(trial: Trial) -> None:
    """Check that a program ends as it would unobserved, also by a signal to its whole group."""
    for status in (0, 3, 127, 255):
        seen = trial.run(trial.new_folder(), "/bin/sh", "-c", f"exit {status}")
        holds(seen.status == status, f"the status {status} became {seen.status}")
    for number in (signal.SIGSEGV, signal.SIGKILL, signal.SIGTERM):
        seen = trial.run(trial.new_folder(), "/bin/sh", "-c", f"kill -{number.value} $$; sleep 9")
        holds(seen.status == -number, f"{number.name} became {seen.status}")
        holds(seen.trace.complete or not trial.sees(*LISTS), f"not complete after {number.name}: {seen.trace.reason}")
    handler = "import signal\nsignal.signal(15, lambda *_: sys.exit(7))\npause()\n"
    seen = trial.script(trial.new_folder(), handler, meanwhile=lambda _, pid: os.killpg(pid, signal.SIGTERM))
    holds(seen.status == 7, f"a program that handles SIGTERM ended with {seen.status}")
    holds(seen.trace.complete or not trial.sees(*LISTS), f"a signal to the group disturbs: {seen.trace.reason}")


def keeps_the_surroundings(trial: Trial) -> None:
    """Check that a program has the words, environment, folder, group, signals and descriptors that it has unobserved."""
    folder = trial.new_folder()
    command = (trial.python, "-I", "-S", "-c", SURROUNDINGS, "", "a b", "-o", "--", "ü")
    with_it = trial.run(folder, *command)
    plain = subprocess.run(
        command,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        cwd=folder / "output",
        env={"PATH": os.environ["PATH"], "LANG": "C.UTF-8"},
        start_new_session=True,
        check=True,
    )
    for seen, wanted in zip(json.loads(with_it.out), json.loads(plain.stdout), strict=True):
        holds(seen == wanted, f"{wanted!r} became {seen!r}")
    holds(with_it.err == b"", f"something was written to its standard error: {with_it.err[:200]!r}")


def leaves_errors_to_the_caller(trial: Trial) -> None:
    """Check that a program that cannot be started gives the error that it gives unobserved."""
    folder = trial.new_folder()
    (folder / "text").write_text("no program\n")
    (folder / "text").chmod(0o755)
    (folder / "orphan").write_text("#!/no/such/interpreter\n")
    (folder / "orphan").chmod(0o755)
    cases = ("no_such_program", str(folder / "none"), str(folder), str(folder / "text"), str(folder / "orphan"))
    for number, program in enumerate(cases):
        observation = trial.way.begin(str(folder / f"{number}.log"), str(folder))
        words = observation.prefixed([program], {"PATH": os.environ["PATH"]}, str(folder))
        with contextlib.suppress(OSError):
            status = subprocess.Popen(words, cwd=folder, env={"PATH": os.environ["PATH"]}).wait()
            raise AssertionError(f"{program!r} could be started, and ended with {status}")
        observation.end()
        holds(not observation.trace().complete, f"the trace of {program!r} is complete, which never ran")


def sees_mapped_files(trial: Trial) -> None:
    """Check that a file that the program has mapped is seen, and the program itself."""
    folder = trial.new_folder()
    data = folder / "data"
    data.write_bytes(b"x" * 5000)
    text = "import mmap\nfile = open(sys.argv[2], 'rb')\nmap = mmap.mmap(file.fileno(), 0, prot=mmap.PROT_READ)\npause()\n"
    seen = trial.script(folder, text, str(data), meanwhile=lambda observation, pid: observation.look([pid]))
    holds(os.path.realpath(data) in seen.trace.read, f"the mapped file is not in {seen.trace.read[:9]}")
    holds(os.path.realpath(trial.python) in seen.trace.executed, f"the program is not in {seen.trace.executed}")
    holds(os.path.realpath(data) in seen.contents.files, f"its content is unknown: {dict(seen.contents.unusable)}")


def is_complete_only_if_it_sees_all(trial: Trial) -> None:
    """Check that the trace of a simple program is complete, or says in one line why not."""
    trace = trial.run(trial.new_folder(), "/bin/sh", "-c", "exit 0").trace
    holds(trace.complete == trial.sees(*LISTS), f"complete is {trace.complete}, and it sees {sorted(trial.way.sees)}")
    holds(trace.disturbed is None, f"the run was disturbed: {trace.disturbed}")
    if trace.reason is not None:
        is_one_line(trace.reason)


def sees_each_kind_of_use(trial: Trial) -> None:
    """Check each list with a program that does one thing of each kind."""
    folder = trial.new_folder().resolve()
    for name in ("read", "found", "written", "removed", "target"):
        (folder / name).write_text(name)
    (folder / "listed").mkdir()
    (folder / "link").symlink_to("target")
    script = folder / "script"
    script.write_text("#!/bin/sh\nexit 0\n")
    script.chmod(0o755)
    text = """
import subprocess
os.chdir(sys.argv[2])
open("read").close(); os.path.exists("found"); os.path.exists("missed"); os.listdir("listed"); open("link").close()
open("written", "a").close(); os.remove("removed")
open("own", "w").close(); open("own").close(); os.rename("own", "other"); open("other").close()
os.mkdir("made"); open("made/x", "x").close(); os.remove("made/x"); os.rmdir("made")
os.chdir("listed"); os.path.exists("../missed too")
subprocess.run(["../script"])
"""
    seen = trial.script(folder, text, str(folder)).trace
    wanted = {
        "read": {"read", "target"},
        "found": {"found"},
        "missed": {"missed", "missed too"},
        "listed": {"listed"},
        "written": {"written", "other"},
        "removed": {"removed", "own"},
        "executed": {"script"},
    }
    for kind in sorted(trial.way.sees & wanted.keys()):
        paths = {path for path in getattr(seen, kind) if Path(path).parent == folder}
        names = {Path(path).name for path in paths} - {"go", "output"}
        allowed = {"script", "listed", "link"} if kind == "found" else {"script"} if kind == "read" else set()
        holds(names - allowed == wanted[kind] - allowed, f"{kind} should be {sorted(wanted[kind])}, and is {sorted(names)}")
    if trial.sees("executed", "read"):
        holds(os.path.realpath("/bin/sh") in seen.executed, "the interpreter of a script is not seen")
        holds(seen.links.get(str(folder / "link")) == str(folder / "target"), "a link that was followed is not seen")


def sees_any_name(trial: Trial) -> None:
    """Check that names with line breaks, quotes, and bytes that are no text are seen as they are."""
    if not trial.sees("read", "missed"):
        return
    folder = trial.new_folder().resolve()
    for name in ODD:
        Path(os.fsdecode(os.fsencode(folder) + b"/" + name)).write_bytes(name)
    text = "os.chdir(sys.argv[2])\nfor name in map(os.fsencode, sys.argv[3:]):\n"
    text += "    open(name).close()\n    os.path.exists(b'-' + name[1:])\n"
    seen = trial.script(folder, text, str(folder), *map(os.fsdecode, ODD)).trace
    holds(seen.complete, f"not complete: {seen.reason}")
    for name in ODD:
        path = f"{folder}/{os.fsdecode(name)}"
        holds(path in seen.read, f"{name!r} was read, and is not seen")
        missed = f"{folder}/-{os.fsdecode(name[1:])}"
        holds(missed in seen.missed, f"{name!r} was looked for, and is not seen")


def sees_descendants(trial: Trial) -> None:
    """Check that what a daemon reads (a child of a child, in a session of its own) is seen, or the trace is not complete."""
    folder = trial.new_folder().resolve()
    (folder / "data").write_text("x")
    text = """
if os.fork() == 0:
    os.setsid()
    if os.fork() == 0:
        open(sys.argv[2]).close()
        open("done", "w").close()
    os._exit(0)
while not os.path.exists("done"):
    time.sleep(0.01)
"""
    seen = trial.script(folder, text, str(folder / "data")).trace
    holds(not seen.complete or str(folder / "data") in seen.read, "a file that a daemon read is not seen")
    holds(seen.complete or not trial.sees(*LISTS), f"not complete: {seen.reason}")


def notices_changes(trial: Trial) -> None:
    """Check that a file that was changed after it was opened has no content, and an unchanged one has."""
    folder = trial.new_folder().resolve()
    data, kept = folder / "data", folder / "kept"
    data.write_text("before")
    kept.write_text("same")
    text = "import mmap\nfor path in sys.argv[2:]:\n    file = open(path, 'rb')\n"
    text += "    globals()[path] = mmap.mmap(file.fileno(), 0, prot=mmap.PROT_READ)\npause()\n"

    def change(observation: Observation, pid: int) -> None:
        observation.look([pid])
        data.write_text("after!")

    seen = trial.script(folder, text, str(data), str(kept), meanwhile=change).contents
    holds(str(data) in seen.unusable, "a file that was changed after it was opened is not noticed")
    holds(str(kept) in seen.files, f"a file that was not changed is unusable: {seen.unusable.get(str(kept))}")


def knows_its_tracer(trial: Trial) -> None:
    """Check that no process of the run counts as the tracer, and that no tracer is left at the end."""
    folder = trial.new_folder()
    tracers: list[int] = []

    def look(observation: Observation, pid: int) -> None:
        holds(not observation.is_tracer(pid), "the program counts as the tracer")
        tracers.extend(process for process in all_processes() if observation.is_tracer(process))
        for process in tracers:
            holds(os.getpgid(process) != pid, "the tracer is in the run's process group")

    trial.script(folder, "pause()\n", meanwhile=look)
    holds(not [pid for pid in tracers if state_of(pid) not in (None, b"Z")], "the tracer is left")


def is_never_complete_without_its_tracer(trial: Trial) -> None:
    """Check that a trace is not complete, and the run disturbed, if the tracer is killed."""
    folder = trial.new_folder()
    killed: list[int] = []

    def kill(observation: Observation, pid: int) -> None:
        killed.extend(process for process in all_processes() if observation.is_tracer(process))
        for process in killed:
            os.kill(process, signal.SIGKILL)
        wait(lambda: all(state_of(process) in (None, b"Z") for process in killed), lambda: "it cannot be killed", SOON_S)
        os.killpg(pid, signal.SIGKILL)

    trace = trial.script(folder, "pause()\n", meanwhile=kill).trace
    if killed:
        holds(not trace.complete, "the trace is complete, although the tracer was killed")
        holds(trace.disturbed is not None, "the run is not disturbed, although the tracer was killed")


def ends_a_tracer_that_hangs(trial: Trial) -> None:
    """Check that a run can be ended while its tracer hangs, and that its trace is not complete."""
    folder = trial.new_folder()
    stopped: list[int] = []

    def stop(observation: Observation, pid: int) -> None:
        stopped.extend(process for process in all_processes() if observation.is_tracer(process))
        for process in stopped:
            os.kill(process, signal.SIGSTOP)
        os.killpg(pid, signal.SIGKILL)
        observation.end(seconds=0)

    seen = trial.script(folder, "pause()\n", meanwhile=stop)
    holds(seen.status == -signal.SIGKILL, f"a killed program ended with {seen.status}")
    holds(not stopped or not seen.trace.complete, "the trace is complete, although the tracer hung")


CLAIMS: Sequence[Callable[[Trial], None]] = (
    says_whether_it_can_be_used,
    keeps_the_exit_status,
    keeps_the_surroundings,
    leaves_errors_to_the_caller,
    sees_mapped_files,
    is_complete_only_if_it_sees_all,
    sees_each_kind_of_use,
    sees_any_name,
    sees_descendants,
    notices_changes,
    knows_its_tracer,
    is_never_complete_without_its_tracer,
    ends_a_tracer_that_hangs,
)

"""Programs in C do what is hard to observe, and strace sees it or says that it has not."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from sierra.testing.observers import Seen, Trial
from sierra.worker import trace_log
from sierra.worker.file_trace import Observation
from sierra.worker.observers import Strace
from sierra.worker.processes import all_processes
from tests.strace_logs import read
from tests.users import User, a_user, called_as

HEAD = """
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <linux/filter.h>
#include <linux/seccomp.h>
#include <pthread.h>
#include <sched.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/ptrace.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/un.h>
#include <sys/wait.h>
#include <unistd.h>
"""


class Bench:
    """A trial with a compiler."""

    def __init__(self, folder: Path) -> None:
        self.trial = Trial(Strace(), folder)
        self.place = self.trial.new_folder().resolve()

    def compile(self, text: str, *options: str, name: str = "program") -> Path:
        source = self.place / f"{name}.c"
        source.write_text(HEAD + text)
        subprocess.run(["gcc", "-w", *options, "-o", self.place / name, source, "-ldl", "-lpthread"], check=True)
        return self.place / name

    def run(self, *words: str | Path) -> Seen:
        return self.trial.run(self.place, *map(str, words))

    def main(self, body: str, *words: str | Path) -> Seen:
        """Observe a program with this body of `main`."""
        return self.run(self.compile(f"int main(int argc, char **argv) {{ {body} return 0; }}"), *words)

    def file(self, name: str, content: str = "content") -> Path:
        (self.place / name).write_text(content)
        return self.place / name


@pytest.fixture
def bench(tmp_path: Path, require: Callable[..., str]) -> Bench:
    require("strace")
    require("gcc")
    return Bench(tmp_path)


@pytest.mark.nightly
def test_a_plug_in_that_is_loaded_is_read_and_one_that_is_looked_for_is_missed(bench: Bench) -> None:
    plugin = bench.compile("int answer(void) { return 42; }", "-shared", "-fPIC", name="plugin.so")
    body = 'void *h = dlopen(argv[1], RTLD_NOW); dlopen(argv[2], RTLD_NOW); return ((int (*)(void))dlsym(h, "answer"))();'
    program = bench.compile(f"int main(int argc, char **argv) {{ {body} }}")
    seen = bench.run(program, plugin, bench.place / "other.so")
    assert seen.status == 42
    assert seen.trace.complete
    assert str(plugin) in seen.contents.files
    assert str(bench.place / "other.so") in seen.trace.missed


@pytest.mark.nightly
def test_a_script_of_a_shell_and_what_it_starts_are_seen(bench: Bench) -> None:
    program = bench.compile('int main() { close(open("data", 0)); return 5; }')
    bench.file("data")
    script = bench.file("run.sh", '#!/bin/sh\ncd "$1" || exit 9\n./program\n')
    seen = bench.run("sh", script, bench.place)
    assert seen.status == 5
    assert seen.trace.complete
    assert {str(program), os.path.realpath("/bin/sh")} <= set(seen.trace.executed)
    assert {str(script), str(bench.place / "data")} <= set(seen.trace.read)


@pytest.mark.nightly
def test_a_static_program_has_no_loader(bench: Bench, require: Callable[..., str]) -> None:
    source = bench.file("static.c", "int main() { return 3; }")
    made = subprocess.run(["gcc", "-static", "-o", bench.place / "static", source], check=False, capture_output=True)
    require("a static libc", there=made.returncode == 0)
    seen = bench.run(bench.place / "static")
    assert seen.status == 3
    assert seen.trace.complete
    assert seen.trace.executed == (str(bench.place / "static"),)


@pytest.mark.nightly
def test_many_opened_files_are_all_seen(bench: Bench) -> None:
    (bench.place / "many").mkdir()
    for number in range(10_000):
        (bench.place / "many" / str(number)).touch()
    body = 'char name[99]; for (int i = 0; i < 10000; i++) { sprintf(name, "%s/%d", argv[1], i); close(open(name, 0)); }'
    seen = bench.main(body, bench.place / "many")
    assert seen.trace.complete
    assert len([path for path in seen.trace.read if "/many/" in path]) == 10_000


@pytest.mark.nightly
def test_a_file_that_is_removed_after_reading_has_no_content(bench: Bench) -> None:
    data = bench.file("data")
    program = bench.compile("int main(int argc, char **argv) { int f = open(argv[1], 0); unlink(argv[1]); return f < 0; }")
    seen = bench.run(program, data)
    assert str(data) in seen.trace.read
    assert str(data) in seen.trace.removed
    assert "removed" in seen.contents.unusable[str(data)]


@pytest.mark.nightly
def test_a_file_that_is_removed_and_made_again_is_written_and_not_read(bench: Bench) -> None:
    data = bench.file("data")
    body = "unlink(argv[1]); close(open(argv[1], O_CREAT | O_EXCL | O_RDWR, 0600)); close(open(argv[1], 0));"
    seen = bench.main(body, data)
    assert str(data) in seen.trace.written
    assert str(data) not in seen.trace.read + seen.trace.removed


@pytest.mark.nightly
def test_a_file_that_is_opened_to_be_changed_is_read_and_written(bench: Bench) -> None:
    data = bench.file("data")
    body = "close(open(argv[1], O_RDWR | O_CREAT, 0600)); close(open(argv[2], O_RDWR | O_CREAT | O_TRUNC, 0600));"
    seen = bench.main(body, data, bench.file("emptied"))
    assert str(data) in seen.trace.read
    assert {str(data), str(bench.place / "emptied")} <= set(seen.trace.written)
    assert str(bench.place / "emptied") not in seen.trace.read


@pytest.mark.nightly
def test_an_unnamed_file_counts_when_it_gets_a_name(bench: Bench) -> None:
    body = (
        'int f = open(argv[1], O_TMPFILE | O_RDWR, 0600); char name[99]; sprintf(name, "/proc/self/fd/%d", f);'
        'chdir(argv[1]); if (linkat(-100, name, -100, "named", AT_SYMLINK_FOLLOW)) return 4; close(open("named", 0));'
    )
    seen = bench.main(body, bench.place)
    assert seen.status == 0
    assert seen.trace.complete
    assert str(bench.place / "named") in seen.trace.written
    assert str(bench.place / "named") not in seen.trace.read


@pytest.mark.nightly
def test_an_input_that_is_moved_is_read_under_its_first_name(bench: Bench) -> None:
    data = bench.file("data")
    body = 'chdir(argv[1]); rename("data", "a"); rename("a", "b"); close(open("b", 0));'
    seen = bench.main(body, bench.place)
    assert str(data) in seen.trace.read
    assert str(bench.place / "b") not in seen.trace.read
    assert str(data) in seen.contents.unusable


@pytest.mark.nightly
def test_threads_share_their_folder_and_may_execute_a_program(bench: Bench) -> None:
    bench.file("data")
    text = """
    char *folder;
    void *inner(void *x) { chdir(folder); return 0; }
    void *outer(void *x) { execl("/bin/true", "true", (char *)0); return 0; }
    int main(int argc, char **argv) {
        pthread_t t; folder = argv[1];
        pthread_create(&t, 0, inner, 0); pthread_join(t, 0); access("data", 0);
        pthread_create(&t, 0, outer, 0); pause();
    }"""
    seen = bench.run(bench.compile(text), bench.place)
    assert seen.status == 0
    assert str(bench.place / "data") in seen.trace.found
    assert os.path.realpath("/bin/true") in seen.trace.executed
    if b"strace" in seen.err:  # it complains about such threads sometimes
        assert seen.trace.disturbed == "the tracer has written to the run's standard error"
    else:
        assert seen.trace.complete


@pytest.mark.nightly
def test_a_program_that_lets_itself_be_traced_was_disturbed(bench: Bench) -> None:
    seen = bench.main("return ptrace(PTRACE_TRACEME, 0, 0, 0) ? 4 : 0;")
    assert seen.status == 4
    assert not seen.trace.complete
    assert "traces processes" in (seen.trace.disturbed or "")


@pytest.mark.nightly
def test_a_filter_of_the_programs_own_stays_observable(bench: Bench) -> None:
    body = """
    struct sock_filter rules[] = {
        BPF_STMT(BPF_LD | BPF_W | BPF_ABS, 0), BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, SYS_mkdir, 0, 1),
        BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ERRNO | EPERM), BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ALLOW) };
    struct sock_fprog filter = { 4, rules };
    prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0);
    if (prctl(PR_SET_SECCOMP, SECCOMP_MODE_FILTER, &filter)) return 3;
    if (syscall(SYS_mkdir, "x", 0700) != -1 || errno != EPERM) return 4;
    close(open("/etc/passwd", 0));
    """
    seen = bench.main(body)
    assert seen.status == 0
    assert "/etc/passwd" in seen.trace.read
    assert seen.trace.complete


def test_io_uring_makes_a_trace_incomplete(bench: Bench, require: Callable[..., str]) -> None:
    body = "char p[512] = {0}; int f = syscall(425, 4, p); return f < 0 ? 77 : 0;"
    seen = bench.main(body)
    require("io_uring", there=seen.status == 0)
    assert "io_uring" in (seen.trace.reason or "")
    assert seen.trace.disturbed is None


@pytest.mark.nightly
def test_a_connection_to_a_daemon_is_noted(bench: Bench) -> None:
    body = """
    struct sockaddr_un a = { AF_UNIX, "s" };
    int l = socket(AF_UNIX, SOCK_STREAM, 0); bind(l, (void *)&a, sizeof a); listen(l, 1);
    int c = socket(AF_UNIX, SOCK_STREAM, 0); return connect(c, (void *)&a, sizeof a) ? 4 : 0;
    """
    seen = bench.main(body)
    assert seen.status == 0
    assert seen.trace.complete
    assert seen.trace.notes == ("waited for connections", "may have read through the socket s")


@pytest.mark.nightly
def test_a_process_that_nobody_may_trace_is_missed(bench: Bench) -> None:
    body = "if (syscall(SYS_clone, CLONE_UNTRACED | SIGCHLD, 0, 0, 0, 0) == 0) _exit(0); wait(0);"
    seen = bench.main(body)
    assert "escaped" in (seen.trace.reason or "")


@pytest.mark.nightly
@pytest.mark.parametrize(("call", "reason"), [('chroot("/")', "root folder"), ("unshare(CLONE_NEWNS)", "mounts")])
def test_a_changed_root_or_mount_makes_a_trace_incomplete(
    call: str, reason: str, bench: Bench, require: Callable[..., str]
) -> None:
    require("root", there=os.geteuid() == 0)
    seen = bench.main(f"return {call} ? 77 : 0;")
    require("the right to do this", there=seen.status == 0)
    assert reason in (seen.trace.reason or "")


@pytest.mark.nightly
def test_processes_of_a_namespace_of_their_own_are_seen(bench: Bench, require: Callable[..., str]) -> None:
    body = """
    if (unshare(CLONE_NEWPID)) return 77;
    if (fork() == 0) { if (fork() == 0) { close(open("/etc/passwd", 0)); _exit(0); } wait(0); _exit(0); } wait(0);
    """
    seen = bench.main(body)
    require("the right to make namespaces", there=seen.status == 0)
    assert "/etc/passwd" in seen.trace.read
    assert seen.trace.complete, seen.trace.reason


def test_a_killed_tracer_makes_calls_fail_and_the_run_disturbed(bench: Bench) -> None:
    text = r"""int main(int argc, char **argv) {
        puts("ready"); fflush(stdout);
        for (int i = 0; i < 2000; i++) {
            int f = open("/etc/passwd", 0); if (f < 0 && errno == ENOSYS) return 6; close(f); usleep(5000);
        } return 0; }"""
    program = bench.compile(text)

    def kill(observation: Observation, pid: int) -> None:
        for one in [one for one in all_processes() if observation.is_tracer(one)]:
            os.kill(one, 9)

    seen = bench.trial.run(bench.place, str(program), meanwhile=kill)
    assert seen.status == 6
    assert "tracer was killed" in (seen.trace.reason or "")
    assert seen.trace.disturbed


@pytest.mark.nightly
def test_a_full_disk_makes_the_run_disturbed(bench: Bench, disk: Callable[[Path, str], Path]) -> None:
    small = disk(bench.place / "disk", "64k")
    body = 'for (int i = 0; i < 3000; i++) close(open("/etc/passwd", 0));'
    program = bench.compile(f"int main() {{ {body} return 0; }}")
    observation = Strace().begin(str(small / "log"), str(bench.place))
    words = observation.prefixed([str(program)], dict(os.environ), str(bench.place))
    with (bench.place / "err").open("wb") as err:
        assert subprocess.call(words, stderr=err, start_new_session=True) == 0
    observation.end()
    trace = observation.trace(str(bench.place / "err"))
    assert "the disk of the log is full" in trace.reasons
    assert trace.disturbed


@pytest.mark.nightly
def test_a_log_that_grows_too_long_is_cut_off_without_disturbing(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trace_log, "LOG_BYTES", 10_000)
    body = """
    for (int i = 0; i < 500; i++) close(open("/etc/passwd", 0));
    puts("ready"); fflush(stdout);
    while (access(argv[1], 0)) usleep(100000);
    return 3;"""
    log = bench.place.with_suffix(".log")
    sizes: list[int] = []

    def cut(observation: Observation, pid: int) -> None:
        sizes.append(log.stat().st_size)
        observation.limit()

    program = bench.compile(f"int main(int argc, char **argv) {{ {body} }}")
    seen = bench.trial.run(bench.place, str(program), str(bench.place / "go"), meanwhile=cut)
    assert seen.status == 3
    assert sizes[0] > 10_000 > log.stat().st_size
    assert b"\0" not in log.read_bytes()
    assert seen.trace.reasons == ("its log is longer than 10000 bytes",)
    assert seen.trace.disturbed is None


@pytest.fixture
def user(require: Callable[..., str]) -> Iterator[User]:
    require("root, to make a user", there=os.geteuid() == 0)
    require("useradd")
    with a_user(f"sierra-test-{os.getpid()}", ids=False) as made:
        yield made


@pytest.mark.nightly
def test_a_setuid_program_was_disturbed(user: User, require: Callable[..., str]) -> None:
    require("strace")
    require("gcc")
    bench = Bench(user.home)
    program = bench.compile("int main() { return geteuid() == 0 ? 3 : 4; }")
    program.chmod(0o4755)
    for path in (bench.place, bench.place / "output"):
        shutil.chown(path, user.name)

    def observed() -> None:
        seen = bench.run(program)
        assert seen.status == 4
        assert "setuid" in (seen.trace.disturbed or "")

    assert subprocess.run(["setpriv", "--reuid", user.name, "--clear-groups", program], check=False).returncode in (3, 4)
    called_as(user, observed)


@pytest.mark.nightly
def test_a_real_log_that_is_cut_anywhere_is_never_complete(bench: Bench) -> None:
    body = 'if (fork() == 0) { chdir("/"); access("x", 0); _exit(0); } wait(0); close(open("/etc/passwd", 0));'
    assert bench.main(body).trace.complete
    log = bench.place.with_suffix(".log").read_bytes()
    for size in range(len(log)):
        assert not read(log[:size], str(bench.place)).complete
    assert read(log, str(bench.place)).complete

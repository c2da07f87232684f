"""Logs of strace as text, and what they say about the files that a run has used."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sierra.worker import file_trace, trace_log
from sierra.worker.file_names import Names
from sierra.worker.file_trace import Trace
from sierra.worker.observed_record import contents
from tests.strace_logs import ENDED, LOG, calls, read


def test_a_log_is_read() -> None:
    trace = read(LOG)
    assert trace.complete, trace.reason
    assert trace.disturbed is None
    assert trace.read == ("/nonexistent/real",)
    assert trace.links["/nonexistent/in"] == "/nonexistent/real"
    assert trace.found == ("/w/sub", "/w/there")
    assert trace.missed == ("/etc/ld.so.preload", '/w/sub/x\n\udcff"<>y')
    assert trace.listed == ("/nonexistent/folder",)
    assert os.path.realpath("/bin/true") in trace.executed
    assert any("ld-" in path or "ld." in path for path in trace.executed)


OUT = 'openat(AT_FDCWD</w>, "/x/out", O_WRONLY|O_CREAT|O_TRUNC, 0666) = 3</x/out>'


IN = 'openat(AT_FDCWD</w>, "/x/out", O_RDONLY) = 3</x/out>'


MADE = 'openat(AT_FDCWD</w>, "/x/out", O_RDWR|O_CREAT|O_EXCL, 0600) = 3</x/out>'


@pytest.mark.parametrize(
    ("lines", "reread", "new"),
    [
        ((OUT, IN), True, False),
        ((IN, OUT), False, False),
        ((OUT.replace("O_TRUNC", "O_APPEND"),), False, False),
        ((OUT.replace("WRONLY", "RDWR"),), True, False),
        ((MADE, IN), False, True),
        (('mkdir("/x", 0777) = 0', OUT, IN), False, True),
        (('mkdir("/x", 0777) = -1 EEXIST (File exists)', OUT, IN), True, False),
        ((MADE, 'unlink("/x/out") = 0', IN), True, False),
        (('unlink("/x/out") = 0', MADE, IN), True, False),
        (('rename("/x/out", "/x/old") = 0', MADE, IN), True, False),
        (('rmdir("/x") = 0', 'mkdir("/x", 0777) = 0', OUT, IN), True, False),
        ((MADE, 'unlink("/x/out") = 0', MADE, IN), False, True),
        (('symlink("/r/output", "/x/out") = 0', IN.replace("/x/out", "/x/out/in", 1)), False, True),
        (('unlink("/x/out") = 0', 'symlink("/r/output", "/x/out") = 0', 'chdir("/x/out") = 0'), True, False),
        (('symlink("/r/a", "/x/tmp") = 0', 'rename("/x/tmp", "/x/out") = 0', IN.replace("</x/out", "</r/b")), True, False),
        (('symlink("/r", "/x/tmp") = 0', 'rename("/x/tmp", "/x/out") = 0', 'rename("/r/a", "/x/out/b") = 0'), True, False),
        (('unlink("/x/out") = 0', 'symlink("/r/output", "/x/out") = 0'), False, False),
        (('unlink("/x/out") = 0', 'symlink("/y/of/all", "/x/out") = 0', IN.replace("</x/out", "</y/of/all")), False, False),
        ((MADE.replace("out", "tmp"), 'rename("/x/tmp", "/x/out") = 0', IN), True, False),
        (
            (MADE.replace("out", "tmp"), 'renameat2(AT_FDCWD, "/x/tmp", AT_FDCWD, "/x/out", RENAME_NOREPLACE) = 0', IN),
            False,
            True,
        ),
        (('mkdir("/y", 0777) = 0', OUT.replace("/x", "/y"), 'rename("/y", "/x") = 0', IN), True, False),
        ((OUT, 'rename("/x/out", "/x/log") = 0'), False, False),
        ((OUT, 'rename("/x/out", "/r/output/in") = 0'), True, False),
        ((OUT, 'link("/x/out", "/r/output/in") = 0'), True, False),
        ((OUT, 'execve("/x/out", [...], 0x7ffe /* 3 vars */) = 0'), True, False),
        (('openat(AT_FDCWD</w>, "/x/out", O_RDONLY|O_CREAT|O_NOCTTY, 0666) = 3</x/out>',), False, False),
    ],
)
def test_a_file_that_a_run_wrote_and_then_used_is_noted(lines: tuple[str, ...], reread: bool, new: bool) -> None:
    first = '7 execve("/bin/true", [...], 0x7ffe /* 3 vars */) = 0'
    trace = read("\n".join([first, *("7 " + line for line in lines), "7 " + ENDED, ""]), "/r/output")
    assert (trace.reread, trace.reread_new) == (("/x/out",) * reread, ("/x/out",) * new)


def reread(roots: dict[str, str], *paths: str) -> tuple[str, ...]:
    """Return those of the paths that are noted if a run opens them for both."""
    opened = 'openat(AT_FDCWD</w>, "{0}", O_RDWR|O_CREAT, 0666) = 3<{0}>'
    return Names({"run": "/r", **roots}).inputs(calls(*map(opened.format, paths))).reread


def test_a_log_that_is_cut_anywhere_is_never_complete() -> None:
    for size in range(len(LOG)):
        assert not read(LOG[:size]).complete, LOG[:size][-80:]


def test_a_log_that_lacks_a_line_of_a_call_in_two_parts_is_not_complete() -> None:
    lines = LOG.splitlines(keepends=True)
    for number in (0, 4, 5, 6, 7, 8, 10, 11, 14, 16):
        assert not read("".join(lines[:number] + lines[number + 1 :])).complete, lines[number]


@given(st.data())
def test_no_log_is_refused_with_an_exception(data: st.DataObject) -> None:
    lines = LOG.encode().splitlines(keepends=True)
    pieces = st.one_of(st.sampled_from(lines), st.binary(max_size=30), st.sampled_from([line[:-9] for line in lines]))
    trace = read(b"".join(data.draw(st.lists(pieces, max_size=30))))
    assert all(len(reason.splitlines()) == 1 for reason in (*trace.reasons, *trace.notes, trace.disturbed or "-"))


@given(st.integers(0, len(LOG) - 1), st.binary(min_size=1, max_size=3))
def test_a_changed_byte_gives_no_exception(at: int, by: bytes) -> None:
    log = LOG.encode()
    read(log[:at] + by + log[at + 1 :])


@given(
    st.binary(min_size=1, max_size=40).filter(lambda name: b"/" not in name and b"\0" not in name and name not in (b".", b".."))
)
def test_any_name_is_read_as_it_is(name: bytes) -> None:
    """Names are written as strace writes them: by the octal escapes of all bytes, or of those that are not printable."""
    for escaped in (
        "".join(f"\\{byte:03o}" for byte in name),
        "".join(chr(byte) if 32 <= byte < 127 and chr(byte) not in '"\\<>0123456789' else f"\\{byte:03o}" for byte in name),
    ):
        trace = calls(f'openat(AT_FDCWD</w>, "{escaped}", O_RDONLY) = 3</w/{escaped}>')
        assert trace.read == ("/w/" + os.fsdecode(name),)


def test_relative_names_follow_the_folder_of_their_process() -> None:
    trace = calls('chdir("a/b") = 0', 'access("x", F_OK) = 0', "fchdir(5</c>) = 0", 'access("y", F_OK) = 0')
    assert {"/w/a/b/x", "/c/y"} <= set(trace.found)
    trace = calls('newfstatat(AT_FDCWD</real>, "z", {}, 0) = 0', 'readlink("l", ""..., 9) = 3')
    assert {"/real/z", "/real/l"} <= set(trace.found)
    trace = calls('openat(5</d>, "../e/./f", O_RDONLY) = 3</e/f>', 'openat(AT_FDCWD, "g", O_RDONLY) = 3')
    assert trace.read == ("/e/f", "/w/g")


def test_a_relative_name_in_an_unknown_folder_makes_a_trace_incomplete() -> None:
    text = '7 execve("/bin/true", [...], 0x1) = 0\n9 access("x", F_OK) = 0\n9 +++ exited with 0 +++\n7 +++ exited with 0 +++\n'
    assert "unknown folder" in (read(text).reason or "")
    assert read(text.replace('"x"', '"/x"')).complete


def test_threads_share_a_folder_and_processes_do_not() -> None:
    text = """7 execve("/bin/true", [...], 0x1) = 0
7 clone3({{flags=CLONE_VM{0}, exit_signal=0}} => {{parent_tid=[8]}}, 88) = 8
8 chdir("/other") = 0
7 access("x", F_OK) = 0
8 +++ exited with 0 +++
7 +++ exited with 0 +++
"""
    assert "/other/x" in read(text.format("|CLONE_FS")).found
    assert "/w/x" in read(text.format("")).found


def test_what_a_run_has_made_itself_is_no_input() -> None:
    trace = calls(
        'openat(AT_FDCWD</w>, "a", O_WRONLY|O_CREAT|O_TRUNC, 0666) = 3</w/a>',
        'openat(AT_FDCWD</w>, "a", O_RDONLY) = 3</w/a>',
        'rename("a", "b") = 0',
        'openat(AT_FDCWD</w>, "b", O_RDONLY) = 3</w/b>',
        'mkdir("d", 0777) = 0',
        'access("d/none", F_OK) = -1 ENOENT (No such file or directory)',
        'openat(AT_FDCWD</w>, "d/c", O_RDWR|O_CREAT|O_EXCL, 0666) = 3</w/d/c>',
        'rename("d", "e") = 0',
        'openat(AT_FDCWD</w>, "e/c", O_RDONLY) = 3</w/e/c>',
        'unlink("e/c") = 0',
        'openat(AT_FDCWD</w>, "e/c", O_RDONLY) = -1 ENOENT (No such file or directory)',
    )
    assert trace.read == trace.missed == ()
    assert trace.written == ("/w/b", "/w/e")
    assert trace.removed == ("/w/a",)  # perhaps it was there before


def test_what_was_there_is_an_input_under_its_old_name() -> None:
    trace = calls(
        'rename("folder", "other") = 0',
        'openat(AT_FDCWD</w>, "other/x", O_RDONLY) = 3</w/other/x>',
        'link("f", "g") = 0',
        'openat(AT_FDCWD</w>, "g", O_RDONLY) = 3</w/g>',
        'openat(AT_FDCWD</w>, "h", O_RDWR|O_CREAT, 0666) = 3</w/h>',
    )
    assert trace.read == ("/w/f", "/w/folder/x", "/w/h")
    assert trace.removed == ("/w/folder",)
    assert trace.written == ("/w/g", "/w/h", "/w/other")


@pytest.mark.parametrize(
    ("error", "where"),
    [("ENOENT", "missed"), ("ENOTDIR", "missed"), ("EACCES", "refused"), ("EEXIST", "found"), ("ENXIO", "found")],
)
def test_an_error_tells_whether_a_path_exists(error: str, where: str) -> None:
    assert "/nothing" in getattr(calls(f'openat(AT_FDCWD</w>, "/nothing", O_RDONLY) = -1 {error} (Why)'), where)


def test_an_error_that_has_nothing_to_do_with_a_path_tells_nothing() -> None:
    trace = calls('openat(AT_FDCWD</w>, "/nothing", O_RDONLY) = -1 EMFILE (Too many open files)')
    assert all("/nothing" not in getattr(trace, name) for name in file_trace.LISTS)


def test_a_thread_that_executes_a_program_takes_the_id_of_its_process() -> None:
    head = '7 execve("/bin/true", [...], 0x1) = 0\n7 clone(flags=CLONE_FS|CLONE_THREAD) = 8\n'
    tail = "7 <... execve resumed>) = -1 (errno 18446744073709551595)\n7 +++ exited with 0 +++\n"
    superseded = "7 +++ superseded by execve in pid 8 +++\n"
    for begun in ("<pid changed to 7 ...>", "<unfinished ...>"):
        trace = read(f'{head}8 execve("/bin/sh", [...], 0x7ff /* 3 vars */ {begun}\n{superseded}{tail}')
        assert trace.complete, trace.reason
        assert os.path.realpath("/bin/sh") in trace.executed


def test_the_interpreters_of_scripts_are_executed_too(tmp_path: Path) -> None:
    outer, inner = tmp_path / "outer", tmp_path / "inner"
    outer.write_text(f"#!{inner} -x\n")
    inner.write_text("#! /bin/sh\n")
    trace = read(f'7 execve("{outer}", [...], 0x1) = 0\n7 {ENDED}\n')
    assert trace.complete, trace.reason
    assert {str(outer), str(inner), os.path.realpath("/bin/sh")} <= set(trace.executed)
    inner.write_text("nothing that is known\n")
    assert f"what executes {inner} is unknown" in read(f'7 execve("{outer}", [...], 0x1) = 0\n7 {ENDED}\n').reasons


def test_a_long_log_is_read_in_bounded_memory_and_too_long_ones_are_cut_off(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = 'openat(AT_FDCWD</w>, "x", O_RDONLY) = 3</w/x>'
    monkeypatch.setattr(trace_log, "LOG_BYTES", 10_000)
    text = "\n".join(['7 execve("/bin/true", [...], 0x1) = 0', *["7 " + lines] * 1000, f"7 {ENDED}", ""])
    trace = read(text)
    assert trace.reasons == ("its log is longer than 10000 bytes",)
    assert trace.disturbed is None
    monkeypatch.undo()
    monkeypatch.setattr(trace_log, "MOST_PATHS", 10)
    many = [f'7 access("/{number}", F_OK) = 0' for number in range(10_000)]
    assert "more than 10 files" in (read("\n".join(['7 execve("/bin/true", [...], 0x1) = 0', *many, ""])).reason or "")


def test_a_link_to_nothing_is_missed_and_a_file_used_as_a_folder_is_found(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to("nothing")
    (tmp_path / "file").touch()
    trace = calls(
        f'openat(AT_FDCWD</w>, "{tmp_path}/link", O_RDONLY) = -1 ENOENT (No such file or directory)',
        f'openat(AT_FDCWD</w>, "{tmp_path}/file", O_RDONLY|O_DIRECTORY) = -1 ENOTDIR (Not a directory)',
    )
    assert trace.missed == (f"{tmp_path}/link",)
    assert trace.found == (f"{tmp_path}/file",)
    assert contents(Trace("strace", missed=trace.missed), 0).unusable == {}


def test_a_script_without_its_interpreter_misses_the_interpreter(tmp_path: Path) -> None:
    (tmp_path / "script").write_text("#!/no/such/shell\n")
    trace = calls(f'execve("{tmp_path}/script", [...], 0x1) = -1 ENOENT (No such file or directory)')
    assert trace.missed == ("/no/such/shell",)
    assert trace.found == (f"{tmp_path}/script",)


@pytest.mark.parametrize("kind", ["EFAULT (Bad address)", "ENAMETOOLONG (File name too long)"])
def test_names_that_cannot_be_read_are_left_out_if_the_call_failed(kind: str) -> None:
    word = "0x7ffc" if "EFAULT" in kind else '"xx"...'
    calls(f"access({word}, F_OK) = -1 {kind}")


@pytest.mark.parametrize("word", ["0x7ffc", '"xx"...', "", '"unclosed'])
def test_names_that_cannot_be_read_make_a_trace_incomplete(word: str) -> None:
    trace = read(f'7 execve("/bin/true", [...], 0x1) = 0\n7 access({word}, F_OK) = 0\n7 {ENDED}\n')
    assert trace.reasons == ("1 lines of the log are not understood",)
    assert trace.disturbed


def test_a_call_in_which_a_process_was_killed_has_no_effect() -> None:
    text = '7 execve("/bin/true", [...], 0x1) = 0\n7 execve(0x7ff, [...], 0x1 <unfinished ...>\n'
    text += "7 <... execve resumed>) = ? <unavailable>\n7 +++ killed by SIGKILL +++\n"
    assert read(text).complete
    text = text.replace("execve(0x7ff, [...], 0x1", "clone(flags=SIGCHLD").replace("execve resumed", "clone resumed")
    assert read(text).reasons == ("it was killed while it started a process",)
    assert read(text).disturbed is None


@pytest.mark.parametrize(
    ("call", "reason"),
    [
        ("io_uring_setup(4, {}) = 3<anon_inode:[io_uring]>", "io_uring"),
        ('chroot("/x") = 0', "root folder"),
        ('mount("a", "/b", "tmpfs", 0, NULL) = 0', "mounts"),
        ("unshare(CLONE_NEWNS) = 0", "mounts"),
        ("setns(3</proc/1/ns/mnt>, 0) = 0", "namespace"),
        ("pidfd_getfd(3<anon_inode:[pidfd]>, 5, 0) = 4</x>", "from another process"),
        ("seccomp(SECCOMP_SET_MODE_FILTER, SECCOMP_FILTER_FLAG_NEW_LISTENER, {}) = 3", "answers its calls"),
        ("ptrace(PTRACE_TRACEME) = -1 EPERM (Operation not permitted)", "traces processes"),
        ('execveat(3</memfd:x>(deleted), "", [...], 0x1, AT_EMPTY_PATH) = 0', "what executes /memfd:x is unknown"),
        ('execve("/proc/self/fd/5", [...], 0x1) = 0', "through /proc"),
        ('renameat2(AT_FDCWD</w>, "a", AT_FDCWD</w>, "b", RENAME_EXCHANGE) = 0', "exchanged"),
    ],
)
def test_what_escapes_observation_makes_a_trace_incomplete(call: str, reason: str) -> None:
    trace = read(f'7 execve("/bin/true", [...], 0x1) = 0\n7 {call}\n7 {ENDED}\n')
    assert len(trace.reasons) == 1
    assert reason in trace.reasons[0]
    assert bool(trace.disturbed) == call.startswith("ptrace")


def test_an_escape_that_failed_is_none() -> None:
    calls("io_uring_setup(4, {}) = -1 ENOSYS (Function not implemented)", 'chroot("/x") = -1 EPERM (Operation not permitted)')


def test_connections_are_noted() -> None:
    trace = calls(
        'connect(3<socket:[1]>, {sa_family=AF_UNIX, sun_path="/run/a\\nb"}, 110) = 0',
        'connect(3<socket:[1]>, {sa_family=AF_UNIX, sun_path=@"x\\0y"}, 110) = 0',
        'connect(3<socket:[1]>, {sa_family=AF_UNIX, sun_path="/run/none"}, 110) = -1 ENOENT (No such file or directory)',
        'connect(3<socket:[1]>, {sa_family=AF_INET, sin_port=htons(80), sin_addr=inet_addr("10.0.0.1")}, 16) '
        "= -1 EINPROGRESS (Operation now in progress)",
        'connect(3<socket:[1]>, {sa_family=AF_INET, sin_port=htons(81), sin_addr=inet_addr("10.0.0.1")}, 16) '
        "= -1 ECONNREFUSED (Connection refused)",
    )
    assert trace.notes == (
        "may have read through the socket /run/a\\nb",
        "may have read through the socket @x\\x00y",
        "may have read from 10.0.0.1, port 80",
    )
    assert trace.missed == ("/run/none",)


def test_a_file_that_is_opened_by_a_handle_is_read() -> None:
    assert calls("open_by_handle_at(3</>, {handle_bytes=8}, O_RDONLY) = 4</data>").read == ("/data",)

"""Logs of strace, hashes and names of what a run has read: with logs as text, and real files."""

from __future__ import annotations

import hashlib
import io
import os
import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sierra.testing.observers import wait_for_tick
from sierra.util import worker_zip
from sierra.worker import file_trace
from sierra.worker.file_trace import Contents, Distributions, Environments, Names, Strace, Trace, contents, parsed, sha256_of
from tests.pythons import python_of

ENDED = "+++ exited with 0 +++"

LOG = r"""
7  execve("/bin/true", [...], 0x7ffe44899a98 /* 35 vars */) = 0
7  access("/etc/ld.so.preload", R_OK)   = -1 ENOENT (No such file or directory)
7  openat(AT_FDCWD</w>, "/nonexistent/in", O_RDONLY|O_CLOEXEC) = 3</nonexistent/real>
7  newfstatat(3</nonexistent/real>, "", {st_mode=S_IFREG|0644, st_size=5, ...}, AT_EMPTY_PATH) = 0
7  clone(child_stack=NULL, flags=CLONE_CHILD_CLEARTID|SIGCHLD <unfinished ...>
8  chdir("sub" <unfinished ...>
7  <... clone resumed>, child_tidptr=0x7efea4e2ca10) = 8
8  <... chdir resumed>)                 = 0
7  vfork( <unfinished ...>
9  stat("there", {st_mode=S_IFREG|0644, st_size=5, ...}) = 0
9  +++ exited with 3 +++
7  <... vfork resumed>)                 = 9
8  stat("x\n\377\"<>y", 0x7fff173aed50) = -1 ENOENT (No such file or directory)
8  --- SIGTERM {si_signo=SIGTERM} ---
8  +++ killed by SIGTERM +++
7  getdents64(4</nonexistent/folder>, 0x556004a5f2e0 /* 5 entries */, 32768) = 120
7  +++ exited with 0 +++
""".lstrip("\n")


def read(text: str | bytes, cwd: str = "/w") -> Trace:
    return parsed(io.BytesIO(text.encode() if isinstance(text, str) else text), cwd)


def calls(*lines: str) -> Trace:
    """Return the trace of one process that made these calls."""
    first = '7 execve("/bin/true", [...], 0x7ffe /* 3 vars */) = 0'
    trace = read("\n".join([first, *("7 " + line for line in lines), "7 " + ENDED, ""]))
    assert trace.complete, trace.reason
    return trace


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


TCP = "socket(AF_INET, SOCK_STREAM|SOCK_CLOEXEC, IPPROTO_IP) = {0}<socket:[{0}]>"
UDP = TCP.replace("SOCK_STREAM", "SOCK_DGRAM")
BIND = 'bind({0}<socket:[{0}]>, {{sa_family=AF_INET, sin_port=htons({1}), sin_addr=inet_addr("{2}")}}, 16) = {3}'
CONNECT = BIND.replace("bind", "connect", 1)
LISTEN = "listen({0}<socket:[{0}]>, 8) = {1}"
OPTION = "setsockopt({0}<socket:[{0}]>, SOL_SOCKET, {1}, [{2}], 4) = 0"
LOCAL = "bind(3<socket:[3]>, {{sa_family=AF_UNIX, sun_path={0}}}, 9) = {1}"
USED = "-1 EADDRINUSE (Address already in use)"
HERE, ANYWHERE = "127.0.0.1", "0.0.0.0"  # noqa: S104 - in a log


@pytest.mark.parametrize(
    ("lines", "channels"),
    [
        ((TCP.format(3), BIND.format(3, 2000, ANYWHERE, 0)), {"127.0.0.1:2000": "listened"}),
        ((TCP.format(3), BIND.format(3, 0, HERE, 0)), {}),
        ((UDP.format(3), BIND.format(3, 2000, HERE, 0)), {"127.0.0.1:2000/udp": "listened"}),
        ((TCP.format(3), BIND.format(3, 2000, HERE, USED)), {"127.0.0.1:2000": "in_use"}),
        ((TCP.format(3), BIND.format(3, 2000, HERE, 0), LISTEN.format(3, USED)), {"127.0.0.1:2000": "in_use"}),
        (
            (TCP.format(3), BIND.format(3, 2000, HERE, USED), BIND.format(3, 2001, HERE, 0)),
            {"127.0.0.1:2000": "searched", "127.0.0.1:2001": "searched"},
        ),
        (
            (TCP.format(3), BIND.format(3, 2000, HERE, USED), BIND.format(3, 0, HERE, 0), CONNECT.format(4, 2000, HERE, 0)),
            {"127.0.0.1:2000": "connected in_use"},
        ),
        (
            (TCP.format(3), BIND.format(3, 2000, "::", 0), TCP.format(4), BIND.format(4, 2000, ANYWHERE, USED)),
            {"127.0.0.1:2000": "listened"},
        ),
        (
            (TCP.format(3), TCP.format(4), CONNECT.format(4, 2000, "127.0.1.1", 0), BIND.format(3, 2000, HERE, 0)),
            {"127.0.0.1:2000": "listened"},
        ),
        (
            (TCP.format(3), CONNECT.format(3, 2000, HERE, "-1 EINPROGRESS (Operation now in progress)")),
            {"127.0.0.1:2000": "connected"},
        ),
        ((TCP.format(3), CONNECT.format(3, 2000, HERE, "-1 ECONNREFUSED (Connection refused)")), {}),
        ((TCP.format(3), CONNECT.format(3, 2000, "192.0.2.1", 0)), {}),
        ((UDP.format(3), CONNECT.format(3, 2000, HERE, 0)), {}),
        ((TCP.format(3), OPTION.format(3, "SO_REUSEPORT", 1), BIND.format(3, 2000, HERE, 0)), {"127.0.0.1:2000": "reused"}),
        ((TCP.format(3), OPTION.format(3, "SO_REUSEPORT", 0), BIND.format(3, 2000, HERE, 0)), {"127.0.0.1:2000": "listened"}),
        ((TCP.format(3), OPTION.format(3, "SO_REUSEADDR", 1), BIND.format(3, 2000, HERE, 0)), {"127.0.0.1:2000": "listened"}),
        ((UDP.format(3), OPTION.format(3, "SO_REUSEADDR", 1), BIND.format(3, 2000, HERE, 0)), {"127.0.0.1:2000/udp": "reused"}),
        (
            (
                UDP.format(3),
                'setsockopt(3<socket:[3]>, SOL_IP, IP_ADD_MEMBERSHIP, {imr_multiaddr=inet_addr("239.255.0.1"), imr_interface='
                'inet_addr("0.0.0.0")}, 8) = 0',
                BIND.format(3, 7400, ANYWHERE, 0),
            ),
            {"239.255.0.1:7400/udp": "reused"},
        ),
        ((LOCAL.format('@"world"', 0),), {"@world": "listened"}),
        ((LOCAL.format('@"world"', USED),), {"@world": "in_use"}),
        ((LOCAL.format('"/x/world"', 0),), {"/x/world": "listened"}),
        ((LOCAL.format('"world"', 0),), {}),
        (('mkdir("/x", 0700) = 0', LOCAL.format('"/x/world"', 0)), {}),
        ((LOCAL.replace("bind", "connect").format('@"world"', 0),), {"@world": "connected"}),
        (("shmget(0x1234, 64, IPC_CREAT|0600) = 3", "shmget(IPC_PRIVATE, 64, 0600) = 4"), {"shared memory 0x1234": "reused"}),
        (('mq_open("world", O_RDWR|O_CREAT, 0600, NULL) = 5</world>',), {"message queue /world": "reused"}),
    ],
)
def test_names_by_which_runs_exchange_data_are_noted(lines: tuple[str, ...], channels: dict[str, str]) -> None:
    first = '7 execve("/bin/true", [...], 0x7ffe /* 3 vars */) = 0'
    trace = read("\n".join([first, *("7 " + line for line in lines), "7 " + ENDED, ""]), "/r/output")
    assert trace.complete, trace.reason
    found: dict[str, list[str]] = {}
    for name, use in trace.channels:
        found.setdefault(name, []).append(use)
    assert {name: " ".join(uses) for name, uses in found.items()} == channels


def test_ports_of_the_run_and_of_shared_services_are_left_out() -> None:
    channels = tuple(
        (name, "listened")
        for name in ("127.0.0.1:2000", "@/tmp/.X11-unix/X2000", "127.0.0.1:20001", "@db", "239.255.0.7:9/udp")
    )
    kept = file_trace.with_channels(Trace("strace", channels=channels), [2000], ["@db"], {"GZ_PARTITION": "own"})
    assert [name for name, _ in kept.channels] == ["127.0.0.1:20001"]


def reread(roots: dict[str, str], *paths: str) -> tuple[str, ...]:
    """Return those of the paths that are noted if a run opens them for both."""
    opened = 'openat(AT_FDCWD</w>, "{0}", O_RDWR|O_CREAT, 0666) = 3<{0}>'
    return Names({"run": "/r", **roots}).inputs(calls(*map(opened.format, paths))).reread


def test_locks_are_no_data_of_a_run(tmp_path: Path) -> None:
    sizes = {"empty": 0, "full": 1, "pid.lock": 64, "data.lock": 65}
    for name, size in sizes.items():
        (tmp_path / name).write_bytes(b"1" * size)
    kept = reread({}, *(f"{tmp_path}/{name}" for name in sizes), "/x/a.lock", "/x/.lock", "/x/block")
    assert kept == (f"{tmp_path}/data.lock", f"{tmp_path}/full", "/x/block")


LOCKED = 'openat(AT_FDCWD</w>, "/x/.lock", {0}, 0600) = 3</x/.lock>'


@pytest.mark.parametrize(
    ("flags", "then", "doubtful"),
    [
        ("O_WRONLY|O_CREAT|O_TRUNC", "O_RDONLY", True),
        ("O_RDWR|O_CREAT|O_TRUNC", "O_RDWR|O_CREAT|O_TRUNC", False),
        ("O_WRONLY|O_CREAT|O_EXCL", "O_RDONLY", False),
    ],
)
def test_a_lock_that_is_gone_was_made_new_or_not_read_for_itself(flags: str, then: str, doubtful: bool) -> None:
    trace = calls(LOCKED.format(flags), LOCKED.format(then), 'unlink("/x/.lock") = 0')
    assert (len(trace.reread), trace.reread_new) == (doubtful, ())


def test_caches_are_no_data_of_a_run_where_caches_lie() -> None:
    roots = {"home": "/h", "cache": "/c", "project": "/h/.p", "work": "/h/.p/.sierra/work/s", "store": "/h/.p/.sierra"}
    caches = ("/h/.cache/mesa_shader_cache/index", "/c/numba/a", "/c/app/qtshadercache-x86_64/a", "/h/.nv/ComputeCache/c")
    caches += ("/h/.julia/compiled/v1.10/A/b.ji", "/h/.theano/compiledir_Linux/tmp/mod.so", "/tmp/torchinductor_me/a")
    caches += ("/var/tmp/OptixCache_me/optix7cache.db", "/h/.cache/huggingface/hub/models--a/refs/main", "/c/keops2.1/a")
    caches += ("/x/__pycache__/a.nbi", "/x/a.pyc.12", "/h/.p/__pycache__/a.pyc", "/dev/shm/fastrtps_port7411")
    data = ("/h/numba/a", "/h/jax/a", "/h/.cache/jax-swarm/a", "/h/.cache/a/b/numba/c", "/h/.p/.triton/a", "/h/.p/ccache/a")
    data += ("/h/.p/.sierra/a", "/h/.p/.sierra/work/a", "/h/.p/.sierra/work/s/a", "/h/.p/.sierra/work/s/numba/a")
    data += ("/tmp/matplotlib/a", "/tmp/a/torchinductor_b/c", "/x/triton_v2/a", "/x/compiled/v1.2/a", "/x/.cache/numba/a")
    assert reread(roots, *caches, *data, "/r/home/.cache/numba/a", "/h/.p/.sierra/work/s/r/a") == tuple(
        sorted((*data, "/h/.p/.sierra/work/s/r/a"))
    )
    assert Names(roots).name("/h/.p/.sierra/work/s/a") == "{store}/work/s/a"


def test_names_that_still_exist_are_recorded_first_if_there_are_too_many(tmp_path: Path) -> None:
    (tmp_path / "z").write_text("x")
    many = [f"{tmp_path}/{number:04}" for number in range(file_trace.MOST_REREAD)]
    trace = Trace("strace", reread=(*many, f"{tmp_path}/z"))
    cut = Names({}).inputs(trace)
    assert (cut.reread, cut.complete) == ((*many[:-1], f"{tmp_path}/z"), False)
    whole = Names({}).inputs(trace._replace(reread=tuple(many)))
    assert (whole.reread, whole.complete) == (tuple(many), True)


def test_a_log_that_is_cut_anywhere_is_never_complete() -> None:
    for size in range(len(LOG)):
        assert not read(LOG[:size]).complete, LOG[:size][-80:]


@pytest.mark.integration
@given(st.lists(st.integers(0, len(LOG)), max_size=5))
def test_what_living_programs_have_done_is_read_piece_by_piece_from_a_log_that_grows(
    tmp_path_factory: pytest.TempPathFactory, cuts: list[int]
) -> None:
    log, whole = tmp_path_factory.mktemp("log") / "log", read(LOG)
    growing = Strace("/usr/bin/strace").begin(str(log), "/w")
    for end in sorted((*cuts, len(LOG))):
        log.write_text(LOG[:end])
        seen = growing.trace(living=True)
        begun = "execve" in LOG[:end].rpartition("\n")[0]
        assert (seen.disturbed, "it had not begun" in seen.reasons) == (None, not begun)
    assert seen == whole


def test_a_living_program_may_be_observed_until_its_log_is_too_long(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log, whole = tmp_path / "log", read(LOG)
    growing = Strace("/usr/bin/strace").begin(str(log), "/w")
    log.write_text(LOG)
    assert growing.trace(living=True).reason is None
    monkeypatch.setattr(file_trace, "LOG_BYTES", 10)
    growing.limit()
    log.write_text("a log that begins anew")
    cut = growing.trace(living=True)
    assert (cut.read, cut.reason, cut.disturbed) == (whole.read, "its log is longer than 10 bytes", None)


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


def test_a_checkout_in_the_store_is_the_project() -> None:
    names = Names({"store": "/p/.sierra", "project": "/p/.sierra/work/1/source", "run": "/p/.sierra/work/1/7"})
    trace = names.inputs(Trace("strace", executed=("/p/.sierra/work/1/source/sim", "/p/.sierra/work/1/7/x", "/p/.sierra/y")))
    assert [names.name(path) for path in trace.executed] == ["{project}/sim"]


@pytest.mark.parametrize("seen", [True, False])
def test_a_path_that_came_into_existence_is_missed_unless_the_run_found_it(tmp_path: Path, seen: bool) -> None:
    """A run that waits for a file would otherwise never count."""
    come, absent = tmp_path / "come", tmp_path / "absent"
    come.touch()
    trace = Trace("strace", missed=(str(absent), str(come)), found=(str(come),) if seen else ())
    record = file_trace.as_record(trace, contents(trace, 0), Names({}))
    kinds = [(str(come), "found", file_trace.sha256_of_kind(str(come)), None)] if seen else [(str(come), "missed", None, None)]
    assert record["files"] == [(str(absent), "missed", None, None), *kinds]
    assert record["reason"] == f"{come}: it was made after the run had looked for it"


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
    monkeypatch.setattr(file_trace, "LOG_BYTES", 10_000)
    text = "\n".join(['7 execve("/bin/true", [...], 0x1) = 0', *["7 " + lines] * 1000, f"7 {ENDED}", ""])
    trace = read(text)
    assert trace.reasons == ("its log is longer than 10000 bytes",)
    assert trace.disturbed is None
    monkeypatch.undo()
    monkeypatch.setattr(file_trace, "MOST_PATHS", 10)
    many = [f'7 access("/{number}", F_OK) = 0' for number in range(10_000)]
    assert "more than 10 files" in (read("\n".join(['7 execve("/bin/true", [...], 0x1) = 0', *many, ""])).reason or "")


def fake(folder: Path, script: str) -> Strace:
    program = folder / "strace"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)
    return Strace(str(program))


@pytest.mark.parametrize(
    ("script", "trouble"),
    [
        ("echo 'strace -- version 5.2'", "strace -- version 5.2; 5.3 or newer is needed"),
        ("exit 1", "of an unknown version"),
        (
            'test "$1" = -V && { echo "strace -- version 6.1"; exit; }\necho "ptrace: Operation not permitted" >&2; exit 1',
            "cannot trace here: ptrace: Operation not permitted",
        ),
        ('test "$1" != -V || echo "strace -- version 6.1"', "the log of .* is not understood"),
    ],
)
def test_a_strace_that_cannot_be_used_says_why_in_one_line(script: str, trouble: str, tmp_path: Path) -> None:
    said = fake(tmp_path, script).trouble()
    assert said is not None
    assert len(said.splitlines()) == 1
    assert re.search(trouble, said)
    assert Strace(str(tmp_path / "none")).trouble() is not None


def test_another_way_is_used_with_the_reason(tmp_path: Path) -> None:
    way, troubles = file_trace.usable([fake(tmp_path, "exit 1"), file_trace.Maps()])
    assert way is not None
    assert way.name == "maps"
    assert len(troubles) == 1


def observed(tmp_path: Path, change: Callable[[Path], object]) -> tuple[Path, Contents]:
    """Return a folder, and the contents of what was read there before a change."""
    root = tmp_path.resolve() / "place"
    (root / "listed").mkdir(parents=True)
    for path in (root / "data", root / "listed/a", root / "listed/b"):
        path.write_text(path.name)
    (root / "link").symlink_to("data")
    began = wait_for_tick(root)
    change(root)
    trace = Trace(
        "strace",
        read=(f"{root}/data",),
        listed=(f"{root}/listed",),
        found=(f"{root}/listed/a",),
        missed=(f"{root}/missed",),
        links={f"{root}/link": f"{root}/data"},
    )
    return root, contents(trace, began)


def test_files_are_hashed_and_listings_too(tmp_path: Path) -> None:
    root, seen = observed(tmp_path, lambda root: None)
    assert seen.unusable == {}
    file = seen.files[f"{root}/data"]
    assert (file.sha256, file.size) == (hashlib.sha256(b"data").hexdigest(), 4)
    assert seen.folders == {f"{root}/listed": hashlib.sha256(b"a\0b\0").hexdigest()}


def replace(root: Path) -> None:
    (root / "new").write_text("DATA")
    os.utime(root / "new", ns=(0, 0))
    (root / "new").replace(root / "data")


def relink(root: Path) -> None:
    (root / "link").unlink()
    (root / "link").symlink_to(root / "data")


def date_back(root: Path) -> None:
    (root / "data").write_text("DATA")
    os.utime(root / "data", ns=(0, 0))


@pytest.mark.parametrize(
    ("change", "path", "reason"),
    [
        (lambda root: (root / "data").write_text("data"), "data", "changed after the run had opened it"),
        (date_back, "data", "changed after the run had opened it"),
        (replace, "data", "changed after the run had opened it"),
        (lambda root: (root / "data").unlink(), "data", "removed after the run had read it"),
        (lambda root: (root / "listed/c").touch(), "listed", "changed after the run had listed it"),
        (lambda root: (root / "listed/a").unlink(), "listed/a", "removed after the run had found it"),
        (lambda root: (root / "missed").touch(), "missed", "made after the run had looked for it"),
        (relink, "link", "its link was changed"),
    ],
)
def test_changes_since_the_run_began_are_noticed(
    change: Callable[[Path], object], path: str, reason: str, tmp_path: Path
) -> None:
    root, seen = observed(tmp_path, change)
    assert reason in seen.unusable[f"{root}/{path}"]
    assert f"{root}/{path}" not in seen.files
    assert f"{root}/{path}" not in seen.folders


def test_a_cache_saves_hashing_but_not_the_check_for_changes(tmp_path: Path) -> None:
    path = tmp_path / "place" / "data"
    path.parent.mkdir()
    path.write_text("x")
    asked: list[str] = []

    def cache(path: str, status: os.stat_result, hashed: Callable[[], str]) -> str:
        asked.append(path)
        return "known"

    trace = Trace("strace", read=(str(path),))
    assert contents(trace, wait_for_tick(path.parent), cache).files[str(path)].sha256 == "known"
    assert contents(trace, 0, cache).unusable
    assert asked == [str(path)]

    def change(path: str, status: os.stat_result, hashed: Callable[[], str]) -> str:
        Path(path).write_text("longer")
        return hashed()

    assert contents(trace, wait_for_tick(path.parent), change).unusable


def names(tmp_path: Path) -> Names:
    roots = {"project": "p", "run": "p/.sierra/work/1/7", "store": "p/.sierra", "home": "h", "prefix": "venv"}
    return Names({name: str(tmp_path / folder) for name, folder in roots.items()})


def test_names_are_the_same_on_every_machine(tmp_path: Path) -> None:
    given = names(tmp_path)
    assert given.name(f"{tmp_path}/p/a b") == "{project}/a b"
    assert given.name(f"{tmp_path}/p") == "{project}"
    assert given.name(f"{tmp_path}/px") == f"{tmp_path}/px"
    assert given.name(f"{tmp_path}/p/.sierra/work/1/7/output/x") == "{run}/output/x"
    assert (
        given.name(f"{tmp_path}/venv/lib/python3.11/site-packages/numpy/x.py")
        == "{prefix}/lib/python3.11/site-packages/numpy/x.py"
    )
    assert given.name("/usr/lib/x.so") == "/usr/lib/x.so"


def test_names_know_roots_behind_links(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    given = Names({"project": str(tmp_path / "link")})
    assert given.name(f"{tmp_path}/link/x") == given.name(f"{tmp_path.resolve()}/real/x") == "{project}/x"


def test_what_is_no_input_is_left_out(tmp_path: Path) -> None:
    given = names(tmp_path)
    for path in ("/proc/self/maps", "/dev/null", "/sys/x", "/var/cache/fontconfig/x"):
        assert given.left_out(path)
    for path in ("h/.cache/fontconfig/x", "p/.sierra/x", "p/.sierra/work/1/7/home/.config"):
        assert given.left_out(f"{tmp_path}/{path}")
    for path in ("p/x", "h/.config/x", "h/.cached", "h/.cache/model.bin", "venv/x.pyc"):
        assert given.left_out(f"{tmp_path}/{path}") is None
    assert given.left_out("/dev/shm/x") is None


def test_a_checkout_in_the_store_has_the_names_of_the_project(tmp_path: Path) -> None:
    checkout, project = tmp_path / "p/.sierra/work/1/source", tmp_path / "p"
    given = Names({"project": str(checkout), "project:given": str(project), "store": str(project / ".sierra"), "home": "/root"})
    for folder in (checkout, project):
        assert given.name(f"{folder}/sim.py") == "{project}/sim.py"
        assert given.left_out(f"{folder}/sim.py") is None
    assert given.left_out(f"{tmp_path}/p/.sierra/work/1/journal.jsonl")


def test_a_run_in_a_checkout_does_not_miss_what_no_checkout_has(tmp_path: Path) -> None:
    roots = {"project": str(tmp_path / "checkout"), "unlisted:0": f"{tmp_path}/p/.git", "unlisted:1": f"{tmp_path}/p/in.xml"}
    missed = tuple(f"{tmp_path}/checkout/{name}" for name in (".git", ".git/HEAD", ".gitx", "in.xml", "plugin.so"))
    inputs = Names({**roots, "project:given": str(tmp_path / "p")}).inputs(Trace("strace", missed=missed))
    assert [Path(path).name for path in inputs.missed] == [".gitx", "plugin.so"]
    assert Names(roots).inputs(Trace("strace", missed=missed)).missed == missed


def test_the_existence_of_folders_above_a_run_is_no_input(tmp_path: Path) -> None:
    given = Names({"project": str(tmp_path / "p"), "run": "/scratch/s/runs/7", "work": "/scratch/s"})
    found = (
        "/",
        "/scratch",
        "/scratch/other",
        "/scratch/s",
        "/scratch/s/runs",
        str(tmp_path),
        f"{tmp_path}/p",
        f"{tmp_path}/p/x",
    )
    assert given.inputs(Trace("strace", found=found)).found == ("/scratch/other", f"{tmp_path}/p/x")


def test_a_listed_project_has_the_same_content_as_its_checkout(tmp_path: Path) -> None:
    for folder in ("p", "p/.sierra", "p/.git", "p/figures", "checkout"):
        (tmp_path / folder).mkdir()
    for file in ("p/sim.py", "p/sierra.toml", "checkout/sim.py"):
        (tmp_path / file).touch()
    hidden = {f"unlisted:{number}": f"{tmp_path}/p/{name}" for number, name in enumerate((".git", "figures", "sierra.toml"))}

    def listed(folder: str) -> str:
        path, given = (
            str(tmp_path / folder),
            Names({"project": str(tmp_path / folder), "store": f"{tmp_path}/p/.sierra", **hidden}),
        )
        return contents(Trace("strace", listed=(path,)), wait_for_tick(tmp_path), is_listed=given.is_listed).folders[path]

    assert listed("p") == listed("checkout")
    (tmp_path / "p" / "plugin.so").touch()
    assert listed("p") != listed("checkout")


def test_a_compiled_module_stands_for_its_source(tmp_path: Path) -> None:
    module = tmp_path.resolve() / "p" / "m.py"
    (module.parent / "__pycache__").mkdir(parents=True)
    module.touch()
    compiled = module.parent / "__pycache__" / "m.cpython-311.pyc"
    orphan = module.parent / "__pycache__" / "gone.cpython-311.pyc"
    trace = Trace("strace", read=(str(compiled), str(orphan)), found=(str(module),), written=(f"{compiled}.123",))
    inputs = names(tmp_path.resolve()).inputs(trace)
    assert inputs.read == (str(orphan), str(module))
    assert inputs.found == inputs.written == ()


@pytest.mark.parametrize(("flags", "counts"), [(0, False), (3, False), (1, True)])
def test_a_compiled_module_that_python_does_not_compare_counts_itself(tmp_path: Path, flags: int, *, counts: bool) -> None:
    module = tmp_path.resolve() / "p" / "m.py"
    (module.parent / "__pycache__").mkdir(parents=True)
    module.touch()
    compiled = module.parent / "__pycache__" / "m.cpython-311.pyc"
    compiled.write_bytes(b"\xa7\r\r\n" + flags.to_bytes(4, "little") + bytes(8))
    inputs = names(tmp_path.resolve()).inputs(Trace("strace", read=(str(compiled),)))
    assert (str(compiled) in inputs.read) is counts


def test_that_roots_and_the_folders_above_them_exist_is_left_out(tmp_path: Path) -> None:
    place = tmp_path.resolve()
    trace = Trace("strace", found=(str(place), str(place / "h"), str(place / "p" / "x"), "/usr"))
    assert names(place).inputs(trace).found == (str(place / "p" / "x"), "/usr")


def environment(folder: Path, name: str, content: str) -> str:
    """Make a virtual environment with one file; return the file's SHA-256."""
    (folder / "bin").mkdir(parents=True)
    (folder / "pyvenv.cfg").touch()
    file = folder / name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(content)
    return sha256_of(str(file), Environments())


RECORD = "lib/python3.11/site-packages/x-1.dist-info/RECORD"
SAME = {
    "bin/tool": "#!{0}/bin/python3 -I\nimport tool\n",
    "bin/long": "#!/bin/sh\n'''exec' \"{0}/bin/python3\" \"$0\" \"$@\"\n' '''\n",
    "lib/x.pth": "import x; x.map('{0}')\n",
    "pyvenv.cfg": "home = /usr/bin\nversion = 3.11.2\ncommand = /usr/bin/python3 -m venv {0}\n",
    RECORD: "x.py,sha256=a,1\n../../../bin/x,sha256={0},9\n__pycache__/x.pyc,,\n",
    "lib/other": "#!/usr/bin/python3\n",
}
DIFFERENT = {
    "the interpreter": ("bin/tool", "#!{0}/bin/python3\n", "#!{0}/bin/pypy3\n"),
    "its options": ("bin/tool", "#!{0}/bin/python3\n", "#!{0}/bin/python3 -I\n"),
    "another environment": ("bin/tool", "#!{0}/bin/python3\n", "#!/else/bin/python3\n"),
    "a folder beside it": ("bin/tool", "#!{0}2/bin/python3\n", "#!{0}2/bin/python3\n"),
    "a folder that ends alike": ("bin/tool", "#!/root{0}/python3\n", "#!/root{0}/python3\n"),
    "the words that replace it": ("bin/tool", "#!{0}/bin/python3\n", "#!{{prefix}}/bin/python3\n"),
    "the rest of a script": ("bin/tool", "#!{0}/bin/python3\n1\n", "#!{0}/bin/python3\n2\n"),
    "the base of the environment": ("pyvenv.cfg", "home = /usr/bin\n", "home = /opt/bin\n"),
    "the packages of the system": ("pyvenv.cfg", "home = /x\n", "home = /x\ninclude-system-site-packages = true\n"),
    "a recorded file": (RECORD, "x.py,sha256=a,1\n", "x.py,sha256=b,1\n"),
}


@pytest.mark.parametrize("name", SAME)
def test_the_path_of_a_virtual_environment_does_not_count(tmp_path: Path, name: str) -> None:
    one, two = (environment(tmp_path / place, name, SAME[name].format(tmp_path / place)) for place in ("one", "two/deep"))
    assert one == two


@pytest.mark.parametrize(("name", "one", "two"), DIFFERENT.values(), ids=list(DIFFERENT))
def test_all_else_in_a_virtual_environment_counts(tmp_path: Path, name: str, one: str, two: str) -> None:
    texts = {tmp_path / "one": one, tmp_path / "two": two}
    first, second = (environment(place, name, text.format(place)) for place, text in texts.items())
    assert first != second


BY_PIP = """\
import re
import sys
from tabulate import _main
if __name__ == '__main__':
    sys.argv[0] = re.sub(r'(-script\\.pyw|\\.exe)?$', '', sys.argv[0])
    sys.exit(_main())
"""
BY_NEW_PIP = """\
import sys
from tabulate import _main
if __name__ == '__main__':
    sys.argv[0] = sys.argv[0].removesuffix('.exe')
    sys.exit(_main())
"""
BY_UV = """\
# -*- coding: utf-8 -*-
import sys
from tabulate import _main
if __name__ == "__main__":
    if sys.argv[0].endswith("-script.pyw"):
        sys.argv[0] = sys.argv[0][:-11]
    elif sys.argv[0].endswith(".exe"):
        sys.argv[0] = sys.argv[0][:-4]
    sys.exit(_main())
"""
FILES_OF_TOOLS = {
    "bin/tabulate": (
        f"#!{{0}}/bin/python3\n# -*- coding: utf-8 -*-\n{BY_PIP}",
        f"#!{{0}}/bin/python3.11\n# -*- coding: utf-8 -*-\n{BY_PIP}",
        f"#!{{0}}/bin/python\n{BY_NEW_PIP}",
        f"#!{{0}}/bin/python\n{BY_UV}",
    ),
    "bin/own": ("#!{0}/bin/python3 -s\nprint(1)\n", "#!{0}/bin/python3.11 -s\nprint(1)\n"),
    "pyvenv.cfg": (
        "home = /usr/bin\ninclude-system-site-packages = false\nversion = 3.11.7\ncommand = /usr/bin/python3 -m venv x\n",
        "home = /usr/bin\nimplementation = CPython\nuv = 0.9\nversion_info = 3.11.7\ninclude-system-site-packages = false\n",
    ),
    "lib/six-1.dist-info/RECORD": (
        "six.py,sha256=a,1\nsix-1.dist-info/INSTALLER,sha256=b,4\nsix-1.dist-info/REQUESTED,sha256=c,0\n",
        "six-1.dist-info/INSTALLER,sha256=d,2\nsix.py,sha256=a,1\n",
    ),
}


@pytest.mark.parametrize("name", FILES_OF_TOOLS)
def test_the_tool_that_made_a_virtual_environment_does_not_count(tmp_path: Path, name: str) -> None:
    texts = [text.replace("{0}", str(tmp_path / str(number))) for number, text in enumerate(FILES_OF_TOOLS[name])]
    found = {environment(tmp_path / str(number), name, text) for number, text in enumerate(texts)}
    assert len(found) == 1


def test_other_words_in_a_script_that_calls_a_function_count(tmp_path: Path) -> None:
    first = f"#!{{0}}/bin/python3\n{BY_UV}"
    others = [
        ("_main())", "_main(1))"),
        ("tabulate", "other"),
        ("    sys.exit", "    print(1)\n    sys.exit"),
        ("[:-11]", "[:-11] or evil()"),
        ("python3", "python3 -O"),
    ]
    texts = [first, *(first.replace(*words) for words in others)]
    places = [tmp_path / str(number) for number in range(len(texts))]
    pairs = zip(places, texts, strict=True)
    found = [environment(place, "bin/tool", text.replace("{0}", str(place))) for place, text in pairs]
    assert len(set(found)) == len(found)


def test_a_script_outside_virtual_environments_is_hashed_as_it_is(tmp_path: Path) -> None:
    script = tmp_path / "bin" / "tool"
    script.parent.mkdir()
    script.write_text(f"#!{tmp_path}/bin/python3\n")
    assert sha256_of(str(script), Environments()) == hashlib.sha256(script.read_bytes()).hexdigest()


def test_a_file_belongs_to_the_distribution_that_has_installed_it(tmp_path: Path) -> None:
    site = tmp_path / "lib/python3.11/site-packages"
    (site / "some_thing-1.2.dist-info").mkdir(parents=True)
    (site / "some_thing-1.2.dist-info/RECORD").write_text('thing/a.py,sha256=x,3\n"thing/b,c.py",,\n../../../bin/thing,,\n')
    found = Distributions()
    assert found.of(f"{site}/thing/a.py") == found.of(f"{site}/thing/b,c.py") == "some_thing-1.2"
    assert found.of(f"{site}/other.py") is None
    assert found.of("/usr/lib/x") is None


def test_distributions_that_share_a_folder_are_told_apart_by_their_files(tmp_path: Path) -> None:
    site = tmp_path / "lib/python3.11/site-packages"
    for name in ("one", "two"):
        (site / f"{name}-1.dist-info").mkdir(parents=True)
        (site / f"{name}-1.dist-info/RECORD").write_text(f"shared/{name}.py,sha256=x,3\n")
    found = Distributions()
    assert found.of(f"{site}/shared/one.py") == "one-1"
    assert found.of(f"{site}/shared/two.py") == "two-1"
    assert found.of(f"{site}/shared/three.py") is None


def test_distributions_without_a_record_have_the_modules_that_they_name(tmp_path: Path) -> None:
    site = tmp_path / "dist-packages"
    (site / "PyYAML-6.0.dist-info").mkdir(parents=True)
    (site / "PyYAML-6.0.dist-info/top_level.txt").write_text("_yaml\nyaml\n")
    (site / "JSBSim-1.2-py3.11.egg-info").mkdir()
    found = Distributions()
    assert found.of(f"{site}/yaml/loader.py") == "PyYAML-6.0"
    assert found.of(f"{site}/jsbsim.cpython-311-x86_64-linux-gnu.so") == "JSBSim-1.2"
    sizes = [(f"{site}/yaml/loader.py", 5), (f"{site}/jsbsim.so", 9), (f"{site}/yaml/x.py", 5), ("/usr/lib/x", 99)]
    assert found.used(sizes) == ["pyyaml==6.0", "jsbsim==1.2"]


def test_reading_metadata_is_not_using_a_distribution(tmp_path: Path) -> None:
    site = tmp_path / "site-packages"
    (site / "x-1.dist-info").mkdir(parents=True)
    (site / "x-1.dist-info/RECORD").write_text("x-1.dist-info/METADATA,,\nx.pth,,\nx.py,,\n")
    found = Distributions()
    assert found.used([(f"{site}/x-1.dist-info/METADATA", 9), (f"{site}/x.pth", 9)]) == []
    assert found.used([(f"{site}/x.py", 0)]) == ["x==1"]


@pytest.mark.parametrize(
    ("path", "expected"),
    [
        ("/usr/lib/x86_64-linux-gnu/libcuda.so.535.54.03", True),
        ("/opt/rocm/lib/libamdhip64.so.6", True),
        ("/usr/lib/libOpenCL.so.1.0.0", True),
        ("/v/site-packages/nvidia/cudnn/lib/libcudnn_ops.so.9", True),
        ("/dev/nvidia0", True),
        ("/dev/dri/renderD128", True),
        ("/dev/kfd", True),
        ("/usr/lib/libcudaless.so", False),
        ("/usr/lib/libGL.so.1", False),
        ("/dev/null", False),
        ("/home/me/nvidia/notes", False),
    ],
)
def test_the_use_of_a_gpu_is_seen_by_its_libraries_and_devices(path: str, *, expected: bool) -> None:
    assert file_trace.uses_gpu(Trace("strace", read=(path,))) is expected
    assert file_trace.uses_gpu(Trace("strace", written=(path,))) is expected
    assert not file_trace.uses_gpu(Trace("strace", missed=(path,)))


def gpus(root: Path, driver: str = "535.54.03", vendor: str = "0x1002") -> str:
    files = {
        "proc/driver/nvidia/version": f"NVRM version: NVIDIA UNIX x86_64 Kernel Module  {driver}\nGCC version:  gcc 12\n",
        "proc/driver/nvidia/gpus/0000:01:00.0/information": "Model: \t\t NVIDIA A100\nIRQ: 16\n",
        "sys/class/drm/card1/device/vendor": f"{vendor}\n",
        "sys/class/drm/card1/device/device": "0x73bf\n",
        "sys/class/drm/card1-DP-1/status": "connected\n",
    }
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    (root / "sys/drivers/amdgpu/module").mkdir(parents=True, exist_ok=True)
    (root / "sys/drivers/amdgpu/module/version").write_text("6.7.0\n")
    driver_link = root / "sys/class/drm/card1/device/driver"
    driver_link.unlink(missing_ok=True)
    driver_link.symlink_to(root / "sys/drivers/amdgpu")
    return file_trace.graphics_sha256(str(root))


def test_gpus_and_their_drivers_are_part_of_the_set(tmp_path: Path) -> None:
    before = gpus(tmp_path)
    assert file_trace.graphics(str(tmp_path)) == [
        "driver NVRM version: NVIDIA UNIX x86_64 Kernel Module 535.54.03",
        "driver GCC version: gcc 12",
        "Model: NVIDIA A100",
        "0x1002 0x73bf amdgpu 6.7.0",
    ]
    assert len({before, gpus(tmp_path, driver="550.1.2"), gpus(tmp_path, vendor="0x8086")}) == 3
    assert gpus(tmp_path) == before


def test_a_gpu_that_was_used_is_recorded_with_the_files(tmp_path: Path) -> None:
    nothing = Contents({}, {}, {})
    record = file_trace.as_record(Trace("strace"), nothing, Names({}), gpu=True)
    assert record["files"] == [("{gpu}", "read", file_trace.graphics_sha256(), None)]
    assert file_trace.as_record(Trace("strace"), nothing, Names({}))["files"] == []


def test_it_runs_alone_on_python_3_8(require: Callable[..., str], tmp_path: Path) -> None:
    oldest = python_of("3.8")
    require("Python 3.8", there=oldest is not None)
    (tmp_path / "worker.pyz").write_bytes(worker_zip.packed())
    text = """
import io, os, sys, zipimport
programs = {"__name__": "programs", "__file__": sys.argv[1] + "/__main__.py"}
exec(zipimport.zipimporter(sys.argv[1]).get_code("__main__"), programs)
programs["add_package"]()
from sierra.worker import file_trace
trace = file_trace.parsed(io.BytesIO(sys.stdin.buffer.read()), "/w")
assert trace.complete, trace.reason
names = file_trace.Names({"project": "/w"})
print([names.name(path) for path in names.inputs(trace).found], len(file_trace.contents(trace, 10**20).files) > 1)
print(file_trace.usable()[0].name)
"""
    command = [str(oldest), "-I", "-S", "-c", text, str(tmp_path / "worker.pyz")]
    done = subprocess.run(command, input=LOG, capture_output=True, text=True, check=False)
    assert done.stderr == ""
    assert done.stdout.splitlines()[0] == "['{project}/sub', '{project}/there'] True"


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

"""Logs of strace as text."""

from __future__ import annotations

import io
import os

from sierra.worker.file_trace import Trace
from sierra.worker.trace_log import Log

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
    """Return what a log says; the first process began in the folder `cwd`."""
    log = Log(os.fsencode(cwd))
    log.read(io.BytesIO(text.encode() if isinstance(text, str) else text))
    return log.trace("strace")


def calls(*lines: str) -> Trace:
    """Return the trace of one process that made these calls."""
    first = '7 execve("/bin/true", [...], 0x7ffe /* 3 vars */) = 0'
    trace = read("\n".join([first, *("7 " + line for line in lines), "7 " + ENDED, ""]))
    assert trace.complete, trace.reason
    return trace

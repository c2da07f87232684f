"""A process that has imported SIERRA and forks a child for each call of the command line.

Starting `sierra` takes half a second of computing, nearly all of it for imports. A fork of a process that has imported
everything takes 10 ms. Each process of tests starts one server, when it first needs it. To callers, a forked child is what
`subprocess.Popen` returns: it has its own process id, working directory, environment, streams and signals. It differs from the
real program in the kernel's information (`/proc/PID/cmdline`, `/proc/PID/environ`) and in the time of imports.

Forking is safe because the server has one thread, opens no database and calls nothing that starts a pool of threads; it
checks the number of its threads.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import importlib
import json
import os
import select
import selectors
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TextIO

SIERRA = Path(sys.executable).with_name("sierra")
ENDING = (signal.SIGINT, signal.SIGQUIT, signal.SIGHUP, signal.SIGTERM)
READ_AT_START = ("PYTHON", "LANG", "LC_", "LD_", "MPL", "OPENBLAS", "OMP_", "ARROW_", "JE_")
"""Prefixes of variables that an interpreter or a library reads only when it starts."""

NUMBER = struct.Struct("!i")
NOT_IMPORTED = ("sierra.setup.examples", "sierra.testing", "sierra.worker")
"""Modules of SIERRA that no command imports."""

LIBRARIES = (
    "duckdb",
    "fontTools.subset",
    "lxml.etree",
    "matplotlib.backends.backend_agg",
    "matplotlib.backends.backend_pdf",
    "matplotlib.backends.backend_svg",
    "pyarrow.compute",
    "pyarrow.dataset",
    "pyarrow.parquet",
    "pydantic.type_adapter",
    "rich.progress",
)
"""Modules that commands and libraries import only when they need them."""


class Popen(subprocess.Popen[str]):
    """A process `sierra WORDS`, forked from the server, or started as usual if a fork does not meet the request."""

    _forked: socket.socket | None = None

    def _execute_child(self, args: Any, executable: Any, preexec_fn: Any, close_fds: Any, pass_fds: Any, *more: Any) -> None:
        cwd, environment, _, _, shell, *pipes = more
        descriptors, (_, gid, gids, uid, umask, new_session, group) = pipes[:6], pipes[6:]
        special = executable or preexec_fn or pass_fds or shell or gids or (gid, uid, umask, group) != (None, None, -1, -1)
        if special or not close_fds or not _can_fork(args, cwd, environment):
            super()._execute_child(args, executable, preexec_fn, close_fds, pass_fds, *more)
            return
        request = {
            "words": [os.fspath(word) for word in args],
            "cwd": os.fspath(cwd or Path.cwd()),
            "environment": dict(os.environ if environment is None else environment),
            "ignored": [number for number in ENDING if signal.getsignal(number) is signal.SIG_IGN],
            "blocked": list(signal.pthread_sigmask(signal.SIG_BLOCK, ())),
            "umask": _umask(),
            "session": new_session,
        }
        streams = [
            theirs if theirs != -1 else own for own, theirs in enumerate((descriptors[0], descriptors[3], descriptors[5]))
        ]
        self._forked = _server().ask(request, streams)
        self.pid = _number(self._forked)
        self._child_created = True
        self._close_pipe_fds(*descriptors)  # type: ignore[attr-defined]

    def _internal_poll(self, *ignored: Any, **more: Any) -> int | None:
        if self._forked is None:
            return super()._internal_poll(*ignored, **more)  # type: ignore[misc,no-any-return]
        if self.returncode is None and select.select([self._forked], [], [], 0)[0]:
            self.returncode = _number(self._forked)
            self._forked.close()
        return self.returncode

    def _wait(self, timeout: float | None) -> int:
        if self._forked is None:
            return super()._wait(timeout)  # type: ignore[misc,no-any-return]
        if self.returncode is None:
            if not select.select([self._forked], [], [], timeout)[0]:
                raise subprocess.TimeoutExpired(self.args, timeout or 0)
            self.returncode = _number(self._forked)
            self._forked.close()
        return self.returncode


def _number(server: socket.socket) -> int:
    """Return the next number that the server sends: the id of a child, then its exit code."""
    data = server.recv(NUMBER.size)
    assert data, "the fork server has ended before its child"
    return int(NUMBER.unpack(data)[0])


def run(
    *words: str, cwd: Path, stdin: str = "", environment: Mapping[str, str] | None = None, timeout: float | None = None
) -> subprocess.CompletedProcess[str]:
    """Call `sierra WORDS` in a folder, without a terminal, and wait for its end."""
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with Popen([SIERRA, *words], cwd=cwd, text=True, env=environment, **pipes) as process:
        try:
            out, err = process.communicate(stdin, timeout=timeout)
        except BaseException:
            process.kill()
            raise
        return subprocess.CompletedProcess(process.args, process.returncode, out, err)


def _can_fork(args: Any, cwd: Any, environment: Mapping[str, str] | None) -> bool:
    """Return whether a fork behaves like a new process of the program."""
    if not hasattr(os, "pidfd_open") or isinstance(args, str | bytes):  # only Linux has pidfd_open
        return False
    if Path(os.fspath(args[0])) != SIERRA or (cwd and not Path(os.fspath(cwd)).is_dir()):
        return False
    wanted = os.environ if environment is None else environment
    return _read_at_start(wanted) == _read_at_start(_SERVER.environment if _SERVER else os.environ)


def _read_at_start(environment: Mapping[str, str]) -> dict[str, str]:
    return {name: value for name, value in environment.items() if name.startswith(READ_AT_START)}


def _umask() -> int:
    status = Path("/proc/self/status").read_text()
    return int(next(line for line in status.splitlines() if line.startswith("Umask:")).split()[1], 8)


class _Server:
    """The client's side of the server."""

    def __init__(self) -> None:
        self.environment = dict(os.environ)
        self._lock = threading.Lock()
        self._control, theirs = socket.socketpair()
        argv = [sys.executable, "-P", __file__, str(theirs.fileno())]
        environment = os.environ | {"OPENBLAS_NUM_THREADS": "1", "JE_ARROW_MALLOC_CONF": "background_thread:false"}
        with theirs:
            self._process = subprocess.Popen(
                argv, cwd="/", env=environment, stdin=subprocess.DEVNULL, pass_fds=[theirs.fileno()]
            )
        atexit.register(self._end)

    def ask(self, request: Mapping[str, Any], streams: list[int]) -> socket.socket:
        """Make the server fork; return the socket on which it sends the child's id and, after its end, its exit code."""
        ours, theirs = socket.socketpair()
        text = json.dumps(request).encode()
        with self._lock, theirs:
            socket.send_fds(self._control, [NUMBER.pack(len(text))], [theirs.fileno(), *streams])
            self._control.sendall(text)
        return ours

    def _end(self) -> None:
        self._control.close()
        self._process.wait()


_SERVER: _Server | None = None


def _server() -> _Server:
    global _SERVER
    if _SERVER is None:
        _SERVER = _Server()
    return _SERVER


# The following functions run in the server.


def serve(control: socket.socket) -> None:
    """Fork a child for each request and report its exit code, until all clients have ended."""
    signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)  # signals are delivered to a child when it is ready
    _import_all()
    watched = selectors.DefaultSelector()
    watched.register(control, selectors.EVENT_READ)
    while True:
        for key, _ in watched.select():
            if key.fileobj is not control:
                watched.unregister(key.fileobj)
                _report(key.fd, *key.data)
                continue
            head, descriptors, _, _ = socket.recv_fds(control, NUMBER.size, 4)
            if not head:
                return
            request = json.loads(_exactly(control, NUMBER.unpack(head)[0]))
            if (child := os.fork()) == 0:
                watched.close()
                _become(request, descriptors)
            answer = socket.socket(fileno=descriptors[0])
            for descriptor in descriptors[1:]:
                os.close(descriptor)
            answer.sendall(NUMBER.pack(child))
            watched.register(os.pidfd_open(child), selectors.EVENT_READ, (child, answer))


def _import_all() -> None:
    """Import what commands import when they run; start no thread and open nothing."""
    import functools
    import pkgutil

    import typer.main

    import sierra.cli
    from sierra.cli import app, open_project
    from sierra.errors import SierraError

    with contextlib.suppress(SierraError):
        open_project.project()  # imports pyarrow as commands do
    for module in pkgutil.walk_packages(sierra.__path__, "sierra."):
        if not module.name.startswith(NOT_IMPORTED):
            importlib.import_module(module.name)
    for name in LIBRARIES:
        importlib.import_module(name)

    typer.main.get_command = functools.cache(typer.main.get_command)
    list(typer.main.get_command(app.app).commands.values())
    assert len([*Path("/proc/self/task").iterdir()]) == 1, "a library has started a thread; forking would lose it"
    assert "pandas" not in sys.modules, "commands do not import pandas"
    gc.collect()
    gc.freeze()


def _exactly(control: socket.socket, size: int) -> bytes:
    parts = bytearray()
    while len(parts) < size:
        parts += control.recv(size - len(parts))
    return bytes(parts)


def _report(pidfd: int, child: int, answer: socket.socket) -> None:
    os.close(pidfd)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    with answer, contextlib.suppress(BrokenPipeError):
        answer.sendall(NUMBER.pack(code))


def _become(request: Mapping[str, Any], descriptors: list[int]) -> None:
    """Act as the program `sierra` with these words, from the start of its interpreter to its end."""
    for own, theirs in enumerate(descriptors[1:]):
        os.dup2(theirs, own)
    os.closerange(3, max(int(path.name) for path in Path("/proc/self/fd").iterdir()) + 1)
    if request["session"]:
        os.setsid()
    os.chdir(request["cwd"])
    os.umask(request["umask"])
    os.environ.clear()
    os.environ.update(request["environment"])
    time.tzset()
    _signals(request["ignored"], request["blocked"])
    sys.argv[:] = request["words"]
    sys.path.insert(0, str(SIERRA.parent))
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        setattr(sys, name, _stream(number, getattr(sys, name)))
        setattr(sys, f"__{name}__", getattr(sys, name))
    os._exit(_finish(_run()))


def _signals(ignored: list[int], blocked: list[int]) -> None:
    for number in ENDING:
        usual = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
        signal.signal(number, signal.SIG_IGN if number in ignored else usual)
    signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


def _stream(number: int, like: TextIO) -> TextIO:
    """Return standard input, output or error as an interpreter makes it."""
    how = {"encoding": like.encoding, "errors": like.errors, "closefd": False}
    if number == 0:
        return open(0, **how)
    return open(number, "w", 1 if number == 2 or os.isatty(number) else -1, **how)


def _run() -> int:
    from sierra.cli.main import main

    try:
        main()
    except SystemExit as ended:
        if ended.code is None or isinstance(ended.code, int):
            return (ended.code or 0) & 0xFF
        print(ended.code, file=sys.stderr)
        return 1
    except BaseException:
        sys.excepthook(*sys.exc_info())
        return 1
    return 0


def _finish(code: int) -> int:
    """Do what an interpreter does at its end; return the exit code."""
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    try:
        sys.stdout.flush()
        sys.stderr.flush()
    except OSError:
        return 120
    return code


if __name__ == "__main__":
    serve(socket.socket(fileno=int(sys.argv[1])))
    os._exit(0)

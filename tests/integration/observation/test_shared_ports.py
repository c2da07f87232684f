"""Runs that start a server on a fixed port talk to one server if they execute at the same time: they do not count."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests import projects

OK = "SELECT count(*) AS n FROM runs WHERE status = 'ok'"
REASON = "{} is used by several runs at the same time; execute with --jobs 1, in a container, or use {{port}}"
pytestmark = pytest.mark.integration

SIM = """
import os, re, socket, struct, subprocess, sys, threading, time
given = open(sys.argv.pop(1)).read()
mode, seed, name = sys.argv[1:3] + [os.path.expandvars(sys.argv[3])]
family, kind = socket.AF_INET, socket.SOCK_DGRAM if mode in ("udp", "group") else socket.SOCK_STREAM
address = ("127.0.0.1", int(name)) if name.isdecimal() else name.replace("@", chr(0))
if isinstance(address, str):
    family = socket.AF_UNIX
server, client, world = socket.socket(family, kind), socket.socket(family, kind), seed
if mode == "experiment":
    mode, address = "fixed", (address[0], address[1] + int(re.search('count="([0-9]+)"', given)[1]))
if mode in ("fixed", "spread") and family == socket.AF_INET:
    server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
if mode == "spread":
    mode, address = "search", (address[0], address[1] + int(seed) % 7)
if mode in ("reuse", "group"):
    server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT if mode == "reuse" else socket.SO_REUSEADDR, 1)
if mode == "group":
    address = ("", int(name))
    joined = struct.pack("4s4s", socket.inet_aton("239.255.7.7"), socket.inet_aton("127.0.0.1"))
    server.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, joined)
if mode == "replace" and os.path.exists(name):
    os.unlink(name)
if mode == "key":
    import ctypes
    libc = ctypes.CDLL(None)
    assert libc.shmget(0x7A31C5, 64, 0o1666) >= 0
    time.sleep(0.2)
elif mode == "outside":
    client.connect(address)
    time.sleep(0.3)
else:
    for number in range(100):
        try:
            server.bind(address)
            break
        except OSError:
            if mode != "search":
                break
            address = (address[0], address[1] + 1)
    if kind == socket.SOCK_STREAM:
        def serve():
            server.listen(8)
            while True:
                one = server.accept()[0]
                one.sendall(seed.encode())
                one.close()
        threading.Thread(target=serve, daemon=True).start()
        for number in range(500):
            try:
                client.connect(address)
                break
            except OSError:
                client.close()
                client = socket.socket(family, kind)
                time.sleep(0.02)
        world = seed if mode == "reuse" else client.recv(99).decode()
    time.sleep(float((sys.argv[4:] or ["0.4"])[0]))
open("swarm.csv", "w").write(f"tick,value\\n0,{world}\\n")
"""


def free() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1]) - 20_000  # not one that the kernel chooses


@pytest.fixture
def execute(tmp_path: Path, require: Callable[..., str]) -> Callable[..., tuple[int, str]]:
    """Execute runs with a server; return how many count, and what SIERRA has said. Check that none has another run's data."""
    require("strace")

    def execute(arguments: str, *, runs: int = 4, jobs: int = 2, sizes: str = "1,2", observe: str = "first") -> tuple[int, str]:
        folder = tmp_path / "project"
        command = f"python3 {{project}}/server.py {{input}} {arguments.replace(' ', ' {seed} ', 1)}"
        config = projects.CONFIG.replace("python3 sim.py {input}", command).replace("runs = 2", f"runs = {runs}")
        if not folder.exists():
            projects.make(folder, config)
        (folder / "sierra.toml").write_text(f'observe = "{observe}"\n{config}')
        (folder / "server.py").write_text(SIM)
        done = projects.quick(folder, "run", f"population_size={sizes}", "--jobs", str(jobs), "--no-figures")
        if projects.sql(folder, OK)[0]["n"]:
            assert projects.sql(folder, "SELECT * FROM swarm JOIN runs r USING (run) WHERE value <> r.seed") == []
        return projects.sql(folder, OK)[0]["n"], done.stdout + done.stderr

    return execute


@pytest.mark.parametrize("mode", ["fixed", "reuse", pytest.param("udp", marks=pytest.mark.each_case)])
def test_runs_that_share_a_port_do_not_count(execute: Callable[..., tuple[int, str]], mode: str) -> None:
    port = free()
    good, said = execute(f"{mode} {port}")
    assert good < 3
    assert REASON.format(f"127.0.0.1:{port}{'/udp' if mode == 'udp' else ''}") in said


@pytest.mark.each_case
@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ("fixed @sierra-test-{0}", "@sierra-test-{0}"),
        ("replace {1}/world.sock", "world.sock"),
        ("group {0}", "239.255.7.7:{0}/udp"),
        ("key 1", "shared memory 0x7a31c5"),
    ],
)
def test_runs_that_share_another_channel_do_not_count(
    execute: Callable[..., tuple[int, str]], tmp_path: Path, arguments: str, name: str
) -> None:
    port = free()
    good, said = execute(arguments.format(port, tmp_path))
    assert good < 3
    assert REASON.format(name.format(port)).split(" is used")[0] in said
    assert "is used by several runs at the same time" in said


def test_a_socket_among_the_temporary_files_is_that_of_one_run(execute: Callable[..., tuple[int, str]]) -> None:
    assert execute("fixed $TMPDIR/world.sock")[0] == 8


def test_with_one_job_they_count(execute: Callable[..., tuple[int, str]]) -> None:
    assert execute(f"fixed {free()}", runs=2, jobs=1)[0] == 4


def test_two_runs_at_once_are_compared_although_one_was_observed(execute: Callable[..., tuple[int, str]]) -> None:
    port = free()
    good, said = execute(f"fixed {port} 2", runs=1)
    assert good < 2
    assert f"127.0.0.1:{port} is used" in said


@pytest.mark.parametrize("arguments", ["fixed {port}", pytest.param("udp {port3}", marks=pytest.mark.each_case)])
def test_runs_with_ports_of_their_own_count(execute: Callable[..., tuple[int, str]], arguments: str) -> None:
    good, said = execute(arguments, runs=3)
    assert good == 6
    assert "127.0.0.1" not in said


def test_a_program_that_looks_for_a_free_port_has_one_of_its_own(execute: Callable[..., tuple[int, str]]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", port := free()))
        assert execute(f"search {port}")[0] == 8


def test_ports_that_runs_have_in_common_by_chance_are_no_problem(execute: Callable[..., tuple[int, str]]) -> None:
    good, said = execute(f"spread {free()} 0.1", runs=12, observe="all")
    assert good == 24, said


def test_runs_that_share_the_port_of_their_experiment_do_not_count(execute: Callable[..., tuple[int, str]]) -> None:
    good, said = execute(f"experiment {free()} 0.2", runs=2, sizes="1,2,4")
    assert "are used by several runs at the same time" in said
    assert good < 6


@contextlib.contextmanager
def outside(port: int = 0) -> Iterator[int]:
    """Serve connections at a port, as a program that no run has started."""
    with contextlib.ExitStack() as open_until_the_end:
        server = open_until_the_end.enter_context(socket.create_server(("127.0.0.1", port)))

        def serve() -> None:
            with contextlib.suppress(OSError):  # the end of the test
                while True:
                    open_until_the_end.enter_context(server.accept()[0])

        thread = threading.Thread(target=serve)
        thread.start()
        yield server.getsockname()[1]
        server.shutdown(socket.SHUT_RDWR)
        thread.join()


def test_a_server_that_no_run_has_started_gets_a_note(execute: Callable[..., tuple[int, str]]) -> None:
    with outside() as port:
        good, said = execute(f"outside {port}")
        assert good == 8
        assert f"runs at the same time used a server that no run has started: 127.0.0.1:{port}; if runs change" in said
        assert "no run has started" not in execute(f"outside {port} 1", jobs=1)[1]


def test_the_servers_of_an_earlier_batch_do_not_count(execute: Callable[..., tuple[int, str]]) -> None:
    port = free()
    assert execute(f"fixed {port}", runs=1, jobs=1)[0] == 2
    with outside(port):
        good, said = execute(f"outside {port}")
    assert good == 2 + 8
    assert "no run has started" in said


def test_programs_that_choose_a_display_each_share_none(tmp_path: Path, require: Callable[..., str]) -> None:
    require("strace")
    require("xvfb-run")
    command = "xvfb-run -a python3 sim.py {input}"
    root = projects.make(tmp_path / "p", projects.CONFIG.replace("python3 sim.py {input}", command).replace("= 2", "= 3"))
    done = projects.quick(root, "run", "population_size=1,2", "--jobs", "2", "--no-figures")
    assert (done.returncode, projects.sql(root, OK)) == (0, [{"n": 6}]), done.stdout

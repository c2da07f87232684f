"""Names by which runs may exchange data, from logs of strace as text."""

from __future__ import annotations

import pytest

from sierra.worker.channels import with_channels
from sierra.worker.file_trace import Trace
from tests.strace_logs import ENDED, read

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
    kept = with_channels(Trace("strace", channels=channels), [2000], ["@db"], {"GZ_PARTITION": "own"})
    assert [name for name, _ in kept.channels] == ["127.0.0.1:20001"]

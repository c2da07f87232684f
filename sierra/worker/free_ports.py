"""Free ports of this host, which no other run gets until they are given back."""

from __future__ import annotations

import errno
import itertools
import os
import sys

TYPE_CHECKING = False  # each run starts a conductor, and importing `typing` or `socket` is a tenth of its time
if TYPE_CHECKING:
    import socket

PORTS = range(20000, 32760)  # below those that Linux gives to outgoing connections
BLOCK = 10
TRIES = 1000


class NoFreePort(Exception):
    """No port is free."""


class Ports:
    """Ports that no other program uses, and that no other run on this host gets until they are given back.

    A port is chosen at random, as the first of a block of BLOCK free ones, because some programs use those that follow, too.
    The block is taken by an abstract Unix socket. Like a port, it belongs to a network namespace, and the kernel removes it
    with the process, whatever ends that.
    """

    def __init__(self) -> None:
        self._held: list[socket.socket] = []

    def take(self) -> int:
        """Return a port. Raises NoFreePort if none is free."""
        import socket

        blocks = len(PORTS) // BLOCK
        for _ in range(TRIES):
            port = PORTS[0] + BLOCK * (int.from_bytes(os.urandom(4), "big") % blocks)
            mark = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            try:
                if sys.platform == "linux":  # no other system has such names
                    mark.bind("\0sierra-port-%d" % port)
                if all(map(is_free, range(port, port + BLOCK))):
                    self._held.append(mark)
                    return port
            except OSError:  # another run has it
                pass
            mark.close()
        raise NoFreePort("no port between %d and %d is free" % (PORTS[0], PORTS[-1]))

    def give_back(self) -> None:
        """Let other runs have the ports."""
        while self._held:
            self._held.pop().close()


def is_free(port: int) -> bool:
    """Return whether no program uses a port, for TCP or UDP."""
    import socket

    for family, kind in itertools.product((socket.AF_INET, socket.AF_INET6), (socket.SOCK_STREAM, socket.SOCK_DGRAM)):
        try:
            with socket.socket(family, kind) as server:
                if family == socket.AF_INET6:
                    server.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
                server.bind(("", port))
        except OSError as error:
            if error.errno in (errno.EADDRINUSE, errno.EACCES):  # else there is no IPv6 here
                return False
    return True

"""Links: commands per second, and copies compared with `ssh cat`, on three robots of this machine. For root.

Python and sshd share the cores of this machine with all robots, so that a real fleet is faster. Local files are in memory, so
that the disk of this machine is not measured.
"""

from __future__ import annotations

import os
import queue
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from sierra.extensions.hosts.fabric import Fabric  # noqa: E402
from sierra.extensions.hosts.openssh import OpenSsh, OpenSshOptions  # noqa: E402
from sierra.extensions.robots import agent_start  # noqa: E402
from sierra.extensions.robots.agent_link import AgentLink  # noqa: E402
from sierra.extensions.robots.fleet_table import FleetTable  # noqa: E402
from sierra.runners.links.base import Link, LinkOptions  # noqa: E402 - tests are found by the line above
from tests.support.robot_fleet import PROGRAMS, Fleet  # noqa: E402

COMMANDS = 100
SIZE = 20_000_000


def main() -> None:
    if os.geteuid() != 0 or not all(shutil.which(one, path=os.environ["PATH"] + ":/usr/sbin:/sbin") for one in PROGRAMS):
        print(f"links: not measured, because this needs root and {', '.join(PROGRAMS)}")
        return
    with Fleet() as fleet, tempfile.TemporaryDirectory(dir="/dev/shm") as folder:
        config = str(fleet.ssh_config)
        for name, make in (
            ("fabric", lambda host: Fabric(host, LinkOptions(ssh_config=config))),
            ("openssh", lambda host: OpenSsh(host, OpenSshOptions(ssh_config=config))),
        ):
            links = [make(host) for host in fleet.names]
            commands(name, links)
            copies(name, links[0], fleet, Path(folder) / name)
            for link in links:
                link.close()


def commands(name: str, links: list[Link]) -> None:
    """Measure the commands per second, one after the other on each host, and eight at once."""
    for link in links:
        link.run(["true"])
    for at_once in (1, 8):
        rates = []
        for _ in range(3):
            with ThreadPoolExecutor(len(links) * at_once) as pool:
                began = time.perf_counter()
                list(pool.map(lambda link: link.run(["true"]), [link for _ in range(COMMANDS) for link in links]))
                rates.append(COMMANDS * len(links) / (time.perf_counter() - began))
        what = f"{COMMANDS * len(links)} commands over {name}, {at_once} at once on each host"
        print(f"{what:58} {statistics.median(rates):8.0f} a second  (fabric: 200 or more)", flush=True)


def copies(name: str, link: Link, fleet: Fleet, folder: Path) -> None:
    """Compare pulling and pushing a folder of one file with `ssh cat`."""
    source = folder / "source"
    source.mkdir(parents=True)
    (source / "bag").write_bytes(os.urandom(SIZE))
    ssh = ["ssh", "-F", str(fleet.ssh_config), "-o", "ControlPath=/tmp/sierra-bench-%C", "-o", "ControlMaster=auto"]
    argv = [*ssh, "-o", "ControlPersist=60", link.name]
    link.push(source, name)
    with (folder / "cat").open("wb") as file:
        plain = _median(lambda _: subprocess.run([*argv, f"cat {name}/bag"], stdout=file, check=True), 5)
    ours = _median(lambda turn: link.pull(name, folder / f"pulled{turn}"), 5)
    agent = AgentLink(link.name, link, 5.0, queue.SimpleQueue())
    table = FleetTable(stop=(), fleet={link.name: {"host": link.name}})
    home = agent_start.start(agent, table.robot(link.name), table, "bench", "")["home"]
    agents = _median(lambda turn: agent.pull(f"{home}/{name}", folder / f"sent{turn}"), 5)
    agent.close()
    back = _median(lambda turn: link.push(source, f"pushed{turn}") and link.run(["rm", "-r", f"pushed{turn}"]), 5)
    subprocess.run([*argv[:-1], "-O", "exit", link.name], capture_output=True, check=False)
    for what, took in (("pull", ours), ("pull by the agent", agents), ("push", back)):
        print(f"{f'{what} of 20 MB over {name}, verified':58} {took:8.2f} s  {plain:8.2f} s  ratio {took / plain:5.2f}", end="")
        print("  (pull: 2 or less; ssh cat)", flush=True)


def _median(what: Callable[[int], object], times: int) -> float:
    measured = []
    for turn in range(times):
        began = time.perf_counter()
        what(turn)
        measured.append(time.perf_counter() - began)
    return statistics.median(measured)


if __name__ == "__main__":
    main()

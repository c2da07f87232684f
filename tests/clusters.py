"""A temporary real SLURM in one folder: for root on one Linux host, without systemd, control groups, files in /etc.

Each node is a slurmd in its own PID, mount and host-name namespaces: `hostname` returns the node's name there, and killing
its first process is a power cut: slurmd, and all processes of jobs, die immediately. The controller, munged and the nodes end
with the process that started them, even if it is killed. Debian: see `make system`.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import select
import shutil
import signal
import socket
import subprocess
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from tests.waiting import PATIENCE_S, until

SBIN = ":/usr/sbin:/sbin"
PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "unshare", "nsenter", "setpriv")
LONGEST = 100
"""The approximate maximum length of the path of a Unix socket."""

SETTINGS = {
    "ClusterName": "sierratest",
    "SlurmUser": "root",
    "SlurmdUser": "root",
    "AuthType": "auth/munge",
    "CredType": "cred/munge",
    "MailProg": "/bin/true",
    # use no features of the host: no control groups, no affinity, no PMIx
    "ProctrackType": "proctrack/linuxproc",
    "TaskPlugin": "task/none",
    "JobAcctGatherType": "jobacct_gather/none",
    "MpiDefault": "none",
    "SwitchType": "switch/none",
    # a node may have more cores than the host
    "SlurmdParameters": "config_overrides",
    "ReturnToService": "2",
    # detect failures quickly; defaults: 120, 300 and 30
    "SlurmctldTimeout": "30",
    "SlurmdTimeout": "10",
    "KillWait": "2",
    "MinJobAge": "300",
    "InactiveLimit": "0",
    "SchedulerType": "sched/backfill",
    "SchedulerParameters": "batch_sched_delay=0,sched_min_interval=0,bf_interval=2",
    "SelectType": "select/cons_tres",
    "SelectTypeParameters": "CR_CPU",
    "MaxArraySize": "1001",
    "MaxJobCount": "10000",
    "GresTypes": "gpu",
    "JobCompType": "jobcomp/filetxt",
    "AccountingStorageType": "accounting_storage/none",
}
PARTITIONS = (
    "PartitionName=debug Nodes=ALL Default=YES MaxTime=60 State=UP",
    "PartitionName=short Nodes=ALL MaxTime=1 State=UP",
    "PartitionName=closed Nodes=ALL AllowAccounts=others State=UP",
    "PartitionName=drained Nodes=ALL State=DRAIN",
)


class Slurm:
    """One cluster. `settings` and `partitions` replace those above; with `pbs`, jobs see the variables of PBS too.

    Nodes are named n1, n2, …; each has `cpus` cores, 4000 MiB, 2 GPUs and the feature `fast`.
    """

    def __init__(
        self,
        root: Path,
        *,
        nodes: int = 3,
        cpus: int = 4,
        settings: Mapping[str, str] | None = None,
        partitions: Sequence[str] = PARTITIONS,
        pbs: bool = False,
    ) -> None:
        assert len(str(root / "munge.sock")) < LONGEST, f"{root} is too long for a unix socket"
        self.root = root
        self.names = [f"n{number + 1}" for number in range(nodes)]
        self.environment = {"SLURM_CONF": str(root / "slurm.conf")}
        """The environment with which the commands of SLURM use this cluster."""
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._ports = free_ports(nodes + 1)
        self._write(cpus, settings or {}, partitions, pbs=pbs)

    def _write(self, cpus: int, settings: Mapping[str, str], partitions: Sequence[str], *, pbs: bool) -> None:
        root, host = self.root, socket.gethostname()
        for name in ("state", "log", "key"):
            (root / name).mkdir(parents=True)
        root.chmod(0o755)
        (root / "key").chmod(0o700)  # munged refuses other modes
        own = {
            "SlurmctldHost": f"{host}(127.0.0.1)",
            "SlurmctldPort": str(self._ports[0]),
            "AuthInfo": f"socket={root}/munge.sock",
            "SlurmctldPidFile": f"{root}/slurmctld.pid",
            "SlurmdPidFile": f"{root}/slurmd.%n.pid",
            "StateSaveLocation": f"{root}/state",
            "SlurmdSpoolDir": f"{root}/spool.%n",
            "SlurmctldLogFile": f"{root}/log/slurmctld.log",
            "SlurmdLogFile": f"{root}/log/slurmd.%n.log",
            "JobCompLoc": f"{root}/jobcomp.txt",
        }
        if pbs:
            own["PlugStackConfig"] = f"{root}/plugstack.conf"
            (root / "plugstack.conf").write_text("required spank_pbs.so\n")
        nodes = [
            f"NodeName={name} NodeHostname={host} NodeAddr=127.0.0.1 Port={port} CPUs={cpus} Boards=1 SocketsPerBoard=1 "
            f"CoresPerSocket={cpus} ThreadsPerCore=1 RealMemory=4000 Gres=gpu:2 Feature=fast State=UNKNOWN"
            for name, port in zip(self.names, self._ports[1:], strict=True)
        ]
        lines = [f"{name}={value}" for name, value in {**SETTINGS, **own, **settings}.items()]
        (root / "slurm.conf").write_text("\n".join((*lines, *nodes, *partitions, "")))
        (root / "gres.conf").write_text("AutoDetect=off\nName=gpu File=/dev/null,/dev/zero\n")
        key = root / "key" / "munge.key"
        key.write_bytes(secrets.token_bytes(128))
        key.chmod(0o600)

    def start(self) -> None:
        """Start all daemons; return when every node is idle."""
        key = self.root / "key"
        files = (f"--pid-file={key}/pid", f"--log-file={key}/log", f"--seed-file={key}/seed")
        munge = self.root / "munge.sock"
        self._spawn("munged", "munged", "-F", f"--socket={munge}", f"--key-file={key}/munge.key", *files, "--num-threads=4")
        until(munge.exists, "munged listens")
        self._start("slurmctld", "slurmctld", "-D")
        for name in self.names:
            self.start_node(name)
        self.until_idle()

    def stop(self) -> None:
        """End all daemons and running jobs."""
        for name in sorted(self._processes, key=lambda name: (name not in self.names, name == "munged")):
            self._kill(name, signal.SIGKILL if name in self.names else signal.SIGTERM)

    def __enter__(self) -> Slurm:
        try:
            self.start()
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    # faults

    def power_cut(self, node: str) -> None:
        """Kill all processes of a node. SLURM detects it after half a minute, or immediately with `declare_down`."""
        [first] = _children(self._processes[node].pid)
        ends = os.pidfd_open(first)
        self._kill(node)
        select.select([ends], [], [])  # the kernel ends it after all others: then the node's port is free
        os.close(ends)

    def start_node(self, node: str) -> None:
        """Start a node."""
        script = 'hostname "$1"; slurmd -D -N "$1" & sleep infinity & wait'  # the first process is a shell, which reaps zombies
        self._spawn(node, "unshare", "--pid", "--fork", "--kill-child", "--mount-proc", "--uts", "sh", "-c", script, "sh", node)
        self._until_slurmd(node)

    def kill_slurmd(self, node: str) -> None:
        """Kill only the daemon: the node's jobs continue, and SLURM considers them lost."""
        for pid in self._slurmd(node):
            os.kill(pid, signal.SIGKILL)
        until(lambda: not self._slurmd(node), f"slurmd of {node} has ended")

    def start_slurmd(self, node: str) -> None:
        """Start only the daemon, on a running node."""
        [shell] = _children(self._processes[node].pid)
        enter = ("nsenter", f"--target={shell}", "--pid", "--uts", "--mount", "slurmd", "-D", "-N", node)
        self._spawn(f"slurmd of {node}", *enter)
        self._until_slurmd(node)

    def _until_slurmd(self, node: str) -> None:
        until(lambda: self._slurmd(node), f"slurmd of {node} runs; see {self.root}/log")

    def kill_controller(self, *, saved: bool = False) -> None:
        """Kill the controller; with `saved`, after it has saved its state of jobs, else it may reuse ids."""
        if saved:
            self._until_saved()
        self._kill("slurmctld")

    def _until_saved(self) -> None:
        """Change a job, and wait until the file of all jobs has that change, which takes up to five seconds."""
        file = self.root / "state" / "job_state"
        comment = f"saved {secrets.token_hex(8)}"
        job = self.command("squeue", "-h", "-a", "-o", "%A").split()[0]
        self.command("scontrol", "update", f"jobid={job}", f"AdminComment={comment}")
        until(lambda: file.exists() and comment.encode() in file.read_bytes(), "the controller saves its state")

    def start_controller(self, **settings: str) -> None:
        """Start the controller, with other settings if some are given; return when it answers."""
        with (self.root / "slurm.conf").open("a") as file:
            file.writelines(f"{name}={value}\n" for name, value in settings.items())
        self._start("slurmctld", "slurmctld", "-D")

    def declare_down(self, node: str) -> None:
        """Declare a node down in SLURM. A running node returns to service within seconds."""
        self.command("scontrol", "update", f"nodename={node}", "state=down", "reason=test")

    def resume(self, node: str) -> None:
        """Make SLURM use a node again after it was declared down."""
        self.command("scontrol", "update", f"nodename={node}", "state=resume")

    def requeue(self, task: str) -> None:
        """Requeue a running array task, unless the controller has done this by itself."""
        done = self._executed("scontrol", "requeue", task)
        assert done.returncode == 0 or "pending execution" in done.stderr, done.stderr

    def release_requeued(self, count: int = 1) -> None:
        """Start requeued array tasks immediately instead of after two minutes; wait until `count` are queued."""

        def requeued() -> list[str]:
            waiting = self.command("squeue", "-h", "-a", "-r", "-t", "PENDING", "-o", "%i %r").splitlines()
            return [line.split()[0] for line in waiting if line.endswith("BeginTime")]

        until(lambda: len(requeued()) >= count, f"{count} array tasks are requeued")
        for one in requeued():
            self.command("scontrol", "update", f"jobid={one}", "StartTime=now")

    def heal(self) -> None:
        """Restore a cluster without jobs and with idle nodes after any fault."""
        if self._gone("slurmctld"):
            self.start_controller()
        if jobs := self.command("squeue", "-h", "-a", "-o", "%F").split():
            self.command("scancel", *set(jobs))
        for node in self.names:
            if self._gone(node):
                self.start_node(node)
            elif not self._slurmd(node):
                self.start_slurmd(node)
        self.until_idle()

    # queries

    def command(self, *argv: str) -> str:
        """Run a command of SLURM; return its output."""
        done = self._executed(*argv)
        assert done.returncode == 0, f"{argv}: {done.stderr}"
        return done.stdout.strip()

    def _executed(self, *argv: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            argv, cwd=self.root, env=self._environment(), check=False, timeout=PATIENCE_S, capture_output=True, text=True
        )

    def nodes(self) -> dict[str, str]:
        """Return the state of each node."""
        return dict(line.split() for line in self.command("sinfo", "-h", "-N", "-o", "%N %t").splitlines())

    def states(self, job: str = "") -> dict[str, str]:
        """Return the state of each array task of a job, or of all jobs, by its id."""
        asked = ("squeue", "-h", "-a", "-r", "-t", "all", *(["-j", job] if job else []), "-o", "%i %T")
        return dict(line.split() for line in self.command(*asked).splitlines())

    def restarts(self, job: str) -> dict[str, int]:
        """Return how often SLURM itself has started each array task of a job once more, by the id of the task."""
        tasks = [dict(word.split("=", 1) for word in line.split() if "=" in word) for line in self._details(job)]
        return {f"{one['ArrayJobId']}_{one['ArrayTaskId']}": int(one["Restarts"]) for one in tasks}

    def _details(self, job: str) -> list[str]:
        return self.command("scontrol", "show", "job", "--oneliner", job).splitlines()

    def until_idle(self) -> None:
        """Wait until all nodes are idle; use nodes again that were declared down."""

        def seen() -> str:
            told = (self.command("sinfo", "-N", "-h", "-o", "%N %T %E"), self.command("squeue", "-h", "-a", "-r", "-t", "all"))
            return "\n".join((f"nodes are idle; see {self.root}/log", *told))

        until(self._is_idle, seen)

    def _is_idle(self) -> bool:
        states = self.nodes()
        for node in (node for node, state in states.items() if state.startswith(("down", "drain")) and not self._gone(node)):
            with contextlib.suppress(AssertionError):  # the node is no longer down
                self.resume(node)
        return set(states.values()) == {"idle"}

    def until(self, job: str, *states: str, element: int | None = None, seconds: float = PATIENCE_S) -> None:
        """Wait until all array tasks of a job (or the given one) are in one of these states."""

        def reached() -> bool:
            one = None if element is None else f"{job}_{element}"
            said = [state for name, state in self.states(job).items() if one in (None, name)]
            return bool(said) and set(said) <= set(states)

        until(reached, f"job {job} is {' or '.join(states)}", seconds)

    # processes

    def _spawn(self, name: str, *argv: str) -> None:
        with (self.root / "log" / f"{name}.out").open("ab") as log:
            self._processes[name] = subprocess.Popen(
                ("setpriv", "--pdeathsig", "KILL", *argv),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                cwd=self.root,  # for core dumps
                env=self._environment(),
                start_new_session=True,
            )

    def _start(self, name: str, *argv: str) -> None:
        """Start a daemon; wait until the controller listens, because its clients retry for seconds otherwise."""
        self._spawn(name, *argv)
        until(lambda: listens(self._ports[0]) or self._gone(name), f"{name} listens")
        assert not self._gone(name), f"{name} has ended; see {self.root}/log"

    def _kill(self, name: str, number: signal.Signals = signal.SIGKILL) -> None:
        process = self._processes.pop(name)
        process.send_signal(number)
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    def _gone(self, name: str) -> bool:
        return name not in self._processes or self._processes[name].poll() is not None

    def _slurmd(self, node: str) -> list[int]:
        """Return the processes of a node's daemon, without those of its jobs."""
        found = []
        for process in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                words = (process / "cmdline").read_bytes().split(b"\0")
                if words[0] == b"slurmd" and node.encode() in words and self._is_ours(process):
                    found.append(int(process.name))
        return found

    def _is_ours(self, process: Path) -> bool:
        return f"SLURM_CONF={self.root}/".encode() in (process / "environ").read_bytes()

    def _environment(self) -> dict[str, str]:
        kept = {name: value for name, value in os.environ.items() if not name.startswith(("SLURM_", "SBATCH_", "SQUEUE_"))}
        return {**kept, **self.environment, "PATH": os.environ["PATH"] + SBIN, "LC_ALL": "C"}


@contextlib.contextmanager
def folder() -> Iterator[Path]:
    """Yield a folder with a short path for a cluster; remove it afterwards."""
    path = Path(tempfile.mkdtemp(prefix="sierra-", dir="/tmp"))
    path.chmod(0o755)  # munged requires a folder that everybody can access
    try:
        yield path / "c"
    finally:
        shutil.rmtree(path, ignore_errors=True)


def needed(require: Callable[..., str]) -> None:
    """Skip the test, or fail, if a cluster can't be started."""
    require("root, to start a cluster", there=os.geteuid() == 0)
    programs(require, PROGRAMS)


def programs(require: Callable[..., str], names: Iterable[str]) -> None:
    """Skip the test, or fail, if a program is missing; also find programs that only root has on the PATH."""
    for program in names:
        require(program, there=shutil.which(program, path=os.environ["PATH"] + SBIN) is not None)


_taken: list[socket.socket] = []


def free_ports(count: int) -> list[int]:
    """Return unused ports, below those that Linux gives to outgoing connections, which could take an unbound port.

    Another process of tests does not get them while this one lives: each port has an abstract socket that only one can bind.
    """
    ports: list[int] = []
    with contextlib.ExitStack() as stack:
        while len(ports) < count:
            port = 10_000 + secrets.randbelow(20_000)
            with contextlib.suppress(OSError):
                stack.enter_context(socket.create_server(("", port)))
                mark = socket.socket(socket.AF_UNIX)
                mark.bind(f"\0sierra-tests-port-{port}")
                _taken.append(mark)
                ports.append(port)
    return ports


def listens(port: int) -> bool:
    with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1):
        return True
    return False


def _children(pid: int) -> list[int]:
    return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]

"""Robots for tests: network namespaces of this machine with a real sshd each, and faults to inject. For root on Linux.

A robot has its own network, host name, processes, /etc, /run and /tmp, and a disk in memory as /home, which outlives a power
cut. Lines written to MOTOR set the speed of its motor (`tests.support.motor`), which no power cut stops. It sees the programs
of this machine (/usr), and neither its /root nor the folder of SIERRA. Its user is `robot`.
The names of everything that is made carry the id of this process, so that test processes do not disturb each other; what a
killed process left is removed by the next one. Debian: see `make system`.

    def test_something(fleet: Fleet) -> None:
        robot = fleet.names[0]
        link = Fabric(robot, FabricOptions(ssh_config=str(fleet.ssh_config)))
        fleet.radio(robot, up=False)
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import os
import shutil
import signal
import socket
import subprocess
import tempfile
import threading
import uuid
from collections.abc import Callable, Coroutine
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self, TypeVar

from tests.support.motor import Motor
from tests.waiting import until

SBIN = ":/usr/sbin:/sbin"
PROGRAMS = ("sshd", "ssh-keygen", "ssh", "ip", "unshare", "nsenter", "tc")
OTHER_CLOCK = {
    "LD_PRELOAD": "/usr/$LIB/faketime/libfaketimeMT.so.1",
    "FAKETIME_TIMESTAMP_FILE": "/run/robot/clock",
    "FAKETIME_NO_CACHE": "1",
    "FAKETIME_DONT_FAKE_MONOTONIC": "1",
}
"""The variables of a program whose wall clock is that of `Fleet.set_clock`. `select` waits there; `time.sleep` may fail."""
MOTOR = "/run/robot/motor"
LENT = "/run/lent"
USER, UID = "robot", 5002
GUEST, GUEST_UID = "guest", 5003
"""Another user, whose login `AllowUsers` must permit: see `Fleet.configure`."""
USERS = {USER: UID, GUEST: GUEST_UID}
SUB_IDS, SUB_UID = ("subuid", "subgid"), 500_000
"""The files with the ranges of ids of users, which images with files of several users need, and the first id of the range."""
REPOSITORY = Path(__file__).parents[2]
MARK = "sierra-fleet"

SSHD = """
Port 22
ListenAddress 0.0.0.0
HostKey /run/robot/hostkey
PidFile none
AuthorizedKeysFile /run/robot/authorized_keys
StrictModes no
UsePAM no
PasswordAuthentication no
KbdInteractiveAuthentication no
PermitRootLogin no
AllowUsers robot
Subsystem sftp internal-sftp
UseDNS no
PrintMotd no
MaxStartups 100
MaxSessions 10
LogLevel VERBOSE
"""
INIT = """
set -e
hostname {name}
mount -t tmpfs -o mode=755 tmpfs /run
mkdir /run/sshd /run/robot
mount --bind {folder}/own /run/robot
mount --bind {etc} /etc
mount --bind {folder}/home /home
{lent}
for hidden in {hidden}; do mount -t tmpfs -o mode=755 tmpfs "$hidden"; done
{engines}
mount -t tmpfs -o mode=1777 tmpfs /tmp
cd /
{machine} /usr/sbin/sshd -D -e -f /run/robot/sshd_config &
wait
"""
CLIENT = """Host {name}
  HostName {address}
  User robot
  IdentityFile {key}
  IdentitiesOnly yes
  UserKnownHostsFile {known_hosts}
  GlobalKnownHostsFile /dev/null
  StrictHostKeyChecking yes
{more}
"""
FOR_ENGINES = "\n".join(
    (
        "if [ -e /dev/fuse ]; then mknod -m 666 /run/fuse c 10 229; mount --bind /run/fuse /dev/fuse; fi",
        *(
            f"mkdir -p {target}; mount -t {kind} -o {options.split(',', 2)[-1]} {kind} {target} || true"
            for _, target, kind, options, *_ in map(str.split, Path("/proc/mounts").read_text().splitlines())
            if target.startswith("/sys/fs/cgroup") and not options.endswith("name=systemd")
        ),
    )
)
"""The needs of container engines that `ip netns` hides: a FUSE device for all users, and control groups."""
Result = TypeVar("Result")
_count = itertools.count()


def needed(require: Callable[..., str]) -> None:
    """Skip the test if this machine cannot have a fleet."""
    require("root, for a fleet of robots", there=os.geteuid() == 0)
    for program in PROGRAMS:
        require(program, there=_which(program) is not None)


@dataclass
class Robot:
    """One robot: its folder on this machine, its address, and its processes if it is switched on."""

    name: str
    folder: Path
    address: str
    namespace: str
    card: str
    motor: Motor = field(init=False)
    process: subprocess.Popen[bytes] | None = None
    machine: str = ""
    changed: bool = False
    """Whether it must start again to be as at first."""

    @property
    def own(self) -> Path:
        """The folder that is /run/robot on the robot."""
        return self.folder / "own"

    @property
    def home(self) -> Path:
        """The home folder of the user, as seen from here."""
        return self.folder / "home" / USER

    @property
    def log(self) -> str:
        return (self.folder / "log").read_text(errors="replace")


class Fleet:
    """Robots on one bridge. `names` are names in `ssh_config`, whose `known_hosts` has the robots' keys."""

    def __init__(self, count: int = 3, disk: str = "64m", lent: Path | None = None) -> None:
        """`lent` is a folder that all robots have as LENT."""
        self.lent = f"mkdir {LENT} && mount --bind {lent} {LENT}" if lent is not None else ""
        self.names = tuple(f"rb{number}" for number in range(1, count + 1))
        self.disk = disk
        self.folder = Path(tempfile.mkdtemp(prefix=f"{MARK}-{os.getpid()}-"))
        self.key, self.known_hosts = self.folder / "id", self.folder / "known_hosts"
        self.ssh_config = self.folder / "ssh_config"
        self._tag = f"{os.getpid():x}{next(_count):x}"
        self._net = _free_network()
        self._bridge = f"sf{self._tag}"
        self.robots = {
            name: Robot(
                name,
                self.folder / name,
                f"{self._net}.{number + 2}",
                f"{MARK}-{os.getpid()}-{self._tag}-{name}",
                f"v{self._tag}.{number}",
            )
            for number, name in enumerate(self.names)
        }

    def __enter__(self) -> Self:
        sweep()
        try:
            self._prepare()
            for name in self.names:
                self.boot(name, wait=False)
            self._wait_for_all()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        for robot in self.robots.values():
            self.power_cut(robot.name)
            subprocess.run(["umount", "--lazy", robot.folder / "home"], capture_output=True, check=False)
        _ip("link", "del", self._bridge, check=False)
        shutil.rmtree(self.folder, ignore_errors=True)

    def heal(self) -> None:
        """Make all robots and the client's files as they were at first, with empty homes."""
        self._write_client_files()
        for robot in self.robots.values():
            robot.machine = ""
            if robot.changed or robot.process is None:
                self.power_cut(robot.name)
                self._configure(robot)
                self._mount(robot, "remount,rw,")
                self.boot(robot.name, wait=False)
                robot.changed = False
            else:
                self.enter(robot.name, "sh", "-c", f"pkill -KILL -u {UID},{GUEST_UID}; rm -rf /tmp/* /tmp/.[!.]*; true")
            self._empty(robot)
            robot.motor.forget()
        self._wait_for_all()

    # Power, radio, link

    def power_cut(self, name: str) -> None:
        """Take a robot's power: all its processes are gone, and no packet tells anyone. Its disk stays."""
        robot = self.robots[name]
        _ip("link", "set", robot.card, "down", check=False)
        if robot.process:
            robot.process.kill()
            robot.process.wait()
            robot.process = None
        _ip("netns", "del", robot.namespace, check=False)
        _ip("link", "del", robot.card, check=False)

    def boot(self, name: str, *, wait: bool = True) -> None:
        """Start a robot."""
        robot = self.robots[name]
        _ip("netns", "add", robot.namespace)
        # a card with another address would not be found until the others forget the old one
        card = "02:" + ":".join(f"{int(part):02x}" for part in f"0.{robot.address}".split("."))
        peer = ["peer", "name", "eth0", "address", card, "netns", robot.namespace]
        _ip("link", "add", robot.card, "type", "veth", *peer)
        _ip("link", "set", robot.card, "master", self._bridge, "up")
        _ip("-n", robot.namespace, "addr", "add", f"{robot.address}/24", "dev", "eth0")
        for card in ("eth0", "lo"):
            _ip("-n", robot.namespace, "link", "set", card, "up")
        hidden = " ".join(f"'{one}'" for one in (REPOSITORY, Path("/root")) if not one.is_relative_to("/tmp"))
        machine = f"setarch {robot.machine}" if robot.machine else ""
        script = INIT.format(
            name=name,
            folder=robot.folder,
            etc=self.folder / "etc",
            hidden=hidden,
            machine=machine,
            engines=FOR_ENGINES,
            lent=self.lent,
        )
        (robot.folder / "init.sh").write_text(script)
        own = ["--mount", "--uts", "--ipc", "--pid", "--fork", "--kill-child", "--mount-proc", "--propagation", "private"]
        with (robot.folder / "log").open("ab") as log:
            robot.process = subprocess.Popen(
                ["ip", "netns", "exec", robot.namespace, "unshare", *own, "sh", str(robot.folder / "init.sh")],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
                env={"PATH": os.environ["PATH"] + SBIN},
            )
        if wait:
            self.wait_for(name)

    @property
    def motors(self) -> dict[str, Motor]:
        return {name: robot.motor for name, robot in self.robots.items()}

    def reboot(self, name: str) -> None:
        """Take a robot's power and start it again, with a new id of the boot, which namespaces alone do not have."""
        self.power_cut(name)
        self.boot(name)
        self.robots[name].changed = True
        (self.robots[name].own / "boot_id").write_text(f"{uuid.uuid4()}\n")
        self.enter(name, "mount", "--bind", "/run/robot/boot_id", "/proc/sys/kernel/random/boot_id")

    def wait_for(self, name: str) -> None:
        """Wait until a robot's sshd answers."""
        robot = self.robots[name]
        until(lambda: _answers(robot.address), f"{name} answers: {robot.log[-500:]}")

    def radio(self, name: str, *, up: bool) -> None:
        """Switch a robot's network off or on. It notices nothing."""
        self.robots[name].changed = True
        _ip("link", "set", self.robots[name].card, "up" if up else "down")

    def slow(self, name: str, rate: str = "1mbit") -> None:
        """Limit the rate of a robot's network in both directions."""
        robot = self.robots[name]
        robot.changed = True
        shape = ["root", "tbf", "rate", rate, "burst", "32kbit", "latency", "400ms"]
        _run("tc", "qdisc", "replace", "dev", robot.card, *shape)
        _ip("netns", "exec", robot.namespace, "tc", "qdisc", "replace", "dev", "eth0", *shape)

    # Disk, clock, processor

    def fill_disk(self, name: str, free: int = 0) -> None:
        """Fill a robot's disk but for `free` bytes, to whole pages."""
        robot = self.robots[name]
        robot.changed = True
        space = shutil.disk_usage(robot.folder / "home").free - free
        with (robot.folder / "home" / "full").open("wb") as file:
            os.posix_fallocate(file.fileno(), 0, max(1, space))

    def read_only(self, name: str) -> None:
        """Make a robot's disk read-only."""
        self.robots[name].changed = True
        self._mount(self.robots[name], "remount,ro,")
        self.enter(name, "mount", "-o", "remount,bind,ro", "/home")

    def set_clock(self, name: str, offset: float) -> None:
        """Change the wall clock of a robot's programs, for new and for running ones. `offset` is in seconds.

        Only programs that have OTHER_CLOCK follow: agents that were started after the first change, but not the runs' programs.
        """
        robot = self.robots[name]
        part = robot.own / "clock.part"
        part.write_text(f"{offset:+f}\n")
        part.chmod(0o644)
        part.replace(robot.own / "clock")  # a program may read it at any time
        if "SetEnv" not in (robot.own / "sshd_config").read_text():
            self.configure(name, "SetEnv " + " ".join(f"{key}={value}" for key, value in OTHER_CLOCK.items()))

    def set_machine(self, name: str, machine: str = "i686") -> None:
        """Start a robot again with another processor: `uname -m` says so, to Python as well."""
        self.power_cut(name)
        self.robots[name].machine = machine
        self.boot(name)
        self.robots[name].changed = True

    # Logins

    def configure(self, name: str, *lines: str) -> None:
        """Add lines to the configuration of a robot's sshd. Existing connections stay."""
        robot = self.robots[name]
        robot.changed = True
        self._configure(robot, *lines)
        (daemon,) = self.enter(name, "pgrep", "-o", "-x", "sshd").split()
        before = robot.log.count("listening on")
        self.enter(name, "kill", "-HUP", daemon)  # it answers until it restarts, and then not for a moment
        until(lambda: robot.log.count("listening on") > before and _answers(robot.address), f"sshd of {name} restarts")

    def refuse_logins(self, name: str) -> None:
        """Remove the user's key from a robot."""
        self.robots[name].changed = True
        (self.robots[name].own / "authorized_keys").write_text("")

    def new_host_key(self, name: str) -> None:
        """Start a robot again with another host key. `known_hosts` has the old one."""
        self.power_cut(name)
        make_key(self.robots[name].own / "hostkey")
        self.boot(name)
        self.robots[name].changed = True

    def forget_host_key(self, name: str) -> None:
        """Remove a robot's key from `known_hosts`."""
        lines = self.known_hosts.read_text().splitlines(keepends=True)
        self.known_hosts.write_text("".join(line for line in lines if not line.startswith(f"{name},")))

    def through(self, name: str, port: int | None = None, jump: str | None = None) -> str:
        """Add a name for a robot: at `port` of this machine (see `Proxy`), or through another robot. Return the new name."""
        robot = self.robots[name]
        alias = f"{name}-by-{jump or port}"
        address = robot.address if jump else "127.0.0.1"
        more = f"  ProxyJump {jump}" if jump else f"  Port {port}"
        key = " ".join((robot.own / "hostkey.pub").read_text().split()[:2])
        with self.ssh_config.open("a") as file:
            file.write(self._client(alias, address, more))
        if port:
            with self.known_hosts.open("a") as file:
                file.write(f"[127.0.0.1]:{port} {key}\n")
        return alias

    # Inside

    def enter(self, name: str, *argv: str) -> str:
        """Execute a command as root within a robot, without its sshd; return its output."""
        robot = self.robots[name]
        assert robot.process
        pid = robot.process.pid
        (child,) = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
        spaces = ["nsenter", "--target", child, "--mount", "--uts", "--ipc", "--pid", "--net"]
        done = subprocess.run([*spaces, *argv], capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{argv}: {done.stderr}"
        return done.stdout

    def commands(self, name: str) -> list[str]:
        """Return the command lines of the user's processes on a robot, without those of sshd."""
        listed = self.enter(name, "sh", "-c", f"ps -ww -u {UID} -o args= || true").splitlines()
        return [line for line in listed if not line.startswith("sshd:")]

    # Making

    def _prepare(self) -> None:
        self.folder.chmod(0o755)
        # all of /etc: a mount of single files is lost when this machine replaces a file
        copy_changing_folder(Path("/etc"), self.folder / "etc")
        for file, line in {
            "passwd": "\n".join(f"{user}:x:{uid}:{uid}::/home/{user}:/bin/bash" for user, uid in USERS.items()),
            "group": "\n".join(f"{user}:x:{uid}:" for user, uid in USERS.items()),
            **dict.fromkeys(SUB_IDS, f"{USER}:{SUB_UID}:65536"),
            "shadow": "\n".join(f"{user}:*:19000:0:99999:7:::" for user in USERS),  # sshd refuses accounts with `!`
            "hosts": "".join(f"{robot.address} {robot.name}\n" for robot in self.robots.values()),
        }.items():
            with (self.folder / "etc" / file).open("a") as opened:
                opened.write(f"{line}\n")
        (self.folder / "etc" / "nologin").unlink(missing_ok=True)
        make_key(self.key)
        _ip("link", "add", self._bridge, "type", "bridge")
        _ip("addr", "add", f"{self._net}.1/24", "dev", self._bridge)
        _ip("link", "set", self._bridge, "up")
        for robot in self.robots.values():
            robot.own.mkdir(parents=True)
            (robot.folder / "home").mkdir()
            self._mount(robot, "")
            self._empty(robot)
            make_key(robot.own / "hostkey")
            shutil.copytree(robot.own, robot.folder / "first")
            robot.motor = Motor(robot.own / Path(MOTOR).name)
            self._configure(robot)
        self._write_client_files()

    def _mount(self, robot: Robot, options: str) -> None:
        target = robot.folder / "home"
        _run("mount", "-t", "tmpfs", "-o", f"{options}size={self.disk},nr_inodes=100k,mode=755", "tmpfs", str(target))

    def _empty(self, robot: Robot) -> None:
        for path in (robot.folder / "home").iterdir():
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        for user, uid in USERS.items():
            robot.home.with_name(user).mkdir()
            os.chown(robot.home.with_name(user), uid, uid)

    def _configure(self, robot: Robot, *lines: str) -> None:
        """Write the configuration of a robot; without lines, the first one, with the first keys."""
        if not lines:
            shutil.copytree(robot.folder / "first", robot.own, dirs_exist_ok=True)
            shutil.copy(f"{self.key}.pub", robot.own / "authorized_keys")
        text = SSHD if not lines else (robot.own / "sshd_config").read_text()
        (robot.own / "sshd_config").write_text("".join(f"{line}\n" for line in lines) + text)  # the first value of a key counts

    def _write_client_files(self) -> None:
        keys = {robot.name: (robot.folder / "first" / "hostkey.pub").read_text().split()[:2] for robot in self.robots.values()}
        self.known_hosts.write_text(
            "".join(f"{robot.name},{robot.address} {' '.join(keys[robot.name])}\n" for robot in self.robots.values())
        )
        self.ssh_config.write_text("".join(self._client(robot.name, robot.address) for robot in self.robots.values()))

    def _client(self, name: str, address: str, more: str = "") -> str:
        return CLIENT.format(name=name, address=address, key=self.key, known_hosts=self.known_hosts, more=more)

    def _wait_for_all(self) -> None:
        for name in self.names:
            self.wait_for(name)


class Proxy:
    """A TCP proxy to a robot's sshd on a port of this machine, which delays, stalls and cuts connections."""

    def __init__(self, address: str, delay: float = 0.0) -> None:
        self.address, self.delay = address, delay
        self.passing = threading.Event()
        self.passing.set()
        self.passed = 0
        self._loop = asyncio.new_event_loop()
        self._writers: set[asyncio.StreamWriter] = set()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        self._server = self._call(asyncio.start_server(self._serve, "127.0.0.1", 0))
        self.port = self._server.sockets[0].getsockname()[1]
        return self

    def __exit__(self, *_: object) -> None:
        self._server.close()
        self.cut()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        for task in asyncio.all_tasks(self._loop):
            task.cancel()
            with contextlib.suppress(BaseException):
                self._loop.run_until_complete(task)
        self._loop.run_until_complete(self._loop.shutdown_asyncgens())
        self._loop.close()

    def stall(self, *, stalled: bool = True) -> None:
        """Pass nothing any more, in both directions, or go on."""
        self.passing.clear() if stalled else self.passing.set()

    def cut(self) -> None:
        """Reset all connections."""

        async def cut() -> None:
            for writer in self._writers:
                writer.transport.abort()

        self._call(cut())

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        there, back = await asyncio.open_connection(self.address, 22)
        self._writers |= {writer, back}
        with contextlib.suppress(asyncio.CancelledError):
            await asyncio.gather(self._pass(reader, back), self._pass(there, writer))

    async def _pass(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            while data := await reader.read(1 << 16):
                await asyncio.sleep(self.delay)
                while not self.passing.is_set():
                    await asyncio.sleep(0.02)
                self.passed += len(data)
                writer.write(data)
                await writer.drain()
        with contextlib.suppress(OSError):
            writer.close()
        self._writers.discard(writer)

    def _call(self, what: Coroutine[Any, Any, Result]) -> Result:
        return asyncio.run_coroutine_threadsafe(what, self._loop).result()


def copy_changing_folder(source: Path, target: Path) -> None:
    """Copy a folder in which other processes replace files, as `useradd` does in /etc; what is gone meanwhile is left out."""
    try:
        shutil.copytree(source, target, symlinks=True)
    except shutil.Error as error:
        if [path for path, *_ in error.args[0] if os.path.lexists(path)]:
            raise


def sweep() -> None:
    """Remove the fleets of processes that are gone."""
    for path in Path(tempfile.gettempdir()).glob(f"{MARK}-*-*"):
        if not _alive(path.name.split("-")[2]):
            for home in path.glob("*/home"):
                subprocess.run(["umount", "--lazy", home], capture_output=True, check=False)
            shutil.rmtree(path, ignore_errors=True)
    for namespace in [line.split()[0] for line in _ip("netns", "list").splitlines()]:
        if namespace.startswith(f"{MARK}-") and not _alive(namespace.split("-")[2]):
            for pid in _ip("netns", "pids", namespace, check=False).split():
                with contextlib.suppress(ProcessLookupError):
                    os.kill(int(pid), signal.SIGKILL)
            _ip("link", "del", f"sf{namespace.split('-')[3]}", check=False)
            _ip("netns", "del", namespace, check=False)


def _alive(pid: str) -> bool:
    return Path(f"/proc/{pid}").exists()


def _free_network() -> str:
    """Return the beginning of 256 addresses that no card of this machine has."""
    used = _ip("-o", "-4", "addr")
    numbers = ((os.getpid() * 7 + step * 257) % 8192 for step in itertools.count())
    return next(net for net in (f"10.{96 + one // 256}.{one % 256}" for one in numbers) if f" {net}." not in used)


def make_key(path: Path) -> Path:
    """Write a private key without a passphrase, and the public one beside it; return its path."""
    path.unlink(missing_ok=True)
    _run("ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(path))
    return path


def _answers(address: str) -> bool:
    try:
        with socket.create_connection((address, 22), 0.3) as connection:
            return connection.recv(4) == b"SSH-"
    except OSError:
        return False


def _ip(*words: str, check: bool = True) -> str:
    return _run("ip", *words, check=check)


def _run(*argv: str, check: bool = True) -> str:
    path = os.environ["PATH"] + SBIN
    done = subprocess.run(argv, capture_output=True, text=True, check=False, env={**os.environ, "PATH": path})
    if check and done.returncode:
        raise RuntimeError(f"{' '.join(argv)}: {done.stderr.strip()}")
    return done.stdout


def _which(program: str) -> str | None:
    return shutil.which(program, path=os.environ["PATH"] + SBIN)

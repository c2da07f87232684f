"""A run of Gazebo classic: `python gazebo_driver.py WORLD FOLDER --seed 1 --length 30 --interval 1`.

SIERRA lays this file and `gazebo_transport.py` beside the world of each run. They need Python 3.9 or newer. The driver starts
`gzserver` without a display, and writes `poses.csv` into the folder: the places of all models that can move, at the start and
after each interval.

The same seed gives the same poses, because the world is paused whenever something waits for wall-clock time:

- Gazebo inserts the models of a population while it runs. It is started paused, and steps when all models are there.
- Each interval is an exact number of steps. The world is paused again while its poses are read.
- Gazebo's own log of states is not used: another thread writes it, so that its lines differ between executions.

A run is complete if all steps were made, Gazebo reports no error, all poses are numbers, and what plug-ins wrote is complete.
The exit status of `gzserver` says little: it ends by itself only if it fails, and may abort although everything was simulated.
"""

from __future__ import annotations

import argparse
import csv
import math
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from xml.etree import ElementTree

sys.dont_write_bytecode = True  # the folder of a run has nothing but its files

from gazebo_transport import Fields, Gazebo, TransportError, message  # type: ignore[import-not-found]  # noqa: E402 beside this file

TABLE = "poses.csv"
COLUMNS = ("time", "model", "x", "y", "z", "roll", "pitch", "yaw")
PATIENCE_S = float(os.environ.get("GAZEBO_DRIVER_PATIENCE", "120"))
"""Time without any progress after which Gazebo is taken to hang; not the time that a run may take. Tests shorten it."""
SETTLE_S, GRACE_S = PATIENCE_S / 6, PATIENCE_S / 24
"""Time without a new model after which no more are expected; time that gzserver gets after a signal that asks it to end."""
DYING_S = 5.0
"""Time that gzserver gets to end after it has closed a connection; its exit status then says more."""
PORTS = 5
"""Ports that are tried: another program may take one between the choice and the start."""
VARIABLES = {"models": "GAZEBO_MODEL_PATH", "plugins": "GAZEBO_PLUGIN_PATH", "resources": "GAZEBO_RESOURCE_PATH"}
MODELS, LIGHTS = 8, 9
"""Fields of the message Scene."""
HARMLESS = ("[RenderEngine.cc:", "[OpenAL.cc:")
"""Sources of messages about a display or a sound device, which runs do not need; a camera without a display has another."""
SETUP = "/usr/share/gazebo/setup.sh"

Pose = tuple[float, ...]


class Fault(Exception):
    """The run has failed."""


class World:
    """The parts of a world file that the driver needs."""

    def __init__(self, path: Path) -> None:
        world = ElementTree.parse(path).find("world")  # noqa: S314 SIERRA has read and changed it safely
        if world is None:
            raise Fault("the file has no world")
        self.name = world.get("name", "default")
        self.step = float(world.findtext("physics/max_step_size") or 0.001)
        populations = [(one.find("model"), int(one.findtext("model_count") or 0)) for one in world.iterfind("population")]
        copies = [f"{model.get('name')}_clone_{n}" for model, count in populations if model is not None for n in range(count)]
        named = (*world.iterfind("model"), *world.iterfind("actor"), *world.iterfind("light"))
        self.names = {str(one.get("name")) for one in named}.union(copies)
        self.count = len(self.names) + len(world.findall("include"))


class Server:
    """The process of gzserver, and the port of its master."""

    def __init__(self, given: argparse.Namespace) -> None:
        self._given = given
        self.process: subprocess.Popen[bytes] | None = None
        self.port = 0

    def start(self) -> None:
        """Start gzserver, and wait until its master listens. Raises Fault if it ends, or takes too long."""
        for _ in range(PORTS):
            self.port = _free_port()
            self.process = self._process()
            limit = time.monotonic() + PATIENCE_S
            while self.process.poll() is None and time.monotonic() < limit:
                if self._listens():
                    return
                time.sleep(0.02)
            if self.process.poll() is None:
                raise Fault(f"gzserver has not opened its port after {PATIENCE_S:g} s")
            if not _listening(self.port):  # so that it did not end because another program has the port
                break
        self.check()

    def check(self, seconds: float = 0.0) -> None:
        """Raise Fault if gzserver has ended, or ends in the next seconds."""
        with suppress(subprocess.TimeoutExpired):
            status = self._started().wait(seconds)
            raise Fault(f"gzserver ended too early: {_status(status)}; see its messages above")

    def check_messages(self) -> None:
        """Raise Fault if Gazebo has reported an error, after which it simulates another world: a missing plug-in or mesh."""
        log = Path("~/.gazebo").expanduser() / f"server-{self.port}" / "default.log"
        try:
            lines = log.read_text(errors="replace").splitlines()
        except OSError as error:
            raise Fault(f"gzserver has written no messages into {log}: {error.strerror}") from error
        for line in lines:
            _, found, text = line.partition("[Err] ")
            if found and not any(part in text for part in (*HARMLESS, *self._given.ignore)):
                raise Fault(f"Gazebo reports an error: {text}")

    def kill(self) -> None:
        """End gzserver at once, if it was started."""
        if self.process is not None:
            self.process.kill()
            self.process.wait()

    def end(self) -> int:
        """End gzserver, whatever it does; return its exit status. It may ignore a signal."""
        process = self._started()
        for number in (signal.SIGINT, signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            process.send_signal(number)
            try:
                return process.wait(GRACE_S)
            except subprocess.TimeoutExpired:
                print(f"gazebo_driver: gzserver ignores {number.name} for {GRACE_S:g} s", file=sys.stderr)
        return process.wait()

    def _process(self) -> subprocess.Popen[bytes]:
        try:
            return subprocess.Popen(self._words(), env=self._variables())
        except FileNotFoundError:
            raise Fault(f"{self._given.server} is not installed, or not in PATH") from None

    def _started(self) -> subprocess.Popen[bytes]:
        if self.process is None:
            raise Fault("gzserver was not started")
        return self.process

    def _words(self) -> list[str]:
        return [
            self._given.server,
            "--verbose",
            "-u",
            "--seed",
            str(self._given.seed),
            "--minimal_comms",
            str(self._given.world),
        ]

    def _variables(self) -> dict[str, str]:
        """Return the environment of gzserver: it uses no network, no sound device, and no other Gazebo of this computer."""
        own = {
            "GAZEBO_MASTER_URI": f"http://127.0.0.1:{self.port}",
            "GAZEBO_IP": "127.0.0.1",
            "GAZEBO_MODEL_DATABASE_URI": "",
            "IGN_IP": "127.0.0.1",
            "IGN_PARTITION": f"sierra-{os.getpid()}-{self.port}",
            "ALSOFT_DRIVERS": "null",
        }
        for option, name in VARIABLES.items():
            if folders := getattr(self._given, option):
                own[name] = os.pathsep.join([*folders, *filter(None, [os.environ.get(name) or _installed(name)])])
        return {**os.environ, **own}

    def _listens(self) -> bool:
        """Return True if the port is one of this process, and not one that another program took first."""
        links = Path(f"/proc/{self._started().pid}/fd")
        try:
            sockets = {str(link.readlink()) for link in links.iterdir()}
        except OSError:  # it is about to end
            return False
        return any(f"socket:[{inode}]" in sockets for inode in _listening(self.port))


class Simulation:
    """A paused world in Gazebo, which advances by exact numbers of steps."""

    def __init__(self, server: Server, world: World) -> None:
        self._server, self._world = server, world
        self._gazebo = Gazebo(server.port, PATIENCE_S)
        print(self._gazebo.version, flush=True)
        self._requests = self._made = 0
        self._control, self._request = self._topic("world_control"), self._topic("request")
        self._stats, self._response = self._topic("world_stats"), self._topic("response")
        self._gazebo.advertise(self._control, "gazebo.msgs.WorldControl")
        self._gazebo.advertise(self._request, "gazebo.msgs.Request")
        self._gazebo.subscribe(self._response, "gazebo.msgs.Response")
        self._connect(3)

    def wait_for_models(self) -> None:
        """Wait until all models and lights of the world file are there. Raises Fault if some are missing, and no more come."""
        before: set[str] = set()
        limit = time.monotonic() + SETTLE_S
        while time.monotonic() < limit:
            found = self._scene_names()
            missing = self._world.names - found
            if not missing and len(found) >= self._world.count and found == before:
                return self._watch_steps()
            if found != before:
                before, limit = found, time.monotonic() + SETTLE_S
        names = ", ".join(sorted(missing)[:5]) or "some of those that are included; are they in a folder of `models`?"
        raise Fault(f"Gazebo has loaded {len(found)} of {self._world.count} models and lights; missing: {names}")

    def advance(self, steps: int) -> None:
        """Make some steps. Raises Fault if Gazebo makes others, or none for a long time."""
        self._made += steps
        self._gazebo.publish(self._control, message(multi_step_3=steps))
        for content in self._received(self._stats, f"step {self._made}"):
            made, is_paused = int(content.number(6)), bool(content.number(5))
            if made > self._made or not is_paused:
                raise Fault(f"Gazebo made step {made}, but should have stopped after step {self._made}; does a plug-in run it?")
            if made == self._made:
                return

    def poses(self) -> dict[str, Pose]:
        """Return the places of the models that can move."""
        models = [Fields(one) for one in self._scene().all(MODELS)]
        return {model.text(1): _pose(model.inner(4)) for model in models if not model.number(3)}

    def _scene_names(self) -> set[str]:
        scene = self._scene()
        return {Fields(one).text(1) for one in (*scene.all(MODELS), *scene.all(LIGHTS))}

    def _scene(self) -> Fields:
        """Return everything that is in the world now."""
        self._requests += 1
        self._gazebo.publish(self._request, message(id_1=self._requests, request_2="scene_info"))
        for content in self._received(self._response, "the places of models"):
            if content.number(1) == self._requests:
                break
        return content.inner(5)

    def _topic(self, name: str) -> str:
        return f"/gazebo/{self._world.name}/{name}"

    def _watch_steps(self) -> None:
        """Ask for the numbers of steps.

        From then on, Gazebo sends one every 0.2 s. It answers requests every 0.2 s, too, and has just done so. If each number
        comes a little earlier than the answers, reading the poses after some steps takes 0.2 s and not 0.4 s.
        """
        time.sleep(0.15)
        self._gazebo.subscribe(self._stats, "gazebo.msgs.WorldStatistics")
        self._connect(4)

    def _connect(self, topics: int) -> None:
        """Wait until some topics are connected, which happens when Gazebo has loaded the world."""
        limit = time.monotonic() + PATIENCE_S
        while len(self._gazebo.connected()) < topics:
            self._server.check()
            list(self._gazebo.receive(0.2))
            if time.monotonic() > limit:
                raise Fault(f"Gazebo has not loaded the world {self._world.name!r} after {PATIENCE_S:g} s")

    def _received(self, topic: str, what: str) -> Iterator[Fields]:
        """Yield the messages of a topic. Raises Fault if gzserver ends, or if nothing changes for a long time."""
        limit, last = time.monotonic() + PATIENCE_S, None
        while time.monotonic() < limit:
            self._server.check()
            for name, content in self._gazebo.receive(0.2):
                if name == self._stats and content.number(6) != last:
                    limit, last = time.monotonic() + PATIENCE_S, content.number(6)
                if name == topic:
                    yield content
        raise Fault(f"Gazebo does nothing: no answer for {PATIENCE_S:g} s, waiting for {what}")


def simulate(given: argparse.Namespace) -> None:
    """Simulate the whole length and write the table. Raises Fault."""
    world = World(given.world)
    steps, intervals = round(given.interval / world.step), round(given.length / given.interval)
    before = set(given.folder.iterdir())
    server = Server(given)
    try:
        server.start()
        simulation = Simulation(server, world)
        simulation.wait_for_models()
        server.check_messages()
        rows = list(_rows(simulation, steps, intervals, given.interval))
        server.check_messages()
    except BaseException as error:
        if isinstance(error, TransportError):
            server.check(DYING_S)
        server.kill()
        raise
    _check_end(server.end(), sorted(path.name for path in set(given.folder.iterdir()).difference(before)))
    _write(given.folder / TABLE, rows)


def _rows(simulation: Simulation, steps: int, intervals: int, interval: float) -> Iterator[tuple[object, ...]]:
    for number in range(intervals + 1):
        if number:
            simulation.advance(steps)
        now = round(number * interval, 9)
        for name, pose in sorted(simulation.poses().items()):
            if not all(map(math.isfinite, pose)):
                raise Fault(f"the physics became unstable: {name!r} is nowhere at {now:g} s; use a smaller step")
            yield (now, name, *pose)


def _check_end(status: int, written: list[str]) -> None:
    """Refuse files of plug-ins if gzserver did not end as it should: their last lines may be missing."""
    if status == 0:
        return
    if written:
        raise Fault(
            f"gzserver wrote {written[0]}, but did not end as it should ({_status(status)}): the file may be incomplete"
        )
    print(
        f"gazebo_driver: all steps were made; gzserver then ended with {_status(status)}, which changes nothing",
        file=sys.stderr,
    )


def _write(path: Path, rows: list[tuple[object, ...]]) -> None:
    """Write the table at once, so that it is never there in part."""
    unfinished = path.with_suffix(".unfinished")
    with unfinished.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([COLUMNS, *rows])
    unfinished.replace(path)


def _pose(pose: Fields) -> Pose:
    """Return x, y, z in metres, and roll, pitch, yaw in radians: turns around the fixed axes x, y, z, in this order."""
    place, turn = pose.inner(3), pose.inner(4)
    x, y, z, w = (float(turn.number(field)) for field in (2, 3, 4, 5))
    roll = math.atan2(2 * (w * x + y * z), w * w - x * x - y * y + z * z)
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - x * z))))
    yaw = math.atan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)
    return (*(float(place.number(field)) for field in (1, 2, 3)), roll, pitch, yaw)


def _free_port() -> int:
    with socket.socket() as tried:
        tried.bind(("127.0.0.1", 0))
        return int(tried.getsockname()[1])


def _listening(port: int) -> list[str]:
    """Return the inodes of the sockets of this computer that listen on a TCP port (see proc(5))."""
    lines = Path("/proc/net/tcp").read_text().splitlines()[1:]
    sockets = [line.split() for line in lines]
    return [one[9] for one in sockets if one[3] == "0A" and int(one[1].rpartition(":")[2], 16) == port]


def _installed(name: str) -> str:
    """Return the folders that Gazebo would search if the variable were not set."""
    if not Path(SETUP).exists():
        return ""
    script = f'unset {name}; . {SETUP}; printf %s "${name}"'
    return subprocess.run(["sh", "-c", script], check=True, capture_output=True, text=True).stdout


def _status(status: int) -> str:
    return f"signal {-status}" if status < 0 else f"exit status {status}"


@contextmanager
def _ended_by_signals() -> Iterator[None]:
    """Make SIGTERM an exception, so that gzserver is ended with the driver."""

    def stop(number: int, frame: object) -> None:
        raise Fault(f"the run was ended by {signal.Signals(number).name}")

    signal.signal(signal.SIGTERM, stop)
    signal.signal(signal.SIGINT, stop)
    yield


def main() -> None:
    """Simulate; print in one line why a run has failed."""
    parser = argparse.ArgumentParser()
    parser.add_argument("world", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, required=True)
    for name in ("length", "interval"):
        parser.add_argument(f"--{name}", type=float, required=True)
    parser.add_argument("--server", default="gzserver")
    for name in (*VARIABLES, "ignore"):
        parser.add_argument(f"--{name}", nargs="*", default=[])
    given = parser.parse_args()
    try:
        with _ended_by_signals():
            simulate(given)
    except (Fault, TransportError, OSError, ValueError, ElementTree.ParseError) as error:
        sys.exit(f"{given.world}: {' '.join(str(error).split())}")


if __name__ == "__main__":
    main()

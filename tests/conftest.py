"""Fixtures and helpers for all tests."""

from __future__ import annotations

import contextlib
import fcntl
import importlib
import json
import logging
import os
import shutil
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

from sierra.store.store import Store
from tests import clusters, projects, stores, tiers
from tests.properties import PHASES
from tests.support import robot_fleet
from tests.waiting import PATIENCE_S, until

# If a shell starts the tests in the background, they and their child processes ignore these signals.
signal.signal(signal.SIGINT, signal.default_int_handler)
for number in (signal.SIGQUIT, signal.SIGHUP, signal.SIGTERM):
    signal.signal(number, signal.SIG_DFL)

settings.register_profile("here", deadline=None, phases=PHASES)
settings.register_profile("ci", deadline=None, derandomize=True, print_blob=True, phases=PHASES)
settings.load_profile("ci" if os.environ.get("CI") else "here")


@pytest.hookimpl(tryfirst=True)  # before pytest selects by marks
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    tiers.add_marks(items)


@pytest.hookimpl(tryfirst=True)
def pytest_collection(session: pytest.Session) -> None:
    """Let each test process begin with other files: together they compile each new file once, not each process all of them."""
    worker = getattr(session.config, "workerinput", None)
    if worker is None:
        return
    number, count = int(worker["workerid"].removeprefix("gw")), int(worker["workercount"])
    for path in sorted((session.config.rootpath / "tests" / "unit").rglob("test_*.py"))[number::count]:
        with contextlib.suppress(Exception, pytest.skip.Exception):  # reported when the file is collected
            importlib.import_module(".".join(path.relative_to(session.config.rootpath).with_suffix("").parts))


@pytest.fixture(autouse=True, scope="session")
def no_progress() -> Iterator[None]:
    """Turn off progress messages of this process: standard error must not depend on durations."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sierra.cli.progress.FIRST_S", 1e9)
        patch.setattr("sierra.cli.progress.LAST_S", 1e9)
        yield


@pytest.fixture(autouse=True, scope="session")
def no_early_segments() -> Iterator[None]:
    """Make the number of segments that this process records independent of the duration of runs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sierra.ingest.recorder.SOON_S", 1e9)
        patch.setattr("sierra.ingest.recorder.LATE_S", 1e9)
        yield


@pytest.fixture(autouse=True, scope="session")
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Give the tests a new cache folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield


@pytest.fixture(autouse=True, scope="session")
def direct_python() -> Iterator[None]:
    """Make `python3` the interpreter itself: the script of a version manager takes longer than a simulator."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PATH", f"{Path(sys.base_prefix, 'bin')}{os.pathsep}{os.environ['PATH']}")
        yield


@pytest.fixture(autouse=True)
def no_listeners() -> Iterator[None]:
    """Check that no test leaves a listener to SIERRA's messages, because those change which messages a program receives."""
    yield
    logger = logging.getLogger("sierra")
    left, logger.handlers = logger.handlers, []
    assert left == []


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the project of `stores.make`, outside git, made once for all test processes; tests only read it."""
    base = tmp_path_factory.getbasetemp()
    root = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "recorded" / "project"
    root.parent.mkdir(exist_ok=True)
    with (root.parent / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (root.parent / "made").exists():
            stores.make(root)
            (root.parent / "made").touch()
    return root


@pytest.fixture
def require() -> Callable[..., str]:
    """Declare a requirement of a test: `require("podman")`, or `require("a slurm cluster", there=cluster.answers())`.

    Return the path of a program that is found by name. A missing requirement skips the test, or fails it if
    SIERRA_REQUIRE_ALL=1 is set (except for the requirements in SIERRA_REQUIRE_ALL_BUT).
    """

    def require(what: str, *, there: bool | None = None) -> str:
        program = shutil.which(what)
        if program is not None if there is None else there:
            return program or what
        if os.environ.get("SIERRA_REQUIRE_ALL") == "1" and what != os.environ.get("SIERRA_REQUIRE_ALL_BUT"):
            pytest.fail(f"needs {what}, and SIERRA_REQUIRE_ALL=1 forbids skipping", pytrace=False)
        pytest.skip(f"needs {what}")

    return require


@pytest.fixture
def disk(require: Callable[..., str]) -> Iterator[Callable[[Path, str], Path]]:
    """Yield a function that mounts an empty disk in memory of a size (`1m`) on a folder, or resizes this disk."""
    made: list[Path] = []

    def disk(folder: Path, size: str) -> Path:
        folder.mkdir(exist_ok=True)
        options = f"remount,size={size}" if folder in made else f"size={size}"
        mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", options, "none", folder], check=False, capture_output=True)
        require("the right to mount a disk", there=mounted.returncode == 0)
        made.append(folder)
        return folder

    yield disk
    for folder in set(made):
        subprocess.run(["umount", "--lazy", folder], check=True)


@pytest.fixture(scope="session")
def running_slurm() -> Iterator[clusters.Slurm]:
    """Yield a cluster that each test process starts once, on first use; tests use `slurm`."""
    with clusters.folder() as folder, clusters.Slurm(folder, pbs=True) as cluster:
        yield cluster


@pytest.fixture
def slurm(
    require: Callable[..., str], request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> Iterator[clusters.Slurm]:
    """Yield an idle real SLURM of three nodes, which the commands of SLURM (and its wrapper for PBS) use."""
    clusters.needed(require)
    cluster: clusters.Slurm = request.getfixturevalue("running_slurm")
    for name, value in cluster.environment.items():
        monkeypatch.setenv(name, value)
    cluster.heal()
    yield cluster
    cluster.heal()


@pytest.fixture(scope="session")
def running_fleet() -> Iterator[robot_fleet.Fleet]:
    """Yield three robots that each test process starts once, on first use; tests use `fleet`."""
    with robot_fleet.Fleet() as fleet:
        yield fleet


@pytest.fixture
def fleet(require: Callable[..., str], request: pytest.FixtureRequest) -> robot_fleet.Fleet:
    """Return three robots without faults, with empty homes, and with a real sshd each."""
    robot_fleet.needed(require)
    running: robot_fleet.Fleet = request.getfixturevalue("running_fleet")
    running.heal()
    return running


PRINTS = r"printf 't,v\n1,1\n2,4\n' > swarm.csv"
"""A shell command with which a simulator writes a result."""


def held(count: int, script: str = PRINTS) -> str:
    """Return a simulator of which about `count` runs end (up to the slots fewer); later runs wait for the gate."""
    begun, gate = (f'"${{0%/*}}/../{name}"' for name in ("executed", "gate"))
    size = count * 65  # the file is not read: runs that write and read one file would fail
    return f'[ "$(stat -c %s {begun})" -le {size} ] || until [ -e {gate} ]; do sleep 0.02; done\n{script}'


class Simulated:
    """A project whose simulator is a shell script that logs its run in a file outside the project."""

    def __init__(self, folder: Path, script: str) -> None:
        self.folder = folder
        self.folder.mkdir()
        self._executed = folder.with_name("executed")
        self._executed.touch()
        (self.folder / "sim.sh").write_text(f'echo "$SIERRA_RUN_ID" >> "{self._executed}"\n{script}\n')
        (self.folder / "in.xml").write_text('<swarm size="1" speed="1" seed="0"/>\n')
        (self.folder / "sierra.toml").write_text(
            'template = "in.xml"\n'
            'command = ["sh", "sim.sh", "{input}"]\n'
            'seed = "/swarm/@seed"\n'
            '[variables]\nsize = "/swarm/@size"\nspeed = "/swarm/@speed"\n'
            "[limits]\ngrace = 2\n"
        )

    def open(self) -> None:
        """Open the gate for all waiting runs: see `held`."""
        self.folder.with_name("gate").touch()

    def start(self, *words: str, **more: Any) -> subprocess.Popen[str]:
        """Start `sierra WORDS`."""
        return projects.start(self.folder, *words, **more)

    def ask(self, *words: str) -> subprocess.CompletedProcess[str]:
        """Run `sierra WORDS` to its end; check that its output has no traceback."""
        return self.end_of(self.start(*words))

    def quick(self, *words: str) -> subprocess.CompletedProcess[str]:
        """Run `sierra WORDS` within this process: see `projects.quick`."""
        done = projects.quick(self.folder, *words)
        assert "fault in SIERRA" not in done.stderr
        return done

    def end_of(self, process: subprocess.Popen[str], timeout: float = PATIENCE_S) -> subprocess.CompletedProcess[str]:
        out, err = process.communicate(timeout=timeout)
        assert "Traceback" not in err
        assert "fault in SIERRA" not in err
        return subprocess.CompletedProcess(process.args, process.returncode, out, err)

    def sql(self, text: str) -> list[dict[str, Any]]:
        rows: list[dict[str, Any]] = Store(self.folder / ".sierra").rows(text)
        return rows

    def executed(self) -> Counter[str]:
        """Return how often each run was begun."""
        return Counter(self._executed.read_text().split())

    def until_executed(self, count: int, process: subprocess.Popen[str] | None = None) -> None:
        """Wait until this number of runs was begun, or the process has ended."""
        begun = self.executed
        until(lambda: begun().total() >= count or (process and process.poll() is not None), f"{count} runs begin")

    def work(self) -> list[Path]:
        """Return the session folders that are left."""
        return sorted(path for path in self.folder.glob(".sierra/work/*") if path.name not in ("lock", "mark"))

    def journals(self) -> list[dict[str, Any]]:
        """Return the events in the journals of these sessions."""
        texts = []
        for path in self.folder.glob(".sierra/work/*/journal.jsonl"):
            with contextlib.suppress(FileNotFoundError):  # the session has been recorded meanwhile
                texts.append(path.read_text())
        return [json.loads(line) for text in texts for line in text.split("\n")[:-1]]

    def left_running(self) -> list[int]:
        """Return the processes of this project: workers and runs."""
        found = []
        for process in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                text = (process / "environ").read_bytes() + (process / "cmdline").read_bytes()
                if b"SIERRA_SESSION=" in text and os.fsencode(self.folder) in text:
                    found.append(int(process.name))
        return found

    def worker(self) -> int | None:
        """Return the process id of the worker; None without a worker."""
        for pid in self.left_running():
            with contextlib.suppress(OSError):
                if b"SIERRA_RUN_ID=" not in Path(f"/proc/{pid}/environ").read_bytes():
                    return pid
        return None

    def kill_all(self) -> None:
        for pid in self.left_running():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)


@pytest.fixture
def simulate(tmp_path: Path) -> Iterator[Callable[..., Simulated]]:
    """Yield a function that makes a project with a shell script as simulator; end its processes afterwards."""
    made: list[Simulated] = []

    def simulate(script: str = f"sleep 0.03; {PRINTS}", *, name: str = "a project's") -> Simulated:
        made.append(Simulated(tmp_path / name, script))
        return made[-1]

    yield simulate
    for one in made:
        one.kill_all()

"""Conformance suite for engines, as functions that a plug-in's author calls in tests.

    from sierra.testing import engines as conformance

    def test_it_is_an_engine(tmp_path):
        conformance.check(MyEngine(), image, project, tmp_path)

`image` is a pinned `sierra.containers.images.Image` of the project at `project` (a path). It needs `sh`, `cat` and `sleep`, as
in every busybox. None means no image, for an engine that contains nothing. The suite tests the real program: it starts
containers, asks them to end, and kills them. Each claim is one function of a `Trial`, and can be called alone. A broken claim
raises AssertionError with one line, even if Python runs with `-O`.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import signal
import subprocess
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

from sierra.containers.engines.base import HOSTNAME, INSIDE, WRITABLE, Capabilities, ContainerSpec, Engine, Mount, Process
from sierra.containers.images.image import Image, Kind
from sierra.model import Client, Result
from sierra.store.layout import RUN_HOME, RUN_OUTPUT, RUN_TMP, StorePaths
from sierra.testing.assertions import holds, is_one_line, says_what_its_options_are, variable, wait
from sierra.worker.processes import marked

PATIENCE_S = 30.0
SOON_S = 15.0
"""Seconds to wait for something that comes at once, if it comes at all. Both limits are shorter than the programs of these
claims would last."""
GRACE_S = 0.3
WORDS = ("", "a b", " c ", "d\ne", "'f'", '"g"', "$HOME", "`h`", "i\\j", "*", "-k", "ü", "--", "a=b,c=d")
VALUES = {
    "PLAIN": "1",
    "EMPTY": "",
    "COMMAS": "a,b=c,d",
    "QUOTES": 'it\'s "so"',
    "LINES": "one\ntwo\n",
    "DOLLAR": "$HOME `id` \\n \\u000A $",
    "BLANKS": "  two  blanks  ",
    "LD_LIBRARY_PATH": "/nowhere",
}
CANARY = "SIERRA_NOBODY_GIVES_THIS_TO_A_CONTAINER"
ODD = ("a b", "c,d", "e:f", "it's", "g$h", "i\\j", "k=l", "ü")
"""Names of folders in which a run may execute."""
ODDER = ('m"n', "o\np")
"""Names that an engine may refuse if it reports this."""
FILL = "sh -c 'x=0123456789abcdef; i=0; while test $i -lt 24; do x=$x$x; i=$((i + 1)); done'; echo all"
"""A script that has a part that needs 256 MiB. The script continues, whatever happens to that part."""
LOOK = """
echo "user $(cat /proc/self/uid_map)"
echo "host $(cat /proc/sys/kernel/hostname)"
while read -r name value; do echo "status $name $value"; done < /proc/self/status
while read -r name _; do case $name in *:*) echo "card $name" ;; esac; done < /proc/net/dev
for process in /proc/[0-9]*; do echo "process $process"; done
for file in /x /bin/x /etc/x "$SIERRA_RUN_DIR/x" "$SIERRA_RUN_DIR/input"; do
    (: >> "$file") 2>/dev/null && echo "wrote $file"
done
for file in "$HOME/x" "$TMPDIR/x" ./x; do (: >> "$file") 2>/dev/null || echo "refused $file"; done
echo "input $(cat "$SIERRA_RUN_DIR/input")"
echo "folder $(pwd)"
"""


@dataclass(frozen=True, slots=True)
class Started:
    """A container that was started, and the files of its run."""

    client: Client
    process: subprocess.Popen[bytes]
    folder: Path
    execution: str

    def left(self) -> list[int]:
        """Return the processes of the run that are still alive."""
        return sorted(marked({f"SIERRA_EXECUTION={self.execution}".encode()}))

    def said(self) -> str:
        return (self.folder / "stdout").read_text(errors="replace")

    def until_it_says(self, word: str) -> None:
        _wait(lambda: word in self.said() or self.process.poll() is not None, f"the program never printed {word!r}")
        time.sleep(GRACE_S)  # a client such as podman's passes signals on only a moment after its container has begun
        holds(
            word in self.said(),
            f"the program ended before it printed {word!r}: {(self.folder / 'stderr').read_text(errors='replace')}",
        )

    def signal(self, number: int) -> None:
        """Send a signal to the client's process group, as a worker does."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, number)

    def stop(self) -> None:
        """Clean up after a client that is gone, as a worker does."""
        if self.client.stop:
            subprocess.run(self.client.stop, env=self.client.environment, capture_output=True, timeout=PATIENCE_S, check=False)


@dataclass(frozen=True, slots=True)
class Ended:
    """A container that has ended."""

    result: Result
    out: bytes
    err: bytes
    folder: Path


@dataclass
class Trial:
    """An engine and an image to test."""

    engine: Engine
    image: Image | None
    root: Path
    folder: Path
    session: str = field(default_factory=lambda: f"trial-{secrets.token_hex(8)}")

    @cached_property
    def able(self) -> Capabilities:
        return self.engine.probe()

    @cached_property
    def reference(self) -> str:
        return self.engine.prepare(self.image, self.root, StorePaths(self.folder / "store")) if self.image else ""

    @property
    def contains(self) -> bool:
        return self.image is not None

    def box(self) -> ContainerSpec:
        nothing = Image("none", "sha256:" + "0" * 64, Kind.OCI, "", (), {})
        return ContainerSpec(self.image or nothing, self.reference, self.session)

    def start(
        self,
        *argv: str,
        box: ContainerSpec | None = None,
        variables: Mapping[str, str] | None = None,
        name: str = "",
        said: str | None = None,
    ) -> Started:
        """Start a process in a container of its own, in a new folder. `said` is written to its standard input."""
        execution = secrets.token_hex(8)
        folder = self.folder / (name or execution)
        for sub in (RUN_OUTPUT, RUN_HOME, RUN_TMP):
            (folder / sub).mkdir(parents=True)
        (folder / "input").write_text("given")
        here = f"{INSIDE}/run" if self.contains else str(folder)
        mounts = [Mount("\0", here), *(Mount(f"\0/{sub}", f"{here}/{sub}", writable=True) for sub in (RUN_OUTPUT, RUN_HOME))]
        temporary = "/tmp" if self.contains else f"{folder}/{RUN_TMP}"  # noqa: S108 - the container's own
        mounts.append(Mount(f"\0/{RUN_TMP}", temporary, writable=True))
        given = variables or {}
        own = {"HOME": f"{here}/{RUN_HOME}", "TMPDIR": temporary, "SIERRA_RUN_DIR": here, "SIERRA_EXECUTION": execution}
        environment = {"PATH": os.defpath + ":/usr/sbin:/sbin", **own, "SIERRA_SESSION": self.session, **given}
        process = Process(argv, environment, tuple(mounts), f"{here}/{RUN_OUTPUT}", interactive=said is not None)
        client = _in(folder, self.engine.client(box or self.box(), process))
        with (folder / "stdout").open("wb") as out, (folder / "stderr").open("wb") as err:
            started = subprocess.Popen(
                client.argv,
                stdin=subprocess.DEVNULL if said is None else subprocess.PIPE,
                stdout=out,
                stderr=err,
                cwd=folder / RUN_OUTPUT,
                env=client.environment,
                start_new_session=True,
            )
        if said is not None and started.stdin:
            with started.stdin as pipe:
                pipe.write(said.encode())
        return Started(client, started, folder, execution)

    def end(self, started: Started, *, seconds: float = PATIENCE_S, stopped: str | None = None) -> Ended:
        """Wait for the end of a container, and return its result and output."""
        try:
            status = started.process.wait(seconds)
        except subprocess.TimeoutExpired:
            started.signal(signal.SIGKILL)
            started.process.wait()
            started.stop()
            raise AssertionError(f"{started.client.argv[-1]!r} did not end within {seconds:.0f} s") from None
        code, number = (status, None) if status >= 0 else (None, -status)
        result = Result("", "", "", 0.0, 0.0, code, number, stopped, None, None, None, "", 0, ())
        out, err = ((started.folder / name).read_bytes() for name in ("stdout", "stderr"))
        enforced = frozenset(self.box_of_limits().limits) & self.able.enforced
        return Ended(self.engine.classify(result, err.decode(errors="replace"), enforced), out, err, started.folder)

    def run(
        self, *argv: str, box: ContainerSpec | None = None, variables: Mapping[str, str] | None = None, name: str = ""
    ) -> Ended:
        return self.end(self.start(*argv, box=box, variables=variables, name=name))

    def script(self, text: str, *words: str, box: ContainerSpec | None = None) -> Ended:
        return self.run("sh", "-c", text, "sh", *words, box=box)

    def box_of_limits(self) -> ContainerSpec:
        """Return a specification with all limits. The memory limit is 32 MiB."""
        return replace(self.box(), memory=32 << 20, cpus=0.5, pids=50)

    @cached_property
    def look(self) -> list[tuple[str, str]]:
        """Pairs of a kind and a fact about the environment that a process sees."""
        ended = self.script(LOOK)
        holds(ended.result.exit_code == 0, f"the inspection of the container failed: {ended.result.error or ended.result}")
        return [line.partition(" ")[::2] for line in ended.out.decode().splitlines()]

    def saw(self, kind: str) -> list[str]:
        return [what for name, what in self.look if name == kind]


def check(engine: Engine, image: Image | None, project: Path, folder: Path) -> None:
    """Check all claims. `folder` is an empty folder for the runs."""
    trial = Trial(engine, image, project, folder)
    try:
        for claim in CLAIMS if image else APPLY_WITHOUT_AN_IMAGE:
            claim(trial)
    finally:
        engine.sweep([trial.session])


def says_what_it_can(trial: Trial) -> None:
    """Check that the engine works here, declares its options, reports its version in one line, and repeats itself at once."""
    able = trial.able
    says_what_its_options_are(trial.engine)
    holds(not able.trouble, able.trouble)
    is_one_line(able.version)
    took = []
    for _ in range(3):  # the answer may change in between, as other users' activity changes
        began = time.monotonic()
        holds(trial.engine.probe() == able, "the answer differs when it is requested again")
        took.append(time.monotonic() - began)
    holds(min(took) < 1, "the engine was probed again, although nothing has changed")
    holds(able.enforced <= {"memory", "cpus", "pids"}, f"unknown limits: {sorted(able.enforced)}")


def prepares_once(trial: Trial) -> None:
    """Check that a prepared image keeps its reference, and that preparing it again is quick."""
    if trial.image is None:
        return
    first, began = trial.reference, time.monotonic()
    again = trial.engine.prepare(trial.image, trial.root, StorePaths(trial.folder / "store"))
    holds(again == first, f"the image's reference is first {first!r}, then {again!r}")
    holds(time.monotonic() - began < SOON_S, "preparing an image that is ready took too long")


def ends_with_the_programs_status(trial: Trial) -> None:
    """Check that the program's exit status is kept, even if it is one that engines use themselves."""
    for status in (0, 3, 125, 126, 127, 255):
        result = trial.script(f"exit {status}").result
        holds((result.exit_code, result.error) == (status, None), f"status {status} became {result.exit_code}, {result.error}")


def tells_the_programs_signal(trial: Trial) -> None:
    """Check that a program that a signal ended has the signal and no status."""
    for number in (signal.SIGSEGV, signal.SIGTERM, signal.SIGABRT):
        result = trial.script(f"kill -{number.value} $$; sleep 9").result
        holds((result.exit_code, result.signal) == (None, number), f"{number.name} became {result}")
        holds(result.error is None, f"{number.name} became an error: {result.error}")


def passes_words_as_they_are(trial: Trial) -> None:
    """Check that no word of a command is evaluated, split or lost."""
    ended = trial.script('printf "<%s>" "$@"', *WORDS)
    wanted = "".join(f"<{word}>" for word in WORDS)
    holds(ended.out.decode() == wanted, f"{wanted!r} became {ended.out.decode(errors='replace')!r}")


def passes_the_environment_exactly(trial: Trial) -> None:
    """Check that each variable keeps its value, and that none of the caller's variables is passed on."""
    with variable(CANARY):
        ended = trial.run("cat", "/proc/self/environ", variables=VALUES)
    seen = dict(entry.split("=", 1) for entry in ended.out.decode().split("\0") if "=" in entry)
    for name, value in VALUES.items():
        holds(seen.get(name) == value, f"the variable {name} is {seen.get(name)!r}, not {value!r}")
    holds(seen.get("HOME", "").endswith(f"/{RUN_HOME}"), f"HOME is {seen.get('HOME')!r}, not the run's folder")
    given = {*VALUES, "PATH", "HOME", "TMPDIR", "SIERRA_RUN_DIR", "SIERRA_EXECUTION", "SIERRA_SESSION"}
    leaked = {name for name in seen.keys() - given if os.environ.get(name) == seen[name] or name == CANARY}
    holds(not leaked, f"the container sees variables of the caller: {sorted(leaked)}")


def keeps_output_apart(trial: Trial) -> None:
    """Check that standard output and error contain exactly the program's bytes."""
    ended = trial.script(r"printf 'out\000\377\n'; printf 'err' >&2")
    holds(ended.out == b"out\0\xff\n", f"standard output became {ended.out!r}")
    holds(ended.err == b"err", f"standard error became {ended.err!r}")


def passes_standard_input(trial: Trial) -> None:
    """Check that an interactive process reads what its client is given, and that any other process reads nothing."""
    if trial.contains:
        ended = trial.end(trial.start("cat", said="a\nb"))
        holds(ended.out == b"a\nb", f"its standard input became {ended.out!r}")
    holds(trial.run("cat").out == b"", "its standard input is not empty")


def begins_in_its_folder(trial: Trial) -> None:
    """Check that the working directory is the output folder, and that the caller owns the outputs."""
    ended = trial.script("pwd; echo done > file; mkdir folder")
    holds(ended.out.decode().strip().endswith(f"/{RUN_OUTPUT}"), f"the program begins in {ended.out.decode().strip()}")
    for name in ("file", "folder"):
        path = ended.folder / RUN_OUTPUT / name
        holds(path.exists(), f"the output {name} is missing")
        holds(path.stat().st_uid == os.geteuid(), f"the output {name} belongs to user {path.stat().st_uid}")


def leaves_nothing_on_the_host(trial: Trial) -> None:
    """Check that files written elsewhere stay in the container. If runs share a container, these files are removed."""
    if trial.contains:
        name = f"sierra-{secrets.token_hex(8)}"
        trial.script(f'for place in {" ".join(WRITABLE)}; do : > "$place/{name}"; done 2>/dev/null')
        left = [place for place in WRITABLE if Path(place, name).exists()]
        holds(not left, f"files that it wrote in {left} are on the host")


def has_no_network(trial: Trial) -> None:
    """Check that there is no network, unless it is requested or the engine reports that it cannot isolate it."""
    cards = [card for card in trial.saw("card") if card.partition(":")[0] != "lo"]
    holds(not cards or not trial.able.isolated, f"the container has network interfaces: {cards}")


def has_the_network_where_asked(trial: Trial) -> None:
    """Check that a run that requests the network has the host's namespace. Its interfaces may change at any time."""
    ended = trial.script("readlink /proc/self/ns/net", box=replace(trial.box(), network=True))
    seen, ours = ended.out.decode().strip(), str(Path("/proc/self/ns/net").readlink())
    holds(seen == ours, f"the network of the container is {seen or 'unknown'}, not {ours}")


def writes_where_it_may(trial: Trial) -> None:
    """Check that a run can write to its own home, temporary and output folders, and to nothing else."""
    holds(not trial.saw("wrote"), f"the program could write {trial.saw('wrote')}")
    holds(not trial.saw("refused"), f"the program could not write {trial.saw('refused')}")
    holds(trial.saw("input") == ["given"], f"the program's input is {trial.saw('input')}")
    ended = trial.script('echo 1 > "$HOME/h"; echo 2 > "$TMPDIR/t"; echo 3 > /tmp/u')
    for path in (f"{RUN_HOME}/h", f"{RUN_TMP}/t", f"{RUN_TMP}/u"):
        holds((ended.folder / path).is_file(), f"{path} is not in the run's folder")


def has_no_rights(trial: Trial) -> None:
    """Check that a run has no capabilities, and cannot get new ones."""
    said = dict(line.split(" ", 1) for line in trial.saw("status") if " " in line)
    for name in ("CapInh:", "CapPrm:", "CapEff:", "CapAmb:", "CapBnd:"):
        holds(int(said[name].strip(), 16) == 0, f"{name} is {said[name]}")
    holds(said["NoNewPrivs:"].strip() == "1", "the program can gain privileges (NoNewPrivs is 0)")


def has_no_name_of_the_hosts(trial: Trial) -> None:
    """Check that the host's name and processes are hidden."""
    holds(trial.saw("host") == [HOSTNAME], f"the container's host name is {trial.saw('host')}")
    holds(len(trial.saw("process")) < 10, f"the container sees {len(trial.saw('process'))} processes")


def ends_when_asked(trial: Trial) -> None:
    """Check that SIGTERM reaches the program, which may react to it, and that nothing is left then."""
    started = trial.start("sh", "-c", "trap 'echo got; exit 5' TERM; echo ready; while :; do sleep 0.1; done")
    started.until_it_says("ready")
    started.signal(signal.SIGTERM)
    trial.end(started, seconds=SOON_S, stopped="interrupted")
    _wait(lambda: "got" in started.said() or not started.left(), "SIGTERM did not reach the program")  # podman may end first
    started.stop()
    holds("got" in started.said(), "SIGTERM did not reach the program")
    _nothing_is_left(started)


def ends_a_program_that_does_not_care(trial: Trial) -> None:
    """Check that SIGTERM ends a program that does not handle it, even as the first process of a container."""
    started = trial.start("sh", "-c", "echo ready; exec sleep 60")
    started.until_it_says("ready")
    started.signal(signal.SIGTERM)
    result = trial.end(started, seconds=SOON_S, stopped="timeout").result
    holds(result.stopped == "timeout", f"a time limit became {result}")
    started.stop()
    _nothing_is_left(started)


def is_killed_after_its_grace(trial: Trial) -> None:
    """Check that SIGKILL and `stop` end a program that ignores SIGTERM and has children outside its process group."""
    started = trial.start("sh", "-c", "trap '' TERM; sleep 60 & (setsid sleep 60 &) ; echo ready; while :; do sleep 1; done")
    started.until_it_says("ready")
    started.signal(signal.SIGTERM)
    time.sleep(GRACE_S)
    holds(bool(started.left()), "the program ended, although it ignores SIGTERM")
    started.signal(signal.SIGKILL)
    started.process.wait(SOON_S)
    started.stop()
    _nothing_is_left(started)


def stops_what_lost_its_client(trial: Trial) -> None:
    """Check that `stop` ends everything after SIGKILL of the client alone."""
    started = trial.start("sh", "-c", "sleep 60 & echo ready; sleep 60")
    started.until_it_says("ready")
    started.process.kill()
    result = trial.end(started).result
    started.stop()
    _nothing_is_left(started)
    holds(result.exit_code is None, f"a killed client became {result}")


def sweeps_what_is_left_of_a_session(trial: Trial) -> None:
    """Check that a session's id suffices to end its containers, and that other sessions' containers are left alone."""
    other = Trial(trial.engine, trial.image, trial.root, trial.folder)
    kept = other.start("sh", "-c", "echo ready; sleep 60")
    started = trial.start("sh", "-c", "sleep 60 & echo ready; sleep 60")
    for container in (started, kept):
        container.until_it_says("ready")
    started.process.kill()
    started.process.wait()
    trial.engine.sweep([trial.session, "trial-that-never-was"])
    _nothing_is_left(started)
    holds(bool(kept.left()), "a container of another session was removed too")
    trial.engine.sweep([other.session])
    _wait(lambda: kept.process.poll() is not None, "the client of a removed container is still running")
    _nothing_is_left(kept)


def leaves_nothing_behind(trial: Trial) -> None:
    """Check that processes which a program has started end with it, even in a session of their own."""
    started = trial.start("sh", "-c", "(setsid sleep 60 >/dev/null 2>&1 &) ; exit 3")
    holds(trial.end(started, seconds=SOON_S).result.exit_code == 3, "the program's exit status was lost")
    _nothing_is_left(started)


def says_what_cannot_be_started(trial: Trial) -> None:
    """Check that a command that does not exist or is not a program is the engine's error, not the program's status."""
    for word in ("no-such-program", f"{INSIDE}/run/input", f"{INSIDE}/run/nothing", f"{INSIDE}/run"):
        result = trial.run(word).result
        if result.error is None:
            raise AssertionError(f"{word!r} cannot be executed, but became {result}")
        holds(result.exit_code is None, f"{word!r} cannot be executed, but has the exit status {result.exit_code}")
        is_one_line(result.error)


def says_that_an_image_is_missing(trial: Trial) -> None:
    """Check that a missing image is the engine's error."""
    result = trial.run("true", box=replace(trial.box(), reference=trial.reference[:-8] + "00000000")).result
    if result.error is None:
        raise AssertionError(f"a missing image became {result}")
    is_one_line(result.error)


def enforces_what_it_says(trial: Trial) -> None:
    """Check that the engine enforces the limits that it reports as enforced. Other limits are no reason to fail."""
    box, enforced = trial.box_of_limits(), trial.able.enforced
    ended = trial.script("exit 3", box=box)
    holds(ended.result.exit_code == 3, f"with limits, status 3 became {ended.result.error or ended.result}")
    if "memory" in enforced:
        _is_held_to_its_memory(trial, box)
    if "pids" in enforced:
        sixty = "for i in 0 1 2 3 4 5; do for j in 0 1 2 3 4 5 6 7 8 9; do sleep 2 & done; done; echo all"
        ended = trial.script(sixty, box=box)
        holds(b"all" not in ended.out or b"fork" in ended.err, "60 processes started, but only 50 are allowed")


def _is_held_to_its_memory(trial: Trial, box: ContainerSpec) -> None:
    """Check that a program over its memory limit is killed with all of its processes, or cannot go on.

    The result must not look like the program's own end.
    """
    started = trial.start("sh", "-c", FILL, box=box)
    try:
        status = started.process.wait(SOON_S)
    except subprocess.TimeoutExpired:
        started.signal(signal.SIGKILL)
        status = started.process.wait()
        started.stop()
    holds("all" not in started.said(), "a script continues although it exceeded its memory limit")
    if status in (-signal.SIGKILL, 128 + signal.SIGKILL):
        result = trial.end(started).result
        holds(result.stopped == "memory" or status < 0, f"a program that exceeded its memory limit became {result}")
    _nothing_is_left(started)


def runs_in_odd_folders(trial: Trial) -> None:
    """Check that blanks, commas, colons and quotes in a path work. A path that cannot be mounted is reported in one line."""
    for name in (*ODD, *ODDER):
        ended = trial.end(trial.start("sh", "-c", "cat ../input; echo done > file", name=f"runs {name}"))
        if ended.result.error and name in ODDER:
            is_one_line(ended.result.error)
            continue
        holds(ended.out == b"given", f"in a folder called {name!r}, its input is {ended.out!r}: {ended.result.error}")
        holds((ended.folder / RUN_OUTPUT / "file").is_file(), f"in a folder called {name!r}, its output was lost")


def starts_many_at_once(trial: Trial) -> None:
    """Check that containers stay separate when many threads start them."""
    with ThreadPoolExecutor(4) as pool:
        ended = list(pool.map(lambda number: trial.script(f"echo {number}; exit {number}"), range(8)))
    for number, one in enumerate(ended):
        is_own = (one.result.exit_code, one.out) == (number, f"{number}\n".encode())
        holds(is_own, f"one of many simultaneous containers became {one}")


CLAIMS: tuple[Callable[[Trial], None], ...] = (
    says_what_it_can,
    prepares_once,
    ends_with_the_programs_status,
    tells_the_programs_signal,
    passes_words_as_they_are,
    passes_the_environment_exactly,
    keeps_output_apart,
    passes_standard_input,
    begins_in_its_folder,
    has_no_network,
    has_the_network_where_asked,
    writes_where_it_may,
    leaves_nothing_on_the_host,
    has_no_rights,
    has_no_name_of_the_hosts,
    ends_when_asked,
    ends_a_program_that_does_not_care,
    is_killed_after_its_grace,
    stops_what_lost_its_client,
    sweeps_what_is_left_of_a_session,
    leaves_nothing_behind,
    says_what_cannot_be_started,
    says_that_an_image_is_missing,
    enforces_what_it_says,
    runs_in_odd_folders,
    starts_many_at_once,
)
APPLY_WITHOUT_AN_IMAGE = (
    says_what_it_can,
    ends_with_the_programs_status,
    tells_the_programs_signal,
    passes_words_as_they_are,
    passes_the_environment_exactly,
    keeps_output_apart,
    passes_standard_input,
    begins_in_its_folder,
    ends_when_asked,
    ends_a_program_that_does_not_care,
    starts_many_at_once,
)
"""Claims that hold without an image, where nothing is contained. A worker is responsible for the others then."""


def _in(folder: Path, client: Client) -> Client:
    """Return a client with the folder of its run filled in."""

    def filled(words: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(word.replace("\0", str(folder)) for word in words)

    variables = {name: value.replace("\0", str(folder)) for name, value in client.environment.items()}
    return Client(filled(client.argv), variables, filled(client.stop))


def _nothing_is_left(started: Started) -> None:
    _wait(lambda: not started.left(), "processes of the run are still running")


def _wait(condition: Callable[[], bool], otherwise: str) -> None:
    wait(condition, lambda: otherwise, PATIENCE_S)

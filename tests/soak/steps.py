"""Events that may happen to a store, one function each: it returns a description, and raises Differs after damage."""

from __future__ import annotations

import contextlib
import functools
import os
import re
import shutil
import signal
import string
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from random import Random
from typing import Any, get_args

import tests.soak.faults as faults
from sierra.store import index_files
from sierra.util import scratch
from tests import projects
from tests.soak.faults import Action, Ended, sierra
from tests.soak.project import NAMES, QUERY, RAW, Differs, Wanted, check, content, left_over, make, recorded
from tests.soak.properties import EXAMPLES, PROPERTIES

OTHER = ("run", "noise=0.5", "--no-figures")
THIRD = ("run", "noise=0.25", "--runs", "1", "--no-figures")
FOURTH = ("run", "noise=0.75", "--runs", "1", "--no-figures")
CODES = (0, 1, 2, 3, 130)


class Place:
    """A folder for one step, its random numbers, and the results of undisturbed runs."""

    def __init__(self, folder: Path, chance: Random, name: str = "") -> None:
        self.chance = chance
        self.folder = folder
        self.name = name or chance.choice(NAMES)

    def project(self) -> Path:
        """Make the project in a folder with an odd name."""
        return make(self.folder, self.name)

    def recorded(self) -> Path:
        """Make the project with two batches in its store, of which the first has enough segments to be merged."""
        root = self.project()
        expect(sierra(root, *QUERY), 0)
        expect(sierra(root, "replay", batch_of(root, QUERY), "--runs", "1"), 0)
        expect(sierra(root, *OTHER), 0)
        return root


@functools.cache
def undisturbed(folder: Path) -> dict[str, list[dict[str, Any]]]:
    """Return the store's content after only the query; computed once for each folder."""
    root = make(folder, "undisturbed")
    expect(sierra(root, *QUERY), 0)
    return content(root)


@functools.cache
def passed(folder: Path, *words: str) -> tuple[str, ...]:
    """Return the points that a command passes: the query in an empty store, other commands with two recorded batches."""
    root = make(folder, "points " + "-".join(re.sub(r"\W", "", word) for word in words))
    if words != QUERY:
        expect(sierra(root, *QUERY), 0)
        expect(sierra(root, *OTHER), 0)
    return tuple(faults.points(root, *(words if words[0] != "rm" else ("rm", batch_of(root, OTHER), *words[1:]))))


def expect(ended: Ended, *codes: int) -> Ended:
    """Check the end of a command: one of these exit statuses, and no internal error of SIERRA."""
    if ended.code not in codes:
        raise Differs(f"sierra {' '.join(ended.words)} ended with {ended.code}: {ended.out[-600:]}{ended.err[-600:]}")
    for sign in ("Traceback", "fault in SIERRA"):
        if sign in ended.err:
            raise Differs(f"sierra {' '.join(ended.words)}: {ended.err[-1500:]}")
    return ended


def batch_of(root: Path, words: Sequence[str]) -> str:
    """Return the id of the batch of a `sierra run` command."""
    from sierra.store.store import Store

    [row] = Store(root / ".sierra").rows("SELECT batch FROM batches WHERE starts_with(query, $q)", q=words[1])
    return str(row["batch"])


def fault_at_a_point(place: Place, wanted: Wanted, point: str = "", action: Action | None = None) -> str:
    """Execute the query with a fault at a point."""
    root = place.project()
    point = point or place.chance.choice(passed(place.folder.parent / "points", *QUERY))
    action = action or place.chance.choice(get_args(Action))
    ended = sierra(root, *QUERY, point=point, action=action)
    expect(ended, *((*CODES, -signal.SIGKILL) if action == "kill" and ended.struck else CODES))
    check(root, wanted, recorded(root))
    return f"{action} at {point!r}" + ("" if ended.struck else " (not reached)")


def kill_at_a_time(place: Place, wanted: Wanted) -> str:
    """Kill SIERRA, its worker, or all its processes at a random time."""
    root, victim, wait = place.project(), place.chance.choice(("driver", "worker", "all")), place.chance.uniform(0, 1.2)
    process = subprocess.Popen([projects.SIERRA, *QUERY], cwd=root, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    time.sleep(wait)
    for pid in [process.pid] * (victim != "worker") + _processes(root) * (victim != "driver"):
        _kill(pid)
    process.wait(faults.LONGEST_S)
    _until_gone(root)
    check(root, wanted, recorded(root))
    return f"killed {victim} after {wait:.3f} s"


def fault_in_maintenance(
    place: Place, wanted: Wanted, words: Sequence[str] = (), point: str = "", action: Action | None = None
) -> str:
    """Run a command that rewrites the store with a fault at a point; then run it again."""
    root = place.recorded()
    words = words or place.chance.choice((("gc", "--yes"), ("rm", "--yes")))
    point = point or place.chance.choice(passed(place.folder.parent / "points", *words) or ("",))
    action = action or place.chance.choice(get_args(Action))
    called = (*words[:1], batch_of(root, OTHER), *words[1:]) if words[0] == "rm" else tuple(words)
    ended = sierra(root, *called, point=point, action=action)
    expect(ended, *((*CODES, -signal.SIGKILL) if action == "kill" and ended.struck else CODES))
    expect(sierra(root, "fsck"), 0)
    expect(sierra(root, *called), *((0, 2, 3) if words[0] == "rm" else (0,)))
    if words[0] == "rm":
        check(root, wanted)
    else:
        expect(sierra(root, "rm", batch_of(root, OTHER), "--yes"), 0)
        check(root, wanted)
    return f"{action} at {point!r} of {' '.join(called)}" + ("" if ended.struck else " (not reached)")


def fault_while_indexing(place: Place, wanted: Wanted, point: str = "", action: Action | None = None) -> str:
    """Execute a query whose process builds an index, with a fault in doing so: it matters to nothing else."""
    root = place.recorded()
    expect(sierra(root, *THIRD, indexes=True), 0)
    point = point or place.chance.choice(indexing(place.folder.parent / "points"))
    action = action or place.chance.choice(get_args(Action))
    ended = sierra(root, *FOURTH, point=point, action=action, indexes=True)
    codes = {"kill": (0, -signal.SIGKILL), "interrupt": (0, 130)}
    expect(ended, *codes.get(action, (0,)))
    told = f"{action} at {point!r}" + ("" if ended.struck else " (not reached)")
    _compare_with_unindexed(root, told)
    expect(sierra(root, "fsck"), 0, 1)
    expect(sierra(root, "gc", "--yes", indexes=True), 0)
    _compare_with_unindexed(root, told)
    expect(sierra(root, "fsck"), 0)
    for query in (OTHER, THIRD, FOURTH):
        expect(sierra(root, "rm", batch_of(root, query), "--yes"), 0)
    built = Path(tempfile.gettempdir()).glob(f"{index_files.PREFIX}*/*")
    left = [*(root / ".sierra" / "index").iterdir(), *(path for path in built if path.name != scratch.UNMARKED)]
    if left:
        raise Differs(f"{told}: {left[0]} is left")
    check(root, wanted)
    return told


@functools.cache
def indexing(folder: Path) -> tuple[str, ...]:
    """Return the points that a command passes while it builds an index on top of another one."""
    root = make(folder, "points of indexes")
    expect(sierra(root, *QUERY, indexes=True), 0)
    return tuple(point for point in faults.points(root, *THIRD, indexes=True) if "index" in point)


def _compare_with_unindexed(root: Path, told: str) -> None:
    from sierra.store.store import Store

    found, wanted = content(root), content(root, Store(root / ".sierra").unindexed())
    for name, rows in wanted.items():
        if found[name] != rows:
            raise Differs(f"{told}: {name} with an index differ from those without it")


def flipped_bit(place: Place, wanted: Wanted) -> str:
    """Flip a bit of a recorded file: fsck must detect it, and repair the store so that the query can be completed."""
    root = place.recorded()
    file = place.chance.choice(_files_of_segments(root))
    bytes_ = bytearray(file.read_bytes())
    at = place.chance.randrange(len(bytes_))
    bytes_[at] ^= 1 << place.chance.randrange(8)
    file.write_bytes(bytes_)
    told = f"flipped a bit of byte {at} of {file.parent.name}/{file.name}"
    found = sierra(root, "fsck")
    expect(found, 1)
    if file.parent.name not in found.out + found.err:
        raise Differs(f"{told}: fsck does not report it: {found.out}")
    repaired = expect(sierra(root, "fsck", "--repair"), 0, 1)
    for query in (QUERY, OTHER):
        expect(sierra(root, *query), 0)
    expect(sierra(root, "rm", batch_of(root, OTHER), "--yes"), 0)
    check(root, wanted, but=RAW if "the bytes of files that became tables are lost" in repaired.out else "")
    return told


def fuzzed_calls(place: Place, wanted: Wanted) -> str:
    """Run commands with random arguments."""
    root = place.recorded()
    lines = []
    for _ in range(25):
        words = _nonsense(place.chance)
        done = projects.quick(root, *words)
        expect(Ended(tuple(words), done.returncode, done.stdout, done.stderr), *CODES)
        lines.append(" ".join(words))
    shutil.rmtree(root / "out", ignore_errors=True)
    expect(sierra(root, *OTHER), 0)
    expect(sierra(root, "rm", batch_of(root, OTHER), "--yes"), 0)
    projects.make(root, simulator=(root / "sim.py").read_text())
    check(root, wanted)
    return f"{len(lines)} fuzzed calls"


def fuzzed_settings(place: Place, wanted: Wanted) -> str:
    """Change some characters of sierra.toml or of the template."""
    root = place.recorded()
    for file in (root / "sierra.toml", root / "arena.xml"):
        text = file.read_text()
        for _ in range(6):
            file.write_bytes(_mutated(text, place.chance).encode("utf-8", "surrogateescape"))
            done = projects.quick(root, *QUERY, "-n")
            expect(Ended((*QUERY, "-n"), done.returncode, done.stdout, done.stderr), *CODES)
        file.write_text(text)
    expect(sierra(root, "rm", batch_of(root, OTHER), "--yes"), 0)
    check(root, wanted)
    return "12 mutated settings"


def full_disk(place: Place, wanted: Wanted) -> str:
    """Execute the query on a disk that becomes full."""
    disk = place.folder / "disk"
    disk.mkdir()
    size = place.chance.choice((300, 500, 800, 1200))
    if not _mount(disk, f"size={size}k"):
        return "no right to mount a disk: left out"
    try:
        root = make(disk, place.name)
        expect(sierra(root, *QUERY), 0, 1, 3)
        _mount(disk, "remount,size=64m")
        check(root, wanted, recorded(root))
    finally:
        subprocess.run(["umount", "--lazy", str(disk)], check=True)
    return f"a disk of {size} kB"


def jumping_clock(place: Place, wanted: Wanted, days: int = 0) -> str:
    """Execute the query with another Python and a wrong clock, then as usual: the last results are effective."""
    faketime = shutil.which("faketime")
    if faketime is None:
        return "needs faketime: left out"
    root, days = place.project(), days or place.chance.choice((-400, -2, 2, 400))
    other = place.folder / "bin" / "python3"
    other.parent.mkdir()
    other.write_text(f'#!/bin/sh\nOFFSET=1000 exec "{shutil.which("python3")}" "$@"\n')
    other.chmod(0o755)
    path = {"PATH": f"{other.parent}{os.pathsep}{os.environ['PATH']}"}
    expect(sierra(root, *QUERY, prefix=(faketime, "-f", f"{days:+d}d"), environment=path), 0)
    if content(root)["swarm"] == wanted["swarm"]:
        raise Differs("the other Python gave the same values")
    check(root, wanted, recorded(root))
    return f"a clock {days:+d} days off"


def many_at_once(place: Place, wanted: Wanted) -> str:
    """Run several commands concurrently on one store."""
    root = place.recorded()
    choices = (
        QUERY,
        OTHER,
        ("gc", "--yes"),
        ("fsck",),
        ("ls",),
        ("run", "population_size.Log8", "--runs", "4", "--no-figures"),
    )
    called = [place.chance.choice(choices) for _ in range(5)]
    begun = [
        subprocess.Popen([projects.SIERRA, *words], cwd=root, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        for words in called
    ]
    refused = []
    for words, process in zip(called, begun, strict=True):
        out, _ = process.communicate(timeout=faults.LONGEST_S)
        if process.returncode and "retry when" in out:  # a session that has not said what it executes is left in peace
            refused.append(words)
        else:
            expect(Ended(words, process.returncode, out, ""), 0)
    for words in refused:
        expect(sierra(root, *words), 0)
    from sierra.store.store import Store

    keep = {row["batch"] for row in wanted["batch_runs"]}
    for batch in {row["batch"] for row in Store(root / ".sierra").rows("SELECT batch FROM batches")} - keep:
        expect(sierra(root, "rm", batch, "--yes"), 0)
    check(root, wanted)
    return "at once: " + "; ".join(" ".join(words[:2]) for words in called)


def random_properties(place: Place, wanted: Wanted) -> str:
    """Check all properties with random examples; the store of the step is not used."""
    for one in PROPERTIES:
        try:
            one.check(place.chance.getrandbits(32), EXAMPLES)
        except Exception as error:
            raise Differs("\n    ".join([f"{one.name}: {error!r}", *getattr(error, "__notes__", [])])) from error
    return f"{len(PROPERTIES)} properties"


def _files_of_segments(root: Path) -> list[Path]:
    """List the files of all segments, in an order that does not depend on the segments' names."""
    folders = sorted((root / ".sierra" / "segments").iterdir(), key=lambda folder: folder.stat().st_mtime_ns)
    return [path for folder in folders for path in sorted(folder.iterdir())]


STEPS: tuple[Callable[[Place, Wanted], str], ...] = (
    fault_at_a_point,
    kill_at_a_time,
    fault_in_maintenance,
    fault_while_indexing,
    flipped_bit,
    fuzzed_calls,
    fuzzed_settings,
    full_disk,
    jumping_clock,
    many_at_once,
    random_properties,
)


def _processes(root: Path) -> list[int]:
    return [int(found.split()[1]) for found in left_over(root) if found.startswith("process ")]


def _kill(pid: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)


def _until_gone(root: Path) -> None:
    """Wait for the processes of a killed session: its worker and its runs end by themselves."""
    end = time.monotonic() + faults.LONGEST_S
    while _processes(root):
        if time.monotonic() > end:
            raise Differs(f"processes still run after a kill: {left_over(root)}")
        time.sleep(0.05)


def _mount(disk: Path, options: str) -> bool:
    done = subprocess.run(["mount", "-t", "tmpfs", "-o", options, "none", str(disk)], check=False, capture_output=True)
    return done.returncode == 0


WORDS = (
    *("run", "ls", "show", "sql", "stats", "figures", "fsck", "gc", "rm", "files", "diff", "why", "replay", "schema", "status"),
    *("--json", "-n", "--runs", "0", "-1", "1e9", "--set", "//noise=1", "//*[", "=", "-b", "--to", "out", "--yes", "--explain"),
    *(
        "population_size.Log8",
        "population_size=",
        "noise=0:1:3",
        "noise=nan",
        "montecarlo.C2",
        "scenario=x",
        "swarm",
        "coverage",
    ),
    *(
        "SELECT 1",
        "SELECT * FROM runs",
        "DROP TABLE runs",
        "",
        " ",
        "\x1b[31m",
        "é",
        "'",
        '"',
        "0" * 64,
        "abcd",
        "ffff",
        "\udcff",
    ),
)


def _nonsense(chance: Random) -> list[str]:
    words = [chance.choice(WORDS) for _ in range(chance.randint(1, 6))]
    if chance.random() < 0.2:
        words.append("".join(chance.choices(string.printable, k=chance.randint(1, 12))))
    return words if "-h" not in words else ["ls"]


def _mutated(text: str, chance: Random) -> str:
    """Return the text with one to three changes."""
    for _ in range(chance.randint(1, 3)):
        at = chance.randrange(len(text))
        end = min(len(text), at + chance.randint(0, 6))
        text = (
            text[:at] + "".join(chance.choices("\x00\t\n'\"[]{}<>=/\\&;é\udcff019.-#aZ", k=chance.randint(0, 3))) + text[end:]
        )
    return text

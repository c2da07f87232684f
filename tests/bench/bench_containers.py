"""Containers: the overhead of SIERRA over the bare engine, and the savings of a shared container.

    python tests/bench/bench_containers.py [runs]

The engine's loop is `xargs -P2` over the command with which SIERRA starts a run, in equal folders. The targets are
1.1 times that loop, and for 1,000 runs in shared containers 3 times the time without containers.
"""

from __future__ import annotations

import shlex
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from idle import project

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))
SIERRA = str(Path(sys.executable).with_name("sierra"))
TIMES = 3


def main() -> None:
    from tests import containers

    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    with tempfile.TemporaryDirectory(prefix="sierra-bench-") as made:
        folder = Path(made)
        archive = containers.busybox(folder)
        for engine in ("podman", "apptainer"):
            if shutil.which(engine):
                here = contained(folder / engine, f'[container]\nimage = "{archive}"\nengine = "{engine}"\n')
                ours = seconds_of(lambda here=here: ask(here, runs))  # type: ignore[misc]
                theirs = loop(here, engine, runs, folder / f"{engine}-loop")
                say(f"{runs} runs of true in {engine} / a loop of {engine}, both -j2", *in_turn(ours, theirs), "at most 1.1")
        if shutil.which("podman") and containers.PYTHON.exists():
            shared = contained(folder / "shared", f'[container]\nimage = "{containers.python(folder)}"\nisolation = "worker"\n')
            plain = project(folder / "plain", command="true {input}")
            both = in_turn(seconds_of(lambda: ask(shared, 10 * runs)), seconds_of(lambda: ask(plain, 10 * runs)))
            say(f"{10 * runs} runs of true, one container per slot / none", *both, "at most 3")


def contained(folder: Path, container: str) -> Path:
    project(folder, container, command="true {input}")
    subprocess.run([SIERRA, "image", "pin"], cwd=folder, check=True, stdout=subprocess.DEVNULL)
    return folder


def ask(here: Path, runs: int) -> None:
    """Execute a new batch; keep the cached information about the image."""
    for entry in (here / ".sierra").glob("*"):
        if entry.is_dir() and entry.name != "images":
            shutil.rmtree(entry)
        elif entry.is_file():
            entry.unlink()
    words = [SIERRA, "run", "population_size=1,2,3,4", "--runs", str(runs // 4), "-j2", "--no-figures"]
    subprocess.run(words, cwd=here, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def loop(here: Path, engine: str, runs: int, folder: Path) -> Callable[[], float]:
    """Return a function that executes the same runs without SIERRA, each in a folder with an input file."""
    import sierra
    from sierra.containers import container_setup
    from sierra.execution import commands

    plan = sierra.open(here).plan("population_size=1", runs=1, engine=engine)
    store = sierra.open(here).store
    contained = container_setup.contain(
        plan.engine, plan.image, plan.batch.spec, plan.project.config.container, plan.limits.of_containers,
        code=here, project=here, store=store.paths, session="bench",
    )  # fmt: skip
    maker = commands.CommandBuilder(
        plan.batch.spec, here, plan.engine, plan.limits, "bench", here, image=plan.image, box=contained.box
    )
    client = maker.job(plan.batch.runs[0], (("input.xml", b""),)).client
    assert client is not None
    words = " ".join(shlex.quote(word) for word in client.argv).replace("\0", "'\"$1\"'")
    variables = " ".join(f"{name}={shlex.quote(value)}" for name, value in client.environment.items())
    script = folder.with_suffix(".sh")
    made = 'mkdir "$1" "$1/output" "$1/home" "$1/tmp"\nprintf "<e/>" > "$1/input.xml"\n'
    script.write_text(f'set -e\n{made}exec env -i {variables} {words} > "$1/stdout"\n')

    def once() -> None:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        folders = "\n".join(str(folder / str(number)) for number in range(runs))
        subprocess.run(["xargs", "-P2", "-n1", "sh", script], input=folders, text=True, check=True)

    return seconds_of(once)


def seconds_of(what: Callable[[], None]) -> Callable[[], float]:
    def timed() -> float:
        began = time.perf_counter()
        what()
        return time.perf_counter() - began

    return timed


def in_turn(ours: Callable[[], float], theirs: Callable[[], float]) -> tuple[float, float]:
    """Return the medians of two measurements that alternate."""
    measured = [(ours(), theirs()) for _ in range(TIMES)]
    return statistics.median(one for one, _ in measured), statistics.median(other for _, other in measured)


def say(what: str, ours: float, theirs: float, promise: str) -> None:
    print(f"{what:58} {ours:8.2f} s  {theirs:8.2f} s  ratio {ours / theirs:5.2f}  ({promise})", flush=True)


if __name__ == "__main__":
    main()

"""`make soak`: random steps until the time is over. Each failed step is printed with the command that repeats it."""

from __future__ import annotations

import argparse
import itertools
import os
import secrets
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from random import Random

from sierra.errors import SierraError
from tests.soak.project import QUERY, Differs
from tests.soak.steps import STEPS, Place, passed, undisturbed


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.soak", description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0, help="duration in minutes")
    parser.add_argument("--seed", type=int, default=None, help="seed of the first step; each next step adds one")
    parser.add_argument("--steps", type=int, default=None, help="end after this number of steps")
    parser.add_argument("--only", choices=[step.__name__ for step in STEPS], help="execute only this kind of step")
    parser.add_argument(
        "--points", action="store_true", help="list the points at which a fault can be placed in a run, and end"
    )
    arguments = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="sierra-soak-"))
    os.environ.update(XDG_CACHE_HOME=str(folder / "cache"), XDG_STATE_HOME=str(folder / "state"))
    try:
        if arguments.points:
            print(*passed(folder, *QUERY), sep="\n")
            return 0
        return soak(folder, arguments)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def soak(folder: Path, arguments: argparse.Namespace) -> int:
    """Execute steps until the time is over; return the exit code."""
    first = secrets.randbelow(1_000_000) if arguments.seed is None else arguments.seed
    end = time.monotonic() + 60 * arguments.minutes
    wanted, failed, taken = undisturbed(folder), 0, 0
    for number in itertools.count() if arguments.steps is None else range(arguments.steps):
        if time.monotonic() > end:
            break
        seed = first + number
        chance = Random(seed)
        step = chance.choice(STEPS)
        if arguments.only:
            step = next(one for one in STEPS if one.__name__ == arguments.only)
        here = folder / str(seed)
        here.mkdir()
        place = Place(here, chance)
        taken += 1
        try:
            done = step(place, wanted)
        except (Differs, SierraError, subprocess.TimeoutExpired) as error:
            failed += 1
            only = f" ONLY={arguments.only}" if arguments.only else ""
            done = f"FAILED: {error}\n    again: make soak SEED={seed} STEPS=1{only}"
        print(f"seed {seed}: {step.__name__} in {place.name!r}: {done}", flush=True)
        shutil.rmtree(here)
    print(f"{taken} steps, {failed} failed")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())

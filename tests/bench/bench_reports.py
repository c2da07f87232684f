"""Reports: of the example, with its size and the time until a browser shows it; and of a store with 10,000 batches.

The targets for the example are 1 MB and 1 s.
"""

from __future__ import annotations

import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from idle import measured, project

sys.path.append(str(Path(__file__).resolve().parents[2]))
SIERRA = str(Path(sys.executable).with_name("sierra"))
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
PACKAGE = '\n[package]\ntitle = "Swarm"\nauthors = [{ name = "Jane Doe" }]\nlicense = "MIT"\n'


def main() -> None:
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    with tempfile.TemporaryDirectory(prefix="sierra-bench-") as folder:
        example(Path(folder))
        list_of_many(Path(folder))


def example(folder: Path) -> None:
    here = folder / "swarm"
    quietly("init", "--example", "swarm", str(here), where=folder)
    quietly("run", "population_size.Log8", "--no-figures", where=here)
    page = folder / "report.html"
    say("report of the example", here, page, "under 1 MB")
    opened(page, "under 1 s")
    with (here / "sierra.toml").open("a") as file:
        file.write(PACKAGE)
    quietly("figures", where=here)
    batch = next((here / "figures").iterdir()).name
    for words in ((), ("--no-report",)):
        seconds, cpu, _ = measured(here, SIERRA, "package", batch, "-o", str(folder / f"{len(words)}.zip"), "--yes", *words)
        print(f"{' '.join(('package of the example', *words)):36} {cpu:6.2f} s CPU  {seconds:6.2f} s", flush=True)


def list_of_many(folder: Path) -> None:
    from tests.support import many_batches

    here = project(folder / "many")
    many_batches.make(here, 10_000)
    page = folder / "all.html"
    say("list of 10,000 batches", here, page, "under 1 MB", "--all")
    opened(page, "under 1 s")


def say(what: str, here: Path, page: Path, promise: str, *words: str) -> None:
    """Measure a report three times, and print the medians."""
    found = [measured(here, SIERRA, "report", *words, "--to", str(page)) for _ in range(3)]
    seconds, cpu, memory = map(statistics.median, zip(*found, strict=True))
    costs = f"{cpu:6.2f} s CPU  {seconds:6.2f} s  {memory / 1e6:6.0f} MB"
    print(f"{what:36} {costs}  file {page.stat().st_size / 1e6:.2f} MB ({promise})", flush=True)


def opened(page: Path, promise: str) -> None:
    """Print the time until a page is drawn in a browser that runs already."""
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None:
        print("  in a browser: not measured, because there is no Chromium", flush=True)
        return
    from tests.browser import Browser

    times = []
    with tempfile.TemporaryDirectory(prefix="sierra-bench-") as folder, Browser(program, Path(folder)) as browser:
        for _ in range(5):
            began = time.perf_counter()
            browser.open(page)
            times.append(time.perf_counter() - began)
    print(f"{'  in a browser':36} {statistics.median(times):25.2f} s  ({promise})", flush=True)


def quietly(*words: str, where: Path) -> None:
    subprocess.run([SIERRA, *words], cwd=where, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


if __name__ == "__main__":
    main()

"""Install the sdist and the wheel of dist/ with each supported Python that is there, and run the demo.

python -m tests.system.try_dist [FOLDER]
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from tests.pythons import python_of

SUPPORTED = ("3.11", "3.12", "3.13", "3.14")
DEMO = (("init", "--example", "swarm", "demo"), ("run", "population_size=1,2", "--runs", "2"), ("fsck",))


def tried(built: Path, python: str, folder: Path) -> None:
    """Install a built file in a new virtual environment, and run the demo. Raises CalledProcessError."""
    programs = folder / "venv" / "bin"
    _call(folder, python, "-m", "venv", str(folder / "venv"))
    _call(
        folder, str(programs / "python"), "-m", "pip", "--disable-pip-version-check", "--quiet", "install", f"{built}[example]"
    )
    for words in DEMO:
        _call(folder if words[0] == "init" else folder / "demo", str(programs / "sierra"), *words)
    if not list((folder / "demo" / "figures").rglob("*.png")):
        raise SystemExit(f"{built.name}: the demo drew no figure")


def _call(folder: Path, *argv: str) -> None:
    ended = subprocess.run(argv, cwd=folder, capture_output=True, text=True, check=False)
    if ended.returncode != 0:
        raise SystemExit(f"{' '.join(argv)}: exit status {ended.returncode}: {ended.stdout}{ended.stderr}")


def main(folder: str = "dist") -> None:
    built = sorted(Path(folder).resolve().glob("sierra_experiments-*"))
    if [file.name.endswith(".whl") for file in built] != [True, False]:
        raise SystemExit(f"{folder} needs one wheel and one sdist; it has {len(built)} files; run make dist")
    there = {version: python for version in SUPPORTED if (python := python_of(version))}
    if not there:
        raise SystemExit(f"none of Python {', '.join(SUPPORTED)} is here")
    for version, python in there.items():
        for file in built:
            with tempfile.TemporaryDirectory() as scratch:
                tried(file, python, Path(scratch))
            print(f"{file.name}: the demo ran with Python {version}", flush=True)
    for version in sorted(set(SUPPORTED) - there.keys()):
        print(f"not tried: Python {version}, which is not here")


if __name__ == "__main__":
    main(*sys.argv[1:])

"""Packing 100,000 runs needs less than 300 MB."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

import sierra
from tests import large_stores, projects

TOML = '\n[package]\ntitle = "Coverage of a swarm"\nauthors = [{ name = "Jane Doe" }]\nlicense = "MIT"\n'
PACK = """
import sys
from pathlib import Path
from sierra.cli import main
sys.argv[0] = "sierra"
try:
    main.main()
finally:
    print(Path("/proc/self/status").read_text())
"""
pytestmark = pytest.mark.integration


@pytest.mark.nightly
def test_100_000_runs_are_packed_with_300_mb(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project", projects.CONFIG + TOML)
    batch = large_stores.grow(root, sierra.open(root).run("population_size=1", runs=1, figures=False).batch, 100_000)
    command = [sys.executable, "-c", PACK, "package", batch, "--no-report", "-o", tmp_path / "x.zip", "--yes"]
    said = subprocess.run(command, cwd=root, check=True, capture_output=True, text=True).stdout
    peak = re.search(r"VmHWM:\s+(\d+) kB", said)
    assert peak is not None
    assert int(peak[1]) < 300_000
    shown = projects.quick(root, "open", str(tmp_path / "x.zip")).stdout
    assert ", 100,000 successful)" in shown
    stored = sum(path.stat().st_size for path in (root / ".sierra").rglob("*") if path.is_file())
    assert (tmp_path / "x.zip").stat().st_size < 1.3 * stored

"""A small new run costs a small number of statements, files and processes, which may only fall.

They are counted, not timed, so that the counts are the same on every machine.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.integration

MOST = {"statements": 107, "snapshots": 23, "files": 17, "processes of git": 7}
PROBE = """
import atexit, json, sys
from pathlib import Path
from sierra.store import local_connection, store
counts = dict.fromkeys(("statements", "snapshots"), 0)
call, opened = local_connection.Interruptible._call, store.Snapshot.__init__

def called(self, method, *given, **named):
    counts["statements"] += getattr(method, "__name__", "") == "execute" or "sql" in getattr(method, "__name__", "")
    return call(self, method, *given, **named)

def counted(self, *given, **named):
    counts["snapshots"] += 1
    opened(self, *given, **named)

local_connection.Interruptible._call, store.Snapshot.__init__ = called, counted
file = Path(sys.argv.pop(1))
atexit.register(lambda: file.write_text(json.dumps(counts)))
from sierra.cli.main import program
program()
"""
GIT = """#!/bin/sh
echo >> "{count}"
exec {git} "$@"
"""
TOML = """
template = "template.xml"
command = "true {input}"
seed = "/experiment/@seed"
[variables]
size = "//swarm/@size"
"""


def test_counts_of_a_new_run_beside_another_one(tmp_path: Path) -> None:
    here, count, counts = tmp_path / "project", tmp_path / "processes", tmp_path / "counts"
    here.mkdir()
    (here / "sierra.toml").write_text(TOML)
    (here / "template.xml").write_text('<experiment seed="1"><swarm size="3"/></experiment>')
    git = str(shutil.which("git"))
    for words in (("init", "-q"), ("add", "-A"), ("-c", "user.name=a", "-c", "user.email=a@example.org", "commit", "-qm", "a")):
        subprocess.run([git, *words], cwd=here, check=True)
    program = tmp_path / "bin" / "git"
    program.parent.mkdir()
    program.write_text(GIT.format(count=count, git=git))
    program.chmod(0o755)

    def run(size: int) -> None:
        argv = [sys.executable, "-c", PROBE, str(counts), "run", f"size={size}", "--runs", "1", "--no-figures"]
        path = f"{program.parent}{os.pathsep}{os.environ['PATH']}"
        subprocess.run(argv, cwd=here, env={**os.environ, "PATH": path}, check=True, capture_output=True)

    run(1)
    count.unlink()
    before = set(here.glob(".sierra/segments/*/*.parquet"))
    run(2)
    found = {
        **json.loads(counts.read_text()),
        "files": len(set(here.glob(".sierra/segments/*/*.parquet")) - before),
        "processes of git": count.read_text().count("\n"),
    }
    assert {name: (found[name], most) for name, most in MOST.items() if found[name] > most} == {}
    assert found["statements"] > 20  # it counts them

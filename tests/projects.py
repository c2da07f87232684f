"""A tiny project for tests: a simulator that reads one XML and writes one CSV, and calls of the command line."""

from __future__ import annotations

import contextlib
import functools
import io
import json
import os
import signal
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import typer.main

from sierra.cli import main
from sierra.store import equal_runs
from sierra.util import signals
from tests import forkserver

typer.main.get_command = functools.cache(typer.main.get_command)
"""Cached, because each call within this process would build all commands again, which is slow."""

SIERRA = forkserver.SIERRA
"""The program itself; `sierra` and `start` do not start it but fork a process that has imported it: see `forkserver`."""

SIMULATOR = """\
import sys

# a parser of XML would take longer to import than all else takes
arena = open(sys.argv[1]).read()
count = int(arena.split('<swarm count="')[1].split('"')[0])
seed = int(arena.split('<random seed="')[1].split('"')[0])
noise = float(arena.split("<noise>")[1].split("<")[0])
with open("swarm.csv", "w") as file:
    print("tick,coverage", file=file)
    for tick in range(5):
        print(tick, count * tick + noise * (seed % 100), sep=",", file=file)
"""

TEMPLATE = """\
<?xml version="1.0"?>
<!-- an arena -->
<arena size="10">
  <random seed="0"/>
  <swarm count="1" controller="none"/>
  <noise>0.1</noise>
</arena>
"""

CONFIG = """\
template = "arena.xml"
command = "python3 sim.py {input}"
seed = "//random/@seed"
runs = 2
[variables]
population_size = "//swarm/@count"
noise = "//noise"
"""


def make(folder: Path, config: str = CONFIG, *, simulator: str = SIMULATOR, template: str = TEMPLATE) -> Path:
    """Write a project into a new folder; return the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "sim.py").write_text(simulator)
    (folder / "arena.xml").write_text(template)
    (folder / "sierra.toml").write_text(config)
    return folder


def commit(folder: Path, message: str = "first") -> Path:
    """Commit all files, in a new git repository if there is none; return the folder.

    The same content with the same history gives the same commit at any time.
    """
    environment = os.environ | dict.fromkeys(("GIT_AUTHOR_DATE", "GIT_COMMITTER_DATE"), "2026-01-01T00:00:00Z")
    author = ("-c", "user.name=a", "-c", "user.email=a@b")
    for words in (("init", "-q"), ("add", "."), ("commit", "-q", "-m", message)):
        subprocess.run(["git", *author, *words], cwd=folder, check=True, env=environment)
    return folder


def sierra(
    folder: Path, *words: str, stdin: str = "", environment: Mapping[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """Run the command line in a folder, as a user does, without a terminal."""
    return forkserver.run(*words, cwd=folder, stdin=stdin, environment={**os.environ, **(environment or {})}, timeout=200)


def start(folder: Path, *words: str, **more: Any) -> forkserver.Popen:
    """Start the command line in a folder; `more` are arguments of `subprocess.Popen`."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return forkserver.Popen([SIERRA, *words], cwd=folder, **{**pipes, **more})


def quick(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run the command line within this process, without the time to start Python."""
    out, err = io.TextIOWrapper(io.BytesIO(), "utf-8"), io.StringIO()
    before = sys.argv, sys.stdin
    handlers = {number: signal.getsignal(number) for number in signals.ENDING}
    sys.argv, sys.stdin = ["sierra", *words], io.StringIO()
    try:
        with contextlib.chdir(folder), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            main.main()
    except SystemExit as ended:
        out.flush()
        said = out.buffer.getvalue().decode()  # type: ignore[attr-defined]
        return subprocess.CompletedProcess(words, int(str(ended.code or 0)), said, err.getvalue())
    finally:
        sys.argv, sys.stdin = before
        for number, handler in handlers.items():
            signal.signal(number, handler)
    raise AssertionError("the command line always exits")


def run(folder: Path, *words: str) -> tuple[dict[str, Any], str]:
    """Execute a query without figures; return its summary and its standard error."""
    done = quick(folder, "run", *words, "--no-figures", "--json")
    assert done.returncode == 0, done.stderr
    summary: dict[str, Any] = json.loads(done.stdout)
    return summary, done.stderr


def other_notes(stderr: str) -> str:
    """Return what a command has said without the note on equal runs: the programs of many tests use no seed."""
    return "".join(line for line in stderr.splitlines(keepends=True) if equal_runs.NOTE not in line)


def sql(folder: Path, statement: str) -> list[dict[str, Any]]:
    """Return the rows of a statement on the store."""
    done = quick(folder, "sql", "--format", "json", statement)
    assert done.returncode == 0, done.stderr
    found: list[dict[str, Any]] = json.loads(done.stdout)
    return found


def values(root: Path, statement: str) -> set[object]:
    """Return the values of the only column of a statement."""
    return {value for row in sql(root, statement) for value in row.values()}

"""`sierra explore` as a program: what it prints, how it ends, what it leaves, and what others can do to it meanwhile."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

import sierra
from tests import projects, stores
from tests.extensions.explorer.page import Page
from tests.terminals import Terminal
from tests.waiting import PATIENCE_S, until

PACKAGE = '\n[package]\ntitle = "T"\nauthors = [{ name = "Jane Doe" }]\nlicense = "MIT"\n'
MODEL = '\n[models.theory]\ncommand = ["sh", "-c", "touch {project}/executed /tmp/executed-TOKEN"]\ncolumn = "coverage"\n'
LARGE = "SELECT count(*) FROM (SELECT DISTINCT a.range + b.range * 100000 FROM range(100000) a, range(100000) b)"
SLOW = projects.SIMULATOR + "import pathlib, time\nwhile seed % 2 and not pathlib.Path('GO').exists():\n    time.sleep(0.05)\n"
pytestmark = pytest.mark.integration


@contextmanager
def explored(root: Path, *words: str, **environment: str) -> Iterator[tuple[subprocess.Popen[str], dict[str, Any]]]:
    """Run `sierra explore --json`; yield the process and what it prints, and end it as a user does."""
    argv = [str(projects.SIERRA), *words, "--json"]
    with subprocess.Popen(argv, cwd=root, stdout=subprocess.PIPE, text=True, env={**os.environ, **environment}) as process:
        assert process.stdout
        try:
            lines = iter(process.stdout.readline, "}\n")
            yield process, json.loads("".join(lines) + "}")
        finally:
            process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE_S) in (0, -signal.SIGKILL)


def test_programs_can_ask_and_a_port_that_is_taken_is_refused(recorded: Path) -> None:
    before = stores.state(recorded)
    with explored(recorded, "explore") as (process, printed), explored(recorded, "explore") as (_, other):
        page = Page(printed["address"])
        assert printed == {
            "address": f"http://127.0.0.1:{printed['port']}/#{printed['token']}",
            "host": "127.0.0.1",
            "port": printed["port"],
            "token": page.token,
            "writes": False,
        }
        assert page.ask("batches") == Page(other["address"]).ask("batches")
        refused = projects.sierra(recorded, "explore", "--no-browser", "--port", str(printed["port"]))
        assert refused.returncode == 3
        assert refused.stderr.count("\n") == 1
        assert "choose another one with --port" in refused.stderr
        assert process.poll() is None
    assert process.returncode == 0
    assert stores.state(recorded) == before


def test_nothing_is_left_of_an_explorer_that_was_killed(recorded: Path, tmp_path: Path) -> None:
    temporary, before = tmp_path / "temporary", stores.state(recorded)
    temporary.mkdir()
    with explored(recorded, "explore", TMPDIR=str(temporary)) as (process, printed):
        page = Page(printed["address"])
        batch = page.ask("batches")["batches"][0]["batch"]
        page.ask("chart", batch=batch, name="mine", keys={"table": "swarm", "column": "coverage"})
        began = computed(process.pid)
        asking = threading.Thread(target=lambda: _ask(page, LARGE))
        asking.start()
        until(lambda: computed(process.pid) > began + 0.5, "the statement is being answered")
        process.kill()
        asking.join(PATIENCE_S)
    assert stores.state(recorded) == before
    assert list(temporary.iterdir()) == []
    with explored(recorded, "explore", "--port", str(printed["port"])) as (_, again):
        assert Page(again["address"]).ask("batches")["all"] == 3


def _ask(page: Page, statement: str) -> None:
    with suppress(OSError, AssertionError):
        page.ask("query", statement=statement)


def computed(pid: int) -> float:
    """Return the CPU seconds so far of a process and of those that it has started."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    own = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    started = (child for path in Path(f"/proc/{pid}/task").glob("*/children") for child in path.read_text().split())
    return own + sum(computed(int(child)) for child in started)


def test_nothing_of_a_hostile_package_is_executed(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project", projects.CONFIG + PACKAGE)
    batch = stores.ask(root, "population_size=1,2", runs=2)
    trap = tmp_path / "executed"
    config = projects.CONFIG + PACKAGE + MODEL.replace("/tmp/executed-TOKEN", str(trap))
    (root / "sierra.toml").write_text(config)
    sierra.open(root).packages.pack(batch, path=tmp_path / "one.zip")
    trap.unlink(missing_ok=True)  # whoever makes a package executes its own models
    with explored(tmp_path, "open", "one.zip", "explore") as (_, printed):
        page = Page(printed["address"])
        assert page.ask("overview")["package"] is True
        found = page.ask("batch", batch=batch)
        for name, keys in found["figures"].items():
            page.ask("chart", batch=batch, name=name, keys=keys)
        report = page.send("GET", page.ask("report", batch=batch)["address"])[1]
        assert b"commands of the package would have to be executed: theory" in report
        assert "changes no files" in page.error("write", name="x", keys={}, file="")
    assert not trap.exists()


def test_a_batch_that_is_still_running_is_followed(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project", simulator=SLOW.replace("GO", str(tmp_path / "go")))
    running = projects.start(root, "run", "population_size=1,2", "--runs", "4", "--no-figures", "-j2", stdout=None, stderr=None)
    try:
        until(lambda: any((root / ".sierra" / "segments").iterdir()), "the batch is recorded")
        with explored(root, "explore") as (_, printed):
            page = Page(printed["address"])
            batch = page.ask("batches")["batches"][0]["batch"]
            until(lambda: page.ask("batch", batch=batch)["executing"] > 0, "runs are being executed")
            state = page.ask("state")
            (tmp_path / "go").touch()
            assert running.wait(PATIENCE_S) == 0
            assert page.ask("state") != state
            found = page.ask("batch", batch=batch)
            assert (found["executing"], found["facts"]["state"]) == (0, "complete")
            runs = page.ask("query", statement="SELECT count(DISTINCT run) FROM swarm", batch=batch)
            assert runs["rows"] == [[8]]
    finally:
        (tmp_path / "go").touch()
        running.wait(PATIENCE_S)


@pytest.mark.nightly
def test_a_missing_browser_is_reported_on_a_terminal(recorded: Path) -> None:
    lonely = {"PATH": "/nonexistent", "BROWSER": "/nonexistent/browser", "DISPLAY": "", "WAYLAND_DISPLAY": ""}
    with Terminal(recorded, str(projects.SIERRA), "explore", environment=lonely) as terminal:
        terminal.expect("no browser was found; open the address in one")
        terminal.type("\x03")
        assert terminal.end() == 0


@pytest.mark.nightly
def test_a_browser_in_the_terminal_gets_the_page(recorded: Path, tmp_path: Path) -> None:
    """Such a browser returns only when it is closed; the page must be served meanwhile."""
    page, browser = tmp_path / "page.html", tmp_path / "browser"
    browser.write_text(
        f"#!{sys.executable}\nimport os, sys, urllib.request\n"
        f"open({str(page)!r} + '.part', 'wb').write(urllib.request.urlopen(sys.argv[1]).read())\n"
        f"os.rename({str(page)!r} + '.part', {str(page)!r})\n"
    )
    browser.chmod(0o755)
    with Terminal(recorded, str(projects.SIERRA), "explore", environment={"BROWSER": f"{browser} %s"}) as terminal:
        until(page.exists, "the browser has the page")
        assert b"<html" in page.read_bytes()
        terminal.type("\x03")
        assert terminal.end() == 0


@pytest.mark.parametrize("words", [("--port", "65536"), ("--port", "x")])
def test_a_wrong_port_is_a_mistake_of_the_user(recorded: Path, words: tuple[str, ...]) -> None:
    assert projects.quick(recorded, "explore", *words).returncode == 2

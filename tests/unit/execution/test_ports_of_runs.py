"""`{port}`: a free port of the run, in commands, values of changes and variables, and in no id."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from sierra.worker.free_ports import BLOCK, Ports
from tests.projects import quick, run, sql

SIMULATOR = """\
import json, os, pathlib, sys

given = json.loads(pathlib.Path(sys.argv[1]).read_text())
words = [given["port"], given["url"].rpartition(":")[2], os.environ["P"], *sys.argv[2:]]
print("tick,input,url,variable,a,b", "0," + ",".join(map(str, words)), sep="\\n", file=open("out.csv", "w"))
"""
CONFIG = """\
template = "in.json"
command = "python3 sim.py {input} {port} {port2}"
seed = "/seed"
changes = [{ set = "/port", value = "{port}" }, { set = "/url", value = "tcp://localhost:{port2}" }]
[environment]
set = { P = "{port}" }
[variables]
population_size = "/count"
"""


def make(folder: Path, config: str = CONFIG) -> Path:
    folder.mkdir(parents=True)
    (folder / "sim.py").write_text(SIMULATOR)
    (folder / "in.json").write_text('{"count": 1, "seed": 0, "port": 2000, "url": "none"}')
    (folder / "sierra.toml").write_text(config)
    return folder


@pytest.mark.integration
def test_ports_are_filled_in_everywhere_and_not_in_ids(tmp_path: Path) -> None:
    root = make(tmp_path / "p")
    batch = run(root, "population_size=1,2", "--runs", "2")[0]["batch"]
    rows = sql(root, "SELECT * FROM out")
    assert all(row["input"] == row["variable"] == row["a"] != row["b"] == row["url"] for row in rows)
    assert len({row["a"] for row in rows}) > 1
    given = "SELECT execution, list(name ORDER BY name) AS names FROM channels WHERE use = 'given' GROUP BY ALL"
    recorded = {row["execution"]: row["names"] for row in sql(root, given)}
    for row in sql(root, "SELECT * FROM out JOIN executions USING (execution)"):
        assert recorded[row["execution"]] == sorted(f"127.0.0.1:{row[name]}" for name in ("a", "b"))
    execution = next(iter(recorded))
    assert json.loads(quick(root, "show", execution, "--json").stdout)["ports"] == recorded[execution]
    assert run(make(tmp_path / "elsewhere" / "q"), "population_size=1,2", "--runs", "2")[0]["batch"] == batch
    done = quick(root, "replay", str(batch))
    assert "4 runs" in done.stdout, done.stderr
    assert quick(root, "inputs", "population_size=1", "--runs", "1", "--to", "in").returncode == 0
    [inputs] = (root / "in").rglob("input.json")
    assert '"port": {port}, "url": "tcp://localhost:{port2}"' in inputs.read_text()
    command = json.loads((inputs.parent / "command.json").read_text())
    assert command["argv"][-2:] == ["{port}", "{port2}"]


@pytest.mark.integration
def test_a_variable_of_that_name_keeps_its_meaning(tmp_path: Path) -> None:
    config = CONFIG.replace("[variables]\n", "[variables]\nport = {}\n").replace("{port2}", "7")
    root = make(tmp_path / "p", config)
    run(root, "population_size=1", "port=2000", "--runs", "1")
    [row] = sql(root, "SELECT input, a, b FROM out")
    assert row == {"input": 2000, "a": 2000, "b": 7}


@pytest.mark.parametrize("name", ["port17", pytest.param("port1", marks=pytest.mark.each_case)])
def test_an_unknown_port_is_an_error(tmp_path: Path, name: str) -> None:
    root = make(tmp_path / "p", CONFIG.replace("{port2}", f"{{{name}}}", 1))
    done = quick(root, "run", "population_size=1", "--dry-run")
    assert done.returncode == 2
    assert f"command: unknown placeholder {{{name}}}" in done.stderr
    assert "{arguments}, {port}, {checkpoint}, {population_size}; write" in done.stderr


def test_a_template_with_the_mark_of_a_port_is_refused(tmp_path: Path) -> None:
    root = make(tmp_path / "p")
    (root / "in.json").write_text('{"count": 730461892355147, "seed": 0, "port": 2000, "url": "none"}')
    done = quick(root, "run", "population_size=1", "--dry-run")
    assert done.returncode == 2
    assert "which marks ports in inputs" in done.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no abstract sockets")
def test_two_programs_never_get_the_same_ports(monkeypatch: pytest.MonkeyPatch) -> None:
    from sierra.worker import free_ports

    first, second = Ports(), Ports()
    port = first.take()
    monkeypatch.setattr(free_ports, "PORTS", range(port, port + BLOCK))
    with pytest.raises(free_ports.NoFreePort):
        second.take()
    first.give_back()
    assert second.take() == port
    second.give_back()

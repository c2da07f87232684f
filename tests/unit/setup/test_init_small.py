"""`sierra init` says what keeps a value from being varied or a run from being tried; a failed one leaves no project."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from tests.projects import CONFIG, make, quick


def test_a_number_with_a_comment_behind_it_is_named(tmp_path: Path) -> None:
    (tmp_path / "sim.py").write_text("import sys\n")
    (tmp_path / "p.ini").write_text("[main]\nseed = 3\nspeed = 0.5\ncount = 4 ; robots\n# a = 3 # b\n")
    done = quick(tmp_path, "init", "-y", "--no-try")
    assert done.returncode == 0
    assert "note: to vary count, write the comment behind the value on a line of its own" in done.stderr
    assert tomllib.loads((tmp_path / "sierra.toml").read_text())["variables"] == {"speed": "//speed"}


def test_services_that_the_command_uses_are_to_be_declared(tmp_path: Path) -> None:
    (tmp_path / "sim.py").write_text("import sys\n")
    done = quick(tmp_path, "init", "-y", "--command", "python3 sim.py --bridge {services.bridge.port} --robots 3 --seed 1")
    assert done.returncode == 0
    assert "declare [services.bridge] with command and ready first\n" in done.stderr
    written = tmp_path / "sierra.toml"
    service = "# [services.bridge]", '# command = "./server', "# ready"
    lines = [line[2:] if line.startswith(service) else line for line in written.read_text().splitlines()]
    written.write_text("\n".join(lines).replace("./server", "python3"))
    assert quick(tmp_path, "run", "population_size=1,2", "-n").returncode == 0


def test_ports_in_a_template_are_proposed_as_free_ones_and_not_as_variables(tmp_path: Path) -> None:
    (tmp_path / "sim.py").write_text("import sys\n")
    (tmp_path / "in.json").write_text('{"seed": 1, "rpc_port": 2000, "tmPort": 8000, "cars": 5, "url": {"port": 2000}}')
    assert quick(tmp_path, "init", "-y", "--no-try", "--command", "python3 sim.py {input}").returncode == 0
    written = tmp_path / "sierra.toml"
    assert list(tomllib.loads(written.read_text())["variables"]) == ["cars"]
    written.write_text(written.read_text().replace("# changes = ", "changes = "))
    changes = {one["set"]: one["value"] for one in tomllib.loads(written.read_text())["changes"]}
    assert changes == {"//rpc_port": "{port}", "//tmPort": "{port2}", "//port": "{port}"}
    assert quick(tmp_path, "run", "cars=1,2", "-n").returncode == 0


@pytest.mark.integration
@pytest.mark.parametrize(("columns", "time"), [("tick,x", "tick"), ("x,tick", None)])
def test_the_time_axis_is_proposed_by_the_rule_of_figures(tmp_path: Path, columns: str, time: str | None) -> None:
    program = f"open('a.csv', 'w').write('{columns}\\n0,1\\n1,2\\n')\n"
    (tmp_path / "sim.py").write_text(program)
    assert quick(tmp_path, "init", "-y", "--command", "python3 sim.py --seed 1 --robots 2").returncode == 0
    text = (tmp_path / "sierra.toml").read_text()
    assert (f'# time = "{time}"' in text) == (time is not None)
    assert ("# time" in text) == (time is not None)


@pytest.mark.nightly
def test_where_only_a_run_was_tried_the_missing_project_is_named(tmp_path: Path) -> None:
    (tmp_path / "sim.py").write_text("import sys\nsys.exit(3)\n")
    assert quick(tmp_path, "init", "-y", "--command", "python3 sim.py --robots 2").returncode == 1
    (tmp_path / "sierra.toml").unlink()
    for words in (("try",), ("ls",), ("run", "robots=1")):
        done = quick(tmp_path, *words)
        assert (done.returncode, done.stderr.count("\n")) == (3, 1)
        assert "no sierra.toml in" in done.stderr
        assert "create one with: sierra init" in done.stderr


def test_a_missing_seed_is_explained_for_the_inputs_that_there_are(tmp_path: Path) -> None:
    folder = make(tmp_path / "template", CONFIG.replace('seed = "//random/@seed"\n', ""))
    assert 'set seed = "XPATH", or use {seed} in the command' in quick(folder, "run", "noise=1", "-n").stderr
    folder = make(tmp_path / "none", 'command = "python3 sim.py {n}"\n[variables]\nn = {}\n')
    said = quick(folder, "run", "n=1", "-n").stderr
    assert 'set seed = { argument = "--seed {value}" } or seed = { environment = "SEED" }, or use {seed}' in said
    assert "XPATH" not in said


def test_a_model_of_netlogo_needs_its_experiment_and_its_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/usr/bin:/bin")
    (tmp_path / "wolf.nlogo").write_text("to go\nend\n")
    done = quick(tmp_path, "init", "-y")
    assert done.returncode == 3
    assert "for the NetLogo model wolf.nlogo, export a BehaviorSpace experiment as XML" in done.stderr
    (tmp_path / "grow.xml").write_text('<experiments><experiment repetitions="1" name="grow all"/></experiments>')
    done = quick(tmp_path, "init", "-y")
    assert done.returncode == 3
    assert "netlogo-headless.sh of NetLogo is not in the PATH; add its folder to PATH, or give the command" in done.stderr
    (tmp_path / "netlogo-headless.sh").write_text("#!/bin/sh\n")
    assert quick(tmp_path, "init", "-y", "--no-try").returncode == 0
    command = tomllib.loads((tmp_path / "sierra.toml").read_text())["command"]
    expected = "--model wolf.nlogo --setup-file {input} --experiment 'grow all' --table {output}/wolf.csv --threads 1"
    assert command == f"./netlogo-headless.sh {expected}"

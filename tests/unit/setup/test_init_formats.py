"""`sierra init` recognises templates of each format, tries one run of a given command, and what it writes runs."""

from __future__ import annotations

import json
import signal
import tomllib
from pathlib import Path
from typing import Any

import pytest

from tests.projects import quick, start
from tests.waiting import until

PARSE = {
    "json": "import json; p = json.load(open(sys.argv[1])); count, seed = p['swarm']['count'], p['random_seed']",
    "yaml": "p = dict(line.split(': ') for line in open(sys.argv[1]) if ': ' in line);"
    "count, seed = int(p['  robots']), int(p['rng'])",
    "toml": "import tomllib; p = tomllib.load(open(sys.argv[1], 'rb')); count, seed = p['swarm']['count'], p['seed']",
    "ini": "import configparser; p = configparser.ConfigParser(); p.read(sys.argv[1]);"
    "count, seed = int(p['swarm']['count']), int(p['main']['seed'])",
    "properties": "p = dict(line.strip().split('=') for line in open(sys.argv[1]));"
    "count, seed = int(p['num_robots']), int(p['seed'])",
    "txt": "p = open(sys.argv[1]).read().split(); count, seed = int(p[1]), int(p[3])",
}
TEMPLATES = {
    "json": '{"random_seed": 0, "swarm": {"count": 2, "speed": 0.5}}\n',
    "yaml": "rng: 0\nswarm:\n  robots: 2\n  speed: 0.5  # m/s\n",
    "toml": "seed = 0\n[swarm]\ncount = 2\nspeed = 0.5\n",
    "ini": "[main]\nseed = 0\n[swarm]\ncount = 2\nspeed = 0.5\n",
    "properties": "seed=0\nnum_robots=2\nspeed=0.5\n",
    "txt": "robots {{count}} seed {{seed}}\n",
}
SEEDS = {
    "json": "//random_seed",
    "yaml": "//rng",
    "toml": "//seed",
    "ini": "//seed",
    "properties": "//seed",
    "txt": "/seed",
}
WRITE = "\nwith open('swarm.csv', 'w') as file:\n    print('tick,covered', 0, count + seed, sep='\\n0,', file=file)\n"
GIVEN = ("--command", "python3 model.py {input}")


def make(folder: Path, ending: str) -> Path:
    folder.mkdir()
    (folder / "model.py").write_text(f"import sys\n{PARSE[ending]}{WRITE}")
    (folder / f"world.{ending}").write_text(TEMPLATES[ending])
    return folder


def settings(folder: Path) -> dict[str, Any]:
    return tomllib.loads((folder / "sierra.toml").read_text())


@pytest.mark.integration
@pytest.mark.parametrize("ending", PARSE)
def test_a_template_of_each_format_is_found_and_what_is_written_runs(tmp_path: Path, ending: str) -> None:
    folder = make(tmp_path / "project", ending)
    done = quick(folder, "init", "--json", *GIVEN)
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert (said["template"], said["seed"]) == (f"world.{ending}", SEEDS[ending])
    assert settings(folder)["template"] == f"world.{ending}"
    assert len(said["variables"]) == 1
    words = said["next"].removeprefix("sierra ").removesuffix(" -n").split()
    ran = quick(folder, *words, "--runs", "2", "--no-figures", "--json")
    assert ran.returncode == 0, ran.stderr
    summary = json.loads(ran.stdout)
    assert summary["failed"] == 0
    found = json.loads(quick(folder, "sql", "--json", "SELECT count(DISTINCT covered) AS n FROM swarm").stdout)
    assert found[0]["n"] >= summary["runs"]  # the variable and the seed have an effect


@pytest.mark.integration
def test_a_tried_run_is_shown_and_described_in_comments(tmp_path: Path) -> None:
    folder = make(tmp_path / "project", "json")
    done = quick(folder, "init", "-y", *GIVEN)
    assert done.returncode == 0
    assert "result  ok\n" in done.stdout
    text = (folder / "sierra.toml").read_text()
    assert "# A run wrote:\n#   swarm.csv: table swarm, 2 rows of tick, covered\n" in text
    assert '# [outputs.swarm]\n# file = "swarm.csv"\n# time = "tick"\n' in text
    (folder / "sierra.toml").write_text(
        text.replace("# [outputs", "[outputs").replace("# file", "file").replace("# time", "time")
    )
    assert quick(folder, "run", "population_size=1", "--runs", "1", "--no-figures").returncode == 0


@pytest.mark.integration
def test_a_run_that_fails_leaves_a_file_to_correct(tmp_path: Path) -> None:
    folder = make(tmp_path / "project", "json")
    (folder / "model.py").write_text("import sys\nprint('no map', file=sys.stderr)\nsys.exit(4)\n")
    done = quick(folder, "init", "-y", *GIVEN)
    assert done.returncode == 1
    place = "its standard error is .sierra/try/run/stderr"
    said = f"failed: exit status 4; {place} (correct sierra.toml, then: sierra try)\n"
    assert done.stderr.endswith(said)
    assert (folder / ".sierra/try/run/stderr").read_text() == "no map\n"
    assert "no map\n" in done.stderr
    written = (folder / "sierra.toml").read_bytes()
    (folder / "sierra.toml").unlink()
    assert quick(folder, "init", "-y", *GIVEN, "--no-try").returncode == 0
    assert (folder / "sierra.toml").read_bytes() == written


@pytest.mark.nightly
def test_an_interrupted_run_leaves_no_sierra_toml(tmp_path: Path) -> None:
    folder = make(tmp_path / "project", "json")
    (folder / "model.py").write_text("import time\nopen('begun', 'w')\ntime.sleep(1000)\n")
    with start(folder, "init", "-y", *GIVEN) as asking:
        until(lambda: list((folder / ".sierra/try/store/work").glob("*/1/output/begun")))
        asking.send_signal(signal.SIGINT)
        asking.communicate()
    assert asking.returncode == 130
    assert not (folder / "sierra.toml").exists()


@pytest.mark.nightly
def test_a_command_that_nobody_gave_is_tried_before_it_is_written(tmp_path: Path) -> None:
    folder = make(tmp_path / "project", "json")
    done = quick(folder, "init", "-y")
    assert done.returncode == 0
    assert "trying one run: python3 model.py {input} (--no-try does not)\n" in done.stdout
    assert settings(folder)["command"] == "python3 model.py {input}"


@pytest.mark.nightly
@pytest.mark.parametrize("words", [(), ("-y",), ("--json",)])
def test_a_guessed_command_that_fails_is_not_written(tmp_path: Path, words: tuple[str, ...]) -> None:
    folder = make(tmp_path / "project", "json")
    (folder / "model.py").write_text("import sys\nprint('no map', file=sys.stderr)\nsys.exit(4)\n")
    done = quick(folder, "init", *words)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1] == (
        "sierra: a run of 'python3 model.py {input}' failed: exit status 4; "
        "its standard error is .sierra/try/run/stderr (correct sierra.toml, then: sierra try)"
    )
    assert settings(folder)["command"] == "python3 model.py {input}"


def test_nothing_is_executed_with_no_try(tmp_path: Path) -> None:
    folder = make(tmp_path / "project", "json")
    (folder / "model.py").write_text("import sys\nopen(sys.argv[0] + '.executed', 'w')\n")
    assert quick(folder, "init", "-y", "--no-try").returncode == 0
    assert settings(folder)["command"] == "python3 model.py {input}"
    assert not (folder / "model.py.executed").exists()


def test_files_of_other_tools_are_no_templates(tmp_path: Path) -> None:
    folder = make(tmp_path / "project", "json")
    for name in ("package.json", "pyproject.toml", "requirements.txt", "environment.yml", "tox.ini"):
        (folder / name).write_text("")
    (folder / "pyproject.toml").write_text("[project]\nname = 'x'\n")
    assert quick(folder, "init", "-y", "--no-try").returncode == 0
    assert settings(folder)["template"] == "world.json"


def test_several_possible_templates_are_named(tmp_path: Path) -> None:
    folder = make(tmp_path / "project", "json")
    (folder / "map.yaml").write_text("a: 1\n")
    done = quick(folder, "init", "-y", "--no-try")
    assert (done.returncode, done.stderr.count("\n")) == (3, 1)
    assert "several files could be the template (map.yaml, world.json); give the template with --template FILE" in done.stderr


@pytest.mark.nightly
def test_the_format_of_a_file_with_another_ending_is_named(tmp_path: Path) -> None:
    folder = make(tmp_path / "project", "ini")
    (folder / "world.ini").rename(folder / "world.conf")
    done = quick(folder, "init", "-y", "--template", "world.conf")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "its ending names no format" in done.stderr
    assert "use --format with one of xml, json" in done.stderr
    assert quick(folder, "init", "-y", "--template", "world.conf", "--format", "ini", *GIVEN).returncode == 0
    assert settings(folder)["template_format"] == "ini"
    assert quick(folder, "run", "population_size=3", "--runs", "1", "--no-figures").returncode == 0


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("world.json", b"<swarm/>\n", "its ending means json, but it begins as XML"),
        ("world.json", b"\x7fELF\x02\x01\x01\0\0", "world.json"),
        ("world.yaml", b"a: 1\na: 2\n", "world.yaml"),
        ("world.json", b'{"a": 1', "world.json"),
    ],
)
def test_doubtful_and_binary_files_are_refused_in_one_line(tmp_path: Path, name: str, content: bytes, said: str) -> None:
    folder = make(tmp_path / "project", "json")
    (folder / "world.json").unlink()
    (folder / name).write_bytes(content)
    done = quick(folder, "init", "-y", *GIVEN)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert said in done.stderr
    assert not (folder / "sierra.toml").exists()


@pytest.mark.nightly
def test_placeholders_without_a_value_are_all_variables(tmp_path: Path) -> None:
    folder = make(tmp_path / "project", "txt")
    (folder / "world.txt").write_text("robots {{count}} seed {{seed}} speed {{speed}}\n")
    done = quick(folder, "init", "-y", *GIVEN)
    assert done.returncode == 0
    assert "  count=1 speed=1, seed " in done.stdout
    assert sorted(settings(folder)["variables"].values()) == ["/count", "/speed"]
    text = (folder / "sierra.toml").read_text()
    assert '# changes = [{ set = "/count", value = 1 }, { set = "/speed", value = 1 }]' in text
    (folder / "sierra.toml").write_text(text.replace("# changes", "changes"))
    assert quick(folder, "try").returncode == 0

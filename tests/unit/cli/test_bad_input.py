"""Every mistake of a user is reported in one line: what is wrong, which one, and what would be right."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from sierra.cli import main
from sierra.config.plugin_registry import PLATFORMS
from tests.projects import CONFIG, TEMPLATE, make, quick, sierra

Ask = Callable[..., tuple[int, str]]
COMMAND = 'command = "python3 sim.py {input}"'


@pytest.fixture
def project(tmp_path: Path) -> Path:
    return make(tmp_path / "project")


@pytest.fixture
def ask(project: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Ask:
    """Call the command line in this process; return its exit code and its one line of output."""

    def ask(*words: str) -> tuple[int, str]:
        monkeypatch.chdir(project)
        monkeypatch.setattr(sys, "argv", ["sierra", *words])
        with pytest.raises(SystemExit) as ended:
            main.main()
        said = capsys.readouterr()
        assert said.out == ""
        assert said.err.startswith("sierra: ")
        assert said.err.count("\n") == 1
        assert "Traceback" not in said.err
        assert "fault in SIERRA" not in said.err
        assert not (project / ".sierra").exists(), "nothing is written before all is understood"
        return int(str(ended.value.code)), said.err

    return ask


@pytest.mark.parametrize(
    ("right", "wrong", "said"),
    [
        ("runs = 2", "rnus = 2", "unknown key 'rnus'; did you mean 'runs'?"),
        ("[variables]", "[variabels]", "unknown key 'variabels'; did you mean 'variables'?"),
        ("", "[limits]\nwal = 3", "unknown key 'limits.wal'; did you mean 'wall'?"),
        ("", '[outputs.swarm]\nfile = "a.csv"\nformt = "csv"', "unknown key 'outputs.swarm.formt'; did you mean 'format'?"),
        ("", '[runners.pbs]\nqueue = "short"', "unknown key 'runners.pbs.queue'; use 'partition' instead"),
        ("", "[runners.slurm]\nwalltime = 60", "unknown key 'runners.slurm.walltime'; use 'wall' instead"),
        ("", '[runners.slurm]\nscratch = "tmp"', "runners.slurm.scratch: 'tmp' should be an absolute path on the node"),
        ("", '[queries.q]\ncriteria = "noise=1"\nrns = 3', "unknown key 'queries.q.rns'; did you mean 'runs'?"),
        ('"//noise"', '{ sett = "//noise" }', "unknown key 'variables.noise.sett'; did you mean 'set'?"),
        ("runs = 2", 'runs = "two"', 'runs should be a whole number, not "two"'),
        ("runs = 2", 'runs = "2"', 'runs should be a whole number, not "2"'),
        ("runs = 2", "runs = 2.5", "runs should be a whole number, not 2.5"),
        ("runs = 2", "runs = true", "runs should be a whole number, not true"),
        ("runs = 2", "runs = 0", "runs should be greater than 0, not 0"),
        ("runs = 2", "runs = ", "not TOML"),
        ('"//noise"', "5", "variables.noise should be a table, not 5"),
        ("", '[figures.x]\nkind = "pie"', "figures.x: unknown kind 'pie'; known are timeseries, "),
        ("", '[figures.x]\nmeasure = "time_to"', 'measure "time_to" and "threshold" must be used together'),
        ("", '[limits]\nmemory = "much"', "limits.memory: 'much' is not a size; use one such as 500 MB or 2 GiB"),
        ("", "[limits]\nmemory = -5", "limits.memory should be greater than 0, not -5"),
        ("", "[limits]\nwall = inf", "limits.wall should be a finite number"),
        ("", '[outputs."a b"]\nfile = "a.csv"', "'a b' is not a valid name; use letters, digits and _"),
        (
            "",
            '[outputs.x]\nfile = "a.csv"\nheader = false\ncolumns = ["t", "my speed (m/s)"]',
            "outputs.x.columns.1: 'my speed (m/s)' is not a valid name; use letters, digits and _, as in my_speed_m_s",
        ),
        (
            "",
            '[outputs.x]\nfile = "a.csv"\ncolumns = ["t"]',
            "[outputs.x]: columns is only for a CSV without header; set header = false too, or remove columns",
        ),
        ("", '[outputs.runs]\nfile = "a.csv"', "the store itself has a table 'runs'; use another name"),
        ("", '[outputs.x]\nfile = "../a.csv"', "'../a.csv' should be a path within the run's output folder"),
        ("", '[outputs.x]\nfile = "/etc/passwd"', "'/etc/passwd' should be a path within the run's output folder"),
        ("", '[environment.set]\nHOME = "/"', "HOME: SIERRA sets this variable for each run; use another name"),
        (
            "",
            '[container]\nimage = "any"\nengine = "none"\nvariables = { SIERRA_SEED = "1" }',
            "[container] variables: SIERRA_SEED: SIERRA sets this variable for each run",
        ),
        ("", '[environment.set]\nA = "a\\u0000b"', "contains the character NUL; remove it"),
        ("", '[source]\npaths = ["nope"]', "'nope' does not exist"),
        ("runs = 2", "per_run = { a = [] }", "per_run.a should not be empty"),
        ("runs = 2", "per_run = { noise = [1] }", "expressions already have another 'noise'"),
        ("runs = 2", "per_run = { seed = [1] }", "expressions already have another 'seed'"),
        ("runs = 2", 'platform = "argoss"', f"unknown platform 'argoss'; known are {', '.join(PLATFORMS.names())}"),
        ("runs = 2", 'controller = "fast"', "controller 'fast' changes nothing"),
        ("runs = 2", 'scenario = "open"', "scenario 'open' changes nothing"),
        ('template = "arena.xml"', "", "{input} in '{input}': there is no template; remove it, or set template"),
        (COMMAND, "", "needs a command"),
        (COMMAND, 'command = "python3 \'sim.py"', "command: No closing quotation"),
        (COMMAND, 'command = "python3 sim.py {inputs}"', "unknown placeholder {inputs}"),
        ("noise =", "number =", "variable 'number': the store itself has a column of that name"),
        ("noise =", "Controller =", "a controller is written 'controller'"),
        ("//random/@seed", "//rnd/@seed", "//rnd/@seed matches nothing"),
        ("", '[[changes]]\nset = "//nothing"\nvalue = 3', "//nothing matches nothing"),
    ],
)
def test_mistakes_in_the_project_file_are_refused_with_a_specific_message(
    project: Path, ask: Ask, right: str, wrong: str, said: str
) -> None:
    text = CONFIG.replace(right, wrong, 1) if right else f"{CONFIG}\n{wrong}\n"
    (project / "sierra.toml").write_text(text)
    code, line = ask("run", "noise=1,2")
    assert said in line
    assert code == 2


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["population_size.Log3"], "3 is not a power of two; use Log2 or Log4"),
        (["population_sise.Log2"], "did you mean 'population_size'?"),
        (["noise=1", "noise=2"], "'noise' is already an axis"),
        (["noise=1,1"], "1 is listed twice; use it once"),
        (["montecarlo.C0"], "a count must be 1 or more, not 0"),
        (["seed=1,2"], "'seed' is a column of the store"),
        ([""], "a criterion must not be empty"),
        (["noise=1", "--runs", "0"], "0 runs per experiment; request 1 or more"),
        (["noise=1", "--runs", "-3"], "-3 runs per experiment; request 1 or more"),
        (["noise=1", "--runs", "99999999999"], "a batch has at most 1000000"),
        (["noise=1", "--runs", "many"], "invalid value for '--runs'"),
        (["noise=1", "--controller", "fast"], "controller 'fast' changes nothing"),
        (["scenario=open,closed"], "scenario 'open' changes nothing"),
        (["noise=1", "--set", "//arena/@size"], "use XPATH=VALUE"),
        (["noise=1", "--set", "//nothing=3"], "//nothing matches nothing"),
        (["noise=1", "--set", "//arena[=3"], "XPATH=VALUE"),
        (["noise=1", "--set", "//arena/@size={1/0}"], "1/0"),
        (["noise=1", "--bogus"], "no such option: --bogus"),
        ([], "missing argument 'QUERY'; see sierra run --help"),
    ],
)
def test_invalid_queries_are_refused(ask: Ask, words: list[str], said: str) -> None:
    code, line = ask("run", *words)
    assert said in line
    assert code == 2


@pytest.mark.parametrize(
    ("xml", "said"),
    [
        ("", "not XML"),
        ("<arena>", "not XML"),
        ("no xml", "not XML"),
        ('<!DOCTYPE a [<!ENTITY e SYSTEM "file:///etc/passwd">]>' + TEMPLATE.split("\n", 1)[1].replace("0.1", "&e;"), "entit"),
    ],
)
def test_invalid_templates_are_refused(project: Path, ask: Ask, xml: str, said: str) -> None:
    (project / "arena.xml").write_text(xml)
    code, line = ask("run", "noise=1")
    assert "arena.xml" in line
    assert said in line
    assert code == 2


def test_missing_programs_templates_and_project_files_give_exit_code_3(project: Path, ask: Ask) -> None:
    (project / "sierra.toml").write_text(CONFIG.replace("python3", "no-such-program"))
    assert ask("run", "noise=1")[0] == 3
    (project / "sierra.toml").write_text(CONFIG.replace("arena.xml", "arenna.xml"))
    assert ask("run", "noise=1")[0] == 3
    (project / "sierra.toml").unlink()
    code, line = ask("run", "noise=1")
    assert "create one with: sierra init" in line
    assert code == 3


def test_read_only_commands_fail_with_code_3_before_the_first_run(ask: Ask) -> None:
    for words in (["ls"], ["show", "abcd"], ["sql", "SHOW TABLES"], ["figures"]):
        code, line = ask(*words)
        assert "nothing has been run here yet" in line
        assert code == 3


def test_file_in_place_of_the_store_folder_is_reported(project: Path) -> None:
    (project / ".sierra").write_text("")
    ended = quick(project, "run", "noise=1")
    assert ended.returncode == 3
    assert ended.stderr.count("\n") == 1
    assert "is a file, but the store must be a folder with this path" in ended.stderr


def test_zero_slots_are_refused(ask: Ask) -> None:
    assert ask("run", "noise=1", "-j", "0") == (2, "sierra: cannot execute 0 runs at a time; use 1 or more\n")


@pytest.mark.integration
def test_failed_run_is_reported_and_gives_exit_code_1(tmp_path: Path) -> None:
    simulator = 'import sys\nprint("no wheels")\nsys.exit("fell over" if \'count="2"\' in open(sys.argv[1]).read() else 0)\n'
    folder = make(tmp_path / "p", simulator=simulator)
    ended = quick(folder, "run", "population_size=1,2", "--runs", "1", "--no-figures")
    assert ended.returncode == 1
    assert "2 executed, 0 reused, 1 failed" in ended.stdout
    assert "fell over" in ended.stdout
    assert "population_size=2" in ended.stdout


FILLS_A_SMALL_DISK = """
import os
open("swarm.csv", "w").write("tick,x\\n0,1\\n")
disk = os.statvfs(".")
with open("b", "wb", buffering=0) as file:
    while disk.f_blocks * disk.f_frsize < 2_000_000:
        file.write(bytes(4096))
"""


@pytest.mark.integration
def test_full_disk_stops_the_batch_which_completes_once_there_is_space(
    tmp_path: Path, disk: Callable[[Path, str], Path]
) -> None:
    folder = make(disk(tmp_path / "small", "1m"), simulator=FILLS_A_SMALL_DISK)
    ended = sierra(folder, "run", "population_size.Log4", "--no-figures", "-j", "1")
    assert ended.returncode == 3
    assert ended.stderr.count("\n") == 1
    assert "No space left on device" in ended.stderr
    disk(folder, "30m")
    assert sierra(folder, "run", "population_size.Log4", "--no-figures").returncode == 0
    counted = sierra(folder, "sql", "SELECT count(*) runs, count(DISTINCT run) FROM executions", "-f", "csv")
    assert counted.stdout.splitlines()[1] == "6,6"


NAMES = ["a'; echo foo", 'quo"ted $(id)', "new\nline", "ünï 名"]


@pytest.mark.integration
@pytest.mark.parametrize("name", NAMES)
def test_file_names_may_contain_any_character(tmp_path: Path, name: str) -> None:
    folder = make(tmp_path / f"{name} {{seed}}", simulator="")
    (folder / f"{name}.xml").write_text(TEMPLATE)
    (folder / f"{name}.py").write_text(f"open({name + '.csv'!r}, 'w').write('tick,{name.encode().hex()}\\n0,1\\n1,2\\n')")
    quoted = name.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
    (folder / "sierra.toml").write_text(
        f'template = "{quoted}.xml"\ncommand = ["python3", "{quoted}.py", "{{input}}"]\n'
        f'[variables]\nx = "//noise"\n[outputs.out]\nfile = "{quoted}.csv"\n'
    )
    ended = quick(folder, "run", "x=1", "--runs", "1", "--no-figures")
    assert ended.stderr == ""
    assert ended.returncode == 0
    assert quick(folder, "sql", "SELECT count(*) n FROM out", "-f", "csv").stdout == "n\n2\n"

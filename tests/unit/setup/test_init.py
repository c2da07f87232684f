"""`sierra init` detects what it can in a folder, asks for the rest, and the command that it suggests gives a plot."""

from __future__ import annotations

import json
import os
import pty
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.projects import SIMULATOR, TEMPLATE, make, quick, start
from tests.waiting import PATIENCE_S

SHELL = '#!/bin/sh\nprintf "t,x\\n0,1\\n1,3\\n" > out.csv\n'


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with a simulator in Python and its template, without files of SIERRA."""
    (make(tmp_path / "p") / "sierra.toml").unlink()
    return tmp_path / "p"


def written(folder: Path) -> dict[str, Any]:
    return tomllib.loads((folder / "sierra.toml").read_text())


def effective(folder: Path) -> list[str]:
    return [line for line in (folder / "sierra.toml").read_text().splitlines() if line and not line.startswith("#")]


def answering(folder: Path, *answers: str, words: tuple[str, ...] = ("init",)) -> tuple[int, str]:
    """Run the command on a terminal, type answers and the end of input; return the exit code and the output."""
    ours, theirs = pty.openpty()
    said = b""
    with start(folder, *words, stdin=theirs, stdout=theirs, stderr=theirs) as asking:
        os.close(theirs)
        os.write(ours, "".join(f"{answer}\n" for answer in answers).encode() + b"\x04")
        try:
            while part := os.read(ours, 65536):
                said += part
        except OSError:  # Linux reports this when the other end is closed
            pass
        asking.wait(PATIENCE_S)
    os.close(ours)
    return asking.returncode, said.decode().replace("\r", "")


# Detection


def test_one_simulator_and_one_template_are_detected(folder: Path) -> None:
    ended = quick(folder, "init", "--no-try")
    assert ended.returncode == 0
    assert written(folder)["command"] == "python3 sim.py {input}"
    assert written(folder)["seed"] == "//random/@seed"
    assert written(folder)["variables"]["population_size"] == "//swarm/@count"
    assert len(effective(folder)) <= 10


@pytest.mark.integration
def test_the_suggested_command_gives_a_plot_from_any_folder_of_the_project(folder: Path) -> None:
    said = json.loads(quick(folder, "init", "--json").stdout)["next"]
    assert said == "sierra run population_size.Log8 -n"
    (folder / "deep" / "er").mkdir(parents=True)
    ended = quick(folder / "deep" / "er", *said.split()[1:-1], "--runs", "2", "--json")
    assert ended.returncode == 0
    assert any(figure.endswith(".png") for figure in json.loads(ended.stdout)["figures"])


@pytest.mark.integration
def test_init_loads_no_heavy_library(folder: Path) -> None:
    program = (
        "import sys; from pathlib import Path; from sierra.setup.init import answers, wizard;"
        "wizard.find_out(Path(), answers.Options());"
        "print({'duckdb', 'pandas', 'pyarrow', 'matplotlib', 'numpy', 'fabric'} & sys.modules.keys())"
    )
    ended = subprocess.run([sys.executable, "-c", program], cwd=folder, capture_output=True, text=True, check=True)
    assert ended.stdout == "set()\n"


def test_the_only_script_that_can_be_started_is_chosen_as_the_simulator(folder: Path) -> None:
    (folder / "arms.py").write_text("LENGTH = 3\n")
    assert quick(folder, "init", "--no-try").returncode == 0
    assert written(folder)["command"] == "python3 sim.py {input}"


@pytest.mark.nightly
@pytest.mark.parametrize(("name", "command"), [("run.sh", "./run.sh {input}"), ("build/a sim", "'./build/a sim' {input}")])
def test_a_program_is_found_in_the_folder_and_in_build_folders(tmp_path: Path, name: str, command: str) -> None:
    program = tmp_path / name
    program.parent.mkdir(exist_ok=True)
    program.write_text(SHELL)
    program.chmod(0o755)
    (tmp_path / "notes.txt").write_text("executable, as all is on some disks")
    (tmp_path / "notes.txt").chmod(0o755)
    (tmp_path / "in.xml").write_text('<swarm count="3" seed="0"/>')
    assert quick(tmp_path, "init", "-y", "--no-try").returncode == 0
    assert written(tmp_path)["command"] == command
    assert quick(tmp_path, "run", "population_size.Log2", "--runs", "1", "--no-figures").returncode == 0


@pytest.mark.nightly
def test_names_may_contain_blanks_and_quotation_marks(tmp_path: Path) -> None:
    folder = tmp_path / "a 'folder'"
    folder.mkdir()
    (folder / 'it\'s "it".py').write_text(SIMULATOR)
    (folder / 'it\'s "it".xml').write_text(TEMPLATE)
    said = quick(tmp_path, "init", "-y", folder.name).stdout
    assert """cd 'a '"'"'folder'"'"'' && sierra run population_size.Log8 -n""" in said
    assert quick(folder, "run", "population_size.Log2", "--runs", "1", "--no-figures").returncode == 0


def test_a_template_with_namespaces_gets_paths_with_prefixes(folder: Path) -> None:
    (folder / "arena.xml").write_text('<a xmlns="urn:a" xmlns:q="urn:q"><q:random q:seed="4"/><robots number="5"/></a>')
    assert quick(folder, "init", "-y", "--no-try").returncode == 0
    assert written(folder)["seed"] == "//q:random/@q:seed"
    assert written(folder)["variables"] == {"population_size": "//_:robots/@number"}


def test_arguments_of_a_launch_file_are_found_by_name(folder: Path) -> None:
    (folder / "arena.xml").unlink()
    (folder / "package.xml").write_text("<package/>")
    (folder / "launch").mkdir()
    (folder / "launch" / "swarm.launch").write_text(
        '<launch><arg name="seed" default="7"/><arg name="num_robots" default="2"/>'
        '<param name="speed" value="0.5"/><param name="noise" value="0.1"/></launch>'
    )
    assert quick(folder, "init", "-y", "--no-try").returncode == 0
    assert written(folder)["template"] == "launch/swarm.launch"
    assert written(folder)["seed"] == "//arg[@name='seed']/@default"
    assert written(folder)["variables"] == {"population_size": "//arg[@name='num_robots']/@default"}
    assert """# speed = "//param[@name='speed']/@value\"""" in (folder / "sierra.toml").read_text()


@pytest.mark.parametrize(
    ("value", "criterion"),
    [
        ("3", "x.Log8"),
        ("500", "x=250,500,1000"),
        ("0.25", "x=0.125,0.25,0.5"),
        ("-3", "x=-1.5,-3,-6"),
        ("0.0", "x=0:1:5"),
        ("0", "x=0,1,2"),
        ("false", "x=true,false"),
        ("open", "x=open"),
        ("1 2 3", "x=VALUE"),
    ],
)
def test_the_first_query_has_values_around_the_one_in_the_template(folder: Path, value: str, criterion: str) -> None:
    (folder / "arena.xml").write_text(f'<arena seed="0" x="{value}"/>')
    said = json.loads(quick(folder, "init", "--json", "--no-try", "--variable", "x=//arena/@x").stdout)["next"]
    assert said == f"sierra run {criterion} -n"
    if "VALUE" not in said:
        assert quick(folder, *said.split()[1:]).returncode == 0


def test_other_seeds_that_stay_fixed_are_reported(folder: Path) -> None:
    (folder / "arena.xml").write_text('<a count="2"><random seed="0"/><noise seed="5"/></a>')
    assert (
        "note: these seeds keep the template's value in all runs: //noise/@seed"
        in quick(folder, "init", "-y", "--no-try").stderr
    )


@pytest.mark.parametrize("seed", ["seed", "/seed", "//seed"])
def test_a_seed_that_is_written_in_another_way_is_the_same_seed(folder: Path, seed: str) -> None:
    (folder / "arena.json").write_text('{"n": 1, "seed": 1, "noise_seed": 3}')
    said = quick(folder, "init", "-y", "--no-try", "--template", "arena.json", "--seed", seed).stderr
    assert "note: these seeds keep the template's value in all runs: //noise_seed" in said


RATES = """\
import json, sys
run = json.load(open(sys.argv[1]))
open("result.csv", "w").write(f"reached,count\\n{VALUE},{run['n']}\\n")
"""


@pytest.mark.integration
@pytest.mark.parametrize(
    ("value", "rates", "same"), [("run['seed'] % 2", True, False), ("1", False, True), ("run['seed']", False, False)]
)
def test_another_seed_shows_rates_and_seeds_without_effect(folder: Path, value: str, rates: bool, same: bool) -> None:
    (folder / "arena.xml").unlink(missing_ok=True)
    (folder / "arena.json").write_text('{"n": 1, "seed": 1}')
    (folder / "sim.py").write_text(RATES.replace("VALUE", value))
    done = quick(folder, "init", "-y", "--template", "arena.json", "--command", "python3 sim.py {input}")
    assert done.returncode == 0, done.stderr
    assert ("this run has the same tables as the one with seed" in done.stderr) == same
    assert ('rates = ["reached"]' in (folder / "sierra.toml").read_text()) == rates
    assert quick(folder, "run", "population_size=1", "--runs", "2", "-n").returncode == 0


# Options


def test_invalid_options_are_reported_and_no_file_is_written(folder: Path) -> None:
    for words, said in (
        (["--template", "nope.xml"], "nope.xml: No such file"),
        (["--template", "sim.py"], "sim.py: its ending names no format"),
        (["--command", "python3 nope.py {input}"], "there is no nope.py"),
        (["--command", "python3 sim.py {inptu}"], "unknown placeholder {inptu}"),
        (["--command", "python3 'sim.py"], "No closing quotation"),
        (["--command", " "], "the command is empty"),
        (["--seed", "//sede"], "//sede matches nothing in arena.xml"),
        (["--variable", "x"], "give a variable as NAME=XPATH"),
        (["--variable", "//swarm/@count='1'"], "give a variable as NAME=XPATH"),
        (["--variable", "x=//nope"], "//nope matches nothing in arena.xml"),
        (["--variable", "x=//["], "is not an XPath"),
        (["--variable", "ü=//noise"], "is not a name of letters, digits and _"),
        (["--variable", "my speed=//noise"], "is not a name of letters, digits and _"),
        (["--variable", "my.speed=//noise"], "is not a name of letters, digits and _"),
        (["--variable", "experiment=//noise"], "is a column of the store"),
        (["--variable", "x=//noise", "--variable", "X=//swarm/@count"], "this name is used already"),
        (["--variable", "x=//random/@seed"], "gets the seed; vary something else"),
        (["--source", "../p"], "there is no '../p'"),
        (["--source", "srcc"], "there is no 'srcc'"),
    ):
        ended = quick(folder, "init", "-y", *words)
        assert said in ended.stderr
        assert (ended.returncode, ended.stdout, ended.stderr.count("\n")) == (3 if "nope.xml" in words else 2, "", 1)
        assert not (folder / "sierra.toml").exists()


@pytest.mark.integration
def test_options_replace_all_questions(folder: Path) -> None:
    words = (
        "--template",
        "arena.xml",
        "--command",
        "true {input}",
        "--variable",
        "x=//noise",
        "--variable",
        "y=//swarm/@count",
    )
    assert quick(folder, "init", "-y", *words, "--seed", "-", "--source", "sim.py").returncode == 0
    assert written(folder) == {
        "template": "arena.xml",
        "command": "true {input}",
        "runs": 10,
        "variables": {"x": "//noise", "y": "//swarm/@count"},
        "source": {"paths": ["sim.py"]},
    }


def test_a_template_may_be_named_relative_to_the_current_folder(folder: Path) -> None:
    for text in ("p/arena.xml", str(folder / "arena.xml")):
        assert quick(folder.parent, "init", "-y", "--no-try", "p", "--template", text).returncode == 0
        assert written(folder)["template"] == "arena.xml"
        (folder / "sierra.toml").unlink()


@pytest.mark.nightly
def test_project_files_named_by_the_command_are_found_from_the_folder_of_a_run(folder: Path) -> None:
    (folder / "conf" / "maps").mkdir(parents=True)
    (folder / "conf" / "a.ini").write_text("")
    (folder / "sim.py").write_text(
        SIMULATOR + "import os\nassert all(map(os.path.exists, [sys.argv[2].split('=')[1], sys.argv[3]]))\n"
    )
    command = f"python3 {folder / 'sim.py'} {{input}} --conf=conf/a.ini ./conf/maps"
    assert quick(folder, "init", "-y", "--command", command).returncode == 0
    assert written(folder)["command"] == "python3 {project}/sim.py {input} --conf={project}/conf/a.ini {project}/conf/maps"
    assert quick(folder / "conf", "run", "population_size.Log1", "--runs", "1", "--no-figures").returncode == 0


@pytest.mark.nightly
def test_a_module_of_the_project_is_found_from_the_folder_of_a_run(folder: Path) -> None:
    (folder / "src" / "swarm").mkdir(parents=True)
    (folder / "sim.py").rename(folder / "src" / "swarm" / "__main__.py")
    assert quick(folder, "init", "-y", "--command", "python3 -m swarm {input}").returncode == 0
    assert len(effective(folder)) <= 10
    assert quick(folder, "run", "population_size.Log1", "--runs", "1", "--no-figures").returncode == 0


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("./sim {input}", "the program './sim' does not exist yet"),
        ("./arena.xml {input}", "is not executable; add its interpreter to the command"),
        ("python3 sim.py {input} > out.csv", "no shell starts the command, so the program gets '>' as an argument"),
        ("python3 sim.py", "the command does not contain {input}"),
        ("python3 sim.py {input} maps", "'maps' is a folder here, but each run starts in its own folder"),
    ],
)
def test_a_suspicious_command_is_written_with_a_note(folder: Path, command: str, said: str) -> None:
    (folder / "maps").mkdir()
    ended = quick(folder, "init", "-y", "--command", command)
    assert ended.returncode == 0
    assert ended.stderr.startswith("note: ")
    assert said in ended.stderr
    assert ended.stderr.count("\n") == 1


@pytest.mark.nightly
def test_json_contains_the_written_settings_and_the_next_command(folder: Path) -> None:
    code, said = answering(folder, words=("init", "--json", "--no-try"))
    assert code == 0
    assert json.loads(said) == {
        "written": "sierra.toml",
        "template": "arena.xml",
        "platform": "command",
        "command": "python3 sim.py {input}",
        "seed": "//random/@seed",
        "variables": written(folder)["variables"],
        "source": [],
        "notes": [],
        "next": "sierra run population_size.Log8 -n",
    }


# Source


def test_the_whole_folder_is_source_by_default(folder: Path) -> None:
    (folder / "results").mkdir()
    assert quick(folder, "init", "-y", "--no-try").returncode == 0
    assert "source" not in written(folder)
    text = (folder / "sierra.toml").read_text()
    assert '# paths = ["sim.py"]  # not results\n' in text
    (folder / "sierra.toml").write_text(text.replace("# [source]", "[source]").replace("# paths", "paths"))
    assert written(folder)["source"] == {"paths": ["sim.py"]}
    assert quick(folder, "run", "population_size.Log2", "-n").returncode == 0


def test_notes_are_left_out_of_the_proposed_source_paths(folder: Path) -> None:
    for name in ("README.md", "notes.txt", "LICENSE", "poster.pdf", "CMakeLists.txt"):
        (folder / name).write_text("")
    assert quick(folder, "init", "-y", "--no-try").returncode == 0
    text = (folder / "sierra.toml").read_text()
    assert '# paths = ["CMakeLists.txt", "sim.py"]  # not LICENSE, README.md, notes.txt, poster.pdf\n' in text


@pytest.mark.nightly
def test_the_source_is_asked_for_if_the_folder_contains_results(folder: Path) -> None:
    (folder / "results").mkdir()
    code, _ = answering(folder, "", "", "", "", "nope", "2")
    assert code == 0
    assert written(folder)["source"] == {"paths": ["sim.py"]}


# Questions


@pytest.mark.integration
def test_an_empty_answer_accepts_the_detected_value(folder: Path) -> None:
    assert answering(folder, "", "", "", "")[0] == 0
    assert written(folder)["variables"] == {"population_size": "//swarm/@count"}


@pytest.mark.nightly
def test_several_templates_and_simulators_are_numbered_choices(folder: Path) -> None:
    (folder / "other.xml").write_text('<a count="3" seed="1"/>')
    (folder / "other.py").write_text("open('out.csv', 'w').write('t,x\\n0,1\\n')\n")
    code, said = answering(folder, "", "2", "python3 other.py {input}", "", "")
    assert code == 0
    assert "  1  arena.xml\n  2  other.xml\n" in said
    assert "  1  python3 other.py {input}\n  2  python3 sim.py {input}\n" in said
    assert written(folder)["template"] == "other.xml"
    assert written(folder)["command"] == "python3 other.py {input}"


@pytest.mark.nightly
def test_undetected_settings_are_asked_for(tmp_path: Path) -> None:
    (tmp_path / "arena.conf").write_text(TEMPLATE)
    assert answering(tmp_path, "arena.conf", "true {input}", "", "")[0] == 0
    assert written(tmp_path)["template"] == "arena.conf"


@pytest.mark.nightly
def test_an_invalid_answer_gives_the_error_of_the_option_and_the_question_again(folder: Path) -> None:
    wrong = {
        "--template": ["nope.xml", "sim.py"],
        "--command": ["python3 nope.py {input}", "python3 sim.py {inptu}", "'"],
        "--seed": ["//sede", "//["],
        "--variable": ["x", "x=//nope", "run=//noise", "x=//random/@seed"],
    }
    errors = [quick(folder, "init", "-y", option, text).stderr for option, texts in wrong.items() for text in texts]
    code, said = answering(folder, *(answer for texts in wrong.values() for answer in (*texts, "")))
    assert code == 0
    places = [said.index(f"  {error.removeprefix('sierra: ')}") for error in errors]
    assert places == sorted(set(places))
    assert written(folder)["variables"] == {"population_size": "//swarm/@count"}


@pytest.mark.nightly
def test_variables_are_asked_for_until_an_empty_answer_and_detected_ones_are_kept(folder: Path) -> None:
    assert answering(folder, "", "", "", "noise_level=//noise", "1", "")[0] == 0
    assert written(folder)["variables"] == {
        "population_size": "//swarm/@count",
        "noise_level": "//noise",
        "size": "//arena/@size",
    }


@pytest.mark.nightly
def test_a_detected_variable_may_be_removed_or_renamed(folder: Path) -> None:
    assert answering(folder, "", "", "", "-population_size", "noise=//noise", "")[0] == 0
    assert written(folder)["variables"] == {"noise": "//noise"}
    (folder / "sierra.toml").unlink()
    assert answering(folder, "", "", "-", "robots=//swarm/@count", "")[0] == 0
    assert written(folder)["variables"] == {"robots": "//swarm/@count"}
    assert "seed" not in written(folder)


@pytest.mark.integration
def test_no_file_is_written_without_an_answer(folder: Path) -> None:
    code, said = answering(folder, "", "")
    assert code == 130
    assert said.endswith("sierra: interrupted\n")
    assert not (folder / "sierra.toml").exists()


# Errors


def test_ambiguous_settings_without_a_terminal_name_their_option(tmp_path: Path) -> None:
    for files, said in (
        ([], "give the template with --template FILE"),
        (["a.xml", "b.xml"], "several files could be the template (a.xml, b.xml); give the template with --template FILE"),
        (["template.xml"], "no program found; give the command that starts it with --command"),
        (["Makefile"], "no program found; build it first, or give the command that starts it with --command"),
        (["c.py", "d.py"], "several files could be the simulator: c.py, d.py; give the command that starts it with --command"),
    ):
        for name in files:
            (tmp_path / name).write_text(TEMPLATE if name.endswith("xml") else "")
        for words in ([], ["-y"], ["--json"]):
            ended = quick(tmp_path, "init", *words)
            assert said in ended.stderr
            assert (ended.returncode, ended.stdout, ended.stderr.count("\n")) == (3, "", 1)


def test_a_project_file_is_never_overwritten(folder: Path) -> None:
    (folder / "sierra.toml").write_text("mine")
    ended = quick(folder, "init", "-y", "--no-try")
    assert ended.returncode == 2
    assert "exists already and is never overwritten; change it with an editor, or remove it first" in ended.stderr
    assert (folder / "sierra.toml").read_text() == "mine"
    (folder / "sierra.toml").unlink()
    (folder / "pyproject.toml").write_text('[tool.sierra]\ntemplate = "arena.xml"\n')
    assert "has [tool.sierra] already" in quick(folder, "init", "-y", "--no-try").stderr
    assert not (folder / "sierra.toml").exists()


def test_a_missing_or_read_only_folder_is_reported(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ended = quick(folder, "init", "nowhere")
    assert (ended.returncode, ended.stdout, ended.stderr.count("\n")) == (3, "", 1)
    right: Callable[..., bool] = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: not mode & os.W_OK and right(path, mode))  # root may write anywhere
    ended = quick(folder, "init", "-y", "--no-try")
    assert (ended.returncode, ended.stderr) == (
        3,
        "sierra: . is not writable; change its permissions, or use another folder\n",
    )


def test_a_project_inside_another_is_reported(folder: Path) -> None:
    (folder.parent / "sierra.toml").write_text("")
    assert "this folder was in the project of" in quick(folder, "init", "-y", "--no-try").stderr


# The example


def test_the_example_is_copied_into_new_folders_only(tmp_path: Path) -> None:
    ended = quick(tmp_path, "init", "--example", "swarm", "demo", "--json")
    assert json.loads(ended.stdout)["next"] == "cd demo && sierra run population_size.Log8"
    assert (tmp_path / "demo" / "sierra.toml").is_file()
    again = quick(tmp_path, "init", "--example", "swarm", "demo")
    assert (again.returncode, again.stderr.count("\n")) == (2, 1)
    assert "is not empty; use a new folder" in again.stderr
    assert "no example 'swram'" in quick(tmp_path, "init", "--example", "swram", "other").stderr
    assert not (tmp_path / "other").exists()

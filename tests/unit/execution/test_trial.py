"""`sierra try` executes one run as a batch does, says what it read and wrote, and records nothing."""

from __future__ import annotations

import json
import signal
from pathlib import Path
from typing import Any

import pytest

from tests.projects import CONFIG, SIMULATOR, commit, make, quick, run, sql, start
from tests.waiting import until

TALKING = 'import sys\nprint("first words")\nprint("a warning", file=sys.stderr)\n' + SIMULATOR
RUN = ".sierra/try/run"


@pytest.fixture
def project(tmp_path: Path) -> Path:
    return make(tmp_path / "project")


def tried(folder: Path, *words: str, code: int = 0) -> dict[str, Any]:
    done = quick(folder, "try", *words, "--json")
    assert done.returncode == code, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


@pytest.mark.integration
def test_a_run_is_tried_without_a_store_and_without_making_one(project: Path) -> None:
    found = tried(project)
    assert (found["status"], found["exit_code"], found["values"]) == ("ok", 0, {"montecarlo": 1})
    [file] = found["files"]
    assert (file["path"], file["table"], file["rows"]) == ("swarm.csv", "swarm", 5)
    assert file["columns"] == {"tick": "number", "coverage": "number"}
    assert sorted(path.name for path in (project / ".sierra").iterdir()) == [".gitignore", "try"]
    assert (project / RUN / "output" / "swarm.csv").stat().st_size == file["bytes"]
    assert "nothing has been run here yet" in quick(project, "ls").stderr


@pytest.mark.integration
def test_the_template_is_used_as_it_is_except_for_the_seed(project: Path) -> None:
    tried(project, "--seed", "4711")
    made = (project / RUN / "input.xml").read_text()
    assert made.replace('seed="4711"', 'seed="0"') == (project / "arena.xml").read_text()


@pytest.mark.integration
def test_a_try_leaves_the_store_as_it_was_and_never_counts(project: Path) -> None:
    summary, _ = run(project, "population_size=1")
    before = sql(project, "SELECT count(*) AS n FROM executions")
    found = tried(project, "population_size=2")
    assert sql(project, "SELECT count(*) AS n FROM executions") == before
    assert quick(project, "fsck").returncode == 0
    assert f'"{summary["batch"]}"' in quick(project, "ls", "--json").stdout
    again, _ = run(project, "population_size=2", "--runs", "1")
    assert (again["executed"], again["reused"]) == (1, 0)
    assert [row["run"] for row in sql(project, "SELECT run FROM runs WHERE population_size = 2")] == [found["run"]]


@pytest.mark.nightly
def test_the_chosen_experiment_and_seed_are_executed(project: Path) -> None:
    found = tried(project, "population_size.Log8", "--experiment", "3", "--seed", "7")
    assert (found["values"], found["seed"]) == ({"population_size": 8}, 7)
    made = (project / RUN / "input.xml").read_text()
    assert 'count="8"' in made
    assert '<random seed="7"/>' in made


def test_an_experiment_that_does_not_exist_is_an_error(project: Path) -> None:
    done = quick(project, "try", "population_size.Log8", "--experiment", "4")
    assert (done.returncode, done.stderr) == (2, "sierra: there is no experiment 4; this query has the experiments 0 to 3\n")
    done = quick(project, "try", "--experiment", "1")
    assert (done.returncode, done.stderr) == (2, "sierra: there is no experiment 1; this query has only experiment 0\n")


@pytest.mark.integration
def test_what_the_program_prints_is_printed(tmp_path: Path) -> None:
    project = make(tmp_path / "project", simulator=TALKING)
    done = quick(project, "try")
    assert done.stdout.startswith("first words\n--\nresult  ok\n")
    assert done.stderr == "a warning\n"
    assert "stdout: 12 bytes, stderr: 10 bytes" in done.stdout


@pytest.mark.nightly
def test_output_is_printed_while_the_run_executes(tmp_path: Path) -> None:
    waiting = "import pathlib, time\nprint('begun', flush=True)\nwhile not pathlib.Path('go').exists(): time.sleep(0.01)\n"
    project = make(tmp_path / "project", simulator=waiting)
    with start(project, "try") as trying:
        assert trying.stdout is not None
        assert trying.stdout.readline() == "begun\n"
        [output] = (project / ".sierra/try/store/work").glob("*/1/output")
        (output / "go").touch()
        assert "result  ok" in trying.stdout.read()
    assert trying.returncode == 0


@pytest.mark.integration
def test_control_characters_of_a_program_are_escaped(tmp_path: Path) -> None:
    project = make(tmp_path / "project", simulator="print('\\x1b[2Jgone\\r50 %\\r\\n', end='')\n")
    assert quick(project, "try").stdout.startswith("\\x1b[2Jgone\n50 %\n--\n")


@pytest.mark.integration
def test_a_run_that_a_batch_would_count_as_failed_exits_with_1(tmp_path: Path) -> None:
    project = make(tmp_path / "project", simulator=SIMULATOR + "sys.exit(3)\n")
    done = quick(project, "try")
    assert done.returncode == 1
    assert "result  failed: exit status 3\n" in done.stdout
    assert "no file was read as a table, because the run failed\n" in done.stdout
    required = CONFIG + '[outputs.poses]\nfile = "poses.csv"\n'
    project = make(tmp_path / "other", required)
    assert tried(project, code=1)["reason"].startswith("did not write 'poses.csv' (output 'poses')")


@pytest.mark.integration
def test_a_table_that_no_reader_reads_is_a_failure(tmp_path: Path) -> None:
    project = make(tmp_path / "project", simulator="open('swarm.csv', 'w').write('a,b\\n1,2\\n1,2,3\\n')\n")
    found = tried(project, code=1)
    assert found["status"] == "mismatch"
    assert "swarm.csv" in found["reason"]


@pytest.mark.nightly
def test_files_that_would_be_no_table_are_named_with_the_reason(tmp_path: Path) -> None:
    project = make(tmp_path / "project", simulator=SIMULATOR + "open('notes.log', 'w').write('x')\n")
    done = quick(project, "try")
    assert "not a table: notes.log: no reader takes .log files\n" in done.stdout


@pytest.mark.nightly
def test_tables_are_listed_before_other_files_in_try_and_in_init(tmp_path: Path) -> None:
    pictures = "for n in range(30): open(f'camera{n}.png', 'wb').write(b'x')\n"
    project = make(tmp_path / "project", simulator=SIMULATOR + pictures)
    assert [file["path"] for file in tried(project)["files"]][:2] == ["swarm.csv", "camera0.png"]
    (project / "sierra.toml").unlink()
    command = ("--template", "arena.xml", "--command", "python3 sim.py {input}")
    done = quick(project, "init", "-y", *command)
    assert done.returncode == 0, done.stderr
    assert "# A run wrote:\n#   swarm.csv: table swarm" in (project / "sierra.toml").read_text()


@pytest.mark.nightly
def test_tables_in_subfolders_are_named_with_the_lines_that_declare_them(tmp_path: Path) -> None:
    folders = "import os\nos.mkdir('floor')\nfor n in range(3): open(f'floor/f-{n}.csv', 'w').write('a\\n1\\n')\n"
    project = make(tmp_path / "project", simulator=SIMULATOR + folders)
    done = quick(project, "try")
    said = 'in a subfolder; declare [outputs.f] file = "floor/f-{tick}.csv"'
    assert f"not a table: floor/f-0.csv and 2 other files: {said}\n" in done.stdout


@pytest.mark.nightly
def test_files_that_are_written_elsewhere_are_named(tmp_path: Path) -> None:
    project = make(tmp_path / "project", simulator=SIMULATOR + "open('../poses.csv', 'w').write('x')\n")
    found = tried(project)
    assert found["elsewhere"] == ["{run}/poses.csv"]
    assert any("runs wrote files beside their input" in text for text in found["notes"])


@pytest.mark.nightly
def test_files_of_the_project_that_an_observed_run_read_are_named(tmp_path: Path, tracer: str) -> None:
    project = make(
        tmp_path / "project", simulator=SIMULATOR.replace("import sys", f"import sys\nopen('{tmp_path}/project/map')")
    )
    (project / "map").write_text("")
    assert tried(project)["used"]["files"] == ["map", "sim.py"]


@pytest.fixture
def tracer(require: Any) -> str:
    program: str = require("strace")
    return program


@pytest.mark.integration
def test_an_interrupted_try_ends_the_run_and_leaves_its_folder(tmp_path: Path) -> None:
    project = make(tmp_path / "project", simulator="import time\nopen('begun', 'w')\ntime.sleep(1000)\n")
    trying = start(project, "try")
    until(lambda: list((project / ".sierra/try/store/work").glob("*/1/output/begun")))
    trying.send_signal(signal.SIGINT)
    said, _ = trying.communicate()
    assert trying.returncode == 130
    assert "result  interrupted: was interrupted\n" in said
    assert (project / RUN / "output" / "begun").exists()
    assert not (project / ".sierra/try/store").exists()


@pytest.mark.nightly
def test_two_tries_at_the_same_time_do_not_disturb_each_other(tmp_path: Path) -> None:
    project = make(tmp_path / "project", simulator="import time\nopen('begun', 'w')\ntime.sleep(1000)\n")
    with start(project, "try") as first:
        until(lambda: list((project / ".sierra/try/store/work").glob("*/1/output/begun")))
        done = quick(project, "try")
        assert (done.returncode, done.stderr) == (
            3,
            "sierra: another sierra try is executing in this project; wait until it ends\n",
        )
        first.send_signal(signal.SIGINT)
        first.communicate()


@pytest.mark.nightly
def test_the_next_try_replaces_what_a_killed_one_has_left(tmp_path: Path) -> None:
    project = make(tmp_path / "project", simulator="import time\nopen('begun', 'w')\ntime.sleep(1000)\n")
    with start(project, "try") as first:
        until(lambda: list((project / ".sierra/try/store/work").glob("*/1/output/begun")))
        first.kill()
        first.communicate()
    (project / "sim.py").write_text(SIMULATOR)
    assert tried(project)["status"] == "ok"
    assert sorted(path.name for path in (project / ".sierra/try").iterdir()) == ["last.json", "lock", "mark", "run"]


def test_a_folder_that_was_not_made_by_a_try_is_left_alone(project: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "run").write_text("precious")
    (project / ".sierra").mkdir()
    (project / ".sierra" / "try").symlink_to(tmp_path / "mine")
    done = quick(project, "try")
    assert done.returncode == 3
    assert "was not made by sierra try; move it away" in done.stderr
    assert (tmp_path / "mine" / "run").read_text() == "precious"


def test_a_program_that_is_not_there_is_an_error_before_anything_executes(project: Path) -> None:
    (project / "sierra.toml").write_text(CONFIG.replace("python3 sim.py", "no-such-program"))
    done = quick(project, "try")
    assert done.returncode == 3
    assert "no-such-program" in done.stderr
    assert not (project / RUN).exists()


@pytest.mark.nightly
def test_the_commit_is_tried_if_changes_are_ignored(project: Path) -> None:
    (project / "sierra.toml").write_text('[source]\ndirty = "ignore"\n'.join((CONFIG, "")))
    commit(project)
    (project / "sim.py").write_text("raise SystemExit(7)\n")
    assert tried(project)["status"] == "ok"


@pytest.mark.nightly
def test_a_limit_ends_the_run(tmp_path: Path) -> None:
    simulator = "import time\nopen('begun', 'w')\ntime.sleep(1000)\n"
    project = make(tmp_path / "project", CONFIG + "[limits]\nwall = 1\n", simulator=simulator)
    found = tried(project, code=1)
    assert (found["status"], found["reason"]) == ("timeout", "ran longer than its limit ([limits] wall)")
    assert (project / RUN / "output" / "begun").exists()


@pytest.mark.nightly
def test_a_file_that_the_template_names_is_looked_for_where_runs_look(tmp_path: Path) -> None:
    simulator = "import sys\nopen(open(sys.argv[1]).read().split('map=\"')[1].split('\"')[0])\n"
    project = make(tmp_path / "project", simulator=simulator, template='<a map="maps/one.png"><random seed="0"/></a>')
    (project / "sierra.toml").write_text(CONFIG.partition("[variables]")[0])
    (project / "maps").mkdir()
    (project / "maps" / "one.png").write_text("")
    found = tried(project, code=1)
    assert any("maps/one.png" in text for text in found["notes"])

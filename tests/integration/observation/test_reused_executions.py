"""Observed executions count although the source or the programs differ, as long as no file that they used has changed."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from sierra.execution.observation import choose_runs
from tests import projects

SIMULATOR = """\
import os, sys
from pathlib import Path
here = Path(__file__).parent
factor = int((here / "factor.txt").read_text())
extra = here / "extra.txt"
factor += int(extra.read_text()) if extra.exists() else 0
maps = len(list((here / "maps").glob("*.map")))
seed = int(open(sys.argv[1]).read().split('<random seed="')[1].split('"')[0])
with open("swarm.csv", "w") as file:
    print("tick,value", *(f"{tick},{factor + 100 * maps + seed % 2}" for tick in range(3)), sep="\\n", file=file)
"""
QUERY = "population_size=1,2"


@pytest.fixture
def root(tmp_path: Path, require: Callable[..., str]) -> Path:
    """A project whose runs read two files of the project, all observed."""
    require("strace")
    folder = projects.make(
        tmp_path / "project", projects.CONFIG.replace("runs = 2", 'runs = 2\nobserve = "all"'), simulator=SIMULATOR
    )
    (folder / "factor.txt").write_text("2")
    (folder / "unused.py").write_text("1")
    (folder / "maps").mkdir()
    (folder / "maps" / "a.map").write_text("a")
    (folder / ".gitignore").write_text(".sierra\n")
    return projects.commit(folder)


def values(root: Path, batch: str) -> list[int]:
    """Return the values of the effective executions of a batch, without what their seeds add."""
    rows = projects.sql(
        root,
        "SELECT DISTINCT s.value - r.seed % 2 AS value FROM swarm s JOIN runs r USING (run) "
        f"JOIN effective e ON s.run = e.run AND s.execution = e.execution WHERE e.batch = '{batch}' ORDER BY 1",
    )
    return [row["value"] for row in rows]


def test_an_edit_of_a_file_that_no_run_read_executes_nothing(root: Path) -> None:
    first, _ = projects.run(root, QUERY)
    (root / "unused.py").write_text("2")
    second, said = projects.run(root, QUERY)
    assert second["batch"] != first["batch"]
    assert (second["executed"], second["reused"]) == (0, 4)
    assert "4 runs reused, because the executions did not use what has changed: {project}/unused.py" in said
    assert values(root, second["batch"]) == [102]
    again, said = projects.run(root, QUERY)
    assert (again["executed"], said) == (0, "")
    assert len(projects.sql(root, "SELECT * FROM sessions")) == 2
    assert projects.quick(root, "fsck").returncode == 0


@pytest.mark.parametrize("change", ["factor.txt", "extra.txt", "maps/b.map", "sim.py"])
def test_an_edit_of_anything_that_runs_used_executes_them_again(root: Path, change: str) -> None:
    projects.run(root, QUERY)
    content = SIMULATOR.replace("100 * maps", "200 * maps") if change == "sim.py" else "40"
    (root / change).write_text(content)
    summary, _ = projects.run(root, QUERY)
    assert (summary["executed"], summary["reused"]) == (4, 0)
    assert values(root, summary["batch"]) != [102]


@pytest.mark.nightly
def test_statistics_tables_and_files_of_reused_executions_are_those_of_the_new_run(root: Path) -> None:
    first, _ = projects.run(root, QUERY)
    (root / "unused.py").write_text("2")
    second, _ = projects.run(root, QUERY)
    rows = projects.sql(
        root,
        f"SELECT r.run, r.execution, e.run AS executed FROM runs r JOIN executions e USING (execution) "
        f"JOIN batch_runs m ON m.run = r.run WHERE m.batch = '{second['batch']}'",
    )
    assert len(rows) == 4
    assert all(row["run"] != row["executed"] for row in rows)
    assert json.loads(projects.quick(root, "show", rows[0]["run"], "--json").stdout)["reused_from"] == rows[0]["executed"]
    assert "swarm.csv" in projects.quick(root, "files", rows[0]["run"]).stdout
    before, now = (
        json.loads(projects.quick(root, "stats", "swarm", "value", "--batch", one["batch"], "--format", "json").stdout)
        for one in (first, second)
    )
    assert before == now
    assert projects.quick(root, "replay", second["batch"][:10]).returncode == 0
    assert "did not use what differs: {project}/unused.py" in projects.quick(root, "why", second["batch"][:10]).stdout


@pytest.mark.nightly
def test_removing_the_first_batch_keeps_what_the_second_reuses(root: Path) -> None:
    first, _ = projects.run(root, QUERY)
    (root / "unused.py").write_text("2")
    second, _ = projects.run(root, QUERY)
    done = projects.quick(root, "rm", "--yes", first["batch"][:10])
    assert done.returncode == 0, done.stderr
    assert "which also belong to batch" in done.stdout + done.stderr
    assert projects.quick(root, "gc", "--yes").returncode == 0
    assert projects.quick(root, "fsck").returncode == 0
    assert values(root, second["batch"]) == [102]
    execution = projects.sql(root, "SELECT execution FROM executions LIMIT 1")[0]["execution"]
    for words in (("show",), ("files",), ("why",)):
        assert projects.quick(root, *words, execution).returncode == 0
    assert projects.run(root, QUERY)[0]["executed"] == 0


@pytest.mark.nightly
def test_removing_an_execution_executes_each_run_that_reused_it_again(root: Path) -> None:
    projects.run(root, QUERY)
    (root / "unused.py").write_text("2")
    second, _ = projects.run(root, QUERY)
    [row] = projects.sql(root, f"SELECT execution FROM effective WHERE batch = '{second['batch']}' ORDER BY 1 LIMIT 1")
    done = projects.quick(root, "rm", "--yes", row["execution"])
    assert "also belong to batch" in done.stdout + done.stderr
    assert projects.run(root, QUERY)[0]["executed"] == 1
    assert projects.quick(root, "fsck").returncode == 0


@pytest.mark.nightly
def test_runs_that_were_not_observed_are_executed_again_for_another_source(root: Path) -> None:
    config = root / "sierra.toml"
    config.write_text(config.read_text().replace('observe = "all"', 'observe = "first"'))
    projects.run(root, QUERY)
    (root / "unused.py").write_text("2")
    summary, _ = projects.run(root, QUERY)
    assert (summary["executed"], summary["reused"]) == (2, 2)


@pytest.mark.nightly
def test_other_rules_evaluate_only_executions_of_the_same_run(root: Path) -> None:
    projects.run(root, QUERY)
    (root / "unused.py").write_text("2")
    config = root / "sierra.toml"
    config.write_text(config.read_text() + '[outputs.swarm]\nfile = "swarm.csv"\nmismatch = "ragged"\n')
    assert projects.run(root, QUERY)[0]["executed"] == 4


@pytest.fixture
def venv(root: Path) -> Path:
    """A virtual environment that the runs use, with a way to install an empty package."""
    folder = root.parent / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True)
    config = root / "sierra.toml"
    config.write_text(config.read_text().replace("python3 sim.py", f"{folder}/bin/python3 sim.py"))
    return folder


def install(venv: Path, name: str) -> None:
    [packages] = venv.glob("lib/python3*/site-packages")
    (packages / name).mkdir()
    (packages / name / "__init__.py").write_text("")
    information = packages / f"{name}-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (information / "RECORD").write_text(
        f"{name}/__init__.py,,\n{name}-1.0.dist-info/METADATA,,\n{name}-1.0.dist-info/RECORD,,\n"
    )


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("observe", "executed"),
    [('observe = "all"', 0), ('observe = "first"\nobserve_budget = 0', 0), ('observe = "first"', 2)],
    ids=["all", "first of each experiment", "first"],
)
def test_an_unused_distribution_executes_only_experiments_that_were_not_observed(
    root: Path, venv: Path, observe: str, executed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run that was not observed counts because of one of its experiment: another experiment may import other packages."""
    config = root / "sierra.toml"
    config.write_text(config.read_text().replace('observe = "all"', observe))
    if executed:
        monkeypatch.setattr(choose_runs, "ALWAYS", 0)
        monkeypatch.setattr(choose_runs, "PART", 0.0)
    assert projects.run(root, QUERY, "--jobs", "1")[0]["executed"] == 4
    install(venv, "unused_package")
    summary, said = projects.run(root, QUERY)
    assert (summary["executed"], summary["reused"]) == (executed, 4 - executed)
    assert "installed distributions" in said


@pytest.mark.parametrize("how", ["import", "startup", "removed"])
def test_a_distribution_that_runs_could_use_executes_them_again(root: Path, venv: Path, how: str) -> None:
    if how == "import":
        simulator = "try:\n    import optional_package\nexcept ImportError:\n    pass\n" + SIMULATOR
        (root / "sim.py").write_text(simulator)
    if how == "removed":
        install(venv, "optional_package")
        (root / "sim.py").write_text("import optional_package\n" + SIMULATOR.replace("100 * maps", "100 * maps"))
    projects.run(root, QUERY)
    [packages] = venv.glob("lib/python3*/site-packages")
    if how == "removed":
        (packages / "optional_package" / "__init__.py").write_text("x = 1\n")
    else:
        install(venv, "optional_package")
    if how == "startup":
        (packages / "optional_package.pth").write_text("import sys\n")
    assert projects.run(root, QUERY)[0]["executed"] == 4


@pytest.mark.nightly
def test_another_program_on_the_search_path_executes_again(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tool = shutil.which("cat")
    assert tool is not None
    folders = [root.parent / name for name in ("one", "two")]
    for folder, word in zip(folders, ("1", "2"), strict=True):
        folder.mkdir()
        (folder / "solver").write_text(f"#!/bin/sh\nprintf 'tick,value\\n0,{word}\\n' > swarm.csv\n")
        (folder / "solver").chmod(0o755)
    (root / "run.sh").write_text("exec solver\n")
    config = root / "sierra.toml"
    config.write_text(config.read_text().replace("python3 sim.py {input}", "sh run.sh {input}"))
    path = f"{Path(tool).parent}:/usr/bin:/bin"
    monkeypatch.setenv("PATH", f"{folders[0]}:{path}")
    projects.run(root, QUERY)
    monkeypatch.setenv("PATH", f"{folders[1]}:{folders[0]}:{path}")
    summary, said = projects.run(root, QUERY)
    assert (summary["executed"], "have changed" in said) == (4, True)
    assert projects.sql(root, "SELECT DISTINCT value FROM swarm") == [{"value": 2}]


@pytest.mark.nightly
def test_a_program_that_may_be_executed_now_executes_again(root: Path) -> None:
    """The search went on behind a file without the right to be executed."""
    folders = [root.parent / name for name in ("one", "two")]
    for folder, word in zip(folders, ("1", "2"), strict=True):
        folder.mkdir()
        (folder / "solver").write_text(f"#!/bin/sh\nprintf 'tick,value\\n0,{word}\\n' > swarm.csv\n")
    (folders[1] / "solver").chmod(0o755)
    (root / "run.py").write_text(
        f"import os\nos.environ['PATH'] = '{folders[0]}:{folders[1]}:' + os.environ['PATH']\nos.execvp('solver', ['solver'])\n"
    )
    config = root / "sierra.toml"
    config.write_text(config.read_text().replace("python3 sim.py {input}", "python3 run.py {input}"))
    projects.run(root, QUERY)
    assert projects.run(root, QUERY)[0]["executed"] == 0
    (folders[0] / "solver").chmod(0o755)
    assert projects.run(root, QUERY)[0]["executed"] == 4
    assert projects.sql(root, "SELECT DISTINCT value FROM swarm") == [{"value": 1}]


@pytest.mark.nightly
def test_diff_names_the_files_that_executions_used(root: Path) -> None:
    """Files of the source are left out, because the difference of the sources has them."""
    (root / ".gitignore").write_text(".sierra\nfactor.txt\nextra.txt\n")
    subprocess.run(["git", "rm", "-q", "--cached", "factor.txt"], cwd=root, check=True)
    projects.commit(root, "ignore")
    first, _ = projects.run(root, QUERY)
    (root / "factor.txt").write_text("3")
    (root / "extra.txt").write_text("4")
    (root / "unused.py").write_text("2")
    second, _ = projects.run(root, QUERY)
    said = projects.quick(root, "diff", first["batch"][:10], second["batch"][:10]).stdout
    expected = "files that executions used: other content: {project}/factor.txt; only used after: {project}/extra.txt"
    assert expected in said


@pytest.mark.nightly
@pytest.mark.parametrize(("change", "expected"), [("unused.py", (0, 0)), ("factor.txt", (1, 1))])
def test_an_edit_meanwhile_fails_only_executions_that_use_the_file(root: Path, change: str, expected: tuple[int, int]) -> None:
    """The second run waits until the file was edited; the first one had ended before. They talk through files in a cache."""
    begun, waiting, go = (Path(os.environ["XDG_CACHE_HOME"], "fontconfig", change, name) for name in ("begun", "waiting", "go"))
    begun.parent.mkdir(parents=True, exist_ok=True)
    (root / "sim.py").write_text(
        "import os, sys, time\n"
        f"if os.path.exists({str(begun)!r}):\n"
        f"    open({str(waiting)!r}, 'w').close()\n"
        f"    while not os.path.exists({str(go)!r}): time.sleep(0.01)\n"
        f"open({str(begun)!r}, 'w').close()\n" + SIMULATOR
    )
    asking = projects.start(root, "run", "population_size=1", "--no-figures", "-j", "1")
    while not waiting.exists():
        assert asking.poll() is None
        time.sleep(0.01)
    (root / change).write_text("2 ")
    go.touch()
    said, _ = asking.communicate(timeout=100)
    failed = projects.sql(root, "SELECT count(*) AS failed FROM executions WHERE reason LIKE 'code or programs have changed%'")
    assert (asking.returncode, failed[0]["failed"] > 0) == (expected[0], bool(expected[1])), said


LISTING = """\
import os, sys, time
while not os.path.exists(sys.argv[2] + "/go"):
    time.sleep(0.01)
names = len([name for name in os.listdir(sys.argv[2]) if name != "__pycache__"])
with open("swarm.csv", "w") as file:
    print("tick,value", f"0,{names}", sep="\\n", file=file)
"""
IMPORTING = """\
import pathlib, sys
import sierra
from sierra.execution.observer import Observer
class Late(Observer):
    def progress(self, progress):
        if "late" not in sys.modules:
            import late
            pathlib.Path(late.__file__).with_name("go").touch()
sys.path.insert(0, sys.argv[1])
print(sierra.open(".").run("population_size=1", runs=1, figures=False, observer=Late()).executed)
"""


def test_modules_that_sierra_imports_meanwhile_do_not_change_a_folder_that_a_run_lists(
    tmp_path: Path, require: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    require("strace")
    monkeypatch.delenv("PYTHONDONTWRITEBYTECODE", raising=False)
    library = tmp_path / "library"
    library.mkdir()
    (library / "late.py").write_text("")
    config = projects.CONFIG.replace("sim.py {input}", f"sim.py {{input}} {library}")
    root = projects.make(tmp_path / "project", config, simulator=LISTING)
    called = subprocess.run(
        [sys.executable, "-c", IMPORTING, library], cwd=root, capture_output=True, text=True, check=False, timeout=100
    )
    assert (called.returncode, called.stdout) == (0, "1\n"), called.stderr
    assert not (library / "__pycache__").exists()

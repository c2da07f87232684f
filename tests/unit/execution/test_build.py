"""[build]: products are made from the source before runs use them, recorded, and made again by a replay."""

from __future__ import annotations

import json
import os
import platform
import shutil
import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest

import sierra
from sierra.execution import build_products
from sierra.execution.build.recipe import build_id
from sierra.model import RunSpec
from sierra.util.processors import here
from sierra.worker.processes import stat_of
from tests import projects
from tests.waiting import until

SIMULATOR = """\
#!/bin/sh
count=$(sed -n 's/.*count="\\([0-9]*\\)".*/\\1/p' "$1")
echo tick,coverage > swarm.csv
echo 0,$count >> swarm.csv
"""
COMPILER = """\
mkdir -p build
{ cat sim.sh; echo "# $FLAVOUR"; } > build/sim
chmod +x build/sim
"""
CONFIG = """\
template = "arena.xml"
command = "build/sim {input} {seed}"
runs = 1
[variables]
population_size = "//swarm/@count"
[build]
command = "sh compile.sh"
produces = ["build/sim"]
"""
HERE = here()
QUERY = ("run", "population_size=1,2", "--no-figures")


def make(folder: Path, config: str = CONFIG, *, compiler: str = COMPILER, ignored: str = "build/\n") -> Path:
    """Write a project in git whose simulator must be built by a script."""
    folder.mkdir(parents=True)
    files = {"sim.sh": SIMULATOR, "compile.sh": compiler, "arena.xml": projects.TEMPLATE, "sierra.toml": config}
    for name, text in {**files, ".gitignore": ignored}.items():
        (folder / name).write_text(text)
    return projects.commit(folder)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return make(tmp_path / "project")


def run(root: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run the query; it must succeed."""
    done = projects.quick(root, *(words or QUERY))
    assert done.returncode == 0, done.stderr
    return done


def failing(root: Path, *words: str) -> str:
    """Run the query, which must fail in one line; return that line."""
    done = projects.quick(root, *(words or QUERY))
    assert done.returncode == 1, (done.stdout, done.stderr)
    [line] = [line for line in done.stderr.splitlines() if not line.startswith("note: ")]
    return line


@pytest.mark.integration
def test_a_build_has_a_short_tmpdir_that_is_removed_with_it(tmp_path: Path) -> None:
    root = make(tmp_path / ("x" * 120), compiler=f'{COMPILER}echo "$TMPDIR" > ../tmpdir; touch "$TMPDIR/left"\n')
    run(root)
    folder = Path((tmp_path / "tmpdir").read_text().strip())
    assert len(str(folder)) <= 75
    assert not folder.exists()


def rows(root: Path, statement: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = sierra.open(root).sql(statement).to_pylist()
    return found


def built(root: Path) -> int:
    """Return how often products were built for runs."""
    return len(rows(root, "SELECT 1 FROM builds WHERE purpose = 'run'"))


def has_ended(pid: int) -> bool:
    """Check whether a process is gone, or a zombie that nobody has waited for yet."""
    return stat_of(pid)[:1] in ([], [b"Z"])


def edit(root: Path) -> None:
    """Change the simulator's code."""
    (root / "sim.sh").write_text(SIMULATOR.replace("echo 0,$count", "echo 0,$((count + 1))"))


@pytest.mark.integration
def test_a_product_is_built_before_runs_use_it_and_recorded(root: Path) -> None:
    done = run(root)
    assert "building, because nothing has been built yet" in done.stderr
    [build] = rows(root, "SELECT b.*, s.build AS used FROM builds b, sessions s")
    assert build["used"] == build["build"]
    assert (build["command"], build["exit_code"], build["produces"]) == (["sh", "compile.sh"], 0, ["build/sim"])
    [product] = rows(root, "FROM build_products")
    assert (product["name"], product["sha256"]) == ("build/sim", build_products.hashed(root, ["build/sim"])[0].sha256)
    assert rows(root, "SELECT name FROM programs WHERE name LIKE '{project}%'") == [{"name": "{project}/build/sim"}]


@pytest.mark.nightly
@pytest.mark.integration
def test_a_product_that_is_up_to_date_is_not_built_again(root: Path) -> None:
    run(root)
    os.utime(root / "sim.sh", (1, 1))
    os.utime(root / "build/sim", (1, 1))
    assert "building" not in run(root).stderr
    run(root, "run", "population_size=3", "--no-figures")
    assert built(root) == 1


@pytest.mark.integration
def test_changed_source_is_built_whatever_its_times_say(root: Path) -> None:
    run(root)
    before = (root / "sim.sh").stat()
    edit(root)
    os.utime(root / "sim.sh", ns=(before.st_atime_ns, before.st_mtime_ns))
    assert "building, because the source has changed (sim.sh)" in run(root).stderr
    assert rows(root, "SELECT coverage FROM swarm JOIN points USING (run) ORDER BY ALL")[-1] == {"coverage": 3}


@pytest.mark.nightly
@pytest.mark.integration
def test_a_source_that_was_built_before_is_built_again_if_the_product_is_another(root: Path) -> None:
    run(root)
    edit(root)
    run(root)
    (root / "sim.sh").write_text(SIMULATOR)
    done = run(root)
    assert "building, because build/sim is not the file that was built" in done.stderr
    assert "0 executed, 2 reused" in done.stdout


@pytest.mark.integration
@pytest.mark.parametrize("how", ["changed", "removed"])
def test_a_changed_or_removed_product_is_built_again_even_if_the_tool_finds_it_up_to_date(tmp_path: Path, how: str) -> None:
    root = make(tmp_path / "project", compiler=f"test build/sim -nt sim.sh && exit\n{COMPILER}")
    run(root)
    if how == "changed":
        with (root / "build/sim").open("a") as file:
            file.write("echo 0,99 >> swarm.csv\n")
    else:
        (root / "build/sim").unlink()
    reason = {"changed": "build/sim is not the file that was built", "removed": "build/sim is missing"}[how]
    done = run(root)
    assert f"building, because {reason}" in done.stderr
    assert "0 executed, 2 reused" in done.stdout
    assert (root / "build/sim").read_text() == f"{SIMULATOR}# \n"


@pytest.mark.nightly
@pytest.mark.integration
def test_a_changed_product_that_the_tool_copies_from_elsewhere_is_never_taken_for_built(tmp_path: Path) -> None:
    compiler = f"test -e build/copy || {{ {COMPILER}ln build/sim build/copy; }}\nln -f build/copy build/sim\n"
    root = make(tmp_path / "project", compiler=compiler)
    run(root)
    with (root / "build/sim").open("a") as file:
        file.write("echo 0,99 >> swarm.csv\n")
    assert "the command left build/sim as it was, although it is not the file that was built" in failing(root)
    assert "let the command build everything" in failing(root)
    (root / "build/copy").unlink()
    assert "0 executed, 2 reused" in run(root).stdout


@pytest.mark.nightly
@pytest.mark.integration
def test_the_probe_for_determinism_builds_in_its_replay(root: Path) -> None:
    (root / "sierra.toml").write_text(CONFIG + "[determinism]\nprobe = true\n")
    assert "both executions wrote the same bytes" in run(root).stderr
    assert rows(root, "SELECT purpose FROM builds ORDER BY lamport") == [{"purpose": "run"}, {"purpose": "replay"}]


@pytest.mark.nightly
@pytest.mark.integration
def test_missing_runs_of_a_recorded_batch_refer_to_its_build(root: Path) -> None:
    run(root)
    [run_id] = [row["run"] for row in rows(root, "SELECT min(run) AS run FROM executions")]
    [batch] = rows(root, "FROM batches")
    run(root, "rm", run_id, "--yes")
    assert "1 executed, 1 reused" in run(root, "run", batch["batch"], "--no-figures").stdout
    assert len(rows(root, "SELECT DISTINCT build FROM sessions")) == 1


@pytest.mark.nightly
@pytest.mark.integration
def test_another_command_flag_or_compiler_builds_again_and_executes_with_the_other_product(root: Path) -> None:
    run(root)
    (root / "sierra.toml").write_text(CONFIG.replace("sh compile.sh", "env FLAVOUR=sweet sh compile.sh"))
    done = run(root)
    assert "building, because [build] has changed" in done.stderr
    assert "2 executed" in done.stdout
    (root / "sierra.toml").write_text(CONFIG + '[environment]\nset = { CFLAGS = "-O3" }\n')
    assert "declared variables have changed" in run(root).stderr
    assert rows(root, "SELECT flags FROM builds ORDER BY lamport DESC LIMIT 1") == [{"flags": '{"CFLAGS": "-O3"}'}]


@pytest.mark.nightly
def test_ids_do_not_depend_on_products(root: Path) -> None:
    preview = json.loads(run(root, *QUERY, "--dry-run", "--json").stdout)
    assert not (root / "build").exists()
    run(root)
    (root / "sierra.toml").write_text(CONFIG.replace("sh compile.sh", "env FLAVOUR=sweet sh compile.sh"))
    run(root)
    assert rows(root, "SELECT batch FROM batches") == [{"batch": preview["batch"]}]


def test_a_failed_build_ends_with_one_line_before_any_run(root: Path) -> None:
    (root / "compile.sh").write_text("echo compiling\necho 'sim.c:3: error: no such thing' >&2\necho stop\nexit 4\n")
    line = failing(root)
    assert "the build failed, so nothing was executed: exit status 4 of sh: sim.c:3: error: no such thing; log: " in line
    assert Path(line.rpartition("log: ")[2]).read_text() == "compiling\nsim.c:3: error: no such thing\nstop\n"
    assert rows(root, "SELECT exit_code, result FROM builds") == [{"exit_code": 4, "result": None}]
    assert rows(root, "FROM executions") == rows(root, "FROM build_products") == []
    assert "building, because the last build failed" in projects.quick(root, *QUERY).stderr


@pytest.mark.integration
def test_a_failed_build_leaves_the_older_product_which_no_run_uses(root: Path) -> None:
    run(root)
    edit(root)
    (root / "compile.sh").write_text("exit 1\n")
    failing(root)
    assert (root / "build/sim").read_text() == f"{SIMULATOR}# \n"
    assert len(rows(root, "FROM executions")) == 2


def test_a_pattern_that_matches_nothing_is_an_error(root: Path) -> None:
    (root / "sierra.toml").write_text(CONFIG.replace('"build/sim"', '"build/sim", "build/*.so"'))
    assert "it made no file that matches 'build/*.so' of produces" in failing(root)


@pytest.mark.nightly
@pytest.mark.integration
def test_a_try_builds_what_its_run_needs_and_a_batch_uses_it(root: Path) -> None:
    done = projects.quick(root, "try", "population_size=3")
    assert done.returncode == 0, done.stderr
    assert "result  ok\n" in done.stdout
    assert projects.sql(root, "SELECT (SELECT count(*) FROM builds) AS b, (SELECT count(*) FROM executions) AS e") == [
        {"b": 1, "e": 0}
    ]
    assert "building" not in run(root).stderr


@pytest.mark.nightly
@pytest.mark.integration
def test_an_interrupted_build_is_ended_and_leaves_the_older_product(tmp_path: Path) -> None:
    root = make(tmp_path / "project", ignored="build/\nbegun\n")
    run(root)
    edit(root)
    (root / "compile.sh").write_text("echo $$ > begun; sleep 1000\n")
    session = projects.start(root, *QUERY)
    until(lambda: (root / "begun").read_text().strip())
    session.send_signal(signal.SIGINT)
    session.communicate()
    assert session.returncode == 130
    assert has_ended(int((root / "begun").read_text()))
    assert (root / "build/sim").read_text() == f"{SIMULATOR}# \n"
    assert list((root / ".sierra/work").glob("[0-9a-f]*")) == []


def test_a_product_in_the_source_is_an_error_with_a_remedy(tmp_path: Path) -> None:
    root = make(tmp_path / "project", ignored="")
    assert "its product build/sim is part of the source" in failing(root)
    done = projects.quick(root, *QUERY)
    assert done.returncode == 2
    assert "build/sim would be part of the source, which products must not change; name the code in [source]" in done.stderr


@pytest.mark.nightly
@pytest.mark.integration
def test_outside_git_paths_of_the_source_must_leave_products_out(tmp_path: Path) -> None:
    root = make(tmp_path / "project")
    shutil.rmtree(root / ".git")
    assert "[source] paths" in failing(root)
    shutil.rmtree(root / "build")
    (root / "sierra.toml").write_text(CONFIG + '[source]\npaths = ["sim.sh", "compile.sh"]\n')
    run(root)
    assert "0 executed" in run(root).stdout


def test_a_build_that_changes_the_source_is_an_error(tmp_path: Path) -> None:
    root = make(tmp_path / "project", compiler=f"{COMPILER}touch notes.txt\n")
    assert "it changed the source (notes.txt)" in failing(root)


def test_a_file_that_matches_but_is_no_product_is_kept_and_named(tmp_path: Path) -> None:
    root = make(tmp_path / "project", CONFIG.replace('"build/sim"', '"build/*"'))
    (root / "build").mkdir()
    (root / "build/data").write_text("precious")
    assert "build/data matches produces, but the command did not make it" in failing(root)
    assert (root / "build/data").read_text() == "precious"


@pytest.mark.nightly
@pytest.mark.integration
def test_a_product_that_is_not_built_any_more_is_removed(tmp_path: Path) -> None:
    root = make(tmp_path / "project", CONFIG.replace('"build/sim"', '"build/*"'), compiler=f"{COMPILER}cp sim.sh build/old\n")
    run(root)
    (root / "compile.sh").write_text(COMPILER)
    run(root)
    assert [path.name for path in (root / "build").iterdir()] == ["sim"]


def test_a_command_whose_product_no_pattern_matches_is_an_error(root: Path) -> None:
    (root / "sierra.toml").write_text(CONFIG.replace('["build/sim"]', '["build/other"]'))
    (root / "compile.sh").write_text(f"{COMPILER}cp sim.sh build/other\n")
    assert "the command names 'build/sim', which the build makes; add it to [build] produces" in failing(root)


@pytest.mark.nightly
@pytest.mark.integration
def test_a_build_that_takes_too_long_is_ended_with_all_its_processes(root: Path) -> None:
    (root / "compile.sh").write_text("sleep 1000 & echo $! > build.pid; wait\n")
    (root / ".gitignore").write_text("build/\nbuild.pid\n")
    (root / "sierra.toml").write_text(CONFIG + "wall = 0.3\n")
    assert "it was ended after 0.3 s, the time limit in [build] wall" in failing(root)
    assert has_ended(int((root / "build.pid").read_text()))


@pytest.mark.nightly
@pytest.mark.integration
def test_the_build_has_the_declared_variables_and_no_others(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FLAVOUR", "of the caller")
    (root / "compile.sh").write_text(COMPILER.replace("$FLAVOUR", "$FLAVOUR $TASTE"))
    (root / "sierra.toml").write_text(CONFIG + '[environment]\nset = { TASTE = "declared" }\n')
    run(root)
    assert (root / "build/sim").read_text() == f"{SIMULATOR}#  declared\n"


@pytest.mark.nightly
@pytest.mark.integration
def test_the_build_is_executed_in_its_folder(root: Path) -> None:
    (root / "code").mkdir()
    (root / "code/compile.sh").write_text(f"cd ..\n{COMPILER}")
    (root / "sierra.toml").write_text(CONFIG.replace("sh compile.sh", "./compile.sh") + 'in = "code"\n')
    (root / "code/compile.sh").write_text(f"#!/bin/sh\ncd ..\n{COMPILER}")
    (root / "code/compile.sh").chmod(0o755)
    run(root)
    assert built(root) == 1


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ('command = "make {input}"', "[build] command: unknown placeholder {input}"),
        ('command = "nosuchcompiler"', "the program 'nosuchcompiler' was not found"),
        ('produces = ["../sim"]', "'../sim' should be a path within the project"),
        ('produces = [".sierra/sim"]', "'.sierra/sim' should be a path within the project"),
        ("produces = []", "should not be empty"),
        ('arch = "z80"', "'z80' should be a processor: x86_64, i686, aarch64"),
        ('arch = "arm64"', "'build/sim' needs {arch}, because each processor in arch has a product of its own"),
    ],
)
def test_a_mistake_in_the_table_is_named(root: Path, line: str, complaint: str) -> None:
    key = line.split(" = ")[0]
    head, _, build = CONFIG.partition("[build]\n")
    kept = "".join(f"{other}\n" for other in build.splitlines() if not other.startswith(key))
    (root / "sierra.toml").write_text(f"{head}[build]\n{kept}{line}\n")
    done = projects.quick(root, *QUERY)
    assert done.returncode in (2, 3)
    assert complaint in done.stderr
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.nightly
@pytest.mark.integration
def test_the_commit_alone_is_not_executed_with_products_of_other_files(root: Path) -> None:
    (root / "sierra.toml").write_text(CONFIG + '[source]\ndirty = "ignore"\n')
    run(root)
    edit(root)
    done = projects.quick(root, *QUERY)
    assert done.returncode == 2
    assert '[source] dirty = "ignore" executes the commit, but [build] builds the files on disk' in done.stderr


@pytest.mark.nightly
@pytest.mark.integration
def test_a_clean_commit_is_built_where_changes_are_refused(root: Path) -> None:
    (root / "sierra.toml").write_text(CONFIG + '[source]\ndirty = "refuse"\n')
    projects.commit(root, "refuse")
    run(root)
    assert built(root) == 1


@pytest.mark.nightly
def test_two_sessions_at_once_build_once(tmp_path: Path) -> None:
    root = make(
        tmp_path / "project",
        compiler=f"echo > begun; until test -e go; do sleep 0.02; done\n{COMPILER}",
        ignored="build/\nbegun\ngo\n",
    )
    first = projects.start(root, *QUERY)
    until((root / "begun").exists)
    second = projects.start(root, *QUERY)
    assert second.stderr is not None
    line = second.stderr.readline()
    (root / "go").touch()
    assert [(session.communicate(), session.returncode)[1] for session in (first, second)] == [0, 0]
    assert "another process builds the products; waiting for it" in line
    assert built(root) == 1
    assert len(rows(root, "FROM executions")) == 2


@pytest.mark.integration
def test_after_a_kill_the_next_session_builds_again(tmp_path: Path) -> None:
    root = make(tmp_path / "project", ignored="build/\nbegun\n")
    run(root)
    edit(root)
    (root / "compile.sh").write_text(f"echo $$ > begun; test -e build/sim || sleep 1000\n{COMPILER}")
    session = projects.start(root, *QUERY)
    until(lambda: (root / "begun").read_text().strip())
    compiler = int((root / "begun").read_text())
    os.kill(session.pid, signal.SIGKILL)
    session.communicate()
    assert not (root / "build/sim").exists()
    (root / "compile.sh").write_text(COMPILER)
    assert "building, because the source has changed" in run(root).stderr
    assert has_ended(compiler)
    assert run(root, "fsck").returncode == 0


@pytest.mark.integration
def test_a_replay_builds_from_the_recorded_source_in_a_fresh_clone(root: Path, tmp_path: Path) -> None:
    run(root)
    [batch] = rows(root, "FROM batches")
    clone = tmp_path / "clone"
    subprocess.run(["git", "clone", "-q", root, clone], check=True)
    shutil.copytree(root / ".sierra", clone / ".sierra")
    shutil.rmtree(root)
    done = run(clone, "replay", batch["batch"])
    assert "identical (2 runs: 2 identical; built from source: build/sim)" in done.stdout
    assert "differ" not in done.stderr
    assert not (clone / "build").exists()
    [build] = rows(clone, "FROM builds WHERE purpose = 'replay'")
    assert build["session"] == rows(clone, "FROM replays")[0]["replay"]


@pytest.mark.nightly
@pytest.mark.integration
def test_a_replay_uses_the_recorded_source_after_the_code_has_changed(root: Path) -> None:
    run(root)
    [batch] = rows(root, "FROM batches")
    edit(root)
    run(root)
    assert "identical (2 runs: 2 identical; built from source: build/sim)" in run(root, "replay", batch["batch"]).stdout
    assert "$((count + 1))" in (root / "build/sim").read_text()


@pytest.mark.nightly
@pytest.mark.integration
def test_a_replay_names_products_that_are_not_reproducible_in_one_line(tmp_path: Path) -> None:
    random = COMPILER.replace("# $FLAVOUR", "# $(cat /proc/sys/kernel/random/uuid)")
    root = make(tmp_path / "project", compiler=random)
    run(root)
    [batch] = rows(root, "FROM batches")
    done = run(root, "replay", batch["batch"])
    assert "identical (2 runs: 2 identical; built from source: build/sim)" in done.stdout
    what = "products built from the recorded source differ from the record (compilers may not be reproducible): build/sim"
    assert [line for line in done.stderr.splitlines() if "build/sim" in line] == [f"note: {what}"]
    answer = json.loads(run(root, "replay", batch["batch"], "--json").stdout)
    assert answer["built"] == {"products": ["build/sim"], "different": ["build/sim"]}
    assert "0 executed, 2 reused" in run(root).stdout


@pytest.mark.nightly
@pytest.mark.integration
def test_files_beside_the_products_do_not_count_even_if_a_variable_names_their_folder(tmp_path: Path) -> None:
    """No run is observed: an observed one would count although a file has changed that it has not read."""
    names = {"LIBRARIES": "build", "DATA": "build/data", "LOADED": "build/sim"}
    variables = ", ".join(f'{name} = "{{project}}/{path}"' for name, path in names.items())
    config = f'observe = "none"\n{CONFIG}[environment]\nset = {{ {variables} }}\n'
    root = make(tmp_path / "project", config, compiler=f"{COMPILER}cp /proc/sys/kernel/random/uuid build/cache\n")
    (root / "build").mkdir()
    (root / "build/data").write_text("1")
    run(root)
    assert "0 executed, 2 reused" in run(root).stdout
    counted = {row["name"] for row in rows(root, "SELECT name FROM programs WHERE name LIKE '{project}%'")}
    assert counted == {"{project}/build/sim", "{project}/build/data"}
    (root / "build/sim").unlink()
    assert "0 executed, 2 reused" in run(root).stdout
    [batch] = rows(root, "FROM batches")
    assert "differ" not in run(root, "replay", batch["batch"]).stderr
    (root / "build/data").write_text("2")
    assert "2 executed, 0 reused" in run(root).stdout


@pytest.mark.nightly
@pytest.mark.integration
def test_a_replay_whose_build_fails_says_so(root: Path) -> None:
    run(root)
    [batch] = rows(root, "FROM batches")
    (root / "fails").touch()
    (root / "compile.sh").write_text(f"test -e {root}/fails && exit 5\n{COMPILER}")
    (root / "fails").unlink()
    run(root)
    batch = rows(root, "FROM batches ORDER BY lamport")[-1]
    (root / "fails").touch()
    assert "the build failed, so nothing was executed: exit status 5 of sh" in failing(root, "replay", batch["batch"])


@pytest.mark.nightly
@pytest.mark.integration
def test_a_recorded_batch_is_executed_only_with_the_products_of_its_source(root: Path) -> None:
    run(root)
    [batch] = rows(root, "FROM batches")
    (root / "arena.xml").write_text(projects.TEMPLATE.replace("0.1", "0.2"))
    assert "0 executed, 2 reused" in run(root, "run", batch["batch"], "--no-figures").stdout
    edit(root)
    run(root)
    done = projects.quick(root, "run", batch["batch"], "--no-figures")
    assert done.returncode == 3
    assert "is not the product that was built from the recorded source" in done.stderr


@pytest.mark.nightly
@pytest.mark.integration
def test_previews_say_whether_products_would_be_built_and_why(root: Path) -> None:
    assert "build: the products would be built first, because nothing has been built yet" in run(root, *QUERY, "-n").stdout
    assert "build: the products were built, because nothing has been built yet" in run(root, *QUERY, "--explain").stdout
    preview = json.loads(run(root, *QUERY, "-n", "--json").stdout)
    assert preview["build"] == "build: the products are up to date"
    [batch] = rows(root, "FROM batches")
    assert "4 runs" not in run(root, "why", batch["batch"]).stdout
    (root / "build/sim").unlink()
    assert "would be built first, because build/sim is missing" in run(root, "why", batch["batch"]).stdout


@pytest.mark.nightly
@pytest.mark.integration
def test_show_names_the_build_of_a_batch(root: Path) -> None:
    run(root)
    [batch] = rows(root, "FROM batches")
    [build] = rows(root, "FROM builds")
    shown = run(root, "show", batch["batch"]).stdout
    assert f"build {build['build'][:10]}: sh compile.sh, on {build['host']}" in shown
    assert f"  build/sim ({build_products.hashed(root, ['build/sim'])[0].sha256[:10]})" in shown
    record = json.loads(run(root, "show", batch["batch"], "--json").stdout)
    assert record["build"]["products"][0]["name"] == "build/sim"


@pytest.mark.nightly
@pytest.mark.integration
def test_doctor_checks_the_command_of_the_build(root: Path) -> None:
    def found(name: str) -> dict[str, Any]:
        checks = json.loads(projects.quick(root, "doctor", "--json").stdout)
        return next(check for check in checks if check["name"] == name)

    assert (found("build")["state"], found("command")["state"]) == ("ok", "ok")
    (root / "sierra.toml").write_text(CONFIG.replace("sh compile.sh", "nosuchcompiler"))
    assert found("build")["state"] == "missing"


@pytest.mark.nightly
@pytest.mark.integration
def test_records_of_builds_stay_sound_and_are_removed_with_their_batch(root: Path) -> None:
    run(root)
    edit(root)
    run(root)
    first, second = rows(root, "FROM batches ORDER BY lamport")
    run(root, "replay", first["batch"])
    run(root, "gc", "--yes")
    assert "sound" in run(root, "fsck").stdout
    run(root, "rm", first["batch"], "--yes")
    assert rows(root, "SELECT batch FROM builds") == [{"batch": second["batch"]}]
    assert len(rows(root, "FROM build_products")) == 1
    assert "sound" in run(root, "fsck").stdout


def for_processors(folder: Path, arch: str = "") -> Path:
    """Write a project with a product for each processor."""
    config = CONFIG.replace("build/sim", "build/{arch}/sim").replace("sh compile.sh", "sh compile.sh {arch}")
    compiler = 'mkdir -p build/$1\n{ cat sim.sh; echo "# for $1"; } > build/$1/sim\nchmod +x build/$1/sim\necho built for $1\n'
    return make(folder, config + arch, compiler=compiler)


@pytest.mark.nightly
def test_each_processor_has_a_product_of_its_own(tmp_path: Path) -> None:
    other = "riscv64" if HERE == "aarch64" else "aarch64"
    root = for_processors(tmp_path / "p", f'arch = ["{HERE}", "{other}"]\n')
    assert run(root).stderr.count("building, because") == 1
    [build] = rows(root, "FROM builds")
    assert (build["produces"], build["processors"]) == (["build/{arch}/sim"], [HERE, other])
    assert build["command"] == ["sh", "compile.sh", "{arch}"]
    names = sorted(f"build/{arch}/sim" for arch in (HERE, other))
    assert [row["name"] for row in rows(root, "FROM build_products ORDER BY name")] == names
    assert rows(root, "SELECT command[1] AS program FROM specs") == [{"program": "{project}/build/{arch}/sim"}]
    assert "building" not in run(root).stderr
    assert "sound" in run(root, "fsck").stdout
    (root / f"build/{other}/sim").write_text("changed")
    assert f"build/{other}/sim is not the file that was built" in run(root).stderr
    replayed = run(root, "replay", rows(root, "FROM batches")[0]["batch"])
    assert "differ" not in replayed.stderr
    config = (root / "sierra.toml").read_text()
    (root / "sierra.toml").write_text(config.replace(f'["{HERE}", "{other}"]', f'"{other}"'))
    refused = projects.quick(root, *QUERY).stderr.splitlines()[-1]
    assert refused == f'sierra: runs need build/{HERE}/sim, but [build] is for {other}; add "{HERE}" to arch in [build]'


@pytest.mark.integration
def test_another_processor_needs_another_product_for_the_same_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = for_processors(tmp_path / "p")
    run(root)
    [batch] = rows(root, "FROM batches")
    monkeypatch.setattr(platform, "machine", lambda: "riscv64")
    plan = sierra.open(root).plan("population_size=1,2")
    assert plan.build
    assert (plan.batch.id, plan.build.reason) == (batch["batch"], "products are needed for riscv64")
    assert "products are needed for riscv64" in run(root).stderr
    assert rows(root, "SELECT name FROM programs WHERE name LIKE '%/sim' ORDER BY name") == [
        {"name": f"{{project}}/build/{arch}/sim"} for arch in sorted(("riscv64", HERE))
    ]
    shutil.rmtree(root / "build")
    monkeypatch.undo()
    assert "different machine" not in run(root, "replay", batch["batch"]).stderr


def test_the_id_of_a_build_is_the_hash_of_its_inputs() -> None:
    spec = RunSpec("build", ("make",), {"CFLAGS": "-O2"}, "swh:1:dir:00")
    assert build_id(spec, ".", ("build/sim",), "00") == "cf30c634097737ef576ec28039d927e3fd7b5d774e786bc24bee1a16dbdef0a3"


@pytest.mark.parametrize(
    ("name", "pattern", "fits"),
    [
        ("build/sim", "build/sim", True),
        ("./build/sim", "build/*", True),
        ("other/build/sim", "build/sim", False),
        ("a/b/c.so", "**/*.so", True),
        ("c.so", "**/*.so", True),
        ("a/b/c.so", "a/*.so", False),
    ],
)
def test_a_pattern_matches_whole_names(name: str, pattern: str, fits: bool) -> None:
    assert build_products.matches(name, pattern) is fits

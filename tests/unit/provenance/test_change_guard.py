"""Changes of code or programs during a batch are detected: no result is ascribed to code that did not produce it."""

from __future__ import annotations

import hashlib
import os
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from sierra.provenance import source
from sierra.provenance.change_guard import guard
from sierra.provenance.dependency_model import NOTHING, Program, Programs
from sierra.provenance.source.manifest import Entry, git_hash, listed
from sierra.provenance.source.suggest_exclusions import ONLY_SAID
from tests import projects
from tests.conftest import PRINTS, held
from tests.waiting import PATIENCE_S

OTHER = r"printf 't,v\n1,1000\n2,4000\n' > swarm.csv"


@pytest.mark.integration
@pytest.mark.parametrize("git", [True, pytest.param(False, marks=pytest.mark.nightly)])
def test_runs_that_may_have_used_changed_code_are_never_effective(simulate: Callable[..., Any], git: bool) -> None:
    script = held(1)
    project = simulate(script)
    if git:
        projects.commit(project.folder)
    asking = project.start("run", "size=1,2,3,4,5,6,7,8", "--runs", "1", "-j", "1", "--no-figures")
    project.until_executed(2, asking)
    code = (project.folder / "sim.sh").read_text()
    (project.folder / "sim.sh").write_text(code.replace(script, OTHER))
    project.open()
    ended = project.end_of(asking)
    assert ended.returncode == 1
    assert "code or programs have changed since the runs began: sim.sh" in ended.stdout
    assert project.sql("SELECT DISTINCT status FROM executions WHERE reason LIKE 'code or programs%'") == [{"status": "failed"}]
    (project.folder / "sim.sh").write_text(code)
    assert project.quick("run", "size=1,2,3,4,5,6,7,8", "--runs", "1", "--no-figures").returncode == 0
    assert project.sql("SELECT count(*) AS runs, max(v) AS v FROM swarm WHERE t = 2") == [{"runs": 8, "v": 4}]


@pytest.mark.nightly
def test_the_error_for_notes_that_change_meanwhile_says_how_to_exclude_them(simulate: Callable[..., Any]) -> None:
    project = simulate(held(1))
    toml = project.folder / "sierra.toml"
    toml.write_text('observe = "none"\n' + toml.read_text())  # runs that are observed have not used the notes
    (project.folder / "notes.txt").write_text("before")
    (project.folder / "figures").mkdir()
    (project.folder / "figures" / "a.png").write_text("before")
    asking = project.start("run", "size=1,2,3", "--runs", "1", "-j", "1", "--no-figures")
    project.until_executed(2, asking)
    (project.folder / "notes.txt").write_text("after")
    project.open()
    ended = project.end_of(asking)
    advice = 'if these are not code, write paths = ["sim.sh"] under [source] in sierra.toml'
    assert (ended.returncode, advice in ended.stdout) == (1, True)
    toml.write_text(toml.read_text() + '[source]\npaths = ["sim.sh"]\n')
    assert project.quick("run", "size=1,2,3", "--runs", "1", "--no-figures").returncode == 0
    (project.folder / "notes.txt").write_text("later")
    assert "0 of 3 runs would execute" in project.quick("run", "size=1,2,3", "--runs", "1", "-n").stdout


def test_the_advice_never_excludes_code_that_changed(tmp_path: Path) -> None:
    names = ("sim.py", "README", "src/a.py", "data/b", ".gitignore", "lib x/c")
    manifest = listed(Entry("100644", "0" * 40, os.fsencode(name)) for name in names)
    taken = guard(tmp_path, manifest, NOTHING)
    assert taken.advice([b"notes.py"]) == taken.advice([b"history.csv"]) == taken.advice([b"src/README.md"])
    assert taken.advice([b"sim.py", b"README"]) == taken.advice([b"src/README.md"]) == ONLY_SAID
    assert 'paths = ["data", "lib x", "sim.py", "src"]' in taken.advice([b"README"])
    assert 'paths = ["lib x", "sim.py", "src"]' in taken.advice([b"README", b"data/b"])


@pytest.mark.integration
def test_runs_fail_if_their_program_is_replaced_while_they_execute(simulate: Callable[..., Any], tmp_path: Path) -> None:
    program = tmp_path / "sim"
    program.write_text(f'#!/bin/sh\nuntil [ -e "{tmp_path}/gate" ]; do sleep 0.02; done; {PRINTS}\n')
    program.chmod(0o755)
    project = simulate(f'{program}; echo "$SIERRA_RUN_ID" >> "{tmp_path}/ended"')
    toml = project.folder / "sierra.toml"
    toml.write_text(toml.read_text().replace('"sim.sh", "{input}"]', f'"sim.sh", "{{input}}", "{program}"]'))
    asking = project.start("run", "size=1,2,3", "-j", "1", "--no-figures")
    project.until_executed(1, asking)
    replaced = tmp_path / "new"
    replaced.write_text(f"#!/bin/sh\n{OTHER}\n")
    replaced.chmod(0o755)
    replaced.replace(program)
    project.open()
    ended = project.end_of(asking)
    assert (ended.returncode, f"changed since the runs began: {program}" in ended.stdout) == (1, True)
    assert project.sql("SELECT DISTINCT status FROM executions") == [{"status": "failed"}]


def test_files_changed_and_changed_back_are_detected_and_new_files_are_not(tmp_path: Path) -> None:
    files = {name: tmp_path / name for name in ("a", "b", "sub/c")}
    for file in files.values():
        file.parent.mkdir(exist_ok=True)
        file.write_text("x")
    manifest = listed(Entry("100644", "0" * 40, os.fsencode(name)) for name in files)

    def changed(what: Callable[[], object]) -> str | None:
        before = guard(tmp_path, manifest, NOTHING)
        what()
        return before.doubt()

    assert changed(lambda: (tmp_path / "new").write_text("")) is None
    assert changed(lambda: files["a"].read_text()) is None
    times = files["a"].stat()

    def there_and_back() -> None:
        files["a"].write_text("y")
        files["a"].write_text("x")
        os.utime(files["a"], ns=(times.st_atime_ns, times.st_mtime_ns))

    for what, name in ((there_and_back, "a"), (files["b"].unlink, "b"), (lambda: files["sub/c"].write_text("x"), "sub/c")):
        assert f": {name} (" in str(changed(what))


def test_only_a_file_with_other_bytes_is_said_to_have_changed(tmp_path: Path) -> None:
    files = {name: tmp_path / name for name in ("code", "tool")}
    for file in files.values():
        file.write_text("x")
    manifest = listed([Entry("100644", git_hash(b"blob", b"x"), b"code")])
    tool = Program("tool", str(files["tool"]), hashlib.sha256(b"x").hexdigest())
    before = guard(tmp_path, manifest, Programs((tool,)))
    for file in files.values():
        file.write_text("x")
    assert "programs may have changed, as their times say, since the runs began: code, tool (" in str(before.doubt())
    files["tool"].write_text("y")
    assert "code or programs have changed since the runs began: tool (" in str(before.doubt())
    files["tool"].write_text("x")
    files["code"].unlink()
    os.mkfifo(files["code"])  # nobody writes to it: its reader would wait for ever
    assert "code or programs have changed since the runs began: code (" in str(before.doubt())
    (tmp_path / "pyvenv.cfg").touch()  # files of virtual environments are read in another way
    files["tool"].unlink()
    os.mkfifo(files["tool"])
    assert "code or programs have changed since the runs began: code, tool (" in str(before.doubt())


@pytest.mark.parametrize("git", [True, False])
@pytest.mark.parametrize("name", ["tracked", "dirty", "untracked"])
def test_a_change_between_the_listing_and_the_guard_is_noticed(tmp_path: Path, git: bool, name: str) -> None:
    folder = tmp_path / "project"
    folder.mkdir()
    for file in ("tracked", "dirty", "same"):
        (folder / file).write_text("x")
    if git:
        projects.commit(folder)
    (folder / "dirty").write_text("y")
    (folder / "untracked").write_text("x")
    (folder / "link").symlink_to("same")
    (folder / "broken").symlink_to("nowhere")
    code = source.capture(folder, paths=(), without=())
    (folder / "same").write_text("x") if git else None
    (folder / name).write_text("z")
    taken = guard(folder, code.manifest, NOTHING, code.listed, code.since)
    assert taken.changed_source() == {str(folder / name): False}
    assert f"code or programs have changed since the runs began: {name} (" in str(taken.doubt())
    (folder / name).unlink()
    removed = guard(folder, code.manifest, NOTHING, code.listed, code.since)
    assert removed.changed_source() == {str(folder / name): True}
    assert taken.changed_source() == {str(folder / name): True}
    again = source.capture(folder, paths=(), without=())
    assert guard(folder, again.manifest, NOTHING, again.listed, again.since).doubt() is None


@pytest.mark.integration
def test_a_replay_fails_if_a_program_is_replaced_meanwhile(simulate: Callable[..., Any], tmp_path: Path) -> None:
    program = tmp_path / "sim"
    program.write_text(f'#!/bin/sh\nuntil [ -e "{tmp_path}/gate" ]; do sleep 0.02; done; {PRINTS}\n')
    program.chmod(0o755)
    project = simulate(str(program))
    toml = project.folder / "sierra.toml"
    toml.write_text(toml.read_text().replace('"sim.sh", "{input}"]', f'"sim.sh", "{{input}}", "{program}"]'))
    project.open()
    assert project.quick("run", "size=1", "--runs", "3", "--no-figures").returncode == 0
    [row] = project.sql("SELECT batch FROM batches")
    (tmp_path / "gate").unlink()
    replaying = project.start("replay", row["batch"], "-j", "1")
    project.until_executed(4, replaying)
    program.touch()
    project.open()
    ended = project.end_of(replaying)
    touched = "may have changed, as their times say, since the runs began" in ended.stdout
    assert (ended.returncode, "3 failed" in ended.stdout, touched) == (1, True, True)


@pytest.mark.nightly
def test_output_redirected_into_the_project_is_refused_unless_git_ignores_it(simulate: Callable[..., Any]) -> None:
    project = simulate(PRINTS)
    ask = (projects.SIERRA, "run", "size=1", "--runs", "3", "--no-figures")
    log = project.folder / "nohup.out"
    with log.open("w") as out:
        refused = subprocess.run(ask, cwd=project.folder, stdout=out, stderr=out, check=False, timeout=PATIENCE_S)
    assert (refused.returncode, log.read_text().count("\n")) == (2, 1)
    assert "output is redirected into the project (nohup.out), which would change its source" in log.read_text()
    (project.folder / ".gitignore").write_text("*.out\n")
    log.unlink()
    projects.commit(project.folder)
    with log.open("w") as out:
        done = subprocess.run(ask, cwd=project.folder, stdout=out, stderr=out, check=False, timeout=PATIENCE_S)
    assert (done.returncode, "3 executed" in log.read_text()) == (0, True)

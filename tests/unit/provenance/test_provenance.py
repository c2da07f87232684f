"""The exact code, programs and machine behind a result are recorded without changing anything."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import sierra
from sierra.cli.render_reasons import new_runs
from sierra.errors import ConfigError, Missing
from sierra.execution import reuse
from sierra.execution.reasons import ChangeReason, Reason
from sierra.explain import why_new_runs
from sierra.provenance import fingerprint_programs, source
from sierra.provenance.source.capture import SWHID, Source
from tests import projects

Git = Callable[..., str]
WITHOUT = ("sierra.toml", ".sierra", "figures", "./t.xml")
NAMES = ("a.txt", "sub/b.txt", "sub/deeper/c", "größe", "new\nline", "blank name", "sub.txt", "sub0", "-dash", "'quote\"")


@pytest.fixture
def git(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Git:
    """Git in the folder `tmp_path/p`, without the settings of this machine."""
    monkeypatch.setenv("GIT_CONFIG_GLOBAL", os.devnull)
    monkeypatch.setenv("GIT_CONFIG_NOSYSTEM", "1")

    def git(*arguments: str, cwd: Path = tmp_path / "p") -> str:
        who = ("-c", "user.name=a", "-c", "user.email=a@b", "-c", "protocol.file.allow=always")
        done = subprocess.run(["git", *who, *arguments], cwd=cwd, check=True, capture_output=True, text=True)
        return done.stdout.strip()

    return git


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with files of all kinds, outside a repository."""
    folder = tmp_path / "p"
    for name in NAMES:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(name)
    (folder / "a.txt").chmod(0o755)
    (folder / "link").symlink_to("sub")
    (folder / "nowhere").symlink_to("not there")
    return folder


def capture(root: Path, *paths: str) -> Source:
    return source.capture(root, paths=paths, without=WITHOUT)


def commit(git: Git) -> str:
    git("init", "-q", "-b", "main")
    git("add", "--all")
    git("commit", "-q", "-m", "x")
    return git("rev-parse", "HEAD")


def test_the_tree_equals_the_tree_of_git_inside_and_outside_a_repository(folder: Path, git: Git) -> None:
    outside = capture(folder)
    commit(git)
    inside = capture(folder)
    assert outside.tree == inside.tree == SWHID + git("rev-parse", "HEAD^{tree}")
    assert (outside.vcs, inside.vcs) == ("none", "git")
    assert outside.manifest == inside.manifest


@pytest.mark.integration
@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(names=st.sets(st.text("ab./-0 é\n", min_size=1, max_size=5).filter(lambda n: n.strip("./")), min_size=1, max_size=8))
def test_the_tree_equals_the_tree_of_git_for_any_file_names(
    tmp_path_factory: pytest.TempPathFactory, git: Git, names: set[str]
) -> None:
    folder = tmp_path_factory.mktemp("any")
    for name in names:
        path = folder / os.path.normpath("./" + name.lstrip("/"))
        if not path.is_relative_to(folder) or ".." in path.parts:
            continue
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(name)
        except (FileExistsError, NotADirectoryError, IsADirectoryError):
            continue
    outside = capture(folder).tree
    git("init", "-q", cwd=folder)
    assert capture(folder).tree == outside


def test_files_of_sierra_are_not_part_of_the_source(folder: Path, git: Git) -> None:
    before = capture(folder).tree
    for name in ("sierra.toml", "t.xml", "figures/x.png", ".sierra/format"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text("x")
    assert capture(folder).tree == before
    commit(git)
    assert capture(folder).tree == before


@pytest.mark.parametrize("rule", [".sierra/", "figures", "*.xml", "/sierra.toml"])
def test_a_repository_may_ignore_files_that_are_not_part_of_the_source(folder: Path, git: Git, rule: str) -> None:
    commit(git)
    before = capture(folder).tree
    for name in ("sierra.toml", "t.xml", "figures/x.png", ".sierra/format"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text("x")
    (folder / ".git" / "info" / "exclude").write_text(f"{rule}\n")
    assert capture(folder).tree == before


def test_files_that_are_not_part_of_the_source_may_have_any_name(folder: Path, git: Git) -> None:
    commit(git)
    before = capture(folder).tree
    names = ("[a]*.xml", "!x.xml", "b\\?.xml", "sub/[c].xml", "^d.xml", " e.xml", "é\n.xml")
    for name in names:
        (folder / name).write_text("x")
    assert source.capture(folder, paths=(), without=names).tree == before
    (folder / "a.xml").write_text("counts")
    assert source.capture(folder, paths=(), without=names).tree != before


def test_figures_leave_no_objects_in_the_repository(folder: Path, git: Git) -> None:
    commit(git)
    (folder / "figures").mkdir()
    (folder / "figures" / "x.png").write_text("a picture of its own")
    capture(folder)
    blob = git("hash-object", "figures/x.png")
    done = subprocess.run(["git", "cat-file", "-e", blob], cwd=folder, check=False, capture_output=True)
    assert done.returncode != 0


def test_changed_and_untracked_files_are_part_of_the_source_and_ignored_ones_are_not(folder: Path, git: Git) -> None:
    commit(git)
    clean = capture(folder)
    (folder / ".git" / "info" / "exclude").write_text("*.log\n")
    (folder / "x.log").write_text("x")
    ignored = capture(folder)
    (folder / "a.txt").write_text("changed")
    changed = capture(folder)
    (folder / "untracked").write_text("x")
    untracked = capture(folder)
    assert (clean.dirty, ignored.dirty, changed.dirty, untracked.dirty) == (False, False, True, True)
    assert clean.tree == ignored.tree
    assert len({clean.tree, changed.tree, untracked.tree}) == 3
    assert source.changed(clean.manifest, untracked.manifest) == ["a.txt", "untracked"]
    assert clean.commit == untracked.commit == git("rev-parse", "HEAD")
    assert clean.branch == "main"


def test_the_users_files_index_and_refs_stay_unchanged_and_a_ref_is_added(folder: Path, git: Git) -> None:
    commit(git)
    (folder / "a.txt").write_text("stashed")
    git("stash")
    (folder / "sub" / "b.txt").write_text("staged")
    git("add", "sub/b.txt")
    (folder / "sub" / "b.txt").write_text("and changed again")
    (folder / "untracked").write_text("x")

    def state() -> tuple[object, ...]:
        index = folder / ".git" / "index"
        files = {path: path.lstat().st_mtime_ns for path in folder.rglob("*") if ".git" not in path.parts}
        heads = git("for-each-ref", "refs/heads", "refs/stash")
        return index.read_bytes(), index.stat().st_mtime_ns, files, heads, git("--no-optional-locks", "status", "--short")

    before = state()
    tree = capture(folder).tree.removeprefix(SWHID)
    assert state() == before
    assert git("rev-parse", f"refs/sierra/{tree}") == tree
    git("prune", "--expire=now")
    assert "b.txt" in git("ls-tree", "--name-only", f"{tree}:sub")
    assert git("show", f"{tree}:sub/b.txt") == "and changed again"


def test_the_source_is_recorded_in_an_empty_repository_and_at_a_detached_head(folder: Path, git: Git) -> None:
    git("init", "-q", "-b", "main")
    empty = capture(folder)
    assert (empty.commit, empty.branch, empty.dirty) == (None, "main", True)
    head = commit(git)
    git("checkout", "-q", "--detach")
    detached = capture(folder)
    assert (detached.commit, detached.branch, detached.dirty) == (head, None, False)
    assert detached.tree == empty.tree


def test_the_source_is_recorded_in_a_linked_worktree_and_in_a_subfolder(folder: Path, git: Git, tmp_path: Path) -> None:
    commit(git)
    git("worktree", "add", "-q", str(tmp_path / "linked"))
    assert capture(tmp_path / "linked").tree == capture(folder).tree
    inside = capture(folder / "sub")
    assert inside.tree == SWHID + git("rev-parse", "HEAD:sub")
    (folder / "a.txt").write_text("elsewhere in the repository")
    assert capture(folder / "sub") == inside


def test_a_submodule_is_recorded_by_its_commit_and_with_its_changes(folder: Path, git: Git, tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    (other / "f").write_text("f")
    git("init", "-q", cwd=other)
    git("add", "f", cwd=other)
    git("commit", "-q", "-m", "x", cwd=other)
    commit(git)
    git("submodule", "add", "-q", str(other), "module")
    git("commit", "-q", "-m", "module")
    clean = capture(folder)
    assert clean.tree == SWHID + git("rev-parse", "HEAD^{tree}")
    (folder / "module" / "f").write_text("changed")
    once = capture(folder)
    (folder / "module" / "f").write_text("changed again")
    assert len({clean.tree, once.tree, capture(folder).tree}) == 3
    assert once.dirty


@pytest.mark.parametrize("inside", [False, True])
def test_paths_limit_the_source_to_the_listed_files(folder: Path, git: Git, inside: bool) -> None:
    if inside:
        commit(git)
    narrow = capture(folder, "./sub/", "a.txt")
    assert narrow == capture(folder, "sub/deeper/..", "a.txt")
    (folder / "sub0").write_text("changed")
    assert capture(folder, "sub", "a.txt").tree == narrow.tree
    (folder / "sub" / "deeper" / "c").write_text("changed")
    assert capture(folder, "sub", "a.txt").tree != narrow.tree


@pytest.mark.parametrize("path", ["not there", "..", "empty", "x.log"])
def test_a_path_without_source_files_is_an_error(folder: Path, git: Git, path: str) -> None:
    commit(git)
    (folder / "empty").mkdir()
    (folder / "x.log").write_text("x")
    (folder / ".git" / "info" / "exclude").write_text("*.log\n")
    with pytest.raises(ConfigError, match=r"\[source\] paths"):
        capture(folder, "a.txt", path)


@pytest.mark.parametrize(
    ("address", "kept"),
    [
        ("https://user:p@ss@host.org/x.git?token=1", "https://host.org/x.git"),
        ("https://host.org/a@b.git", "https://host.org/a@b.git"),
        ("git@host.org:x.git", "git@host.org:x.git"),
    ],
)
def test_credentials_in_the_remote_are_not_recorded(folder: Path, git: Git, address: str, kept: str) -> None:
    git("init", "-q")
    git("remote", "add", "origin", address)
    assert capture(folder).remote == kept


def test_a_missing_git_and_a_damaged_repository_are_reported_in_one_line(
    folder: Path, git: Git, monkeypatch: pytest.MonkeyPatch
) -> None:
    commit(git)
    with monkeypatch.context() as patch:
        patch.setenv("PATH", "")
        with pytest.raises(Missing, match="git is not installed"):
            capture(folder)
    (folder / ".git" / "HEAD").write_text("nonsense")
    with pytest.raises(Missing) as caught:
        capture(folder)
    assert "\n" not in str(caught.value)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files away")
def test_a_repository_of_another_user_is_reported_in_one_line(folder: Path, git: Git) -> None:
    commit(git)
    for path in (folder, folder / ".git"):
        os.chown(path, 12345, 12345)
    with pytest.raises(Missing, match="dubious ownership") as caught:
        capture(folder)
    assert "\n" not in str(caught.value)


# ---------------------------------------------------------------- programs


def program(path: Path, content: str) -> str:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content)
    path.chmod(0o755)
    return str(path)


def test_every_program_of_a_command_is_part_of_the_identity(tmp_path: Path) -> None:
    path = program(tmp_path / "bin" / "simulator", "\x7fELF")
    found = fingerprint_programs.find(("nice", "-n", "5", "simulator"), {"PATH": f"{tmp_path}/bin:/usr/bin:/bin"}, tmp_path)
    assert [one.name for one in found.all if one.kind == "program"] == ["nice", "simulator"]
    program(Path(path), "\x7fELF2")
    assert (
        fingerprint_programs.find(("nice", "-n", "5", "simulator"), {"PATH": f"{tmp_path}/bin:/usr/bin:/bin"}, tmp_path).id
        != found.id
    )


def test_equal_programs_in_other_folders_have_the_same_id(tmp_path: Path) -> None:
    found = [
        fingerprint_programs.find((program(tmp_path / name / "simulator", "\x7fELF"),), {"PATH": ""}, tmp_path).id
        for name in ("one", "two")
    ]
    assert found[0] == found[1]


def test_the_interpreter_of_a_script_and_its_distributions_are_part_of_the_identity(tmp_path: Path) -> None:
    python = program(tmp_path / "env" / "bin" / "python3", "\x7fELF")
    script = program(tmp_path / "run", f"#!{python}\n")
    installed = tmp_path / "env" / "lib" / "python3.11" / "site-packages"
    (installed / "numpy-1.dist-info").mkdir(parents=True)
    first = fingerprint_programs.find((script,), {"PATH": ""}, tmp_path)
    assert [one.name for one in first.all] == [script, python, "python3: installed distributions"]
    assert first.all[-1].version == "numpy==1"
    (installed / "numpy-1.dist-info").rename(installed / "numpy-2.dist-info")
    assert fingerprint_programs.find((script,), {"PATH": ""}, tmp_path).id != first.id


def test_a_missing_program_is_reported(tmp_path: Path) -> None:
    with pytest.raises(Missing, match="'simulator' was not found"):
        fingerprint_programs.find(("simulator",), {"PATH": "/bin"}, tmp_path)


@pytest.mark.integration
def test_changed_programs_execute_runs_again_and_the_reason_is_reported(tmp_path: Path) -> None:
    simulator = program(tmp_path / "bin" / "sim", "#!/bin/sh\necho v > out.csv; echo 1 >> out.csv\n")
    project = make_project(tmp_path / "p", f"{simulator} {{input}}")
    assert project.run("n=1", figures=False).executed == 2
    assert project.run("n=1", figures=False).reused == 2
    program(Path(simulator), "#!/bin/sh\necho v > out.csv; echo 2 >> out.csv\n")
    planned = project.plan("n=1")
    whys = {state.change for state in reuse.states(planned, project.store).values()}
    assert whys == {Reason(ChangeReason.PROGRAMS)}
    assert project.run("n=1", figures=False).executed == 2
    assert project.sql("SELECT DISTINCT v FROM out").column(0).to_pylist() == [2]


@pytest.mark.integration
@pytest.mark.parametrize("link", [False, True])
def test_runs_execute_again_if_a_simulator_outside_the_project_changes(tmp_path: Path, link: bool) -> None:
    script = tmp_path / "shared" / "sim.sh"
    script.parent.mkdir()
    script.write_text("echo v > out.csv; echo 1 >> out.csv\n")
    project = make_project(tmp_path / "p", f"sh {'sim.sh' if link else '../shared/sim.sh'} {{input}}")
    if link:
        (project.root / "sim.sh").symlink_to(script)
    assert project.run("n=1", figures=False).failed == 0
    assert project.run("n=1", figures=False).reused == 2
    script.write_text("echo v > out.csv; echo 2 >> out.csv\n")
    assert project.run("n=1", figures=False).executed == 2
    assert project.sql("SELECT DISTINCT v FROM out").column(0).to_pylist() == [2]


@pytest.mark.integration
def test_a_changed_source_file_is_named(tmp_path: Path) -> None:
    project = make_project(tmp_path / "p", "sh sim.sh {input}")
    (project.root / "sim.sh").write_text("exit 0\n")
    project.run("n=1", figures=False)
    (project.root / "sim.sh").write_text("exit 0 # changed\n")
    assert "source: 1 file differs: sim.sh" in new_runs(why_new_runs.why_new(project.plan("n=1"), project.store))


@pytest.mark.nightly
def test_the_advice_for_changed_notes_says_how_to_exclude_them_from_the_source(tmp_path: Path) -> None:
    project = make_project(tmp_path / "p", "sh sim.sh {input}")
    (project.root / "sim.sh").write_text("exit 0\n")
    (project.root / "notes.txt").write_text("before\n")
    project.run("n=1", figures=False)
    (project.root / "notes.txt").write_text("after\n")
    told = new_runs(why_new_runs.why_new(project.plan("n=1"), project.store))
    assert told[1] == "source: 1 file differs: notes.txt"
    assert 'write paths = ["sim.sh"] under [source] in sierra.toml' in told[2]


@pytest.mark.parametrize("git", [False, True])
def test_prose_is_no_source_unless_paths_names_it(tmp_path: Path, git: bool) -> None:
    project = make_project(tmp_path / "p", "sh sim.sh {input}")
    (project.root / "sim.sh").write_text("exit 0\n")
    for name in ("README", "docs/a.txt", "maps/notes.md", "LICENSE", "CITATION.cff", ".zenodo.json", "codemeta.json"):
        file = project.root / name
        file.parent.mkdir(exist_ok=True)
        file.write_text("before\n")
    (project.root / "maps" / "LICENSE").write_text("a map\n")
    if git:
        (project.root / ".gitignore").write_text(".sierra\n")
        projects.commit(project.root)
    before = project.plan("n=1")
    held = {os.fsdecode(path) for path in source.paths(before.source.manifest)} if before.source else set()
    assert held == {"sim.sh", "maps/LICENSE", *([".gitignore"] if git else [])}
    (project.root / "README").write_text("after\n")
    (project.root / "docs" / "b.txt").write_text("after\n")
    assert project.plan("n=1").batch.id == before.batch.id
    config = project.root / "sierra.toml"
    config.write_text(config.read_text() + '[source]\npaths = ["."]\n')
    whole = sierra.open(project.root).plan("n=1")
    (project.root / "README").write_text("later\n")
    assert sierra.open(project.root).plan("n=1").batch.id != whole.batch.id


def make_project(folder: Path, command: str) -> sierra.Project:
    folder.mkdir()
    toml = f"template = 't.xml'\ncommand = '{command}'\nruns = 2\nseed = '//e/@seed'\n[variables]\nn = '//e/@n'\n"
    (folder / "sierra.toml").write_text(toml)
    (folder / "t.xml").write_text('<e seed="0" n="0"/>')
    return sierra.open(folder)

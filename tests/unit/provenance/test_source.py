"""The source of a result: every kind of repository and working tree works, or is refused in one line."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import socket
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import sierra
from sierra.errors import ConfigError, Damaged, Missing
from sierra.provenance import source
from sierra.provenance.source.capture import LARGE, SWHID, Source
from sierra.provenance.source.origin import without_credentials
from sierra.util.hashing import sealed, unsealed
from tests import projects

Git = Callable[..., str]
WITHOUT = ("sierra.toml", ".sierra", "t.xml")
EMPTY_TREE = "4b825dc642cb6eb9a060e54bf8d69288fbee4904"
POINTER = f"version https://git-lfs.github.com/spec/v1\noid sha256:{'0' * 64}\nsize 12345\n"


@pytest.fixture
def git(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Git:
    """Git in the folder `tmp_path/p`, without the settings of this machine."""
    (tmp_path / "gitconfig").write_text("")
    monkeypatch.setenv("GIT_CONFIG_GLOBAL", str(tmp_path / "gitconfig"))
    monkeypatch.setenv("GIT_CONFIG_NOSYSTEM", "1")

    def git(*arguments: str, cwd: Path = tmp_path / "p") -> str:
        who = ("-c", "user.name=a", "-c", "user.email=a@b", "-c", "protocol.file.allow=always")
        done = subprocess.run(["git", *who, *arguments], cwd=cwd, check=True, capture_output=True)
        return done.stdout.decode(errors="surrogateescape").strip()

    return git


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with two files, outside a repository."""
    return fill(tmp_path / "p", {"a.txt": "a", "sub/b.txt": "b"})


@pytest.fixture
def repository(folder: Path, git: Git) -> Path:
    """Return the same folder, committed to a repository."""
    commit(git, folder)
    return folder


def fill(folder: Path, files: dict[str, str]) -> Path:
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(content)
    return folder


def commit(git: Git, folder: Path) -> str:
    if not (folder / ".git").exists():
        git("init", "-q", "-b", "main", cwd=folder)
    git("add", "--all", cwd=folder)
    git("commit", "-q", "-m", "x", cwd=folder)
    return git("rev-parse", "HEAD", cwd=folder)


def capture(root: Path, *paths: str, dirty: str = "record", large: int = LARGE) -> Source:
    return source.capture(root, paths=paths, without=WITHOUT, dirty=dirty, large=large)


def nothing(blob: str) -> bytes | None:
    """Stand for a store without files."""
    del blob


def restored(code: Source, root: Path, target: Path, content: Callable[[str], bytes | None] = nothing) -> dict[str, str]:
    """Restore a recorded source; return its paths and contents (targets of links)."""
    source.restore(code.tree, code.manifest, root, target, content)
    return {os.fsdecode(path): text for path, text in files_of(target)}


def files_of(folder: Path) -> Iterator[tuple[bytes, str]]:
    for path in sorted(folder.rglob("*")):
        if ".git" not in path.relative_to(folder).parts and (path.is_symlink() or path.is_file()):
            text = f"-> {path.readlink()}" if path.is_symlink() else path.read_bytes().decode(errors="surrogateescape")
            yield os.fsencode(path.relative_to(folder)), text


def one_line(error: pytest.ExceptionInfo[BaseException]) -> str:
    assert "\n" not in str(error.value)
    return str(error.value)


# ---------------------------------------------------------------- side effects


def state(repository: Path, git: Git) -> dict[str, object]:
    """Return the user's state: files with times, the bytes of the index, refs, stash, settings, the output of git."""
    own = repository / ".git"
    times = {path: path.lstat().st_mtime_ns for path in repository.rglob("*") if "objects" not in path.parts}
    kept = {
        p: t for p, t in times.items() if not p.is_relative_to(own / "sierra") and not p.is_relative_to(own / "refs/sierra")
    }
    return {
        "times": {path: when for path, when in kept.items() if path not in (own, own / "refs")},
        "contents": {path: path.read_bytes() for path in kept if path.is_file() and not path.is_symlink()},
        "refs": [line for line in git("for-each-ref").splitlines() if "refs/sierra/" not in line],
        "stash": git("stash", "list"),
        "status": git("--no-optional-locks", "status", "--porcelain=v2", "--branch", "--ignored"),
    }


def test_the_users_state_stays_unchanged_and_no_hook_runs(repository: Path, git: Git, tmp_path: Path) -> None:
    (repository / "a.txt").write_text("stashed")
    git("stash")
    (repository / "sub" / "b.txt").write_text("staged")
    git("add", "sub/b.txt")
    fill(repository, {"sub/b.txt": "and changed again", "untracked": "x", "n.log": "ignored", ".git/info/exclude": "*.log\n"})
    for hook in ("post-index-change", "reference-transaction", "pre-auto-gc", "post-checkout", "fsmonitor"):
        script = repository / ".git" / "hooks" / hook
        script.write_text(f"#!/bin/sh\ntouch '{tmp_path}/ran-{hook}'\n")
        script.chmod(0o755)
    git("config", "core.fsmonitor", str(repository / ".git" / "hooks" / "fsmonitor"))
    for path in tmp_path.glob("ran-*"):
        path.unlink()
    before = {**state(repository, lambda *a: git("-c", "core.fsmonitor=false", "-c", "core.hooksPath=/dev/null", *a))}
    code = capture(repository)
    capture(repository, dirty="ignore")
    restored(code, repository, tmp_path / "out")
    assert not list(tmp_path.glob("ran-*"))
    after = state(repository, lambda *a: git("-c", "core.fsmonitor=false", "-c", "core.hooksPath=/dev/null", *a))
    assert after == before


def test_a_session_within_a_hook_of_another_repository_records_the_projects_source(
    repository: Path, git: Git, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = capture(repository)
    other = fill(tmp_path / "other", {"x": "x"})
    commit(git, other)
    monkeypatch.setenv("GIT_DIR", str(other / ".git"))
    monkeypatch.setenv("GIT_INDEX_FILE", str(other / ".git" / "index"))
    assert capture(repository) == before


def test_concurrent_snapshots_agree_and_leave_no_temporary_files(repository: Path) -> None:
    fill(repository, {f"new/{number}": str(number) for number in range(600)})
    found: list[Source] = []
    threads = [threading.Thread(target=lambda: found.append(capture(repository))) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 4
    assert len({one.tree for one in found}) == 1
    assert {path.suffix for path in (repository / ".git" / "sierra").iterdir()} == {".index", ".rules"}


def test_old_files_of_a_killed_snapshot_are_removed(repository: Path) -> None:
    left = repository / ".git" / "sierra" / "dead.tmp"
    fill(repository, {".git/sierra/dead.tmp": "x", ".git/sierra/living.tmp": "x"})
    os.utime(left, (0, 0))
    capture(repository)
    assert not left.exists()
    assert (repository / ".git" / "sierra" / "living.tmp").exists()


def test_recorded_trees_survive_git_gc(repository: Path, git: Git, tmp_path: Path) -> None:
    fill(repository, {f"new/{number}": str(number) for number in range(600)})
    code = capture(repository)
    shutil.rmtree(repository / "new")
    git("reflog", "expire", "--expire=now", "--all")
    git("gc", "-q", "--prune=now")
    assert restored(code, repository, tmp_path / "out")["new/599"] == "599"


# ---------------------------------------------------------------- the cached index


def test_files_changed_and_changed_back_are_detected_each_time(repository: Path, git: Git) -> None:
    clean = capture(repository)
    trees = []
    for text in ("x", "y", "a"):  # of equal length, and written within one tick of the clock
        (repository / "a.txt").write_text(text)
        trees.append(capture(repository))
    assert len({code.tree for code in trees}) == 3
    assert (trees[2].tree, trees[2].dirty) == (clean.tree, False)
    assert clean.tree == SWHID + git("rev-parse", "HEAD^{tree}")


def test_files_that_git_ignores_now_are_no_longer_part_of_the_source(repository: Path, git: Git) -> None:
    fill(repository, {"new.log": "x", "tracked.log": "x", "added.log": "x"})
    before = capture(repository)
    git("add", "tracked.log", "added.log")
    git("commit", "-q", "-m", "x", "tracked.log")
    fill(repository, {".gitignore": "*.log\n"})
    assert source.paths(capture(repository).manifest) == source.paths(before.manifest) - {b"new.log"} | {b".gitignore"}
    git("rm", "-q", "--cached", "added.log")
    assert b"added.log" not in source.paths(capture(repository).manifest)
    (repository / ".git" / "index").write_bytes(b"nonsense")
    assert b"tracked.log" in source.paths(capture(repository).manifest)


def test_the_cached_index_follows_commits_and_branches(repository: Path, git: Git) -> None:
    first = capture(repository)
    git("checkout", "-q", "-b", "other")
    fill(repository, {"a.txt": "other", "c": "c"})
    dirty = capture(repository)
    commit(git, repository)
    clean = capture(repository)
    assert (dirty.tree, dirty.dirty, clean.dirty, clean.branch) == (clean.tree, True, False, "other")
    git("checkout", "-q", "main")
    assert capture(repository) == first


@pytest.mark.parametrize("damage", [b"", b"nonsense", b"DIRC" + bytes(100)])
def test_an_unreadable_index_is_discarded(repository: Path, git: Git, damage: bytes) -> None:
    before = capture(repository)
    [kept] = (repository / ".git" / "sierra").glob("*.index")
    kept.write_bytes(damage)
    assert capture(repository) == before
    kept.unlink()
    (repository / ".git" / "index").write_bytes(damage)
    now = capture(repository)
    assert (now.tree, now.dirty) == (before.tree, False)
    assert (repository / ".git" / "index").read_bytes() == damage


def test_a_leftover_lock_of_the_index_is_ignored(repository: Path) -> None:
    before = capture(repository)
    (repository / ".git" / "index.lock").touch()
    fill(repository, {"new": "x"})
    assert capture(repository).tree != before.tree


def test_git_settings_of_the_user_do_not_change_the_source(repository: Path, git: Git, tmp_path: Path) -> None:
    fill(repository, {"a.txt": "changed", "new": "x\r\n"})
    before = capture(repository)
    shutil.rmtree(repository / ".git" / "sierra")
    settings = (
        "core.ignoreStat=true core.safecrlf=true status.showUntrackedFiles=no core.untrackedCache=true core.splitIndex=true"
    )
    for setting in (*settings.split(), "feature.manyFiles=true", "diff.ignoreSubmodules=all", "core.commitGraph=false"):
        git("config", *setting.split("="))
    git("update-index", "--split-index", "--untracked-cache")
    assert [capture(repository) for _ in range(2)] == [before, before]
    fill(repository, {"a.txt": "changes", "sub/new": "x"})
    assert source.changed(before.manifest, capture(repository).manifest) == ["a.txt", "sub/new"]


@pytest.mark.parametrize("own", ["all ignored", "no repository"])
def test_a_folder_that_git_ignores_is_recorded_without_git(tmp_path: Path, own: str) -> None:
    """Git says of a folder with `*` in its .gitignore that it is ignored, and takes an empty .git for none."""
    outer, here = tmp_path / "outer", tmp_path / "outer" / "ignored"
    fill(here, {"sim.py": "print(1)"})
    if own == "all ignored":
        subprocess.run(["git", "init", "-q", str(here)], check=True)
        (here / ".gitignore").write_text("*\n")
    else:
        subprocess.run(["git", "init", "-q", str(outer)], check=True)
        (outer / ".gitignore").write_text("ignored\n")
        (here / ".git").mkdir()
    found = capture(here)
    assert (found.vcs, b"sim.py" in found.manifest) == ("none", True)


LYING_GIT = """#!/bin/sh
case "$*" in
*write-tree*) if [ "$(ls "{folder}" | wc -l)" -lt {lies} ]; then mktemp -p "{folder}" >/dev/null; echo {tree}; exit; fi ;;
esac
exec {git} "$@"
"""


@pytest.mark.parametrize("lies", [1, 9])
def test_a_tree_that_differs_from_the_listed_files_is_not_believed(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lies: int
) -> None:
    before = capture(repository)
    shutil.rmtree(repository / ".git" / "refs" / "sierra")  # else nobody writes the tree again
    folder, program = tmp_path / "lies", tmp_path / "bin" / "git"
    folder.mkdir()
    empty_tree = "4b825dc642cb6eb9a060e54bf8d69288fbee4904"
    fill(program.parent, {"git": LYING_GIT.format(folder=folder, lies=lies, tree=empty_tree, git=shutil.which("git"))})
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{program.parent}:{os.environ['PATH']}")
    if lies == 1:
        assert capture(repository) == before
    else:
        with pytest.raises(Missing, match="another tree than its index lists"):
            capture(repository)


def test_files_that_git_assumes_unchanged_are_part_of_the_source(repository: Path, git: Git) -> None:
    before = capture(repository)
    shutil.rmtree(repository / ".git" / "sierra")
    git("update-index", "--assume-unchanged", "a.txt")
    git("update-index", "--skip-worktree", "sub/b.txt")
    assert capture(repository).tree == before.tree
    fill(repository, {"a.txt": "changed"})
    once = capture(repository)
    fill(repository, {"sub/b.txt": "changed"})
    assert len({before.tree, once.tree, capture(repository).tree}) == 3
    assert once.dirty


# ---------------------------------------------------------------- kinds of repositories


def test_the_source_is_recorded_in_a_shallow_clone(repository: Path, git: Git, tmp_path: Path) -> None:
    fill(repository, {"a.txt": "later"})
    head = commit(git, repository)
    git("clone", "-q", "--depth=1", f"file://{repository}", str(tmp_path / "clone"))
    code = capture(tmp_path / "clone")
    assert (code.tree, code.commit, code.described) == (capture(repository).tree, head, head[:12])


def test_the_source_is_recorded_in_a_worktree_of_a_bare_repository(repository: Path, git: Git, tmp_path: Path) -> None:
    git("clone", "-q", "--bare", str(repository), str(tmp_path / "bare.git"))
    git("worktree", "add", "-q", str(tmp_path / "tree"), "main", cwd=tmp_path / "bare.git")
    fill(tmp_path / "tree", {"new": "x"})
    code = capture(tmp_path / "tree")
    assert (code.branch, code.dirty) == ("main", True)
    assert restored(code, tmp_path / "tree", tmp_path / "out") == {"a.txt": "a", "sub/b.txt": "b", "new": "x"}


def test_each_linked_worktree_has_its_own_index(repository: Path, git: Git, tmp_path: Path) -> None:
    git("worktree", "add", "-q", str(tmp_path / "linked"))
    fill(tmp_path / "linked", {"a.txt": "linked"})
    assert capture(tmp_path / "linked").tree != capture(repository).tree
    assert not capture(repository).dirty
    assert list((repository / ".git" / "worktrees" / "linked" / "sierra").iterdir())


def test_a_repository_configured_as_bare_is_refused_in_one_line(repository: Path, git: Git) -> None:
    git("config", "core.bare", "true")
    with pytest.raises(Missing, match="bare") as caught:
        capture(repository)
    one_line(caught)


def test_the_source_is_recorded_in_a_repository_with_sha256(folder: Path, git: Git, tmp_path: Path) -> None:
    git("init", "-q", "--object-format=sha256")
    code = capture(folder)
    assert len(code.tree) == len(SWHID) + 64
    assert restored(code, folder, tmp_path / "out") == {"a.txt": "a", "sub/b.txt": "b"}


def test_the_source_of_a_sparse_checkout_is_the_files_that_exist(repository: Path, git: Git, tmp_path: Path) -> None:
    fill(repository, {"other/c": "c"})
    whole = commit(git, repository)
    git("sparse-checkout", "set", "sub")
    code = capture(repository)
    assert (code.dirty, code.commit) == (False, whole)
    assert restored(code, repository, tmp_path / "out") == {os.fsdecode(p): t for p, t in files_of(repository)}
    assert "other/c" not in restored(code, repository, tmp_path / "again")
    asked = capture(repository, dirty="ignore")
    assert asked.checkout
    assert asked.tree == SWHID + git("rev-parse", "HEAD^{tree}")
    (repository / "sub" / "b.txt").unlink()
    assert capture(repository).dirty


def test_the_source_is_recorded_and_restored_in_a_partial_clone(repository: Path, git: Git, tmp_path: Path) -> None:
    git("config", "uploadpack.allowFilter", "true")
    git("clone", "-q", "--filter=blob:none", f"file://{repository}", str(tmp_path / "partial"))
    git("config", "remote.origin.url", "file:///nowhere", cwd=tmp_path / "partial")
    assert capture(tmp_path / "partial").tree == capture(repository).tree
    assert restored(capture(repository), tmp_path / "partial", tmp_path / "out") == {"a.txt": "a", "sub/b.txt": "b"}


def test_the_source_is_recorded_with_a_sparse_index(repository: Path, git: Git) -> None:
    fill(repository, {"other/c": "c"})
    commit(git, repository)
    git("sparse-checkout", "set", "--cone", "--sparse-index", "sub")
    assert not capture(repository).dirty
    assert b"other/c" not in source.paths(capture(repository).manifest)


def test_the_source_is_recorded_during_an_unresolved_merge(repository: Path, git: Git, tmp_path: Path) -> None:
    for branch, text in (("one", "1"), ("two", "2")):
        git("checkout", "-q", "-B", branch, "main")
        fill(repository, {"a.txt": text})
        commit(git, repository)
    with pytest.raises(subprocess.CalledProcessError):
        git("merge", "one")
    code = capture(repository)
    assert code.dirty
    assert "<<<<<<<" in restored(code, repository, tmp_path / "out")["a.txt"]


def test_the_source_of_a_project_in_a_subfolder_is_that_subfolder(repository: Path, git: Git, tmp_path: Path) -> None:
    code = capture(repository / "sub")
    assert (code.folder, capture(repository).folder) == ("sub", ".")
    assert code.tree == SWHID + git("rev-parse", "HEAD:sub")
    assert restored(code, repository / "sub", tmp_path / "out") == {"b.txt": "b"}
    (repository / "sub" / "b.txt").unlink()
    assert capture(repository / "sub").tree == SWHID + EMPTY_TREE
    new = fill(repository / "new" / "one", {"f": "f"})
    assert restored(capture(new), new, tmp_path / "new") == {"f": "f"}


def test_commits_are_described_by_tags(repository: Path, git: Git) -> None:
    git("tag", "v1")
    assert capture(repository).described == "v1"
    fill(repository, {"a.txt": "x"})
    assert capture(repository).described == "v1-dirty"
    head = commit(git, repository)
    assert capture(repository).described == f"v1-1-g{head[:12]}"


def test_the_error_for_a_repository_of_another_user_names_the_git_command(
    repository: Path, require: Callable[..., str]
) -> None:
    require("root, to give files away", there=os.geteuid() == 0)
    for path in (repository, repository / ".git"):
        os.chown(path, 12345, 12345)
    with pytest.raises(Missing, match=r"git config --global --add safe\.directory") as caught:
        capture(repository)
    one_line(caught)


@pytest.fixture
def reachable(repository: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Yield a repository that other users can access; a new session of pytest closes the folder of an earlier one."""
    monkeypatch.setenv("GIT_CONFIG_GLOBAL", os.devnull)
    with tempfile.TemporaryDirectory() as folder:
        yield shutil.copytree(repository, Path(folder, "p"), symlinks=True)


def test_a_repository_that_is_not_writable_is_reported_in_one_line(reachable: Path) -> None:
    repository = reachable
    fill(repository, {"a.txt": "changed"})
    subprocess.run(["chmod", "-R", "a-w", str(repository / ".git")], check=True)
    with somebody_else(repository), pytest.raises(Missing, match=r"cannot write to .*make it writable") as caught:
        capture(repository)
    one_line(caught)
    subprocess.run(["chmod", "-R", "a+w", str(repository / ".git")], check=True)
    (repository / ".git" / "sierra").mkdir(exist_ok=True)
    (repository / ".git" / "sierra").chmod(0o777)
    subprocess.run(["chmod", "-R", "a-w", str(repository / ".git" / "objects")], check=True)
    with somebody_else(repository), pytest.raises(Missing, match=r"cannot write to .*make it writable") as caught:
        capture(repository)
    one_line(caught)


@contextlib.contextmanager
def somebody_else(repository: Path) -> Iterator[None]:
    """Act as the owner of a repository instead of root: root may write everywhere."""
    if os.geteuid() != 0:
        yield
        return
    subprocess.run(["chown", "-R", "12345", str(repository)], check=True)
    for above in repository.parents:
        above.chmod(above.stat().st_mode | 0o555)
    os.seteuid(12345)
    try:
        yield
    finally:
        os.seteuid(0)


# ---------------------------------------------------------------- submodules


@pytest.fixture
def nested(repository: Path, git: Git, tmp_path: Path) -> Path:
    """Return the repository with a submodule `one` that has a submodule `two`."""
    two, one = fill(tmp_path / "two", {"f": "two"}), fill(tmp_path / "one", {"f": "one"})
    commit(git, two)
    commit(git, one)
    git("submodule", "add", "-q", str(two), "two", cwd=one)
    commit(git, one)
    git("submodule", "add", "-q", str(one), "one")
    git("submodule", "update", "-q", "--init", "--recursive")
    commit(git, repository)
    return repository


def test_submodules_are_recorded_with_their_commits(nested: Path, git: Git, tmp_path: Path) -> None:
    code = capture(nested)
    heads = {path: git("rev-parse", "HEAD", cwd=nested / path) for path in ("one", "one/two")}
    assert json.loads(code.submodules or "") == heads
    assert not code.dirty
    fill(nested, {"one/two/f": "changed"})
    changed = capture(nested)
    assert changed.dirty
    assert json.loads(changed.submodules or "") == heads
    assert restored(changed, nested, tmp_path / "out")["one/two/f"] == "changed"
    assert restored(code, nested, tmp_path / "clean")["one/two/f"] == "two"
    assert git("status", "--short", cwd=nested / "one" / "two") == "M f"


def test_the_index_of_a_submodule_stays_unchanged(nested: Path) -> None:
    [index] = (nested / ".git" / "modules" / "one").glob("index")
    (nested / "one" / "f").touch()
    before = index.read_bytes(), index.stat().st_mtime_ns
    capture(nested)
    assert (index.read_bytes(), index.stat().st_mtime_ns) == before


def test_a_submodule_that_is_not_checked_out_is_left_out_and_reported(nested: Path, git: Git, tmp_path: Path) -> None:
    there = capture(nested)
    git("clone", "-q", str(nested), str(tmp_path / "clone"))
    code = capture(tmp_path / "clone")
    assert code.tree != there.tree
    assert not code.dirty
    assert ["one: submodules that are not checked out" in note for note in code.notes] == [True]
    assert "one/f" not in restored(code, tmp_path / "clone", tmp_path / "out")
    assert capture(tmp_path / "clone", dirty="refuse").tree == code.tree
    fill(tmp_path / "clone", {"one/own": "a file in its place"})
    assert capture(tmp_path / "clone").dirty
    with pytest.raises(Missing, match="git submodule update"):
        restored(there, tmp_path / "clone", tmp_path / "again")


def test_a_nested_repository_that_is_not_a_submodule_needs_a_commit(repository: Path, git: Git, tmp_path: Path) -> None:
    inner = fill(repository / "inner", {"f": "f"})
    git("init", "-q", cwd=inner)
    with pytest.raises(Missing, match="without a commit") as caught:
        capture(repository)
    one_line(caught)
    commit(git, inner)
    code = capture(repository)
    assert json.loads(code.submodules or "") == {"inner": git("rev-parse", "HEAD", cwd=inner)}
    assert restored(code, repository, tmp_path / "out")["inner/f"] == "f"


# ---------------------------------------------------------------- dirty, large


def test_the_repository_of_a_home_folder_is_reported_once_and_can_be_left_out(
    git: Git, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    home = tmp_path / "p"
    root = fill(home / "work" / "project", {"a.txt": "a", "ignored.txt": "i"})
    fill(home, {".gitignore": "ignored.txt\n", ".gitattributes": "* text=auto\n"})
    commit(git, home)
    monkeypatch.setenv("HOME", str(home))
    [note] = capture(root).notes
    assert note.startswith(f"the git repository of this project is {home}; run git init in {root}, or set git = false")
    assert capture(home).notes == ()
    (tmp_path / "link").symlink_to(home)
    monkeypatch.setenv("HOME", str(tmp_path / "link"))
    assert capture(root).notes == (note,)
    assert len(capture(tmp_path / "link" / "work" / "project").notes) == 1
    (root / "a.txt").write_bytes(b"a\r\n")
    before = git("for-each-ref", "refs/sierra")
    found = source.capture(root, paths=(), without=WITHOUT, git=False)
    assert (found.vcs, found.commit, found.notes, found.converted) == ("none", None, (), {})
    assert set(source.blobs(found.manifest)) == {blob_of(b"a\r\n"), blob_of(b"i")}
    assert git("for-each-ref", "refs/sierra") == before
    shutil.copytree(root, outside := tmp_path / "outside")
    assert found.tree == source.capture(outside, paths=(), without=WITHOUT).tree
    with pytest.raises(ConfigError, match="git = false"):
        source.capture(root, paths=(), without=WITHOUT, git=False, dirty="ignore")


def blob_of(content: bytes) -> str:
    return hashlib.sha1(b"blob %d\0" % len(content) + content, usedforsecurity=False).hexdigest()


@pytest.mark.integration
def test_a_project_without_git_is_replayed_from_its_store(git: Git, tmp_path: Path) -> None:
    root = projects.make(tmp_path / "p" / "project", projects.CONFIG + "[source]\ngit = false\n")
    fill(tmp_path / "p", {".gitattributes": "* text=auto\n", ".gitignore": ".sierra\n"})
    (root / "sim.py").write_bytes((root / "sim.py").read_bytes().replace(b"\n", b"\r\n"))
    git("init", "-q", cwd=tmp_path / "p")
    git("add", "--all")
    git("commit", "-q", "-m", "x")
    summary, said = projects.run(root, "population_size=1")
    assert "git" not in said
    assert projects.sql(root, "SELECT vcs, commit FROM sources") == [{"vcs": "none", "commit": None}]
    (root / "sim.py").write_text("")
    done = projects.quick(root, "replay", summary["batch"][:10], "--json")
    assert (done.returncode, json.loads(done.stdout)["verdict"]) == (0, "identical"), done.stderr
    done = projects.quick(root, "source", "push")
    assert (done.returncode, "git = false" in done.stderr) == (2, True)


def test_dirty_refuse_names_the_changed_files_and_the_remedy(repository: Path, git: Git) -> None:
    clean = capture(repository, dirty="refuse")
    fill(repository, {"sierra.toml": "does not count", **{f"new{number}": "x" for number in range(5)}})
    with pytest.raises(ConfigError, match=r"new0, new1, new2 and 2 more: changed since commit \w{12}; commit") as caught:
        capture(repository, dirty="refuse")
    one_line(caught)
    assert capture(repository, "a.txt", "sub", dirty="refuse").tree == clean.tree


def test_dirty_ignore_uses_the_commits_tree_and_a_checkout_if_files_differ(repository: Path, git: Git, tmp_path: Path) -> None:
    clean = capture(repository)
    assert capture(repository, dirty="ignore") == clean
    fill(repository, {"sub/b.txt": "changed", "new": "x", "huge": "x" * 1000})
    code = capture(repository, dirty="ignore", large=100)
    assert (code.tree, code.dirty, code.checkout, code.described) == (clean.tree, False, True, clean.described)
    assert code.id == clean.id
    assert restored(code, repository, tmp_path / "out") == {"a.txt": "a", "sub/b.txt": "b"}
    assert not capture(repository, "a.txt", dirty="ignore").checkout
    fill(repository, {"sub/b.txt": "b"})
    git("clean", "-fdq")
    assert not capture(repository, dirty="ignore").checkout


@pytest.mark.parametrize("dirty", ["refuse", "ignore"])
def test_dirty_refuse_and_ignore_need_a_commit(folder: Path, git: Git, dirty: str) -> None:
    with pytest.raises(ConfigError, match="there is no commit to compare with") as caught:
        capture(folder, dirty=dirty)
    one_line(caught)
    git("init", "-q")
    with pytest.raises(ConfigError, match="no commit yet"):
        capture(folder, dirty=dirty)


@pytest.mark.parametrize("inside", [False, True])
def test_a_large_file_is_refused_and_the_error_names_the_remedies(folder: Path, git: Git, inside: bool, tmp_path: Path) -> None:
    if inside:
        git("init", "-q")
    fill(folder, {"sub/big.bin": "x" * 2000})
    with pytest.raises(
        ConfigError, match=r"sub/big\.bin has 2 kB, more than the 1 kB of \[source\] max_untracked; .*\[source\] paths"
    ) as error:
        capture(folder, large=1000)
    one_line(error)
    assert not inside or not git("count-objects").startswith("3")
    assert capture(folder, "a.txt", large=1000).manifest.count(b"\0") == 1
    code = capture(folder, large=2000)
    kept = dict(source.contents(code, folder, set()))
    assert restored(code, folder, tmp_path / "out", kept.get)["sub/big.bin"] == "x" * 2000


def test_a_large_tracked_file_is_accepted_and_an_untracked_one_that_grows_is_not(repository: Path, git: Git) -> None:
    fill(repository, {"tracked": "x" * 2000, "grows": "x"})
    git("add", "tracked")
    capture(repository, large=1000)
    fill(repository, {"grows": "x" * 2000})
    with pytest.raises(ConfigError, match="grows has 2 kB"):
        capture(repository, large=1000)
    fill(repository, {".gitignore": "grows\n"})
    capture(repository, large=1000)


def test_sierra_toml_sets_the_size_limit_of_untracked_files(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "p", projects.CONFIG + '[source]\nmax_untracked = "1 kB"\n')
    fill(root, {"big": "x" * 1001})
    ended = projects.quick(root, "run", "population_size=1")
    assert ended.returncode == 2
    assert "big has 1 kB, more than the 1 kB" in ended.stderr


# ---------------------------------------------------------------- files


def test_file_names_may_contain_any_bytes(repository: Path, git: Git, tmp_path: Path) -> None:
    names = [b"new\nline", b"tab\t", b"'quote\"", b"\xff\xfe", b":(top)", b"*", b"-dash", b"A", b"a", b" ", b"back\\slash"]
    for name in names:
        Path(os.fsdecode(os.fsencode(repository) + b"/" + name)).write_bytes(name)
    code = capture(repository)
    assert {os.fsdecode(name) for name in names} < restored(code, repository, tmp_path / "out").keys()
    assert code.tree == capture(repository).tree
    with pytest.raises(ConfigError) as caught:
        capture(repository, dirty="refuse")
    one_line(caught)


def test_pipes_and_sockets_are_not_part_of_the_source(repository: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = capture(repository)
    os.mkfifo(repository / "pipe")
    monkeypatch.chdir(repository)
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind("socket")
        assert capture(repository) == before
        (repository / "a.txt").unlink()
        os.mkfifo(repository / "a.txt")
        assert b"a.txt" not in source.paths(capture(repository).manifest)
    shutil.rmtree(repository / ".git")
    assert b"pipe" not in source.paths(capture(repository).manifest)


def test_files_that_become_folders_or_links_are_recorded_as_such(repository: Path, tmp_path: Path) -> None:
    capture(repository)
    (repository / "a.txt").unlink()
    shutil.rmtree(repository / "sub")
    fill(repository, {"a.txt/inside": "x"})
    (repository / "sub").symlink_to("a.txt")
    code = capture(repository)
    assert restored(code, repository, tmp_path / "out") == {"a.txt/inside": "x", "sub": "-> a.txt"}


@pytest.mark.parametrize("inside", [False, True])
def test_links_out_of_the_project_are_reported(folder: Path, git: Git, tmp_path: Path, inside: bool) -> None:
    if inside:
        commit(git, folder)
    assert capture(folder).notes == ()
    (folder / "out").symlink_to(tmp_path)
    (folder / "in").symlink_to("a.txt")
    [note] = capture(folder).notes
    assert note.startswith("out: links out of the project")


def test_a_thousand_new_files_give_the_tree_of_git_with_few_loose_objects(repository: Path, git: Git, tmp_path: Path) -> None:
    files = {f"many/{number}": "x" * number for number in range(1000)}
    fill(repository, {**files, "many/large": "x" * 100_000})
    (repository / "many" / "link").symlink_to("0")
    code = capture(repository)
    loose = list((repository / ".git" / "objects").glob("??/*"))
    assert len(loose) < 20
    assert restored(code, repository, tmp_path / "out").items() >= files.items()
    commit(git, repository)
    assert code.tree == SWHID + git("rev-parse", "HEAD^{tree}")


def test_line_endings_and_filters_are_applied_as_git_commits_them(repository: Path, git: Git, tmp_path: Path) -> None:
    fill(repository, {".gitattributes": "*.txt text eol=crlf\n*.up filter=up\n", "x.up": "shout"})
    git("config", "filter.up.clean", "tr a-z A-Z")
    git("config", "filter.up.smudge", "tr A-Z a-z")
    (repository / "a.txt").write_bytes(b"one\r\ntwo\r\n")
    code = capture(repository)
    commit(git, repository)
    assert code.tree == SWHID + git("rev-parse", "HEAD^{tree}")
    assert not capture(repository).dirty
    out = restored(code, repository, tmp_path / "out")
    assert (out["a.txt"], out["x.up"]) == ("one\r\ntwo\r\n", "shout")


def test_git_attributes_above_the_project_apply_to_restored_files(repository: Path, git: Git, tmp_path: Path) -> None:
    fill(repository, {".gitattributes": "*.txt text eol=crlf\n"})
    (repository / "sub" / "b.txt").write_bytes(b"one\r\n")
    commit(git, repository)
    code = capture(repository / "sub")
    assert restored(code, repository / "sub", tmp_path / "out") == {"b.txt": "one\r\n"}


# ---------------------------------------------------------------- git-lfs


def test_pointers_of_git_lfs_instead_of_data_are_an_error(repository: Path, git: Git) -> None:
    fill(repository, {".gitattributes": "*.bin filter=lfs diff=lfs merge=lfs -text\n", "data/x.bin": POINTER, "text": POINTER})
    commit(git, repository)
    with pytest.raises(
        Missing, match=r"data/x\.bin: git-lfs pointers without their data; fetch the data with git lfs"
    ) as caught:
        capture(repository)
    assert "text" not in one_line(caught)
    assert capture(repository, "a.txt").tree
    with pytest.raises(Missing, match="git-lfs pointers without their data"):
        capture(repository / "data")
    (repository / "data" / "x.bin").write_text("the data")
    assert capture(repository).dirty


def test_pointers_of_git_lfs_in_a_submodule_are_an_error(nested: Path, git: Git) -> None:
    fill(nested, {"one/.gitattributes": "*.bin filter=lfs -text\n", "one/x.bin": POINTER})
    commit(git, nested / "one")
    commit(git, nested)
    with pytest.raises(Missing, match=r"x\.bin: git-lfs pointers without their data"):
        capture(nested)


def test_a_missing_git_lfs_is_reported_in_one_line(repository: Path, git: Git) -> None:
    absent = "git-lfs-that-is-nowhere"
    for name, value in {"process": f"{absent} filter-process", "clean": f"{absent} clean -- %f", "required": "true"}.items():
        git("config", f"filter.lfs.{name}", value)
    fill(repository, {".gitattributes": "*.bin filter=lfs -text\n", "x.bin": "data"})
    with pytest.raises(Missing, match="git-lfs") as caught:
        capture(repository)
    assert "install git-lfs" in one_line(caught)


# ---------------------------------------------------------------- restoring elsewhere


def test_another_clone_restores_a_clean_tree_from_its_commit(repository: Path, git: Git, tmp_path: Path) -> None:
    fill(repository, {"sierra.toml": "left out", "t.xml": "left out"})
    commit(git, repository)
    code = capture(repository)
    fill(repository, {"a.txt": "only here"})
    dirty = capture(repository)
    git("clone", "-q", f"file://{repository}", str(tmp_path / "clone"))
    assert restored(code, tmp_path / "clone", tmp_path / "out") == {"a.txt": "a", "sub/b.txt": "b"}
    with pytest.raises(Missing, match=r"file 'a\.txt' is neither in git .* nor in the store") as caught:
        source.restore(dirty.tree, dirty.manifest, tmp_path / "clone", tmp_path / "no", nothing, commit=dirty.commit)
    assert "never committed: run sierra source fetch" in one_line(caught)  # the commit exists: fetching it would not help
    git("init", "-q", str(tmp_path / "empty"))
    with pytest.raises(Missing) as caught:
        source.restore(dirty.tree, dirty.manifest, tmp_path / "empty", tmp_path / "never", nothing, commit=dirty.commit)
    assert f"fetch commit {str(dirty.commit)[:12]} (git fetch)" in one_line(caught)
    blob = hashlib.sha1(b"blob 9\0only here", usedforsecurity=False).hexdigest()
    assert restored(dirty, tmp_path / "clone", tmp_path / "yes", {blob: b"only here"}.get)["a.txt"] == "only here"


@pytest.mark.integration
def test_uncommitted_code_is_shared_by_source_push_and_fetch(nested: Path, git: Git, tmp_path: Path) -> None:
    bares = {path: tmp_path / f"{path.replace('/', '-')}.git" for path in (".", "one", "one/two")}
    for path, bare in bares.items():
        git("clone", "-q", "--bare", str(nested / path), str(bare))
        git("remote", "add", "shared", str(bare), cwd=nested / path)
    fill(nested, {"a.txt": "changed", "one/f": "changed", "one/two/f": "changed"})
    code = capture(nested)
    clone = tmp_path / "clone"
    git("clone", "-q", str(bares["."]), str(clone))
    git("submodule", "update", "-q", "--init", "--recursive", cwd=clone)
    for path in ("one", "one/two"):
        git("remote", "set-url", "origin", str(bares[path]), cwd=clone / path)
    with pytest.raises(Missing, match="sierra source fetch"):
        restored(code, clone, tmp_path / "before")
    assert source.share(clone, "fetch")[0].sources == 0
    before = state(nested, git)
    pushed = source.share(nested, "push", "shared")
    assert [(one.repository, one.remote, one.new > 0) for one in pushed] == [(path, "shared", True) for path in bares]
    assert [one.new for one in source.share(nested, "push", "shared")] == [0, 0, 0]
    assert state(nested, git) == before
    files = dict(files_of(clone))
    before = [git("status", "--porcelain=v2"), git("for-each-ref", "refs/heads", "refs/tags", "refs/remotes", cwd=clone)]
    fetched = source.share(clone, "fetch")
    assert [(one.repository, one.new) for one in fetched] == [(one.repository, one.new) for one in pushed]
    assert [
        git("status", "--porcelain=v2"),
        git("for-each-ref", "refs/heads", "refs/tags", "refs/remotes", cwd=clone),
    ] == before
    assert dict(files_of(clone)) == files
    there = restored(code, clone, tmp_path / "after")
    assert {there[path] for path in ("a.txt", "one/f", "one/two/f")} == {"changed"}


def test_the_error_for_a_changed_submodule_names_source_fetch(nested: Path, git: Git, tmp_path: Path) -> None:
    fill(nested, {"one/f": "changed"})
    code = capture(nested)
    clone = tmp_path / "clone"
    git("clone", "-q", str(nested), str(clone))
    git("submodule", "update", "-q", "--init", "--recursive", cwd=clone)
    source.share(nested, "push", str(clone))
    with pytest.raises(Missing, match="submodule 'one'") as caught:
        restored(code, clone, tmp_path / "out")
    assert "sierra source fetch" in one_line(caught)
    assert [source.is_available(root, code.tree, code.manifest) for root in (nested, clone)] == [True, False]


def test_a_missing_file_outside_submodules_is_named(nested: Path, git: Git, tmp_path: Path) -> None:
    fill(nested, {"sub/b.txt": "changed"})
    code = capture(nested)
    git("clone", "-q", f"file://{nested}", str(tmp_path / "clone"))
    with pytest.raises(Missing, match=r"file 'sub/b\.txt' is neither in git"):
        restored(code, tmp_path / "clone", tmp_path / "out")


@pytest.mark.nightly
def test_the_source_command_pushes_and_fetches_sources(repository: Path, git: Git, tmp_path: Path) -> None:
    root = projects.commit(projects.make(tmp_path / "project"))
    git("init", "-q", "--bare", str(tmp_path / "bare"))
    refused = projects.quick(root, "source", "push")
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)
    git("remote", "add", "origin", str(tmp_path / "bare"), cwd=root)
    git("push", "-q", "origin", "HEAD:main", cwd=root)
    (root / "sim.py").write_text((root / "sim.py").read_text() + "# never committed\n")
    batch = sierra.open(root).run("population_size=1", runs=1, figures=False).batch
    git("clone", "-q", "-b", "main", str(tmp_path / "bare"), str(tmp_path / "clone"))
    clone = tmp_path / "clone"
    shutil.copytree(root / ".sierra", clone / ".sierra")
    refused = projects.quick(clone, "replay", batch)
    assert (refused.returncode, "sierra source fetch" in refused.stderr) == (3, True)
    done = projects.quick(root, "source", "push")
    assert (done.returncode, done.stdout) == (0, ".: 1 source pushed to origin, 1 of them new\n")
    done = projects.quick(clone, "source", "fetch", "--json")
    assert json.loads(done.stdout) == [{"repository": ".", "remote": "origin", "sources": 1, "new": 1}]
    assert projects.quick(clone, "replay", batch).returncode == 0
    for words in (("source", "fetch", "--upload-pack=touch x"), ("source", "fetch", "nowhere"), ("source", "push", "ext::sh")):
        refused = projects.quick(clone, *words)
        assert refused.returncode in (2, 3)
        assert refused.stderr.count("\n") == 1
    assert projects.quick(projects.make(tmp_path / "none"), "source", "push").returncode == 2


def test_the_content_is_recorded_that_was_hashed_although_the_file_changes(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fill(folder, {"log": "old\n", "gone": "x", "other": "y"})
    code = capture(folder)
    (folder / "log").write_text("old\nnew\n")
    (folder / "gone").unlink()
    (folder / "other").write_text("z")
    assert sorted(content for _, content in source.contents(code, folder, set())) == [b"a", b"b", b"old\n", b"x", b"y"]
    monkeypatch.setattr("sierra.provenance.source.plain_tree.KEPT_BYTES", 0)
    code = capture(folder)
    (folder / "log").write_text("old\nnew\nnewer\n")
    assert b"old\nnew\n" in [content for _, content in source.contents(code, folder, set())]
    (folder / "log").write_text("new\n")
    with pytest.raises(Missing, match=r"/log changed while it was being recorded; run the command again"):
        list(source.contents(code, folder, set()))
    (folder / "log").unlink()
    with pytest.raises(Missing, match=r"cannot read .*/log: No such file"):
        list(source.contents(code, folder, set()))


def test_a_source_recorded_outside_git_is_restored_inside_and_outside_git(folder: Path, git: Git, tmp_path: Path) -> None:
    (folder / "a.txt").chmod(0o755)
    outside = capture(folder)
    kept = dict(source.contents(outside, folder, set()))
    assert restored(outside, tmp_path, tmp_path / "one", kept.get) == {"a.txt": "a", "sub/b.txt": "b"}
    commit(git, folder)
    assert restored(outside, folder, tmp_path / "two") == {"a.txt": "a", "sub/b.txt": "b"}
    for place in ("one", "two"):
        assert os.access(tmp_path / place / "a.txt", os.X_OK)


@pytest.mark.parametrize("blob", ["--textconv", "HEAD:a", "0" * 39, "0" * 41, ""])
def test_invalid_hashes_of_a_hostile_manifest_never_reach_git(folder: Path, git: Git, tmp_path: Path, blob: str) -> None:
    commit(git, folder)
    with pytest.raises(Damaged, match=r"whose hash .* is not a git hash"):
        source.restore("git:x", f"100644 {blob}\ta\0".encode(), folder, tmp_path / "out", nothing)


@pytest.mark.parametrize(
    "path", [b"../out", b"/tmp/out", b"a/../../out", b".git/config", b"x/.GIT/hooks/y", b"link/out", b"a//b"]
)
@pytest.mark.parametrize("inside", [False, True])
def test_paths_of_a_hostile_manifest_never_leave_the_folder(
    folder: Path, git: Git, tmp_path: Path, path: bytes, inside: bool
) -> None:
    if inside:
        commit(git, folder)
    blob = hashlib.sha1(b"blob 1\0a", usedforsecurity=False).hexdigest()
    link = hashlib.sha1(b"blob 2\0..", usedforsecurity=False).hexdigest()
    manifest = f"120000 {link}\tlink\x00100644 {blob}\t".encode() + path + b"\0"
    with pytest.raises(Damaged, match="which is not allowed in a source"):
        source.restore(SWHID + "0" * 40, manifest, folder, tmp_path / "x" / "y", {blob: b"a", link: b".."}.get)
    assert not (tmp_path / "x").exists()


def test_a_manifest_of_another_tree_is_not_restored(folder: Path, tmp_path: Path) -> None:
    first = capture(folder)
    (folder / "a.txt").write_text("other")
    with pytest.raises(Damaged, match="other code would be restored"):
        source.restore(first.tree, capture(folder).manifest, folder, tmp_path / "x", {}.get)
    assert not (tmp_path / "x").exists()


# ---------------------------------------------------------------- outside git


def remembered(root: Path, memory: Path) -> Source:
    return source.capture(root, paths=(), without=WITHOUT, memory=memory)


@pytest.mark.integration
def test_cached_hashes_equal_those_of_the_files(folder: Path, tmp_path: Path) -> None:
    memory = tmp_path / "memory"
    first = remembered(folder, memory)
    assert not memory.exists()  # hashes of files that were just written are not cached
    time.sleep(2.1)
    assert remembered(folder, memory) == first
    assert b"a.txt" in memory.read_bytes()
    before = (folder / "a.txt").stat()
    (folder / "a.txt").write_text("b")
    os.utime(folder / "a.txt", ns=(before.st_atime_ns, before.st_mtime_ns))
    assert remembered(folder, memory).tree == capture(folder).tree != first.tree
    (folder / "sub" / "b.txt").chmod(0o755)
    assert remembered(folder, memory).tree == capture(folder).tree
    (folder / "a.txt").unlink()
    assert remembered(folder, memory).tree == capture(folder).tree


@pytest.mark.integration
def test_valid_cached_hashes_are_used_and_damaged_ones_are_not(folder: Path, tmp_path: Path) -> None:
    memory = tmp_path / "memory"
    time.sleep(2.1)
    first = remembered(folder, memory)
    blob = hashlib.sha1(b"blob 1\0a", usedforsecurity=False).hexdigest().encode()
    wrong = (unsealed(memory.read_bytes()) or b"").replace(blob, b"0" * 40)
    memory.write_bytes(sealed(wrong))
    assert remembered(folder, memory).tree != first.tree
    for damaged in (wrong, sealed(wrong)[:-1], b"nonsense\0\t\0x\ty\0"):
        memory.write_bytes(damaged)
        assert remembered(folder, memory).tree == first.tree


# ---------------------------------------------------------------- addresses


@pytest.mark.parametrize(
    ("address", "kept"),
    [
        ("https://host.org/a/x.git", "https://host.org/a/x.git"),
        ("https://SECRET:x-oauth-basic@github.com/a/x.git", "https://github.com/a/x.git"),
        ("https://SECRET@dev.azure.com/o/p/_git/x", "https://dev.azure.com/o/p/_git/x"),
        ("https://oauth2:SECRET@gitlab.org:8443/x.git", "https://gitlab.org:8443/x.git"),
        ("https://a:SEC/RET@host.org/x.git", "https://host.org/x.git"),
        ("https://a:SEC@RET@host.org/x.git", "https://host.org/x.git"),
        ("https:///a:SECRET@host.org/x.git", "https://host.org/x.git"),
        ("https://a:SEC%40RET@host.org/x.git?access_token=SECRET&x=1", "https://host.org/x.git"),
        ("https://host.org/x.git#SECRET", "https://host.org/x.git"),
        ("https://host.org/x.git;token=SECRET", "https://host.org/x.git"),
        ("HTTPS://a:SECRET@host.org/x", "HTTPS://host.org/x"),
        ("https://a:SEC\nRET@host.org/x", "https://host.org/x"),
        ("ssh://alice:SECRET@host.org:22/x.git", "ssh://host.org:22/x.git"),
        ("git+ssh://SECRET@[::1]:22/x.git", "git+ssh://[::1]:22/x.git"),
        ("persistent-https::https://a:SECRET@host.org/x", "persistent-https::https://host.org/x"),
        ("alice:SECRET@host.org:x.git", "host.org:x.git"),
        ("alice:SEC@RET@host.org:x.git", "host.org:x.git"),
        ("SECRET@host.org:x.git", "host.org:x.git"),
        ("git@host.org:a@b.git", "git@host.org:a@b.git"),
        ("host.org:a@b.git", "host.org:a@b.git"),
        ("https:a:SECRET@host.org/x", "host.org/x"),
        ("ext::sh -c 'curl -u a:SECRET host.org'", "ext::"),
        ("/srv/a@b.git", "/srv/a@b.git"),
        ("../a@b.git", "../a@b.git"),
        ("", ""),
    ],
)
def test_addresses_of_remotes_are_recorded_without_credentials(address: str, kept: str) -> None:
    said = without_credentials(address)
    assert "SEC" not in said
    assert "RET" not in said
    if kept != "host.org:a@b.git":
        assert said == kept


def test_the_recorded_remote_belongs_to_the_branch(repository: Path, git: Git) -> None:
    assert capture(repository).remote is None
    git("remote", "add", "upstream", "https://a:b@host.org/up")
    assert capture(repository).remote == "https://host.org/up"
    git("remote", "add", "origin", "https://host.org/origin")
    assert capture(repository).remote == "https://host.org/origin"
    git("config", "branch.main.remote", "upstream")
    assert capture(repository).remote == "https://host.org/up"


# ---------------------------------------------------------------- in the store


@pytest.mark.integration
def test_sql_and_show_display_the_state_of_the_source(tmp_path: Path, git: Git) -> None:
    root = projects.make(tmp_path / "p" / "study")
    commit(git, tmp_path / "p")
    git("tag", "v1")
    fill(root, {"new.py": "x"})
    project = sierra.open(root)
    batch = project.run("population_size=1", figures=False).batch
    rows = project.sql("SELECT folder, described, dirty, submodules, branch FROM sources").to_pylist()
    assert rows == [{"folder": "study", "described": "v1-dirty", "dirty": True, "submodules": None, "branch": "main"}]
    assert "v1-dirty" in projects.quick(root, "show", batch).stdout

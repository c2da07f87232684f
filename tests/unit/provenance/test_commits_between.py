"""Commits are described with GitPython, and no program that the repository configures is executed."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from sierra.provenance import commits_between
from tests import projects

AUTHOR = ("-c", "user.name=Ada", "-c", "user.email=ada@example.org")
EMPTY = ("commit", "-q", "--allow-empty", "-m")


def git(root: Path, *words: str) -> str:
    return subprocess.run(["git", *AUTHOR, *words], cwd=root, check=True, capture_output=True, text=True).stdout.strip()


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """Return a repository without commits."""
    root = tmp_path / "repository"
    root.mkdir()
    git(root, "init", "-q", "-b", "main")
    return root


def committed(root: Path, subject: str) -> str:
    git(root, *EMPTY, subject)
    return git(root, "rev-parse", "HEAD")


def test_commits_between_two_states_are_listed_with_author_date_and_subject(repository: Path) -> None:
    first, second = committed(repository, "Begin"), committed(repository, "Größer: “ein Test”")
    found = commits_between.between(repository, first, second)
    assert (found.on, found.back, found.base, found.missing) == (1, 0, first, ())
    [commit] = commits_between.listed(repository, first, second)
    assert (commit.id, commit.author, commit.subject) == (second, "Ada", "Größer: “ein Test”")
    assert f"{commit.date:%Y-%m-%dT%H:%M:%S}" == git(repository, "log", "-1", "--format=%aI")[:19]
    assert commits_between.between(repository, second, first).back == 1
    assert commits_between.listed(repository, second, first) == ()


def test_diverged_histories_have_a_base_and_unrelated_ones_do_not(repository: Path) -> None:
    base = committed(repository, "Begin")
    left = committed(repository, "Left")
    git(repository, "checkout", "-q", "-b", "other", base)
    right = committed(repository, "Right")
    found = commits_between.between(repository, left, right)
    assert (found.on, found.back, found.base) == (1, 1, base)
    git(repository, "checkout", "-q", "--orphan", "alone")
    assert commits_between.between(repository, left, committed(repository, "Alone")).base is None


def test_at_most_20_commits_are_listed_and_all_are_counted(repository: Path) -> None:
    first = committed(repository, "Begin")
    for number in range(23):
        last = committed(repository, f"Change {number}")
    found = commits_between.between(repository, first, last)
    log = commits_between.listed(repository, first, last)
    assert (found.on, len(log), log[0].subject) == (23, 20, "Change 22")


def test_a_commit_is_described_by_its_tag_branches_and_remote(repository: Path) -> None:
    first = committed(repository, "Begin")
    git(repository, "tag", "v1")
    git(repository, "remote", "add", "origin", "https://ada:secret@example.org/swarm.git?token=secret")
    committed(repository, "Go on")
    found = commits_between.known(repository, first)
    assert found is not None
    assert (found.commit.subject, found.described, found.branches) == ("Begin", "v1", ("main", "v1"))
    assert found.remote == "https://example.org/swarm.git"


def test_the_history_of_a_repository_with_sha256_is_read(tmp_path: Path) -> None:
    git(tmp_path, "init", "-q", "--object-format=sha256")
    first, second = committed(tmp_path, "Begin"), committed(tmp_path, "Go on")
    assert [commit.subject for commit in commits_between.listed(tmp_path, first, second)] == ["Go on"]


def test_commits_are_missing_in_a_folder_without_a_repository(tmp_path: Path) -> None:
    assert commits_between.known(tmp_path, "0" * 40) is None
    assert commits_between.between(tmp_path, "0" * 40, "1" * 40).missing == ("0" * 40, "1" * 40)


@pytest.mark.parametrize("commit", ["--output=written", "HEAD", "-h", "", "0" * 39])
def test_texts_that_are_not_hashes_never_reach_git(repository: Path, commit: str) -> None:
    committed(repository, "Begin")
    assert commits_between.known(repository, commit) is None
    assert commits_between.between(repository, commit, commit).missing == (commit,)
    assert not (repository / "written").exists()


def test_git_environment_variables_do_not_redirect_the_history(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = committed(repository, "Begin"), committed(repository, "Go on")
    other = tmp_path / "other"
    other.mkdir()
    git(other, "init", "-q")
    monkeypatch.setenv("GIT_DIR", str(other / ".git"))
    monkeypatch.setenv("GIT_OBJECT_DIRECTORY", str(other / ".git" / "objects"))
    monkeypatch.setenv("GIT_OPTIONAL_LOCKS", "1")
    found = commits_between.known(repository, first)
    assert found is not None
    assert found.commit.subject == "Begin"
    assert [commit.id for commit in commits_between.listed(repository, first, second)] == [second]


def test_programs_that_a_hostile_repository_configures_are_not_executed(repository: Path, tmp_path: Path) -> None:
    first = committed(repository, "Begin")
    program = tmp_path / "program"
    program.write_text(f"#!/bin/sh\ntouch '{tmp_path}/ran-'$$\nexit 1\n")
    program.chmod(0o755)
    (repository / ".gitattributes").write_text("* diff=evil filter=evil\n")
    git(repository, "add", ".")
    second = committed(repository, "Add attributes")
    signed = git(repository, "cat-file", "commit", second).replace(
        "\n\n", "\ngpgsig -----BEGIN PGP SIGNATURE-----\n \n x\n -----END PGP SIGNATURE-----\n\n", 1
    )
    written = subprocess.run(
        ["git", "hash-object", "-t", "commit", "-w", "--stdin"], input=signed + "\n", cwd=repository, text=True,
        capture_output=True, check=True,
    )  # fmt: skip
    second = written.stdout.strip()
    for name in (
        *("core.fsmonitor", "core.pager", "pager.log", "pager.describe", "core.sshCommand", "core.editor", "gpg.program"),
        *("diff.external", "diff.evil.textconv", "diff.evil.command", "filter.evil.smudge", "filter.evil.clean"),
        *("core.alternateRefsCommand", "core.gitProxy", "core.askPass", "credential.helper", "alias.log"),
    ):
        git(repository, "config", name, f"!{program}" if name == "alias.log" else str(program))
    for name in ("post-checkout", "reference-transaction", "post-index-change"):
        (repository / ".git" / "hooks" / name).symlink_to(program)
    for name, value in (
        ("log.showSignature", "true"),
        ("core.repositoryFormatVersion", "1"),
        ("extensions.partialClone", "origin"),
        ("remote.origin.promisor", "true"),
        ("remote.origin.url", f"ext::{program}"),
        ("protocol.ext.allow", "always"),
        ("protocol.allow", "always"),
    ):
        git(repository, "config", name, value)
    for left in tmp_path.glob("ran-*"):
        left.unlink()
    absent = "1" * 40
    assert commits_between.between(repository, first, second).on == 1
    assert [commit.id for commit in commits_between.listed(repository, first, second)] == [second]
    assert commits_between.listed(repository, first, absent) == ()
    assert commits_between.between(repository, first, absent).missing == (absent,)
    assert commits_between.known(repository, second) is not None
    assert not list(tmp_path.glob("ran-*"))
    subprocess.run(["git", "cat-file", "-e", absent], cwd=repository, check=False, capture_output=True)
    assert list(tmp_path.glob("ran-*")), "the trap would not notice"


@pytest.mark.integration
def test_show_names_the_recorded_commit_and_diff_the_commits_between(tmp_path: Path) -> None:
    root = projects.commit(projects.make(tmp_path / "project"), "Begin")
    git(root, "remote", "add", "origin", "https://ada:secret@example.org/swarm.git")
    assert projects.quick(root, "run", "population_size=1", "--no-figures").returncode == 0
    (root / "sim.py").write_text(projects.SIMULATOR + "# more\n")
    projects.commit(root, "Say more")
    git(root, "tag", "v2")
    assert projects.quick(root, "run", "population_size=1", "--no-figures").returncode == 0
    before, after = (row["batch"] for row in json.loads(projects.quick(root, "ls", "--json").stdout))
    shown = projects.quick(root, "show", after).stdout
    section = dict(line.split(maxsplit=1) for line in shown.split("in the repository now:\n")[1].splitlines()[:5])
    assert section.pop("author").startswith("a, 20")
    assert section == {
        "subject": "Say more",
        "described": "v2",
        "branches/tags": f"{git(root, 'branch', '--show-current')}, v2",
        "remote": "https://example.org/swarm.git",
    }
    assert "secret" not in shown
    told = projects.quick(root, "diff", before, after).stdout
    assert "; 1 commit ahead" in told
    assert "a: Say more" in told
    assert "the first commit is an ancestor of the second" in told
    assert json.loads(projects.quick(root, "show", after, "--json").stdout)["history"]["described"] == "v2"

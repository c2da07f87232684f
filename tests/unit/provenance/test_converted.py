"""Files that git would restore with other bytes than those on disk: reuse needs equal bytes, and replays restore them."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

import sierra
from sierra.provenance import change_guard, source
from sierra.provenance.dependency_model import Kind, Program, Programs
from sierra.provenance.source import converted, manifest, worktree_snapshot
from sierra.provenance.source.capture import Source
from tests import projects

Git = Callable[..., str]
SETTINGS = {
    "filter.strip.clean": "sed s/local.*/local/",
    "filter.up.clean": "tr a-z A-Z",
    "filter.up.smudge": "tr A-Z a-z",
    "filter.lfs.clean": "pointer=$(mktemp); cat > $pointer; echo version https://git-lfs.github.com/spec/v1; "
    'echo "oid sha256:$(sha256sum < $pointer | cut -c -64)"; echo "size $(wc -c < $pointer)"; rm $pointer',
    "filter.lfs.smudge": "false",
}


@pytest.fixture
def git(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Git:
    """Git in the folder `tmp_path/p`, without the settings of this machine."""
    (tmp_path / "p").mkdir()
    lines = "".join(
        f'[filter "{name.split(".")[1]}"]\n{name.split(".")[2]} = {json.dumps(text)}\n' for name, text in SETTINGS.items()
    )
    (tmp_path / "gitconfig").write_text(lines)
    monkeypatch.setenv("GIT_CONFIG_GLOBAL", str(tmp_path / "gitconfig"))
    monkeypatch.setenv("GIT_CONFIG_NOSYSTEM", "1")

    def git(*arguments: str, cwd: Path = tmp_path / "p") -> str:
        who = ("-c", "user.name=a", "-c", "user.email=a@b", "-c", "protocol.file.allow=always")
        return subprocess.run(["git", *who, *arguments], cwd=cwd, check=True, capture_output=True).stdout.decode().strip()

    git("init", "-q")
    return git


def capture(root: Path, *, dirty: str = "record") -> Source:
    return source.capture(root, paths=(), without=("sierra.toml", ".sierra"), dirty=dirty)


def commit(git: Git, root: Path) -> None:
    git("add", "--all", cwd=root)
    git("commit", "-q", "-m", "x", cwd=root)


def blob(found: Source) -> str:
    """Return git's hash of the file `data.txt` of a source."""
    return manifest.parts(manifest.read(found.manifest)[b"data.txt"])[1]


def sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


CASES = {
    "auto": ("text=auto", b"a\r\nb\r\n", True),
    "auto-unix": ("text=auto", b"a\nb\n", False),
    "auto-binary": ("text=auto", b"a\r\n\0", False),
    "text": ("text", b"a\r\n", True),
    "old": ("crlf=input", b"a\r\n", True),
    "crlf": ("text eol=crlf", b"a\r\nb\r\n", False),
    "crlf-unix": ("text eol=crlf", b"a\n", True),
    "crlf-mixed": ("text eol=crlf", b"a\r\nb\n", True),
    "ident": ("ident", b"$Id: mine $\n", True),
    "ident-new": ("ident", b"$Id$\n", True),
    "strip": ("filter=strip", b"local 5\n", True),
    "strip-none": ("filter=strip", b"local\n", False),
    "up": ("filter=up", b"Shout\n", True),
    "up-low": ("filter=up", b"shout\n", False),
    "unknown": ("filter=unknown", b"a\r\n", False),
    "utf16": ("text working-tree-encoding=UTF-16LE", b"a\0\n\0", False),
    "utf16-lines": ("text working-tree-encoding=UTF-16LE", b"a\0\r\0\n\0", True),
    "lfs": ("filter=lfs -text", b"data\r\n", False),
    "none": ("", b"a\r\n", False),
}
"""By file: its attributes, its content, and whether git loses something."""


@pytest.mark.parametrize("algorithm", ["sha1", pytest.param("sha256", marks=pytest.mark.nightly)])
def test_exactly_the_files_that_git_would_not_restore_are_reported(algorithm: str, git: Git, tmp_path: Path) -> None:
    root = tmp_path / "p"
    git("init", "-q", f"--object-format={algorithm}", cwd=tmp_path) if algorithm != "sha1" else None
    (root / ".gitattributes").write_text("".join(f"/{name} {given}\n" for name, (given, *_) in CASES.items() if given))
    for name, (_, content, _) in CASES.items():
        (root / name).write_bytes(content)
    expected = {name: sha256(content) for name, (_, content, lossy) in CASES.items() if lossy}
    for _ in range(2):  # once with nothing cached, once with a cache
        found = capture(root)
        assert dict(found.converted) == expected
    [note] = found.notes
    assert "git would restore other bytes than those on disk" in note


@pytest.mark.integration
@pytest.mark.each_case
@pytest.mark.parametrize(
    ("settings", "lossy"),
    [
        ({"core.autocrlf": "input"}, {"windows"}),
        ({"core.autocrlf": "true"}, {"unix"}),
        ({"core.autocrlf": "false"}, set()),
        ({"core.eol": "crlf"}, {"auto-unix"}),
        ({}, set()),
    ],
)
def test_settings_of_git_that_change_line_endings_count(
    settings: dict[str, str], lossy: set[str], git: Git, tmp_path: Path
) -> None:
    root = tmp_path / "p"
    if "core.eol" in settings:
        (root / ".gitattributes").write_bytes(b"auto-unix text=auto\n")
    for name, content in {"windows": b"a\r\n", "unix": b"a\n", "auto-unix": b"a\n", "bytes": b"\0\r\n"}.items():
        (root / name).write_bytes(content)
    for name, value in settings.items():
        git("config", name, value)
    assert set(capture(root).converted) - {"auto-unix"} == lossy - {"auto-unix"}
    assert ("auto-unix" in capture(root).converted) == (settings in ({"core.autocrlf": "true"}, {"core.eol": "crlf"}))


def test_a_file_that_is_changed_to_what_git_stores_is_seen_although_git_reports_no_change(git: Git, tmp_path: Path) -> None:
    root = tmp_path / "p"
    (root / ".gitattributes").write_text("*.txt text=auto\n")
    (root / "a.txt").write_bytes(b"a\r\n")
    commit(git, root)
    first = capture(root)
    assert dict(first.converted) == {"a.txt": sha256(b"a\r\n")}
    (root / "a.txt").write_bytes(b"a\n")
    second = capture(root)
    assert (second.tree, dict(second.converted), second.notes) == (first.tree, {}, ())


@pytest.mark.integration
def test_other_attributes_and_marks_in_the_index_are_noticed(git: Git, tmp_path: Path) -> None:
    root = tmp_path / "p"
    (root / "a.txt").write_bytes(b"a\r\n")
    (root / "b.txt").write_bytes(b"a\n")
    (root / ".gitattributes").write_text("*.txt -text\n")
    commit(git, root)
    assert capture(root).converted == {}
    for mark in ("--assume-unchanged", "--skip-worktree"):
        git("update-index", mark, "b.txt")
    (root / ".git" / "info" / "attributes").write_text("*.txt text\n")
    (root / "b.txt").write_bytes(b"b\r\n")
    assert capture(root).converted.keys() >= {"b.txt"}


@pytest.mark.integration
def test_files_of_submodules_and_of_a_project_in_a_subfolder_are_reported(git: Git, tmp_path: Path) -> None:
    library, root = tmp_path / "library", tmp_path / "p"
    library.mkdir()
    git("init", "-q", cwd=library)
    (library / ".gitattributes").write_text("*.txt text=auto\n")
    (library / "data.txt").write_bytes(b"a\n")
    commit(git, library)
    project = root / "sub"
    project.mkdir()
    git("submodule", "--quiet", "add", str(library), "sub/one")
    git("submodule", "--quiet", "add", str(library), "sub/two")
    (root / ".gitattributes").write_text("*.dat text=auto\n")
    (project / os.fsdecode(b"\xff.dat")).write_bytes(b"a\r\n")
    (root / "beside.dat").write_bytes(b"a\r\n")
    commit(git, root)
    (project / "one" / "data.txt").write_bytes(b"a\r\n")  # git reports no change of the submodule
    (project / "two" / "data.txt").write_bytes(b"b\r\n")
    assert set(capture(project).converted) == {r"\xff.dat", "one/data.txt", "two/data.txt"}


def test_the_commits_bytes_are_executed_if_changes_are_ignored(git: Git, tmp_path: Path) -> None:
    root = tmp_path / "p"
    (root / ".gitattributes").write_text("*.txt text=auto\n")
    (root / "a.txt").write_bytes(b"a\r\n")
    commit(git, root)
    found = capture(root, dirty="ignore")
    assert (found.checkout, found.dirty, dict(found.converted)) == (True, False, {})


def test_files_that_have_not_changed_are_not_read_again(git: Git, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = tmp_path / "p"
    (root / ".gitattributes").write_text("*.up filter=up\n*.txt text=auto\n")
    for name in ("a.up", "a.txt"):
        (root / name).write_bytes(b"a\r\n")
    monkeypatch.setattr(converted, "RACY_NS", -(10**12))  # as if they had been written some time ago
    first = capture(root)
    read: list[object] = []
    monkeypatch.setattr(converted._Restored, "_stored", lambda *words: read.append(words))
    assert (capture(root).converted, read) == (first.converted, [])


RULES = {
    "setting": ("", {"core.autocrlf": "input"}, "", {"core.autocrlf": "false"}),
    "attribute": ("* text=auto", {}, "", {}),
    "another": ("* text=auto", {}, "* -text", {}),
    "filter": ("* filter=one", {"filter.one.clean": "tr -d a"}, "* filter=one", {"filter.one.clean": "cat"}),
}
"""Attributes and settings of git that change `data.txt`, and others that do not."""


@pytest.mark.parametrize("snapshots", [1, pytest.param(0, marks=pytest.mark.nightly)])
@pytest.mark.parametrize(
    "case", [pytest.param(name, marks=[] if name == "setting" else pytest.mark.integration) for name in RULES]
)
def test_files_are_converted_by_the_present_rules_of_git(case: str, snapshots: int, git: Git, tmp_path: Path) -> None:
    """Indexes have what git made of a file that has not changed since, by the rules of that time."""
    root, (attributes, settings, other_attributes, other_settings) = tmp_path / "p", RULES[case]
    (root / "data.txt").write_bytes(b"a\r\n")
    os.utime(root / "data.txt", (1, 1))  # git trusts the times of a file that is older than its index

    def rules(attributes: str, settings: dict[str, str]) -> None:
        (root / ".gitattributes").write_text(attributes)
        if not attributes:
            (root / ".gitattributes").unlink()
        for name, value in settings.items():
            git("config", name, value)

    rules(attributes, settings)
    commit(git, root)
    before = [blob(capture(root)) for _ in range(snapshots)]
    rules(other_attributes, other_settings)
    after = capture(root)
    assert blob(after) == git("hash-object", "--no-filters", "data.txt")
    assert blob(after) not in before
    assert after.converted == {}
    assert capture(root).tree == after.tree
    rules(attributes, settings)
    assert [blob(capture(root)) for _ in range(snapshots)] == before


def test_git_does_not_read_all_files_again_for_new_files_and_other_settings(
    git: Git, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / "p"
    (root / ".gitattributes").write_text("*.txt text=auto\n")
    (root / "a.txt").write_bytes(b"a\r\n")
    commit(git, root)
    capture(root)
    monkeypatch.delattr(worktree_snapshot._Index, "start_from_users")
    git("config", "branch.x.remote", "y")
    (root / "b.txt").write_bytes(b"a\r\n")
    assert set(capture(root).converted) == {"a.txt", "b.txt"}
    (root / "a.txt").unlink()
    (root / "b.txt").write_bytes(b"b\n")
    assert set(capture(root).converted) == set()


SIZES = """\
import os
size = len(open(os.path.join(os.path.dirname(os.path.abspath(__file__)), "data.txt"), "rb").read())
open("swarm.csv", "w").write(f"tick,size\\n0,{size}\\n")
"""
QUERY = ("population_size=1", "--runs", "1")
SIZES_FOUND = "SELECT DISTINCT size FROM swarm ORDER BY 1"
LAST = "SELECT size FROM swarm JOIN effective USING (execution)"


def sized(git: Git, root: Path, observe: str = "none") -> Path:
    """Return a project whose runs write the size of a file with line endings of Windows."""
    projects.make(root, projects.CONFIG.replace("runs = 2", f'runs = 1\nobserve = "{observe}"'), simulator=SIZES)
    (root / ".gitattributes").write_text("* text=auto\n")
    (root / ".gitignore").write_text(".sierra\nfigures\n")
    (root / "data.txt").write_bytes(b"a\r\nb\r\n")
    commit(git, root)
    return root


@pytest.mark.integration
@pytest.mark.parametrize("observe", ["none", "all"])
def test_other_bytes_with_the_same_id_are_executed_again(observe: str, git: Git, tmp_path: Path) -> None:
    root = sized(git, tmp_path / "p", observe)
    first, said = projects.run(root, *QUERY)
    assert (first["executed"], said.count("data.txt: git would restore other bytes")) == (1, 1)
    assert projects.run(root, *QUERY)[0]["executed"] == 0
    (root / "data.txt").write_bytes(b"a\nb\n")
    second, said = projects.run(root, *QUERY)
    assert (second["batch"], second["executed"]) == (first["batch"], 1)
    assert projects.sql(root, LAST) == [{"size": 4}]
    assert "would restore" not in said
    assert "{project}/data.txt: 58055bdcc7 recorded, git's bytes found" in said
    (root / "data.txt").write_bytes(b"a\r\nb\r\n")
    assert projects.run(root, *QUERY)[0]["executed"] == 0
    assert projects.sql(root, LAST) == [{"size": 6}]


@pytest.mark.integration
@pytest.mark.parametrize("observe", ["none", "all"])
def test_bytes_that_earlier_rules_of_git_hid_are_executed_again(observe: str, git: Git, tmp_path: Path) -> None:
    root = sized(git, tmp_path / "p", observe)
    os.utime(root / "data.txt", (1, 1))
    git("update-index", "--refresh")
    assert projects.run(root, *QUERY)[0]["executed"] == 1
    (root / ".gitattributes").unlink()
    said = projects.run(root, *QUERY)[1]
    assert "found" not in said
    assert projects.sql(root, SIZES_FOUND) == [{"size": 6}]
    (root / "data.txt").write_bytes(b"a\nb\n")
    assert projects.run(root, *QUERY)[0]["executed"] == 1
    assert projects.sql(root, SIZES_FOUND) == [{"size": 4}, {"size": 6}]


def test_a_file_that_git_converts_and_that_is_only_touched_is_not_said_to_have_changed(git: Git, tmp_path: Path) -> None:
    root, names = tmp_path / "p", ("crlf", "auto", "up-low", "utf16", "lfs", "strip")
    (root / ".gitattributes").write_text("".join(f"/{name} {CASES[name][0]}\n" for name in names))
    for name in names:
        (root / name).write_bytes(CASES[name][1])
    found = capture(root)
    programs = Programs(tuple(Program(path, str(root / path), digest, Kind.FILE) for path, digest in found.converted.items()))
    before = change_guard.guard(root, found.manifest, programs)
    for name in names:
        os.utime(root / name, (1, 1))
    assert "code or programs may have changed, as their times say," in str(before.doubt())
    for name in ("crlf", "lfs", "strip"):
        (root / name).write_bytes(b"changed\r\n")
        assert f"code or programs have changed since the runs began: {name}" in str(before.doubt())
        (root / name).write_bytes(CASES[name][1])


@pytest.mark.integration
def test_a_replay_restores_the_bytes_that_were_executed(git: Git, tmp_path: Path) -> None:
    root = sized(git, tmp_path / "p")
    batch = projects.run(root, *QUERY)[0]["batch"]
    (root / "data.txt").write_bytes(b"a\nb\n")
    done = projects.quick(root, "replay", batch[:10], "--json")
    assert (done.returncode, json.loads(done.stdout)["verdict"]) == (0, "identical"), done.stderr


@pytest.mark.integration
def test_a_replay_without_the_bytes_that_were_executed_names_the_file(git: Git, tmp_path: Path) -> None:
    root = sized(git, tmp_path / "p")
    config = root / "sierra.toml"
    config.write_text(config.read_text() + "[source]\nmax_ignored = 0\n")
    batch = projects.run(root, *QUERY)[0]["batch"]
    (root / "data.txt").write_bytes(b"a\nb\n")
    done = projects.quick(root, "replay", batch[:10], "--json")
    assert done.returncode == 1
    assert "{project}/data.txt" in json.dumps(json.loads(done.stdout)["notes"])


@pytest.mark.nightly
def test_a_package_has_the_bytes_that_were_executed(git: Git, tmp_path: Path) -> None:
    root = sized(git, tmp_path / "p")
    config = root / "sierra.toml"
    config.write_text(config.read_text() + '[package]\ntitle = "Sizes"\nauthors = [{ name = "A" }]\nlicense = "MIT"\n')
    batch = projects.run(root, *QUERY)[0]["batch"]
    package = str(tmp_path / "package.zip")
    done = projects.quick(root, "package", batch[:10], "-o", package, "--no-report", "--yes")
    assert done.returncode == 0, done.stderr
    done = projects.quick(tmp_path, "reproduce", package, "--yes", "--json")
    assert done.returncode == 0, done.stdout + done.stderr
    subprocess.run(["unzip", "-q", package, "-d", str(tmp_path / "out")], check=True)
    [program] = (tmp_path / "out").rglob("reproduce.py")
    done = subprocess.run(["python3", str(program), "--execute", "--yes"], capture_output=True, text=True, cwd=program.parent)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.nightly
def test_a_build_is_repeated_for_other_bytes_with_the_same_id(git: Git, tmp_path: Path) -> None:
    built = 'echo "echo tick,size > swarm.csv; echo 0,$(wc -c < data.txt) >> swarm.csv" > sim.sh\n'
    config = projects.CONFIG.replace("python3 sim.py {input}", "sh {project}/sim.sh {input}").replace("runs = 2", "runs = 1")
    root = sized(git, tmp_path / "p")
    (root / "sierra.toml").write_text(config + '[build]\ncommand = "sh build.sh"\nproduces = ["sim.sh"]\n')
    (root / ".gitignore").write_text(".sierra\nfigures\nsim.sh\n")
    (root / "build.sh").write_text(built)
    batch = projects.run(root, *QUERY)[0]["batch"]
    assert projects.sql(root, LAST) == [{"size": 6}]
    (root / "data.txt").write_bytes(b"a\nb\n")
    assert projects.run(root, *QUERY)[0]["batch"] == batch
    assert projects.sql(root, LAST) == [{"size": 4}]
    done = projects.quick(root, "replay", batch[:10], "--json")
    assert (done.returncode, json.loads(done.stdout)["verdict"]) == (0, "identical"), done.stderr


@pytest.mark.integration
def test_a_copy_for_other_hosts_has_the_bytes_on_disk(git: Git, tmp_path: Path) -> None:
    root = sized(git, tmp_path / "p")
    plan = sierra.open(root).plan(*QUERY[:1])
    checkout = plan.snapshot(lambda blob: None)
    checkout.make(tmp_path / "copy")
    assert (tmp_path / "copy" / "data.txt").read_bytes() == b"a\r\nb\r\n"
    assert checkout.programs_in(tmp_path / "copy").id == plan.programs.id

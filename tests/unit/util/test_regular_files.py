"""Only regular files are read; others are refused at once, wherever a user names one."""

from __future__ import annotations

from pathlib import Path

import pytest

from sierra.util.regular_files import open_regular, read_regular
from tests import projects, stores
from tests.support.irregular_files import irregular

KINDS = ("pipe", "socket", "device")
CLAIM = '\n[claims.c]\nsays = "x"\npaper = "1"\nquery = "population_size=1"\nsql = "SELECT true"\n'
IMAGE = '\n[container]\nimage = "box.sif"\n'


@pytest.fixture(autouse=True)
def short(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_no_regular_file_is_refused(tmp_path: Path, kind: str) -> None:
    with pytest.raises(OSError, match="and not a regular file"):
        read_regular(irregular(tmp_path / "x", kind))


def test_files_links_to_files_and_folders_are_as_usual(tmp_path: Path) -> None:
    (tmp_path / "x").write_bytes(b"a")
    (tmp_path / "y").symlink_to("x")
    assert read_regular(tmp_path / "y") == b"a"
    with pytest.raises(IsADirectoryError):
        open_regular(tmp_path)
    with pytest.raises(FileNotFoundError):
        open_regular(tmp_path / "z")


@pytest.mark.integration
@pytest.mark.each_case
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("name", "words", "more"),
    [
        ("query.json", ("run", "query.json", "-n"), ""),
        ("arena.xml", ("run", "population_size=1", "-n"), ""),
        ("sierra.toml", ("run", "population_size=1", "-n"), ""),
        ("sierra.toml", ("ls",), ""),
        ("sierra.lock", ("image", "ls"), IMAGE),
        ("box.sif", ("run", "population_size=1", "-n"), IMAGE),
        ("box.sif", ("image", "pin"), IMAGE),
        ("box.tar", ("image", "import", "box.tar"), ""),
        ("sierra.baselines.json", ("claims", "--against", "base"), CLAIM),
    ],
)
def test_no_command_waits_for_a_file_that_is_no_regular_one(
    tmp_path: Path, name: str, words: tuple[str, ...], more: str, kind: str
) -> None:
    root = projects.make(tmp_path / "project", projects.CONFIG + more)
    irregular(root / name, kind)
    refused = projects.quick(root, *words)
    assert refused.returncode in (2, 3)
    assert (refused.stdout, refused.stderr.count("\n")) == ("", 1), refused


@pytest.mark.integration
@pytest.mark.each_case
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "name", ["format", "segments/*/MANIFEST", "segments/*/sessions.parquet", "segments/*/executions.parquet"]
)
def test_a_store_with_a_file_that_is_no_regular_one_is_refused(recorded: Path, tmp_path: Path, name: str, kind: str) -> None:
    root = stores.copy(recorded, tmp_path / "project")
    irregular(next((root / ".sierra").glob(name)), kind)
    for words in (("sql", "FROM sessions, executions"), ("fsck",)):
        refused = projects.quick(root, *words)
        assert refused.returncode in (1, 3)
        assert "Traceback" not in refused.stderr

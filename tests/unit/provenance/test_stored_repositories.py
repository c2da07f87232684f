"""Nested repositories come from a store only if their hashes prove them, and stay inside the folder."""

from __future__ import annotations

from pathlib import Path

import pytest

from sierra.errors import Damaged, Missing
from sierra.provenance.source import restore
from sierra.provenance.source.manifest import git_hash, tree_hash, written
from sierra.provenance.source.stored_repositories import data, proves
from sierra.util.hashing import sha256

CONTENT = b"three\n"
BLOB = git_hash(b"blob", CONTENT)


def stored(path: bytes) -> tuple[dict[str, bytes], str]:
    """Return what a store has of a nested repository with one file, and its commit."""
    files = {path: b"100644 " + BLOB.encode()}
    tree = tree_hash(files)
    commit = f"tree {tree}\nauthor a <a@b> 0 +0000\n\nfirst\n".encode()
    return {BLOB: CONTENT, tree: written(files), (name := git_hash(b"commit", commit)): commit}, name


def restored(contents: dict[str, bytes], commit: str, folder: Path) -> Path:
    outer = {b"library": b"160000 " + commit.encode()}
    restore(f"swh:1:dir:{tree_hash(outer)}", written(outer), folder, folder / "restored", contents.get)
    return folder / "restored"


def test_a_nested_repository_is_restored_from_what_proves_it(tmp_path: Path) -> None:
    contents, commit = stored(b"deep/factor.txt")
    assert (restored(contents, commit, tmp_path) / "library/deep/factor.txt").read_bytes() == CONTENT
    assert all(proves(content, name) for name, content in contents.items() if name != BLOB)


@pytest.mark.parametrize("part", [0, 1, 2])
def test_a_nested_repository_with_a_wrong_part_is_refused(tmp_path: Path, part: int) -> None:
    contents, commit = stored(b"factor.txt")
    name = list(contents)[part]
    for wrong in (contents[name] + b"x", b"", b"\xff\0" * 50):
        with pytest.raises((Damaged, Missing)):
            restored({**contents, name: wrong}, commit, tmp_path / str(len(wrong)))
        assert not proves(wrong, name)
    with pytest.raises(Missing, match="neither in git"):
        restored({one: content for one, content in contents.items() if one != name}, commit, tmp_path / "lost")


@pytest.mark.parametrize("path", [b"../outside", b".git/hooks/x", b"a//b"])
def test_a_nested_repository_stays_in_its_folder(tmp_path: Path, path: bytes) -> None:
    with pytest.raises(Damaged, match="not allowed"):
        restored(*stored(path), tmp_path / "in")
    assert not (tmp_path / "outside").exists()


def test_data_of_git_lfs_are_used_only_if_they_are_those_of_the_pointer() -> None:
    pointer = f"version https://git-lfs.github.com/spec/v1\noid sha256:{sha256(CONTENT)}\nsize 6\n".encode()
    assert data(pointer, {sha256(CONTENT): CONTENT}.get) == CONTENT
    assert data(pointer, {sha256(CONTENT): b"other"}.get) == pointer
    assert data(pointer, {}.get) == pointer
    assert data(CONTENT, {}.get) == CONTENT

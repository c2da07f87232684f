"""The cache of SHA-256 hashes of files: valid as long as the files are unchanged."""

from __future__ import annotations

import hashlib
import os
import time
from pathlib import Path

import pytest

from sierra.errors import Missing
from sierra.provenance import hash_cache
from sierra.provenance.hash_cache import HashCache
from sierra.util.hashing import sealed, unsealed
from tests.waiting import PATIENCE_S

LARGE = b"x" * (1 << 17)


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "sierra" / "digests.json"


def hashed(path: Path) -> str:
    """Return the hash of a file, as a new process computes it."""
    found = HashCache()
    digest = found.of(str(path))
    found.save()
    return digest


def rested(path: Path, content: bytes) -> Path:
    """Write a file that was last changed some seconds ago."""
    path.write_bytes(content)
    time.sleep(2.1)
    return path


@pytest.mark.integration
def test_an_unchanged_file_is_hashed_once_and_again_when_it_changes(tmp_path: Path, cache: Path) -> None:
    path = rested(tmp_path / "file", LARGE)
    assert hashed(path) == hashlib.sha256(LARGE).hexdigest()
    known = unsealed(cache.read_bytes()) or b""
    cache.write_bytes(sealed(known.replace(hashlib.sha256(LARGE).hexdigest().encode(), b"from the cache")))
    assert hashed(path) == "from the cache"
    status = path.stat()
    path.write_bytes(LARGE[:-1] + b"y")
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))
    assert hashed(path) == hashlib.sha256(LARGE[:-1] + b"y").hexdigest()


def test_hashes_of_files_that_were_just_changed_are_not_cached(
    tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hash_cache, "RACY_NS", PATIENCE_S * 1e9)
    (tmp_path / "file").write_bytes(LARGE)
    hashed(tmp_path / "file")
    assert not cache.exists()


@pytest.mark.parametrize("content", ["", "{", "[]", '{"PATH": 1}', '{"PATH": []}', "[" * 100_000])
def test_a_damaged_cache_is_ignored(tmp_path: Path, cache: Path, content: str) -> None:
    (tmp_path / "file").write_bytes(LARGE)
    cache.parent.mkdir(parents=True)
    cache.write_text(content.replace("PATH", str(tmp_path / "file")))
    assert hashed(tmp_path / "file") == hashlib.sha256(LARGE).hexdigest()


@pytest.mark.nightly
def test_hashing_works_without_a_cache_folder(tmp_path: Path, cache: Path) -> None:
    (tmp_path / "cache").write_text("a file where the folder should be")
    path = rested(tmp_path / "file", LARGE)
    assert hashed(path) == hashlib.sha256(LARGE).hexdigest()


def test_the_cache_has_a_limited_size(tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hash_cache, "MAX_ENTRIES", 3)
    monkeypatch.setattr(hash_cache, "RACY_NS", -(10**12))
    for number in range(5):
        (tmp_path / str(number)).write_bytes(LARGE)
        hashed(tmp_path / str(number))
    text = cache.read_text()
    assert [str(tmp_path / str(number)) in text for number in range(5)] == [False, False, True, True, True]


def test_a_file_that_cannot_be_read_is_reported(tmp_path: Path, cache: Path) -> None:
    with pytest.raises(Missing, match="gone cannot be read: No such file"):
        hashed(tmp_path / "gone")

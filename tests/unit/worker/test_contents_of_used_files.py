"""Contents of real files after a run that has read them."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from sierra.testing.observers import wait_for_tick
from sierra.worker.file_names import Names
from sierra.worker.file_trace import Trace
from sierra.worker.observed_record import Contents, contents


def observed(tmp_path: Path, change: Callable[[Path], object]) -> tuple[Path, Contents]:
    """Return a folder, and the contents of what was read there before a change."""
    root = tmp_path.resolve() / "place"
    (root / "listed").mkdir(parents=True)
    for path in (root / "data", root / "listed/a", root / "listed/b"):
        path.write_text(path.name)
    (root / "link").symlink_to("data")
    began = wait_for_tick(root)
    change(root)
    trace = Trace(
        "strace",
        read=(f"{root}/data",),
        listed=(f"{root}/listed",),
        found=(f"{root}/listed/a",),
        missed=(f"{root}/missed",),
        links={f"{root}/link": f"{root}/data"},
    )
    return root, contents(trace, began)


def test_files_are_hashed_and_listings_too(tmp_path: Path) -> None:
    root, seen = observed(tmp_path, lambda root: None)
    assert seen.unusable == {}
    file = seen.files[f"{root}/data"]
    assert (file.sha256, file.size) == (hashlib.sha256(b"data").hexdigest(), 4)
    assert seen.folders == {f"{root}/listed": hashlib.sha256(b"a\0b\0").hexdigest()}


def replace(root: Path) -> None:
    (root / "new").write_text("DATA")
    os.utime(root / "new", ns=(0, 0))
    (root / "new").replace(root / "data")


def relink(root: Path) -> None:
    (root / "link").unlink()
    (root / "link").symlink_to(root / "data")


def date_back(root: Path) -> None:
    (root / "data").write_text("DATA")
    os.utime(root / "data", ns=(0, 0))


@pytest.mark.parametrize(
    ("change", "path", "reason"),
    [
        (lambda root: (root / "data").write_text("data"), "data", "changed after the run had opened it"),
        (date_back, "data", "changed after the run had opened it"),
        (replace, "data", "changed after the run had opened it"),
        (lambda root: (root / "data").unlink(), "data", "removed after the run had read it"),
        (lambda root: (root / "listed/c").touch(), "listed", "changed after the run had listed it"),
        (lambda root: (root / "listed/a").unlink(), "listed/a", "removed after the run had found it"),
        (lambda root: (root / "missed").touch(), "missed", "made after the run had looked for it"),
        (relink, "link", "its link was changed"),
    ],
)
def test_changes_since_the_run_began_are_noticed(
    change: Callable[[Path], object], path: str, reason: str, tmp_path: Path
) -> None:
    root, seen = observed(tmp_path, change)
    assert reason in seen.unusable[f"{root}/{path}"]
    assert f"{root}/{path}" not in seen.files
    assert f"{root}/{path}" not in seen.folders


def test_a_cache_saves_hashing_but_not_the_check_for_changes(tmp_path: Path) -> None:
    path = tmp_path / "place" / "data"
    path.parent.mkdir()
    path.write_text("x")
    asked: list[str] = []

    def cache(path: str, status: os.stat_result, hashed: Callable[[], str]) -> str:
        asked.append(path)
        return "known"

    trace = Trace("strace", read=(str(path),))
    assert contents(trace, wait_for_tick(path.parent), cache).files[str(path)].sha256 == "known"
    assert contents(trace, 0, cache).unusable
    assert asked == [str(path)]

    def change(path: str, status: os.stat_result, hashed: Callable[[], str]) -> str:
        Path(path).write_text("longer")
        return hashed()

    assert contents(trace, wait_for_tick(path.parent), change).unusable


def test_a_listed_project_has_the_same_content_as_its_checkout(tmp_path: Path) -> None:
    for folder in ("p", "p/.sierra", "p/.git", "p/figures", "checkout"):
        (tmp_path / folder).mkdir()
    for file in ("p/sim.py", "p/sierra.toml", "checkout/sim.py"):
        (tmp_path / file).touch()
    hidden = {f"unlisted:{number}": f"{tmp_path}/p/{name}" for number, name in enumerate((".git", "figures", "sierra.toml"))}

    def listed(folder: str) -> str:
        path, given = (
            str(tmp_path / folder),
            Names({"project": str(tmp_path / folder), "store": f"{tmp_path}/p/.sierra", **hidden}),
        )
        return contents(Trace("strace", listed=(path,)), wait_for_tick(tmp_path), is_listed=given.is_listed).folders[path]

    assert listed("p") == listed("checkout")
    (tmp_path / "p" / "plugin.so").touch()
    assert listed("p") != listed("checkout")

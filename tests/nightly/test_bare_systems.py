"""Packages are checked and executed on systems that have only Python, without network, by another user at another path."""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

import sierra
from tests import projects
from tests.unit.packages.test_pack import TOML

pytestmark = pytest.mark.nightly
RECIPE = Path(__file__).parents[2] / "containers" / "python" / "rootfs"
DEVICES = {"null": (1, 3), "zero": (1, 5), "urandom": (1, 9)}
USER = 4321


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path | None:
    """The root of a system with nothing but python3 and libstdc++6; None if it cannot be built here."""
    folder = tmp_path_factory.mktemp("bare")
    root = folder / "root"
    root.mkdir()
    if os.geteuid() or subprocess.run(["sh", RECIPE, folder / "root.tar"], capture_output=True, check=False).returncode:
        return None
    subprocess.run(["tar", "-xf", folder / "root.tar", "-C", root], check=True)
    (root / "dev").mkdir(exist_ok=True)
    for name, (major, minor) in DEVICES.items():
        os.mknod(root / "dev" / name, 0o666 | stat.S_IFCHR, os.makedev(major, minor))
        (root / "dev" / name).chmod(0o666)
    return root


@pytest.fixture
def bare(built: Path | None, require: Callable[..., str]) -> Path:
    require("mmdebstrap, root and a mirror of Debian", there=built is not None)
    assert built is not None
    return built


def inside(root: Path, package: Path, *options: str) -> tuple[int, str]:
    """Give a package to a user of the system, who unpacks and executes it; return the exit status and what was printed."""
    place = root / "srv" / package.stem
    place.mkdir()
    shutil.copy(package, place)
    subprocess.run(["unzip", "-q", "-j", package, "reproduce.py", "-d", place], check=True)
    for path in (place, *place.iterdir()):
        os.chown(path, USER, USER)
    words = f"cd /srv/{package.stem} && exec python3 reproduce.py {package.name} --unpack 'it is here' {' '.join(options)}"
    alone = ("unshare", "--net", "--mount", "--pid", "--fork", "--kill-child", f"--mount-proc={root / 'proc'}")
    user = ("chroot", f"--userspec={USER}:{USER}", str(root), "/usr/bin/env", "-i", "PATH=/usr/bin:/bin")
    done = subprocess.run([*alone, *user, "sh", "-c", words], capture_output=True, text=True, check=False)
    assert "Traceback" not in done.stderr
    return done.returncode, done.stdout + done.stderr


def test_python_alone_reaches_levels_1_and_2(bare: Path, tmp_path: Path) -> None:
    root = projects.commit(projects.make(tmp_path / "project", projects.CONFIG + TOML))
    batch = sierra.open(root).run("population_size=1,2", figures=False).batch
    sierra.open(root).packages.pack(batch, report=False, path=tmp_path / "plain.zip")
    status, printed = inside(bare, tmp_path / "plain.zip", "--execute", "--yes")
    assert (status, "LEVEL 2: 4 of 4 runs executed again: 4 identical" in printed) == (0, True), printed
    shutil.move(tmp_path / "plain.zip", tmp_path / "checked.zip")
    status, printed = inside(bare, tmp_path / "checked.zip")
    assert (status, "Level 1 of 3 reached" in printed, "SIERRA is not installed" in printed) == (0, True, True)


def test_the_mujoco_example_is_reproduced_with_the_wheels_of_its_package(bare: Path, tmp_path: Path) -> None:
    """One command, no network, another user and path: SIERRA is installed from the package, and decides its claim."""
    root = tmp_path / "project"
    assert projects.sierra(tmp_path, "init", "--example", "swarm", root.name).returncode == 0
    with (root / "sierra.toml").open("a") as file:
        file.write(TOML.replace("FROM runs", "FROM swarm"))
    batch = sierra.open(root).run("population_size=1,2", runs=2, figures=False).batch
    version = "import sys; print('%d.%d' % sys.version_info[:2])"
    python = subprocess.run(
        ["chroot", bare, "python3", "-c", version], capture_output=True, text=True, check=True
    ).stdout.strip()
    assert sierra.open(root).packages.pack(batch, report=False, path=tmp_path / "swarm.zip", wheels=True, pythons=[python])
    status, printed = inside(bare, tmp_path / "swarm.zip", "--execute", "--yes")
    assert "identical (4 of 4 runs executed again)" in printed, printed
    assert "re-executed (4 of 4 runs executed again)" in printed
    assert (status, "Level 3 of 3 reached." in printed) == (0, True)

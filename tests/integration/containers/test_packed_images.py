"""A package has the container image of its runs by the recorded id, in forms whose bytes are always the same."""

from __future__ import annotations

import json
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

import sierra
from sierra.containers.images import oci, podman_images, squashfs_tools
from sierra.errors import Damaged, Missing
from tests import containers, projects

PACKAGE = '\n[package]\ntitle = "T"\nauthors = [{ name = "Jane Doe" }]\nlicense = "MIT"\n'
pytestmark = pytest.mark.real


@pytest.mark.nightly
def test_the_recorded_image_is_packed_and_no_other(
    tmp_path: Path, require: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    require("podman")
    require("mksquashfs")
    archive = containers.busybox(tmp_path)
    root = containers.make(tmp_path / "project", "../busybox.tar")
    with (root / "sierra.toml").open("a") as file:
        file.write(PACKAGE)
    batch = sierra.open(root).run("population_size=1", runs=1, figures=False).batch
    [identity] = sierra.open(root).sql("SELECT image FROM specs").to_pydict()["image"]
    name = "environment/images/" + identity.replace(":", "-")

    done = projects.quick(root, "package", batch, "--no-report", "-o", "../none.zip", "--image", "none")
    assert "are not packed, only described in environment/images.json" in done.stdout
    done = projects.quick(root, "package", batch, "--no-report", "-o", "../file.zip", "--image", "both")
    assert done.returncode == 0, done.stderr
    archive.rename(tmp_path / "aside.tar")
    assert podman_images.holds(identity)
    sierra.open(root).packages.pack(batch, report=False, path=tmp_path / "podman.zip", image="both")
    assert (tmp_path / "file.zip").read_bytes() == (tmp_path / "podman.zip").read_bytes()
    with zipfile.ZipFile(tmp_path / "podman.zip") as file:
        (tmp_path / "again.tar").write_bytes(file.read(f"{name}.tar"))
        (tmp_path / "again.sqfs").write_bytes(file.read(f"{name}.sqfs"))
        described = json.loads(file.read("environment/images.json"))
    assert [(image["image"], image["kind"]) for image in described] == [(identity, "oci")]
    assert oci.read(tmp_path / "again.tar").id == identity
    assert oci.read(tmp_path / "again.tar").check()
    assert squashfs_tools.is_squashfs(tmp_path / "again.sqfs")

    monkeypatch.setattr(podman_images, "holds", lambda identity: False)
    with pytest.raises(Missing, match=r"busybox\.tar no longer exists, and podman does not have"):
        sierra.open(root).packages.pack(batch, report=False, path=tmp_path / "x.zip", image="oci")
    containers.host(tmp_path, containers.BUSYBOX).rename(archive)
    for form in ("oci", "sif"):
        with pytest.raises(Damaged, match=r"busybox\.tar is the image sha256:\w+, not sha256"):
            sierra.open(root).packages.pack(batch, report=False, path=tmp_path / "x.zip", image=form)
    assert not (tmp_path / "x.zip").exists()


@pytest.mark.integration
@pytest.mark.parametrize("engine", ["podman", "apptainer"])
def test_without_sierra_containers_start_as_those_that_were_recorded(
    tmp_path: Path, require: Callable[..., str], engine: str
) -> None:
    """The same limits and rights are in the outputs, also of runs with commands before their own."""
    require(engine)
    require("mksquashfs")
    state = "{ ulimit -n; ulimit -u; umask; grep -E 'Cap|NoNewPrivs' /proc/self/status; id -u; } > state.txt\n"
    root = containers.make(tmp_path / "project", containers.python(tmp_path), simulator=containers.SIMULATOR + state)
    config = (root / "sierra.toml").read_text()
    (root / "sierra.toml").write_text('before = "cp {input} copy.xml"\n' + config + PACKAGE)
    batch = sierra.open(root).run("population_size=1,2", runs=1, figures=False, engine=engine).batch
    sierra.open(root).packages.pack(
        batch, report=False, path=tmp_path / "x.zip", image="sif" if engine == "apptainer" else "oci"
    )
    with zipfile.ZipFile(tmp_path / "x.zip") as file:
        file.extractall(tmp_path / "x")
    command = [sys.executable, "reproduce.py", "--execute", "--yes", "--level=2", f"--engine={engine}"]
    done = subprocess.run(command, cwd=tmp_path / "x", capture_output=True, text=True, check=False)
    assert "LEVEL 2: 2 of 2 runs executed again: 2 identical" in done.stdout, done.stdout + done.stderr

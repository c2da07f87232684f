"""Runs of a received package execute in its container without network, without a question; more access needs consent."""

from __future__ import annotations

import json
import secrets
import subprocess
from pathlib import Path
from typing import Any

import pytest

import sierra
from tests import containers, images, projects
from tests.unit.packages.test_reproduction import PACKAGE, changed

pytestmark = pytest.mark.real
OUTSIDE = (
    containers.SIMULATOR
    + "touch {outside}/reached /project/reached 2>/dev/null; ls {outside} /sys/class/net > seen.txt 2>/dev/null\n"
)


def packed(folder: Path, name: str, *access: str) -> Path:
    """Return a package of one run, whose program tries to reach this machine."""
    simulator = OUTSIDE.replace("{outside}", str(folder)) + "true\n"
    root = containers.make(folder / name, containers.busybox(folder), *access, simulator=simulator)
    config = root / "sierra.toml"
    config.write_text(config.read_text() + PACKAGE)
    batch = sierra.open(root).run("population_size=2", runs=1, figures=False).batch
    sierra.open(root).packages.pack(batch, report=False, path=folder / f"{name}.zip")
    return folder / f"{name}.zip"


def reproduce(folder: Path, *words: str) -> tuple[int, dict[str, Any]]:
    done = projects.quick(folder, "reproduce", *words, "--json")
    return done.returncode, json.loads(done.stdout) if done.stdout else {"error": done.stderr}


def test_a_container_of_a_package_reaches_nothing(tmp_path: Path) -> None:
    package = packed(tmp_path, "alone")
    code, said = reproduce(tmp_path, str(package))
    [batch] = said["batches"]
    assert (code, batch["engine"], batch["counts"]) == (0, "podman", {"identical": 1}), said
    assert not list(tmp_path.rglob("reached"))


@pytest.mark.nightly
def test_the_image_of_a_package_is_used_if_this_machine_does_not_have_it(tmp_path: Path) -> None:
    layer = images.layer(
        *((one, "") for one in containers.FOLDERS),
        ("bin/busybox", containers.BUSYBOX.read_bytes()),
        *((f"bin/{name} -> busybox", "") for name in ("sh", "sed", "touch", "ls", "true")),
        ("etc/own", secrets.token_hex()),
    )
    file = images.docker_archive(tmp_path / "own.tar", [layer])
    root = containers.make(tmp_path / "project", file)
    (root / "sierra.toml").write_text((root / "sierra.toml").read_text() + PACKAGE)
    batch = sierra.open(root).run("population_size=2", runs=1, figures=False).batch
    sierra.open(root).packages.pack(batch, report=False, path=tmp_path / "without.zip")
    [image] = sierra.open(root).sql("SELECT image FROM images").to_pylist()
    member = f"environment/images/{image['image'].replace(':', '-')}.tar"

    def add(members: dict[str, bytes]) -> None:
        members[member] = file.read_bytes()

    package = changed(tmp_path / "without.zip", tmp_path / "with.zip", add)
    file.unlink()
    subprocess.run(["podman", "rmi", "--force", image["image"].removeprefix("sha256:")], check=True, capture_output=True)
    code, said = reproduce(tmp_path, str(tmp_path / "without.zip"))
    assert (code, "sierra image import" in said["batches"][0]["reason"]) == (3, True), said
    code, said = reproduce(tmp_path, str(package))
    assert (code, said["batches"][0]["counts"]) == (0, {"identical": 1}), said
    code, said = reproduce(tmp_path, str(package), "--engine", "apptainer", "--into", "other")
    assert (code, said["batches"][0]["engine"]) == (0, "apptainer"), said


def test_a_container_with_access_to_the_network_needs_consent(tmp_path: Path) -> None:
    package = packed(tmp_path, "network", "network = true")
    code, said = reproduce(tmp_path, str(package))
    assert (code, "in containers of podman with access to: network" in said["error"]) == (3, True), said
    assert reproduce(tmp_path, str(package), "--yes")[1]["batches"][0]["executed"] == 1


def test_a_package_does_not_choose_a_folder_of_this_machine_for_its_containers(tmp_path: Path) -> None:
    (tmp_path / "home").mkdir()
    package = packed(tmp_path, "mount", f'mounts = {{ "/data" = "{tmp_path}/home" }}')
    code, said = reproduce(tmp_path, str(package), "--yes")
    assert (code, said["notes"][0].startswith("sierra.toml: container.mounts /data")) == (3, True)
    assert "/data from outside the package" in said["batches"][0]["reason"]

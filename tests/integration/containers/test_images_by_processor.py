"""Images for several processors under one name, on this machine: records, comparisons, packages and their removal."""

from __future__ import annotations

import json
import os
import subprocess
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from tests import containers, projects

pytestmark = [pytest.mark.integration, pytest.mark.real]
HERE = os.uname().machine
OTHER = "s390x"
PACKAGE = '[package]\ntitle = "A swarm"\nauthors = [{ name = "Ada Lovelace" }]\nlicense = "MIT"\n'


@pytest.fixture
def root(tmp_path: Path, require: Callable[..., str]) -> Path:
    require("busybox-static, as /bin/busybox", there=containers.BUSYBOX.exists())
    require("apptainer")
    root = tmp_path / "project"
    root.mkdir()
    for processor in (HERE, OTHER):
        containers.busybox(root, processor, MADE_FOR=processor)
    containers.make(root, "busybox-{arch}.tar", 'engine = "apptainer"', simulator=containers.SIMULATOR + "echo $MADE_FOR >&2\n")
    with (root / "sierra.toml").open("a") as file:
        file.write(PACKAGE)
    return root


@pytest.mark.nightly
def test_a_batch_is_recorded_compared_packed_and_removed(root: Path, tmp_path: Path) -> None:
    run = ("run", "population_size=1", "--runs", "1", "--no-figures")
    (root / f"busybox-{OTHER}.tar").rename(tmp_path / "elsewhere.tar")
    assert projects.quick(root, *run).returncode == 0, "only the image for this machine is needed"
    (tmp_path / "elsewhere.tar").rename(root / f"busybox-{OTHER}.tar")
    [spec] = projects.sql(root, "SELECT image FROM specs")
    assert projects.sql(root, "SELECT image, kind, variants IS NULL AS one FROM images ORDER BY one") == [
        {"image": spec["image"], "kind": "variants", "one": False},
        {"image": (used := projects.sql(root, "SELECT image FROM isolations")[0]["image"]), "kind": "oci", "one": True},
    ]
    [batch] = [row["batch"] for row in projects.sql(root, "FROM batches")]
    shown = projects.quick(root, "show", batch).stdout
    assert f"{HERE} {used[:19]}, {OTHER} sha256:" in shown
    assert projects.quick(root, "replay", batch).returncode == 0

    containers.busybox(root, OTHER, MADE_FOR="something else")
    assert projects.quick(root, "image", "pin").returncode == 0
    assert projects.quick(root, *run).returncode == 0
    [now] = [row["batch"] for row in projects.sql(root, f"FROM batches WHERE batch <> '{batch}'")]
    differences = projects.quick(root, "diff", batch, now).stdout
    assert f"images by processor: {OTHER} was sha256:" in differences
    assert f"images by processor: {OTHER} was sha256:" in projects.quick(root, "why", now).stdout

    packed = tmp_path / "package.zip"
    done = projects.quick(root, "package", now, "--output", str(packed), "--image", "oci", "--yes")
    assert done.returncode == 0, done.stderr
    assert projects.quick(root, "rm", batch, "--yes").returncode == 0
    assert len(projects.sql(root, "FROM images")) == 2
    assert projects.quick(root, "fsck").returncode == 0
    assert projects.quick(root, "rm", now, "--yes").returncode == 0
    assert projects.sql(root, "FROM images") == []

    with zipfile.ZipFile(packed) as file:
        described = json.loads(file.read("environment/images.json"))
        names = [name for name in file.namelist() if name.startswith("environment/images/")]
        file.extractall(tmp_path / "unpacked")
    assert {one["image"]: one.get("variants") for one in described}[used] is None
    assert names == [f"environment/images/{used.replace(':', '-')}.tar"]
    reproduced = projects.quick(tmp_path, "reproduce", str(packed), "--yes")
    assert "identical (1 of 1 run executed again)" in reproduced.stdout, reproduced.stdout + reproduced.stderr
    alone = (containers.PYTHON, "-I", "reproduce.py", "--execute", "--yes", "--engine", "podman")
    environment = {"PATH": os.defpath, "HOME": str(tmp_path)}  # without SIERRA
    executed = subprocess.run(
        alone, cwd=tmp_path / "unpacked", capture_output=True, text=True, check=False, env=os.environ | environment
    )
    assert f"in podman containers without network, image {used}" in executed.stdout, executed.stdout + executed.stderr
    assert executed.returncode == 0, executed.stdout

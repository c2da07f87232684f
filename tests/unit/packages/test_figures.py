"""A package has the figures as they were drawn, without those that no longer follow from its records."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import pytest

import sierra
from tests import projects

PACKAGE = '\n[package]\ntitle = "T"\nauthors = [{ name = "Jane Doe" }]\nlicense = "MIT"\n'
pytestmark = pytest.mark.integration


@pytest.mark.nightly
def test_figures_are_packed_as_drawn_and_stale_ones_are_named(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project", projects.CONFIG + PACKAGE)
    batch = sierra.open(root).run("population_size=1,2", runs=1, figures=True).batch
    packed = sierra.open(root).packages.pack(batch, report=False, path=tmp_path / "one.zip")
    drawn = {path.relative_to(root).as_posix(): path for path in root.glob("figures/*/[!.]*")}
    with zipfile.ZipFile(tmp_path / "one.zip") as file:
        assert {name for name in file.namelist() if name.startswith("figures/")} == drawn.keys()
        assert all(file.read(name) == path.read_bytes() for name, path in drawn.items())
    assert drawn
    assert packed is not None
    assert packed.preview.notes == ()
    listed = json.loads(projects.quick(tmp_path, "open", "one.zip", "figures", "--json").stdout)
    assert {file for one in listed for file in one["files"]} == drawn.keys()
    assert {(one["kind"], one["batch"]) for one in listed} == {("figure", batch)}
    name = listed[0]["name"]
    written = projects.quick(tmp_path, "open", "one.zip", "figures", name, "--to", "here")
    assert written.returncode == 0, written.stderr
    assert written.stdout.splitlines() == [f"here/{file}" for file in listed[0]["files"]]
    assert all((tmp_path / "here" / file).read_bytes() == drawn[file].read_bytes() for file in listed[0]["files"])
    again = projects.quick(tmp_path, "open", "one.zip", "figures", name, "--to", "here")
    assert (again.returncode, "exists already" in again.stderr) == (2, True)
    assert projects.quick(tmp_path, "open", "one.zip", "figures", "other").returncode == 2
    stale = sorted(drawn)[0]
    drawn[stale].write_bytes(b"another")
    packed = sierra.open(root).packages.pack(batch, report=False, path=tmp_path / "two.zip")
    assert packed is not None
    [note] = packed.preview.notes
    assert f"of batch {batch[:10]} is not packed: {stale} is not the file that SIERRA made" in note
    with zipfile.ZipFile(tmp_path / "two.zip") as file:
        assert stale not in file.namelist()

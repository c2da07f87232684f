"""Images for several processors under one name: identities, pins and records. No engine is started."""

from __future__ import annotations

import platform
from pathlib import Path

import pytest

import sierra
from sierra.api import Project
from sierra.containers.images.image import architecture
from sierra.errors import ConfigError, Missing
from tests import images, projects

CONFIG = projects.CONFIG + '[container]\nimage = "sim-{arch}.tar"\n'
QUERY = "population_size=1,2"


def image(root: Path, processor: str, text: str = "", made_for: str = "") -> None:
    """Write the image for a processor, with a file of this text."""
    layer = images.layer(("bin/sh", "#!"), ("about", text or processor))
    configuration = images.config([layer], architecture=architecture(made_for or processor))
    images.docker_archive(root / f"sim-{processor}.tar", [layer], configuration)


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Project:
    """Return a project with images for two processors, on a machine with the first one."""
    root = projects.make(tmp_path / "project", CONFIG)
    monkeypatch.setattr(platform, "machine", lambda: "x86_64")
    for processor in ("x86_64", "aarch64"):
        image(root, processor)
    sierra.open(root).images.pin_all()
    return sierra.open(root)


def test_the_ids_are_the_same_on_every_processor(project: Project, monkeypatch: pytest.MonkeyPatch) -> None:
    here = project.plan(QUERY)
    assert here.image is not None
    assert here.image.id.startswith("variants:")
    (project.root / "sim-x86_64.tar").unlink()  # this host needs only its own
    monkeypatch.setattr(platform, "machine", lambda: "aarch64")
    assert project.plan(QUERY).batch.id == here.batch.id


def test_the_ids_depend_on_the_content_of_each_image(project: Project) -> None:
    before = project.plan(QUERY).batch
    image(project.root, "aarch64", "other")
    assert project.plan(QUERY).batch.id == before.id, "the pinned images count"
    project.images.pin_all()
    after = project.plan(QUERY).batch
    assert after.id != before.id
    assert {**before.spec.preimage(), "image": None} == {**after.spec.preimage(), "image": None}
    image(project.root, "riscv64")
    project.images.pin_all()
    assert project.plan(QUERY).batch.id != after.id


def test_an_image_without_the_mark_keeps_its_id(project: Project) -> None:
    config = projects.CONFIG + '[container]\nimage = "sim-x86_64.tar"\n'
    (project.root / "sierra.toml").write_text(config)
    spec = sierra.open(project.root).plan(QUERY).batch.spec
    assert spec.preimage()["image"] == {"id": spec.image, "reach": []}
    assert str(spec.image).startswith("sha256:")


def test_a_processor_without_an_image_is_named(project: Project, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(platform, "machine", lambda: "s390x")
    with pytest.raises(Missing, match=r"^no image for s390x: sim-s390x\.tar is not pinned; add it, and run: sierra image pin"):
        project.plan(QUERY)
    image(project.root, "s390x", made_for="x86_64")
    project.images.pin()
    with pytest.raises(ConfigError, match=r"^the image sim-s390x\.tar is for amd64, but its name is that for s390x$"):
        project.plan(QUERY)


def test_a_name_without_any_image_is_refused(project: Project) -> None:
    for file in (*project.root.glob("sim-*.tar"), project.root / "sierra.lock"):
        file.unlink()
    with pytest.raises(Missing, match=r"^sim-\{arch\}\.tar names no image for any processor: the image file .* exist$"):
        project.images.pin_all()
    with pytest.raises(Missing, match=r"^no image of the name 'sim-\{arch\}\.tar' is pinned, and cannot be pinned yet: "):
        project.plan(QUERY)

"""Files and engines on other hosts, which are folders of this machine here. `tests/extensions/robots` has real ones."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

import pytest

from sierra.config.execution_tables import Container
from sierra.containers import container_setup, on_hosts
from sierra.containers.engines.apptainer import Apptainer
from sierra.containers.engines.base import NoEngine
from sierra.containers.engines.hosts import OtherHost
from sierra.containers.images.image import AnyImage, Image, ImageVariants, Kind, architecture
from sierra.errors import ConfigError, Missing
from sierra.model import Limits, RunSpec
from sierra.store.layout import StorePaths
from sierra.util.processors import here
from tests.support.local_link import LocalLink

IMAGE = Image("lab.sqfs", f"squashfs:{'0' * 64}", Kind.SQUASHFS, "s390x", (), {})
SPEC = RunSpec("command", ("true",), {}, None, IMAGE.id)


def containers(images: AnyImage, any_image: Image) -> on_hosts.HostContainers:
    box = container_setup.settings(SPEC, any_image, Container(image="lab.sqfs"), Limits(), "s")
    return on_hosts.HostContainers(Apptainer(), box, images, lambda image: on_hosts.Prepared(image, Path(image.name), "", ""))


def test_programs_wait_for_a_common_start_only_in_an_image_with_a_shell(host: OtherHost) -> None:
    box = container_setup.settings(SPEC, IMAGE, Container(image="lab.sqfs"), Limits(), "s")
    for shell in (True, False):
        prepared = on_hosts.Prepared(IMAGE, Path("lab.sqfs"), "", "", shell)
        container = on_hosts.HostContainer(box, prepared, host, NoEngine(), NoEngine().probe())
        client = container.client(("env", "x"), {}, waits=True)
        assert client.argv[-2:] == ("env", "x")
        assert (len(client.argv) > 2, client.start_pipe) == (shell, "\0/.start" if shell else "")
        assert any("/bin/sh" in note for note in container.notes) != shell
        assert container.client(("env", "x"), {}).argv == ("env", "x")
        assert not container.client(("env", "x"), {"a.b": ""}, waits=True).start_pipe


@pytest.fixture
def link(tmp_path: Path) -> LocalLink:
    return LocalLink("ada", tmp_path / "ada")


@pytest.fixture
def host(link: LocalLink) -> OtherHost:
    return OtherHost("ada", link, ".cache/runs")


def test_a_file_is_copied_once_and_again_only_if_it_was_damaged(host: OtherHost, link: LocalLink, tmp_path: Path) -> None:
    file, notes = tmp_path / "lab.sif", list[str]()
    file.write_bytes(b"image" * 1000)
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    first, second = (host.place(file, digest, "images", notes.append) for _ in range(2))
    assert first == second
    assert (first.path, notes) == (f"{link.home}/.cache/runs/images/{digest}/lab.sif", [])
    assert link.pushed == [f"{link.home}/.cache/runs/images/{digest}"]
    copy = Path(first.path)
    copy.write_bytes(b"x" + copy.read_bytes()[1:])
    assert host.place(file, digest, "images", notes.append).state != first.state
    assert copy.read_bytes() == file.read_bytes()
    assert notes == [f"ada: {copy} was damaged, and is copied again"]


def test_a_file_that_changes_before_it_is_copied_is_refused(host: OtherHost, tmp_path: Path) -> None:
    file = tmp_path / "lab.sif"
    file.write_bytes(b"other")
    with pytest.raises(Missing, match=r"has other contents than .*lab\.sif after it was copied"):
        host.place(file, "0" * 64, "images", lambda text: None)


def test_a_large_file_is_copied_with_signs_of_progress(
    host: OtherHost, link: LocalLink, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, notes = tmp_path / "lab.sif", list[str]()
    with file.open("wb") as opened:
        opened.truncate(60_000_000)
    push = link.push

    def in_parts(folder: Path, target: str, *, timeout: float = 60.0, progress: object = None) -> object:
        assert callable(progress)
        for _ in range(6):
            progress(10_000_000)
        return push(folder, target)

    monkeypatch.setattr(link, "push", in_parts)
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    host.place(file, digest, "images", notes.append)
    words = "ada: copying the image"
    assert notes == [f"{words} (60 MB)", *(f"{words}: {part} of 60 MB" for part in (20, 30, 50))]


def test_an_image_for_another_processor_is_refused(host: OtherHost, tmp_path: Path) -> None:
    with pytest.raises(Missing, match=r"^ada: the image lab.sqfs is for s390x, but its processor is \w+$"):
        containers(IMAGE, IMAGE).on(host)


def test_each_host_gets_the_image_for_its_processor(host: OtherHost) -> None:
    images = {name: replace(IMAGE, name=f"lab-{name}.sqfs", architecture=architecture(name)) for name in ("s390x", here())}
    both = ImageVariants("lab-{arch}.sqfs", {name: one.id for name, one in images.items()}, images)
    assert containers(both, IMAGE).image_for(host).image == images[here()]
    other = replace(both, ids={"s390x": IMAGE.id}, known={"s390x": images["s390x"]})
    with pytest.raises(
        Missing, match=rf"^ada: no image for {here()}: lab-{here()}\.sqfs is not pinned; add it, and run: sierra"
    ):
        containers(other, IMAGE).on(host)
    with pytest.raises(Missing, match=rf"^ada: the image lab-{here()}\.sqfs \(squashfs:0+\) is neither pinned nor recorded"):
        containers(replace(both, known={}), IMAGE).on(host)


def test_a_host_without_the_engine_or_a_device_is_named(
    host: OtherHost, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = Image("lab.sqfs", IMAGE.id, Kind.SQUASHFS, "", (), {})
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "python3").symlink_to("/usr/bin/python3")
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    with pytest.raises(Missing, match=r"^ada: neither apptainer nor singularity-ce is installed; see"):
        containers(own, own).on(host)
    assert not Path(host.root).exists()


def test_an_engine_that_knows_no_other_hosts_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="the engine 'none' cannot start containers on robots; use apptainer or podman"):
        on_hosts.contain(
            NoEngine(), IMAGE, SPEC, Container(image="a"), Limits(), root=tmp_path, store=StorePaths(tmp_path), session="s"
        )

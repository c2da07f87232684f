"""Containers on other hosts, such as robots: what is prepared here once, and what each host gets.

`sierra.containers.container_setup` does the same for runs on this machine, and on nodes of a cluster that share its files.
"""

from __future__ import annotations

import posixpath
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from sierra.config.execution_tables import Container
from sierra.containers.container_setup import Isolation, examined, ignored, mounts, settings
from sierra.containers.engines.base import PROJECT, Capabilities, ContainerSpec, Engine, Mount, OnOtherHosts, run_process
from sierra.containers.engines.hosts import Notice, OtherHost
from sierra.containers.images.image import ARCHITECTURES, Image
from sierra.errors import ConfigError, Missing
from sierra.model import Client, Limits, RunSpec
from sierra.provenance.hash_cache import cached_sha256
from sierra.store.layout import StorePaths


@dataclass(frozen=True, slots=True)
class HostContainers:
    """The containers of one session on other hosts."""

    engine: OnOtherHosts
    box: ContainerSpec
    """The settings that all hosts share. The sources of its mounts are on this machine, and each host gets a copy."""
    file: Path
    """The image in the form in which hosts get it, and the SHA-256 of this file when the image was verified."""
    sha256: str
    notes: tuple[str, ...] = ()

    def image_for(self, host: OtherHost) -> tuple[Image, Path, str]:
        """Return the image for a host's processor, its file and the file's SHA-256. Raises Missing if there is none."""
        image, machine = self.box.image, ARCHITECTURES.get(host.facts.machine, host.facts.machine)
        if image.architecture and image.architecture != machine:
            raise Missing(f"{host.name}: the image {image.name} is for {image.architecture}, but its processor is {machine}")
        return image, self.file, self.sha256

    def on(self, host: OtherHost) -> HostContainer:
        """Return what the containers on a host need, if they can be started there. Raises Missing and Unreachable."""
        self.image_for(host)
        engine = self.engine.on(host)
        able = engine.probe()
        if able.trouble:
            raise Missing(f"{host.name}: {able.trouble}")
        if lacking := host.call("missing", self.box.devices):
            raise Missing(f"{host.name}: [container] devices: {lacking[0]} does not exist there")
        return HostContainer(self, host, engine, able)


class HostContainer:
    """The containers on one host."""

    def __init__(self, of: HostContainers, host: OtherHost, engine: Engine, able: Capabilities) -> None:
        self.engine, self.abilities = engine, able
        self.files: Mapping[str, tuple[int, ...]] = {}
        """The files there that must not change, with the kernel's data about them when they were verified."""
        self._of, self._host = of, host
        self.box = of.box

    def supply(self, code: str, copies: Mapping[str, str], notice: Notice) -> None:
        """Copy the image to the host unless it is there, and verify it. Raises Missing and Unreachable.

        `code` is the folder of the code there, and `copies` are the copies there of the mounts' sources here.
        """
        image, file, sha256 = self._of.image_for(self._host)
        assert isinstance(self.engine, OnOtherHosts)  # noqa: S101 - it was made by such an engine
        supplied = self.engine.supply(image, file, sha256, notice)
        self.files = supplied.files
        copied = (replace(mount, source=copies[mount.source]) for mount in self._of.box.mounts)
        self.box = replace(
            self._of.box, reference=supplied.reference, mounts=(*([Mount(code, PROJECT)] if code else []), *copied)
        )

    @property
    def sources(self) -> tuple[str, ...]:
        """Return the files and folders of this machine that are mounted."""
        return tuple(mount.source for mount in self._of.box.mounts)

    def placed(self, path: str) -> str:
        """Return the absolute path of a file that is below the folder for runs there."""
        return posixpath.join(self._host.facts.home, path)

    @property
    def isolation(self) -> Isolation:
        """Return the isolation of runs there, to be recorded."""
        return Isolation(self.engine, self.abilities, self.box)

    @property
    def notes(self) -> Iterator[str]:
        """Yield what the engine there cannot do."""
        return (f"{self._host.name}: {note}" for note in ignored(self.engine, self.abilities, self.box))

    def client(self, argv: tuple[str, ...], variables: Mapping[str, str]) -> Client:
        """Return the client that starts the container of a run there."""
        return self.engine.client(self.box, run_process(argv, variables))


def contain(
    engine: Engine,
    image: Image,
    spec: RunSpec,
    container: Container,
    bounds: Limits,
    *,
    root: Path,
    store: StorePaths,
    session: str,
) -> HostContainers:
    """Prepare everything that containers on other hosts need and that does not depend on a host. `root` is the project's.

    Raises ConfigError if the engine cannot start containers elsewhere, Missing if the image or a mount is unavailable.
    """
    if not isinstance(engine, OnOtherHosts):
        raise ConfigError(f"the engine {engine.name!r} cannot start containers on robots; use apptainer or podman")
    inside = examined(spec, image, root, store)
    box = replace(settings(spec, image, container, bounds, session), mounts=tuple(mounts(spec, container, root)))
    file = engine.portable(image, root, store)
    pinned = image.sha256 if image.file and root / image.file == file else ""
    return HostContainers(engine, box, file, pinned or cached_sha256(file), tuple(_notes(container, inside.user)))


def _notes(container: Container, user: str) -> Iterator[str]:
    if container.isolation == "worker":
        yield 'isolation = "worker" has no effect on robots: each run gets its own container'
    if user:
        yield f"the image's USER {user!r} is ignored: outside the container, processes belong to the user of the link"

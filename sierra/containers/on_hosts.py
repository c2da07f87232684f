"""Containers on other hosts, such as robots: the preparation here, once, and the files that each host gets.

`sierra.containers.container_setup` does the same for runs on this machine, and on nodes of a cluster that share its files.
"""

from __future__ import annotations

import posixpath
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path

from sierra.config.execution_tables import Container
from sierra.containers import held_start
from sierra.containers.container_setup import Isolation, examined, ignored, mounts, settings
from sierra.containers.engines.base import PROJECT, Capabilities, ContainerSpec, Engine, Mount, OnOtherHosts, run_process
from sierra.containers.engines.hosts import Notice, OtherHost
from sierra.containers.images.image import AnyImage, Image, architecture, every
from sierra.errors import ConfigError, Missing
from sierra.model import Client, Limits, Result, RunSpec
from sierra.provenance.hash_cache import cached_sha256
from sierra.store.layout import StorePaths
from sierra.util.lazy_definitions import dataclass, replace
from sierra.util.processors import name_of


@dataclass(frozen=True, slots=True)
class Prepared:
    """An image that is ready to be copied to hosts."""

    image: Image
    file: Path
    """The image in the form in which hosts get it, and the SHA-256 of this file when the image was verified."""
    sha256: str
    user: str
    """The user that the image sets for its programs, who is ignored; empty for root."""
    shell: bool = True
    """True if the image has a shell, in which programs can wait for a common start."""


class HostContainers:
    """The containers of one session on other hosts."""

    def __init__(
        self,
        engine: OnOtherHosts,
        box: ContainerSpec,
        image: AnyImage,
        prepare: Callable[[Image], Prepared],
        notes: Iterable[str] = (),
    ) -> None:
        """`box`: the settings that all hosts share, with any of the images. `prepare` is called once for each image in use."""
        self.engine = engine
        self.box = box
        """The sources of its mounts are on this machine, and each host gets a copy."""
        self.notes = tuple(notes)
        self._image, self._prepare = image, prepare
        self._prepared: dict[str, Prepared] = {}
        self._lock = threading.Lock()

    def image_for(self, host: OtherHost) -> Prepared:
        """Return the image for a host's processor. Raises Missing if there is none, or if it is unavailable."""
        processor = name_of(host.facts.machine)
        machine = architecture(processor)
        try:
            image = self._image.on(processor)
            if image.architecture and image.architecture != machine:
                raise Missing(f"the image {image.name} is for {image.architecture}, but its processor is {machine}")
            return self.ready(image)
        except Missing as error:
            raise Missing(f"{host.name}: {error}") from error

    def ready(self, image: Image) -> Prepared:
        """Return an image that is ready to be copied, which takes time once. Several threads may call this."""
        with self._lock:
            if image.id not in self._prepared:
                self._prepared[image.id] = self._prepare(image)
            return self._prepared[image.id]

    def on(self, host: OtherHost) -> HostContainer:
        """Return what the containers on a host need, if they can be started there. Raises Missing and Unreachable."""
        prepared = self.image_for(host)
        engine = self.engine.on(host)
        able = engine.probe()
        if able.trouble:
            raise Missing(f"{host.name}: {able.trouble}")
        if unusable := host.call("unusable", self.box.devices, able.groups):
            raise Missing(f"{host.name}: [container] devices: {unusable[0]}")
        return HostContainer(replace(self.box, image=prepared.image), prepared, host, engine, able)


class HostContainer:
    """The containers on one host."""

    def __init__(self, box: ContainerSpec, prepared: Prepared, host: OtherHost, engine: Engine, able: Capabilities) -> None:
        self.engine, self.abilities = engine, able
        self.files: Mapping[str, tuple[int, ...]] = {}
        """The files there that must not change, with the kernel's data about them when they were verified."""
        self._prepared, self._host = prepared, host
        self._given = box
        self.box = box

    def supply(self, code: str, copies: Mapping[str, str], notice: Notice) -> None:
        """Copy the image to the host unless it is there, and verify it. Raises Missing and Unreachable.

        `code` is the folder of the code there, and `copies` are the copies there of the mounts' sources here.
        """
        assert isinstance(self.engine, OnOtherHosts)  # noqa: S101 - it was made by such an engine
        image = self._prepared
        supplied = self.engine.supply(image.image, image.file, image.sha256, notice)
        self.files = supplied.files
        copied = (replace(mount, source=copies[mount.source]) for mount in self._given.mounts)
        self.box = replace(
            self._given, reference=supplied.reference, mounts=(*([Mount(code, PROJECT)] if code else []), *copied)
        )

    @property
    def sources(self) -> tuple[str, ...]:
        """Return the files and folders of this machine that are mounted."""
        return tuple(mount.source for mount in self._given.mounts)

    def placed(self, path: str) -> str:
        """Return the absolute path of a file that is below the folder for runs there."""
        return posixpath.join(self._host.facts.home, path)

    @property
    def isolation(self) -> Isolation:
        """Return the isolation of runs there, to be recorded."""
        return Isolation(self.engine, self.abilities, self.box)

    @property
    def notes(self) -> Iterator[str]:
        """Yield a line for each limit that the engine there cannot enforce, and each setting of the image without effect."""
        notes = (*_about(self._prepared), *ignored(self.engine, self.abilities, self.box))
        return (f"{self._host.name}: {note}" for note in notes)

    def client(self, argv: tuple[str, ...], variables: Mapping[str, str], *, waits: bool = False) -> Client:
        """Return the client that starts the container of a run there. `variables` replace those that the image sets.

        `waits`: if possible, the program waits in the container for a common start: see `sierra.containers.held_start`.
        """
        complete = {**self.box.image.defaults, **variables}
        if not (waits and self._prepared.shell and held_start.passes(complete)):
            return self.engine.client(self.box, run_process(argv, complete))
        client = self.engine.client(self.box, run_process(held_start.waiting(argv, complete), complete))
        return replace(client, start_pipe=held_start.host_pipe())

    def classify(self, result: Result, stderr: str) -> Result:
        """Return the result of a run's program, derived from its client's result and the end of its standard error."""
        return held_start.classify(self.engine.classify(result, stderr, self.isolation.enforced), stderr)


def contain(
    engine: Engine,
    image: AnyImage,
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

    def prepare(image: Image) -> Prepared:
        inside = examined(spec, image, root, store)
        file = engine.portable(image, root, store)
        pinned = image.sha256 if image.file and root / image.file == file else ""
        shell = inside.program(held_start.SHELL) is not None
        return Prepared(image, file, pinned or cached_sha256(file), inside.user, shell)

    of_any = image if isinstance(image, Image) else next(iter(every(image)))
    # a program may wait for its start for any time, and the agent there ends containers; therefore without a time limit
    box = replace(settings(spec, of_any, container, bounds, session), mounts=tuple(mounts(spec, container, root)), wall=None)
    containers = HostContainers(engine, box, image, prepare, _without_effect(container))
    if isinstance(image, Image):
        containers.ready(image)
    return containers


def _without_effect(container: Container) -> Iterator[str]:
    if container.isolation == "worker":
        yield 'isolation = "worker" has no effect on robots: each run gets its own container'


def _about(image: Prepared) -> Iterator[str]:
    if image.user:
        yield f"the image's USER {image.user!r} is ignored: outside the container, processes belong to the user of the link"
    if not image.shell:
        yield (
            f"the image {image.image.name} has no {held_start.SHELL}: its container starts at the common start, "
            "and its program begins later"
        )

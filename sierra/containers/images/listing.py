"""The images that a project knows: those that it names, has pinned, or has described; and where each of them is."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from sierra.containers.images import inspect, podman_storage
from sierra.containers.images.image import Image, Kind
from sierra.containers.images.pins import pins
from sierra.containers.images.resolve import named
from sierra.errors import SierraError
from sierra.store.layout import StorePaths


class State(StrEnum):
    """How a name's pin and what it stands for now are to each other."""

    PINNED = "pinned"
    MOVED = "moved"
    """It stands for another image than the pinned one."""
    GONE = "gone"
    """The name stands for nothing now; the image itself may still be there."""
    UNPINNED = "not pinned"
    UNNAMED = "unnamed"
    """No name of the project stands for it."""


@dataclass(frozen=True, slots=True)
class Known:
    """One name, or an image without one."""

    name: str
    state: State
    id: str
    """What is pinned; where nothing is, what the name stands for now."""
    now: str
    """What the name stands for now; empty where it is nothing."""
    kind: str
    architecture: str
    podman: bool
    """Whether podman has it."""
    squashfs: bool
    """Whether it is there as apptainer runs it."""
    size: int | None
    """Bytes of its files, where that is known."""
    why: str = ""
    """Why nothing is there under this name, or what is there can't be read."""


def listing(root: Path, store: StorePaths, names: Iterable[str] = ()) -> list[Known]:
    """All that is pinned or among `names`, by name, and then what is described and has no name."""
    pinned = pins(root)
    found = [_named(root, store, name, pinned.get(name)) for name in sorted({*pinned, *names})]
    ids = {identity for one in found for identity in (one.id, one.now)}
    return [*found, *(_unnamed(store, one.image) for one in inspect.known(store) if one.image.id not in ids)]


def _named(root: Path, store: StorePaths, name: str, pinned: Image | None) -> Known:
    now, why = None, ""
    try:
        now = named(root, name)
    except SierraError as error:
        why = str(error)
    image = pinned or now
    if image is None:
        return Known(name, State.GONE, "", "", "", "", podman=False, squashfs=False, size=None, why=why)
    state = State.UNPINNED if pinned is None else State.GONE if now is None else _state(pinned, now)
    return _known(store, name, image, state, now.id if now else "", why)


def _state(pinned: Image, now: Image) -> State:
    return State.PINNED if (pinned.id, pinned.sha256) == (now.id, now.sha256) else State.MOVED


def _unnamed(store: StorePaths, image: Image) -> Known:
    return _known(store, "", image, State.UNNAMED, "", "")


def _known(store: StorePaths, name: str, image: Image, state: State, now: str, why: str) -> Known:
    contents = inspect.contents(store, image)
    return Known(
        name,
        state,
        image.id,
        now,
        str(image.kind),
        image.architecture,
        podman=image.kind == Kind.OCI and podman_storage.holds(image.id),
        squashfs=image.kind == Kind.SQUASHFS or store.image(image.folder).rootfs.is_file(),
        size=contents.size if contents else None,
        why=why,
    )

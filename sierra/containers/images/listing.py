"""The images that a project names, has pinned, or has described in its store, with the places where each one is."""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum
from pathlib import Path

from sierra.containers.images import image_contents, podman_images
from sierra.containers.images.image import Image, Kind
from sierra.containers.images.pins import all_pinned
from sierra.containers.images.resolve import named
from sierra.errors import SierraError
from sierra.store.layout import StorePaths
from sierra.util.lazy_definitions import dataclass


class State(StrEnum):
    """The relation between a name's pin and the image that the name stands for now."""

    PINNED = "pinned"
    MOVED = "moved"
    """The name stands for another image than the pinned one."""
    GONE = "gone"
    """The name stands for no image now; the image itself may still exist."""
    UNPINNED = "not pinned"
    UNNAMED = "unnamed"
    """No name of the project stands for the image."""


@dataclass(frozen=True, slots=True)
class Known:
    """One name with its image, or an image without a name."""

    name: str
    state: State
    id: str
    """The id of the pinned image; without a pin, of the image that the name stands for now."""
    now: str
    """The id of the image that the name stands for now; empty if there is none."""
    kind: str
    architecture: str
    podman: bool
    """True if podman has the image."""
    squashfs: bool
    """True if the image is available in the form that apptainer runs."""
    size: int | None
    """The total size of its files in bytes, if known."""
    why: str = ""
    """The reason why the name stands for no image, or why the image cannot be read."""


def listing(root: Path, store: StorePaths, names: Iterable[str] = ()) -> list[Known]:
    """Return all images that are pinned or in `names`, by name, and then the described images without a name."""
    pinned = all_pinned(root)
    found = [_named(root, store, name, pinned.get(name)) for name in sorted({*pinned, *names})]
    ids = {identity for one in found for identity in (one.id, one.now)}
    others = (one.image for one in image_contents.known(store) if one.image.id not in ids)
    return [*found, *(_known(store, "", image, State.UNNAMED) for image in others)]


def _named(root: Path, store: StorePaths, name: str, pinned: Image | None) -> Known:
    now, why = None, ""
    try:
        now = named(root, name)
    except SierraError as error:
        why = str(error)
    image = pinned or now
    if image is None:
        return Known(name, State.GONE, "", "", "", "", podman=False, squashfs=False, size=None, why=why)
    match pinned, now:
        case None, _:
            state = State.UNPINNED
        case _, None:
            state = State.GONE
        case _:
            state = State.PINNED if (pinned.id, pinned.sha256) == (now.id, now.sha256) else State.MOVED
    return _known(store, name, image, state, now.id if now else "", why)


def _known(store: StorePaths, name: str, image: Image, state: State, now: str = "", why: str = "") -> Known:
    contents = image_contents.contents(store, image)
    return Known(
        name,
        state,
        image.id,
        now,
        str(image.kind),
        image.architecture,
        podman=image.kind == Kind.OCI and podman_images.holds(image.id),
        squashfs=image.kind == Kind.SQUASHFS or store.image(image.folder).rootfs.is_file(),
        size=contents.size if contents else None,
        why=why,
    )

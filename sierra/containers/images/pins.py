"""The file `sierra.lock`, which records the image that each name stands for in this project, and is committed with it.

The image behind a name can change: a tag is rebuilt, a file is replaced. A run must stay the same run, so it uses the pinned
image. `sierra image pin` changes the pin to the new image.

A name with `{arch}` stands for all names that have a processor in its place and are pinned.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

from sierra.containers.images.image import AnyImage, Image, ImageVariants, InvalidImage, architecture, of_fields
from sierra.containers.images.image_contents import Contents, examine, examine_again, is_apptainer_image
from sierra.containers.images.resolve import named
from sierra.errors import ConfigError, Missing, SierraError
from sierra.store.layout import ProjectPaths, StorePaths
from sierra.util import processors
from sierra.util.fs import write_whole
from sierra.util.processors import ARCH
from sierra.util.regular_files import read_regular

FORMAT = 1


def pin(root: Path, store: StorePaths, name: str) -> Contents:
    """Pin the image that a name stands for now, and return its contents. Raises Missing or Damaged, and pins nothing then.

    An archive may have the right configuration and damaged layers, so it is read completely before it is pinned the first time.
    """
    image, before = named(root, name), all_pinned(root).get(name)
    unread = image.file and not is_apptainer_image(root / image.file) and (before is None or before.sha256 != image.sha256)
    contents = examine_again(root, store, image) if unread or (image.file and not image.sha256) else examine(root, store, image)
    _write(root, contents.image)
    return contents


def pinned_for_hosts(root: Path, name: str) -> AnyImage:
    """Return what a name is pinned to: an image, or for a name with `{arch}`, an image for each processor.

    Raises as `pinned`, and ConfigError for an image that is for another processor than its name says.
    """
    return _variants(root, name, all_pinned(root)) if ARCH in name else pinned(root, name)


def pinned(root: Path, name: str) -> Image:
    """Return the image that a name is pinned to. Raises Missing if it is not pinned, ConfigError for a broken `sierra.lock`."""
    known = all_pinned(root)
    if name not in known:
        raise Missing(f"the image {name!r} is not pinned, {_why(root, name)} run: sierra image pin {name}")
    return known[name]


def _variants(root: Path, name: str, known: Mapping[str, Image]) -> ImageVariants:
    variants = {one: known[own] for one in processors.NAMES if (own := name.replace(ARCH, one)) in known}
    if not variants:
        mine = name.replace(ARCH, processors.here())
        raise Missing(f"no image of the name {name!r} is pinned, {_why(root, mine)} run: sierra image pin {name!r}")
    for processor, image in variants.items():
        if image.architecture and image.architecture != architecture(processor):
            raise ConfigError(f"the image {image.name} is for {image.architecture}, but its name is that for {processor}")
    return ImageVariants(name, {processor: image.id for processor, image in variants.items()}, variants)


def _why(root: Path, name: str) -> str:
    """Return the beginning of the remedy for a missing pin: the image must be pinned, or first be made."""
    try:
        named(root, name)
    except SierraError as error:
        return f"and cannot be pinned yet: {error}; then"
    return "so no run can use it;"


def all_pinned(root: Path) -> dict[str, Image]:
    """Return all pinned images, by name. Raises ConfigError for a broken `sierra.lock`."""
    path = ProjectPaths(root).lock
    try:
        lock = json.loads(read_regular(path))
        if not isinstance(lock, dict) or lock.get("format") != FORMAT:
            raise ConfigError(f"{path} does not have format {FORMAT}; another version of SIERRA wrote it, or it was edited")
        return {name: of_fields(name, fields) for name, fields in lock["images"].items()}
    except FileNotFoundError:
        return {}
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        reason = str(error) if isinstance(error, InvalidImage) else "not written by sierra image pin"
        raise ConfigError(f"{path} is broken ({reason}); restore it, or remove it and run: sierra image pin") from error
    except OSError as error:
        raise Missing(f"{path} cannot be read: {error.strerror}") from error


def _write(root: Path, image: Image) -> None:
    """Write the image of a name to `sierra.lock`, replacing the previous pin. Raises Missing if the file cannot be written."""
    known = all_pinned(root) | {image.name: image}
    fields = {name: {key: value for key, value in asdict(pinned).items() if key != "name"} for name, pinned in known.items()}
    text = json.dumps({"format": FORMAT, "images": fields}, indent=2, sort_keys=True, ensure_ascii=False)
    path = ProjectPaths(root).lock
    try:
        write_whole(path, text.encode() + b"\n")
    except OSError as error:
        raise Missing(f"{path} cannot be written: {error.strerror}") from error

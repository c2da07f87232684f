"""Pinning: the image of a name is read completely, checked, described, and recorded in `sierra.lock`."""

from __future__ import annotations

from pathlib import Path

from sierra.containers.images.image_contents import Contents, examine, examine_again, squashfs_file
from sierra.containers.images.pins import pin, pins
from sierra.containers.images.resolve import named
from sierra.store.layout import StorePaths


def take(root: Path, store: StorePaths, name: str) -> Contents:
    """Pin the image that a name stands for now, and return its contents. Raises Missing or Damaged, and pins nothing then.

    An archive may have the right configuration and damaged layers, so it is read completely before it is pinned the first time.
    """
    image, before = named(root, name), pins(root).get(name)
    unread = image.file and not squashfs_file(root / image.file) and (before is None or before.sha256 != image.sha256)
    found = examine_again(root, store, image) if unread or (image.file and not image.sha256) else examine(root, store, image)
    pin(root, found.image)
    return found

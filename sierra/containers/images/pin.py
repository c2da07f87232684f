"""Pinning: what a name stands for now is read whole, checked, described, and written down."""

from __future__ import annotations

from pathlib import Path

from sierra.containers.images.inspect import Contents, examine, examine_again, squashfs_file
from sierra.containers.images.pins import pin, pins
from sierra.containers.images.resolve import named
from sierra.store.layout import StorePaths


def take(root: Path, store: StorePaths, name: str) -> Contents:
    """Pin what a name stands for now; what is in it. Raises Missing, Damaged, and has pinned nothing then.

    An archive may have the right configuration and damaged layers, so that it is read whole before it is pinned first.
    """
    image, before = named(root, name), pins(root).get(name)
    unread = image.file and not squashfs_file(root / image.file) and (before is None or before.sha256 != image.sha256)
    found = examine_again(root, store, image) if unread or (image.file and not image.sha256) else examine(root, store, image)
    pin(root, found.image)
    return found

"""Container images: their names, their identities, their contents, and how they are built.

`image` defines an image and its identity. `named` finds the image that a name stands for, `take` writes its id to
`sierra.lock`, `pinned` returns the image that runs use, and `verify` checks before an execution that it has not changed.
`contents` lists the files in an image, `rootfs` is the squashfs that apptainer runs. The formats are `oci`, `sif` and
`squashfs`; `podman_storage` calls podman.
"""

from __future__ import annotations

from sierra.containers.images.image import Image, Kind, machine, short
from sierra.containers.images.image_contents import Contents, contents, examine, from_row, outdated, rootfs
from sierra.containers.images.pin import take
from sierra.containers.images.pins import pin, pinned, pins
from sierra.containers.images.resolve import named, verify
from sierra.store.layout import LOCK

__all__ = [
    "LOCK",
    "Contents",
    "Image",
    "Kind",
    "contents",
    "examine",
    "from_row",
    "machine",
    "named",
    "outdated",
    "pin",
    "pinned",
    "pins",
    "rootfs",
    "short",
    "take",
    "verify",
]

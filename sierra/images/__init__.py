"""Images: the files that runs see in containers. What they are called, what they are, what is in them, and how they are made.

`image` has the noun, and says what identifies one. `named` finds what a name stands for, `take` writes that down in
`sierra.lock`, `pinned` is what runs are made of, `verify` sees before they execute that it still is that. `contents` is what
is in an image, `rootfs` what apptainer runs of it. Formats are `archive`, `sif` and `squashfs`; podman is called in `storage`.
"""

from __future__ import annotations

from sierra.images.described import Contents, contents, examine, from_row, outdated, rootfs
from sierra.images.image import Image, Kind, machine, short
from sierra.images.naming import named, verify
from sierra.images.pins import pin, pinned, pins
from sierra.images.taking import take
from sierra.paths import LOCK

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

"""Container images: their names, their identities, their contents, and how they are built.

`image` defines an image and its identity. `named` finds the image that a name stands for, `pin` writes its id to
`sierra.lock`, `pinned` returns the image that runs use, and `verify` checks before an execution that it has not changed.
`examine` lists the files in an image, `rootfs` is the squashfs that apptainer runs.
"""

from __future__ import annotations

from sierra.containers.images.image import Image, machine, short
from sierra.containers.images.image_contents import contents, examine, outdated, rootfs
from sierra.containers.images.pins import pin, pinned, pins
from sierra.containers.images.resolve import named, verify

__all__ = ["Image", "contents", "examine", "machine", "named", "outdated", "pin", "pinned", "pins", "rootfs", "short"]
__all__ += ["verify"]

"""Container images: their names, their identities, their contents, and how they are built.

`image` defines an image and its identity. `named` finds the image that a name stands for, `pin` writes its id to
`sierra.lock`, `pinned` returns the image that runs use, and `verify` checks before an execution that it has not changed.
`examine` lists the files in an image, `rootfs` is the squashfs that apptainer runs.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from sierra.containers.images.image import AnyImage, Image, ImageVariants, every, here, machine, short

if TYPE_CHECKING:
    from sierra.containers.images.image_contents import contents, examine, outdated, rootfs
    from sierra.containers.images.pins import all_pinned, pin, pinned, pinned_for_hosts
    from sierra.containers.images.resolve import existing, named, unchanged, verify

HOMES = {
    **dict.fromkeys(("contents", "examine", "outdated", "rootfs"), "image_contents"),
    **dict.fromkeys(("all_pinned", "pin", "pinned", "pinned_for_hosts"), "pins"),
    **dict.fromkeys(("existing", "named", "unchanged", "verify"), "resolve"),
}
"""The modules of names that are loaded when they are used: most projects have no image."""


def __getattr__(name: str) -> object:
    if name not in HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{HOMES[name]}"), name)


__all__ = [
    "AnyImage",
    "Image",
    "ImageVariants",
    "all_pinned",
    "contents",
    "every",
    "examine",
    "existing",
    "here",
    "machine",
    "named",
]
__all__ += ["outdated", "pin", "pinned", "pinned_for_hosts", "rootfs", "short", "unchanged", "verify"]

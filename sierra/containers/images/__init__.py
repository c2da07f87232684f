"""Container images: their names, their identities, their contents, and how they are built.

`image` defines an image and its identity. `named` finds the image that a name stands for, `take` writes its id to
`sierra.lock`, `pinned` returns the image that runs use, and `verify` checks before an execution that it has not changed.
`examine` lists the files in an image, `rootfs` is the squashfs that apptainer runs.
"""

from __future__ import annotations

from sierra.containers.images.image import Image as Image
from sierra.containers.images.image import machine as machine
from sierra.containers.images.image import short as short
from sierra.containers.images.image_contents import contents as contents
from sierra.containers.images.image_contents import examine as examine
from sierra.containers.images.image_contents import outdated as outdated
from sierra.containers.images.image_contents import rootfs as rootfs
from sierra.containers.images.pins import pinned as pinned
from sierra.containers.images.pins import pins as pins
from sierra.containers.images.pins import take as take
from sierra.containers.images.resolve import named as named
from sierra.containers.images.resolve import verify as verify

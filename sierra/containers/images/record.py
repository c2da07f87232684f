"""The rows of images for several processors in the table `images`, and the images that they name."""

from __future__ import annotations

from collections.abc import Mapping

from sierra.containers.images.image import ImageVariants, Kind, short
from sierra.store.row_types import ImageRow


def row(image: ImageVariants) -> ImageRow:
    """Return the row of images for several processors. Each of these images has a row of its own."""
    return ImageRow(
        image=image.id,
        kind=Kind.VARIANTS,
        architecture=None,
        layers=[],
        name=image.name,
        file=None,
        sha256=None,
        squashfs=None,
        manifests=None,
        created=None,
        labels=None,
        variables=None,
        packages=None,
        recipe=None,
        files=None,
        size=0,
        variants=[f"{processor}={identity}" for processor, identity in image.ids.items()],
    )


def variants(of: ImageRow) -> Mapping[str, str]:
    """Return the ids of images by processor, from their common row; an image for one processor has none."""
    return dict(text.split("=", 1) for text in of.variants or ())


def changes(was: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Return the differences between the ids of images by processor, in words."""
    return [
        *(f"{one} is new" for one in now if one not in was),
        *(f"{one} is gone" for one in was if one not in now),
        *(f"{one} was {short(was[one])} and is {short(now[one])}" for one in changed(was, now)),
    ]


def changed(was: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Return the processors of which both sides have an image, but not the same one."""
    return [one for one in now if one in was and was[one] != now[one]]

"""Container images: the files that a run sees instead of the machine's own, identified by content.

Names change, files are copied, and every image store writes its own manifests. These identifiers stay the same:

* for an OCI image, `sha256:` and the digest of its configuration, which names the digest of each layer's files (the manifest's
  digest differs between the forms in which an image is stored, so it cannot identify the image);
* for a squashfs, plain or in a SIF, `squashfs:` and the SHA-256 of the file system (a signature changes the SIF, but not this).

A squashfs that SIERRA made from an OCI image keeps the id of that OCI image.

A name with `{arch}` stands for one image for each processor. Their identity together is `variants:` and the hash of their ids
by processor. It is the same on every host, whichever of the images executes a run there.
"""

from __future__ import annotations

import platform
from collections.abc import Mapping
from enum import StrEnum

from sierra.errors import Missing
from sierra.util import processors
from sierra.util.hashing import digest
from sierra.util.json_types import JsonView, as_texts
from sierra.util.lazy_definitions import dataclass, regex
from sierra.util.processors import ARCH

DEFAULT_PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
"""The PATH that engines use if an image does not set one."""

ID = regex(r"(sha256|squashfs):[0-9a-f]{64}")


class Kind(StrEnum):
    """The form of an image, which decides how it is identified."""

    OCI = "oci"
    SQUASHFS = "squashfs"
    VARIANTS = "variants"
    """Images for several processors under one name."""


@dataclass(frozen=True, slots=True)
class Image:
    """One image: the name that a project uses, and its content identity."""

    name: str
    id: str
    kind: Kind
    architecture: str
    """The architecture in OCI's terms: amd64, arm64, …; empty if the image does not state it."""
    layers: tuple[str, ...]
    """The digests of the layers' files, from the lowest layer; empty for a squashfs."""
    variables: Mapping[str, str]
    """The environment variables that the image sets for its programs."""
    file: str = ""
    """The path of an image file, relative to the project's root if it is inside the project; empty for a tag."""
    sha256: str = ""
    """The SHA-256 of that file."""

    @property
    def folder(self) -> str:
        """Return the image's id as a file name."""
        return self.id.replace(":", "-")

    @property
    def defaults(self) -> dict[str, str]:
        """Return the variables of programs for which nothing else is declared: the image's, and a PATH."""
        return {"PATH": DEFAULT_PATH, **self.variables}

    def on(self, processor: str) -> Image:
        """Return the image itself: it is the same on every host."""
        return self


@dataclass(frozen=True, slots=True)
class ImageVariants:
    """The images that one name with `{arch}` stands for: one for each processor."""

    name: str
    """The name that a project uses, with `{arch}`."""
    ids: Mapping[str, str]
    """The ids of the images, by processor (see `sierra.util.processors`)."""
    known: Mapping[str, Image]
    """The images that are pinned or recorded here, by processor."""

    @property
    def id(self) -> str:
        """Return the content identity of the images together."""
        return variants_id(self.ids)

    def on(self, processor: str) -> Image:
        """Return the image for hosts with a processor. Raises Missing if there is none."""
        name = self.name.replace(ARCH, processor)
        if processor not in self.ids:
            raise Missing(f"no image for {processor}: {name} is not pinned; add it, and run: sierra image pin {name}")
        if processor not in self.known:
            what = f"the image {name} ({short(self.ids[processor])})"
            raise Missing(f"{what} is neither pinned nor recorded; add it, and run: sierra image pin {name}")
        return self.known[processor]


AnyImage = Image | ImageVariants
"""The image, or the images by processor, that a name refers to."""


def variants_id(ids: Mapping[str, str]) -> str:
    """Return the content identity of images together; `ids` are their ids by processor."""
    return f"{Kind.VARIANTS}:{digest('image variants', {'images': dict(ids)})}"


def every(image: AnyImage | None) -> tuple[Image, ...]:
    """Return all known images that a name refers to."""
    if image is None:
        return ()
    return (image,) if isinstance(image, Image) else tuple(image.known.values())


def here(image: AnyImage | None) -> Image | None:
    """Return the image for this machine; None for none. Raises Missing if there is none for its processor."""
    return None if image is None else image.on(processors.here())


class InvalidImage(ValueError):
    """A field of a recorded image has a wrong value; the message names it."""


def of_fields(name: str, fields: Mapping[str, JsonView]) -> Image:
    """Return the image that was recorded by its fields. Raises LookupError, TypeError or ValueError for other fields."""
    identity, architecture, file, sha256 = (_text(name, fields, key) for key in ("id", "architecture", "file", "sha256"))
    layers, variables = fields["layers"], fields["variables"]
    if not isinstance(layers, list | tuple) or not isinstance(variables, Mapping):
        raise TypeError(f"{name!r} has no layers or no variables")
    texts = (*layers, *variables.values())
    if not ID.fullmatch(identity) or not all(isinstance(text, str) for text in texts):
        raise InvalidImage(f"{name!r} has the id {identity!r}")
    sets = {variable: str(value) for variable, value in variables.items()}
    return Image(name, identity, Kind(str(fields["kind"])), architecture, as_texts(layers), sets, file, sha256)


def _text(name: str, fields: Mapping[str, JsonView], key: str) -> str:
    value = fields[key]
    if not isinstance(value, str):
        raise InvalidImage(f"{key} of {name!r} is not a text")
    return value


def machine() -> str:
    """Return this machine's architecture in OCI's terms."""
    return architecture(platform.machine())


def architecture(machine: str) -> str:
    """Return a processor's architecture in OCI's terms, from its name in the kernel's terms."""
    name = processors.name_of(machine)
    return processors.OCI.get(name, name).partition("/")[0]


def short(identity: str) -> str:
    """Return an image's id in short form, for display."""
    kind, _, digest = identity.partition(":")
    return f"{kind}:{digest[:12]}"

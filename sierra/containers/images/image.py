"""Container images: the files that a run sees instead of the machine's own, identified by content.

Names change, files are copied, and every image store writes its own manifests. These identifiers stay the same:

* for an OCI image, `sha256:` and the digest of its configuration, which names the digest of each layer's files (the manifest's
  digest differs between the forms in which an image is stored, so it cannot identify the image);
* for a squashfs, plain or in a SIF, `squashfs:` and the SHA-256 of the file system (a signature changes the SIF, but not this).

A squashfs that SIERRA made from an OCI image keeps the id of that OCI image.
"""

from __future__ import annotations

import platform
import re
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

from sierra.util.json_types import JsonView, as_texts

ARCHITECTURES = {"x86_64": "amd64", "aarch64": "arm64", "armv7l": "arm", "i686": "386"}
"""The OCI names of processor architectures that have another name in the kernel."""

ID = re.compile(r"(sha256|squashfs):[0-9a-f]{64}")


class Kind(StrEnum):
    """The form of an image, which decides how it is identified."""

    OCI = "oci"
    SQUASHFS = "squashfs"


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


class InvalidImage(ValueError):
    """A field of a recorded image has a wrong value; the message names it."""


def of_fields(name: str, fields: Mapping[str, JsonView]) -> Image:
    """Return the image that was recorded by its fields. Raises LookupError, TypeError or ValueError for other fields."""
    identity, architecture, file, sha256 = (_text(name, fields, key) for key in ("id", "architecture", "file", "sha256"))
    layers, variables = fields["layers"], fields["variables"]
    if not isinstance(layers, list | tuple) or not isinstance(variables, Mapping):
        raise TypeError(f"{name!r} has no layers or no variables")
    texts = (*layers, *variables.values())
    if not ID.fullmatch(identity) or not all(isinstance(one, str) for one in texts):
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
    return ARCHITECTURES.get(platform.machine(), platform.machine())


def short(identity: str) -> str:
    """Return an image's id in short form, for display."""
    kind, _, digest = identity.partition(":")
    return f"{kind}:{digest[:12]}"

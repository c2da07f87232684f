"""An image: the files that a run sees in the place of the machine's own, identified by content.

Names move, files are copied, manifests are written anew by every store; what stays is

* of an OCI image, `sha256:` and the digest of its configuration, which names the digest of each layer's files (the manifest's
  digest is another one in every form that the image is kept in, so it identifies nothing);
* of a squashfs, plain or in a SIF, `squashfs:` and the SHA-256 of the file system (a signature changes the SIF, not this).

A squashfs that SIERRA made from an OCI image is that image: its id stays the OCI one.
"""

from __future__ import annotations

import platform
import re
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

ARCHITECTURES = {
    "x86_64": "amd64",
    "aarch64": "arm64",
    "armv7l": "arm",
    "i686": "386",
    "ppc64le": "ppc64le",
    "riscv64": "riscv64",
    "s390x": "s390x",
}
"""What the kernel calls a processor's architecture, and what OCI does."""

ID = re.compile(r"(sha256|squashfs):[0-9a-f]{64}")


class Kind(StrEnum):
    """What an image is made of."""

    OCI = "oci"
    SQUASHFS = "squashfs"


@dataclass(frozen=True, slots=True)
class Image:
    """One image, as a project names it, and what it is."""

    name: str
    id: str
    kind: Kind
    architecture: str
    """As OCI calls it: amd64, arm64, …; empty where it does not say."""
    layers: tuple[str, ...]
    """The digests of the layers' files, from the lowest; none of a squashfs."""
    variables: Mapping[str, str]
    """What the image sets for its programs."""
    file: str = ""
    """Where it is a file: its path, from the project's root where it lies in there; empty for a tag."""
    sha256: str = ""
    """SHA-256 of that file."""

    @property
    def folder(self) -> str:
        """Its id as a file name."""
        return self.id.replace(":", "-")


def machine() -> str:
    """This machine's architecture as OCI calls it."""
    return ARCHITECTURES.get(platform.machine(), platform.machine())


def short(identity: str) -> str:
    """An image's id as it is shown to people."""
    kind, _, digest = identity.partition(":")
    return f"{kind}:{digest[:12]}"

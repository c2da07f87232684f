"""Container images, by their content."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from sierra.errors import Missing
from sierra.paths import StorePaths

LOCK = "sierra.lock"


class Kind(StrEnum):
    """What an image is made of."""

    OCI = "oci"
    SQUASHFS = "squashfs"
    """A file system in one file, bare or in a SIF."""


@dataclass(frozen=True, slots=True)
class Image:
    """An image as it is pinned."""

    name: str
    """As the project calls it: a tag, a file, a recipe's folder."""
    id: str
    """The content: `sha256:…` of an OCI image's configuration, or `squashfs:…`, the SHA-256 of a file system."""
    kind: str
    architecture: str
    """As OCI calls it: amd64, arm64; empty where it is not known."""
    layers: tuple[str, ...]
    """`sha256:…` of each layer's files, of an OCI image."""
    variables: Mapping[str, str]
    """What the image sets for its programs."""
    file: str = ""
    """The file that it is, as seen from the project's root; empty for a tag."""
    sha256: str = ""
    """The SHA-256 of that file."""


def pins(root: Path) -> dict[str, Image]:
    """The images that are pinned, by name."""
    try:
        pinned = json.loads((root / LOCK).read_text())
    except FileNotFoundError:
        return {}
    return {name: Image(**{**fields, "layers": tuple(fields["layers"])}) for name, fields in pinned.items()}


def pinned(root: Path, name: str) -> Image:
    """The image of that name. Raises Missing where it is not pinned."""
    found = pins(root).get(name)
    if found is None:
        raise Missing(f"the image {name} is not pinned: sierra image pin")
    return found


def verify(root: Path, image: Image) -> None:
    return None


class Contents:
    def program(self, name: str, path: str) -> str | None:
        return "/usr/bin/" + name


def contents(store: StorePaths, image: Image) -> Contents | None:
    return Contents()


def from_row(row: Mapping[str, Any]) -> Image:
    return Image(row["name"], row["image"], row["kind"], row["architecture"], (), {})

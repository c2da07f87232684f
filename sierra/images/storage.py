"""podman's storage of images."""

from __future__ import annotations

import subprocess
from pathlib import Path

from sierra.errors import Missing
from sierra.images import Image
from sierra.paths import StorePaths


def identify(name: str) -> str | None:
    told = subprocess.run(("podman", "image", "inspect", "--format={{.Id}}", name), capture_output=True, text=True, check=False)
    return f"sha256:{told.stdout.strip()}" if told.returncode == 0 else None


def prepare(image: Image, root: Path, store: StorePaths) -> str:
    if identify(image.id) is None:
        raise Missing(f"the image {image.name} ({image.id[:17]}…) is not in podman's storage")
    return image.id

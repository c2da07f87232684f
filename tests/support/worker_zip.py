"""Changes to a copy of the zip that nodes execute."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path


def change(path: Path, name: str, changed: Callable[[str], str]) -> None:
    """Replace the text of one member of a zip."""
    with zipfile.ZipFile(path) as archive:
        texts = {member: archive.read(member).decode() for member in archive.namelist()}
    texts[name] = changed(texts[name])
    with zipfile.ZipFile(path, "w") as archive:
        for member, text in texts.items():
            archive.writestr(member, text)

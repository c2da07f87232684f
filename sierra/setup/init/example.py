"""The bundled examples, and copying them to a folder where the user can change them."""

from __future__ import annotations

import shutil
from importlib import resources
from pathlib import Path

from sierra.errors import UsageError


def copy_example(name: str, folder: Path) -> list[str]:
    """Copy a bundled example; return the files' names. Raises UsageError for an unknown name or a folder that is not empty."""
    examples = resources.files("sierra.setup") / "examples"
    known = sorted(entry.name for entry in examples.iterdir() if entry.is_dir() and not entry.name.startswith("_"))
    if name not in known:
        raise UsageError(f"no example {name!r}; known are {', '.join(known)}")
    if folder.exists() and any(folder.iterdir()):
        raise UsageError(f"{folder} is not empty; use a new folder")
    folder.mkdir(parents=True, exist_ok=True)
    with resources.as_file(examples / name) as example:
        files = sorted(file for file in example.iterdir() if file.is_file())
        for file in files:
            shutil.copyfile(file, folder / file.name)
    return [file.name for file in files]

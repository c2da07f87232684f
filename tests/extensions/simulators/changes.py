"""Projects that call real simulators without a platform, and changes of the simulators."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

LOCKS = Path(__file__).parent / "locks"
Edit = Callable[[Path, bytes], None]


def project(folder: Path, command: str, template: str, *, seed: str, size: str, observe: str = "first") -> Path:
    """Write a project whose experiments are called by their size."""
    folder.mkdir()
    (folder / "template.xml").write_text(template)
    (folder / "sierra.toml").write_text(
        f'template = "template.xml"\ncommand = "{command}"\nseed = "{seed}"\nruns = 2\nobserve = "{observe}"\n'
        f'[variables]\nsize = "{size}"\n'
    )
    return folder

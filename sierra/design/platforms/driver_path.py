"""The place of a driver among the input files of a run."""

from __future__ import annotations

import os.path


def driver_path(template: str, name: str, *, is_among_files: bool) -> str:
    """Return the path of a driver in a command: beside the input, which lies in its template's folder among other files."""
    folder = os.path.dirname(os.path.normpath(template)) if is_among_files else ""  # noqa: PTH120
    return "/".join(("{run}", *filter(None, (folder,)), name))

"""Files that are no regular ones, which must not be waited for."""

from __future__ import annotations

import os
import socket
from pathlib import Path


def irregular(path: Path, kind: str) -> Path:
    """Put a pipe, a socket, or a link to a device without an end in the place of a file."""
    path.unlink(missing_ok=True)
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(os.path.relpath(path))  # a socket's path is short
    else:
        path.symlink_to("/dev/zero")
    return path

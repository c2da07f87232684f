"""Changes to a project's file: only of the content that was read, so that no edit by somebody else is lost."""

from __future__ import annotations

import stat
from pathlib import Path

from sierra.errors import Missing, UsageError
from sierra.store import read_lock
from sierra.util.fs import replacing
from sierra.util.regular_files import read_regular


def replace_content(file: Path, before: bytes, after: bytes) -> None:
    """Replace the content of a file, which must still be `before`. Its mode is kept; a link stays a link to the changed file.

    Other processes of SIERRA wait meanwhile. Raises UsageError if the file has changed, Missing if it cannot be written.
    """
    target = file.resolve()
    try:
        with read_lock.alone(target.parent) as alone:
            if not alone:
                raise Missing(f"{file}: another process is changing it; try again")
            _replace(target, before, after)
    except OSError as error:
        raise Missing(f"{file}: {error.strerror}") from error


def _replace(file: Path, before: bytes, after: bytes) -> None:
    with replacing(file) as unfinished:
        unfinished.touch(0o600)
        unfinished.write_bytes(after)
        unfinished.chmod(stat.S_IMODE(file.stat().st_mode))
        if read_regular(file) != before:
            raise UsageError(f"{file.name} has changed since it was read; try again")

"""The programs that run where SIERRA is not installed, as one zip that Python executes; see `sierra.worker.__main__`.

Its bytes depend on nothing but the sources: members have a fixed order and time, and are not compressed, because compressors
differ.
"""

from __future__ import annotations

import io
import zipfile
from functools import lru_cache
from pathlib import Path

from sierra.worker.program import HERE


@lru_cache(maxsize=1)
def packed() -> bytes:
    """Return the zip."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for path in sorted(Path(HERE).glob("*.py")):
            if path.name != "__init__.py":
                member = zipfile.ZipInfo(path.name)
                member.create_system, member.external_attr = 3, 0o644 << 16
                archive.writestr(member, path.read_bytes())
    return buffer.getvalue()

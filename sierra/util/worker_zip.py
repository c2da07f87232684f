"""The programs that run where SIERRA is not installed, as one zip that Python executes; see `sierra.worker.__main__`.

The modules of `sierra.worker` are its members, and a package of programs of an extension, if somebody asks for it. Its bytes
depend on nothing but the sources: members have a fixed order and time, and are not compressed, because compressors differ.
"""

from __future__ import annotations

import io
import zipfile
from functools import cache
from pathlib import Path

from sierra.worker.program import HERE

SIERRA = Path(HERE).parent


@cache
def packed(programs: Path | None = None) -> bytes:
    """Return the zip. `programs` is the folder of a package of an extension that needs no other modules but the worker's."""
    paths = {path.name: path for path in Path(HERE).glob("*.py") if path.name != "__init__.py"}
    if programs is not None:
        above = (folder / "__init__.py" for folder in programs.parents if SIERRA in folder.parents)
        paths |= {str(path.relative_to(SIERRA)): path for path in (*programs.glob("*.py"), *above)}
    zipped = io.BytesIO()
    with zipfile.ZipFile(zipped, "w") as archive:
        for name, path in sorted(paths.items()):
            member = zipfile.ZipInfo(name)
            member.create_system, member.external_attr = 3, 0o644 << 16
            archive.writestr(member, path.read_bytes())
    return zipped.getvalue()

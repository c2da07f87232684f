"""The project that a command is about."""

from __future__ import annotations

import os
import sys

from sierra.project import Project

ALLOCATOR = "ARROW_DEFAULT_MEMORY_POOL"


def project() -> Project:
    """The project of the working directory, as `sierra.open` gives it, but quicker.

    pyarrow loads pandas at the first array it makes, which takes half a second. No command converts to pandas, so
    pyarrow is made to believe that there is none; and its own allocator, which keeps what is freed, gives way to the
    system's: 80 MB less for 100,000 runs. (By a variable, as what pyarrow does in C++ heeds nothing else; it is read but once.)
    Whoever uses SIERRA from Python is not concerned by either.
    """
    if not {"pandas", "pyarrow"} & sys.modules.keys():
        sys.meta_path.insert(0, _NoPandas())
        before = os.environ.get(ALLOCATOR)
        os.environ[ALLOCATOR] = "system"
        try:
            import pyarrow as pa

            pa.array([0])
        finally:
            del sys.meta_path[0], os.environ[ALLOCATOR]
            os.environ.update({} if before is None else {ALLOCATOR: before})
    return Project()


class _NoPandas:
    """An importer to which there is no pandas."""

    def find_spec(self, name: str, path: object = None, target: object = None) -> None:
        if name == "pandas":
            raise ModuleNotFoundError(name)

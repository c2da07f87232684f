"""The project that a command is about."""

from __future__ import annotations

import sys

from sierra.api import Project


def project() -> Project:
    """The project of the working directory, as `sierra.open` gives it, but quicker.

    pyarrow loads pandas at the first array it makes, which takes half a second. No command converts to pandas, so
    pyarrow is made to believe that there is none; and its own allocator, which keeps what is freed, gives way to the
    system's: 60 MB less for 100,000 runs. Whoever uses SIERRA from Python is not concerned by either.
    """
    if not {"pandas", "pyarrow"} & sys.modules.keys():
        sys.meta_path.insert(0, _NoPandas())
        try:
            import pyarrow as pa

            pa.array([0])
            pa.set_memory_pool(pa.system_memory_pool())
        finally:
            del sys.meta_path[0]
    return Project()


class _NoPandas:
    """An importer to which there is no pandas."""

    def find_spec(self, name: str, path: object = None, target: object = None) -> None:
        if name == "pandas":
            raise ModuleNotFoundError(name)

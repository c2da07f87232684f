"""Regular expressions that are compiled when they are first used: a command imports many more than it uses."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from re import compile as regex
else:

    class regex:
        """A regular expression with all attributes of a compiled one; each stays here once somebody has asked for it."""

        def __init__(self, pattern: str | bytes, flags: int = 0) -> None:
            self.pattern = pattern
            self._flags = flags

        def __getattr__(self, name: str) -> object:
            if name.startswith("__"):
                raise AttributeError(name)
            value = getattr(re.compile(self.pattern, self._flags), name)
            setattr(self, name, value)
            return value


__all__ = ("regex",)

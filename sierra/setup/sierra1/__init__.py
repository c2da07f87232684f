"""`sierra init --from-sierra1`: a `sierra.toml` from a project of SIERRA 1.x, and a list of what it cannot carry over."""

from __future__ import annotations

from sierra.setup.sierra1.convert import Converted, convert, write

__all__ = ["Converted", "convert", "write"]

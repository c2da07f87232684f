"""Suggestions for paths that match nothing: the most similar path that matches, or the names that exist instead.

The path is corrected one step after the other. A step matches names by similarity, and `[@name='x']` by similar values.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Sequence
from itertools import pairwise

from sierra.util.lazy_definitions import dataclass, regex
from sierra.util.text import outside

Find = Callable[[str], Sequence[object]]
"""A function that returns what a path selects: nothing for an invalid path."""
Names = Callable[[str, str, str], list[str]]
"""A function that returns the different names one step (`/` or `//`) away from a path: attributes if the last is `@`."""

_SIMPLE_STEP = regex(r"(/{0,2})(@?)([^\s/@*.\[\]()|]+)((?:\[.*\])?)", re.DOTALL)
_SIMPLE_PREDICATE = regex(r"""\[\s*@([\w:.-]+)\s*=\s*("[^"]*"|'[^']*')\s*\]""")


def nearest(path: str, find: Find, names: Names) -> str:
    """Return the end of a message about a path that matches nothing: the most similar path, or the existing names."""
    return _Search(find, names).nearest(path)


@dataclass(frozen=True, slots=True)
class _Search:
    find: Find
    names: Names

    def nearest(self, path: str) -> str:
        good = ""
        for step in _steps(path):
            if self.find(good + step):
                good += step
                continue
            mended = self._mended(good, step)
            if mended is None:
                return self._inventory(good, step)
            good += mended
        return f"; nearest is {good}"

    def _mended(self, good: str, step: str) -> str | None:
        match = _SIMPLE_STEP.fullmatch(step)
        if not match:
            return None
        slash, at, name, predicates = match.groups()
        if predicates and self.find(good + (bare := slash + at + name)):
            return self._mended_predicate(good, bare, predicates)
        for way in (slash, "//") if not at else (slash,):
            close = _closest(name, self.names(good, way, at))
            if close and (not predicates or self.find(good + way + at + close + predicates)):
                return way + at + close + predicates
            if close:
                return self._mended_predicate(good, way + at + close, predicates)
        return None

    def _mended_predicate(self, good: str, bare: str, predicates: str) -> str:
        """Return the step with `[@name='x']` changed to the most similar existing value; other predicates are left out."""
        match = _SIMPLE_PREDICATE.fullmatch(predicates)
        values = [str(value) for value in self.find(f"{good}{bare}/@{match[1]}")] if match else []
        close = _closest(match[2][1:-1], values) if match else None
        if match is None or close is None or ("'" in close and '"' in close):
            return bare
        quote = '"' if "'" in close else "'"
        return f"{bare}[@{match[1]}={quote}{close}{quote}]"

    def _inventory(self, good: str, step: str) -> str:
        """Return the names that exist in the place where a step matches nothing."""
        at = "@" if step.lstrip("/").startswith("@") else ""
        way = re.match("/{0,2}", step)[0]  # type: ignore[index]
        known = [at + name for name in self.names(good, way, at)]
        if not known:
            return f"; only {good} matches" if good else ""
        more = ", …" if len(known) > 8 else ""
        return f"; {f'{good} has' if good else 'there are'} {', '.join(known[:8])}{more}"


def _steps(path: str) -> list[str]:
    """Split a path into steps: `//swarm/@count` into `//swarm` and `/@count`."""
    path = path.strip()
    starts = [position for position in outside(path, "/") if position and path[position - 1] != "/"]
    return [path[start:end] for start, end in pairwise((0, *starts, len(path)))]


def _closest(name: str, known: list[str]) -> str | None:
    """Return the most similar name; a name that differs only in its prefix is preferred."""
    local = name.rpartition(":")[2]
    same = [other for other in known if other.rpartition(":")[2] == local]
    return next(iter(same or difflib.get_close_matches(name, known, 1)), None)

"""The differences between the contents of two images: packages by name, and files by path."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from sierra.containers.images.merge_layers import Entry, listed
from sierra.provenance.dependency_model import by_likelihood
from sierra.util.lazy_definitions import dataclass


@dataclass(frozen=True, slots=True)
class Change:
    """A package or file that only one of two images has, or that differs between them."""

    name: str
    was: str | None
    """A package's version, or a file's SHA-256, link target, or type and mode. None if the first image does not have it."""
    now: str | None
    text: str
    """A short description of the change."""


def packages(
    was: Mapping[str, Sequence[str]], now: Mapping[str, Sequence[str]], words: frozenset[str] = frozenset()
) -> dict[str, list[Change]]:
    """Return the packages that differ, by package manager; packages that `words` name come first."""
    found = {manager: list(_packages(was.get(manager, ()), now.get(manager, ()), words)) for manager in sorted({*was, *now})}
    return {manager: changes for manager, changes in found.items() if changes}


def _packages(was: Sequence[str], now: Sequence[str], words: frozenset[str]) -> Iterator[Change]:
    old, new = _versions(was), _versions(now)
    for name in by_likelihood(old.keys() | new.keys(), words):
        before, after = old.get(name), new.get(name)
        if before != after:
            text = (
                f"{name} {before} gone" if after is None else f"{name} {before} → {after}" if before else f"{name} {after} new"
            )
            yield Change(name, before, after, text)


def _versions(lines: Sequence[str]) -> dict[str, str]:
    """Return the versions by name. If a package is installed more than once, its versions are joined."""
    found: dict[str, list[str]] = {}
    for line in lines:
        name, _, version = line.partition("==")
        found.setdefault(name, []).append(version)
    return {name: ", ".join(sorted(versions)) for name, versions in found.items()}


def files(was: bytes, now: bytes) -> list[Change]:
    """Return the files that differ between two listings, programs and libraries first; folders only if their modes differ."""
    before, after = set(was.splitlines()), set(now.splitlines())
    old, new = listed(before - after), listed(after - before)
    pairs = [(path, old.get(path), new.get(path)) for path in old.keys() | new.keys()]
    return [_file(*pair) for pair in sorted(filter(_counts, pairs), key=_likely)]


Pair = tuple[str, Entry | None, Entry | None]
"""A path, and its entry in each of two images."""


def _counts(pair: Pair) -> bool:
    """Return whether a difference is reported. Added and removed folders are not, because their files are."""
    return None not in pair or all(entry.type != "folder" for entry in pair[1:] if entry)


def _likely(pair: Pair) -> tuple[bool, str]:
    path, *entries = pair
    executed = any(entry.type == "file" and entry.mode & 0o111 for entry in entries if entry)
    return not (executed or ".so" in path), path


def _file(path: str, was: Entry | None, now: Entry | None) -> Change:
    return Change(path, _described(was), _described(now), f"{path}{_difference(was, now)}")


def _difference(was: Entry | None, now: Entry | None) -> str:
    if was is None or now is None:
        return " new" if was is None else " gone"
    if was.type != now.type:
        return f" ({was.type} → {now.type})"
    if was.mode != now.mode:
        return f" (mode {was.mode:o} → {now.mode:o})"
    return f" (→ {now.target})" if now.type == "link" else ""


def _described(entry: Entry | None) -> str | None:
    return (entry.sha256 or entry.target or f"{entry.type}, mode {entry.mode:o}") if entry else None

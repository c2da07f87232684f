"""The description of a commit, and the address of its repository."""

from __future__ import annotations

from collections.abc import Mapping

from sierra.provenance.source.git import Git
from sierra.provenance.source.redact_address import without_credentials

DIGITS = 12
"""Digits of a commit in a description; by default, git would choose their number by the size of the clone."""


def describe(git: Git, commit: str | None, *, dirty: bool) -> str | None:
    """Return a description like that of `git describe --always --dirty --tags`."""
    if commit is None:
        return None
    said = git("describe", "--always", "--tags", f"--abbrev={DIGITS}", commit, optional=True)
    return (said.decode("utf-8", "replace").strip() or commit[:DIGITS]) + ("-dirty" if dirty else "")


def remote(git: Git, branch: str | None) -> str | None:
    """Return the address of the default remote, without credentials.

    The default remote is the one that the branch follows, else `origin`, else the only one. Returns None if there is none.
    """
    settings = _settings(git)
    addresses = _addresses(settings)
    address = addresses.get(_followed(settings, branch) or "")
    return (without_credentials(address) or None) if address else None


def remotes(git: Git) -> set[str]:
    """Return the names of all remotes."""
    return set(_addresses(_settings(git)))


def default_remote(git: Git) -> str | None:
    """Return the name of the remote that the current branch follows, else `origin`, else the only one."""
    branch = git("symbolic-ref", "--quiet", "--short", "HEAD", optional=True).decode("utf-8", "replace").strip()
    return _followed(_settings(git), branch)


def _settings(git: Git) -> dict[str, str]:
    said = git("config", "-z", "--get-regexp", r"^(remote\..*\.url|branch\..*\.remote)$", optional=True)
    return dict(line.partition("\n")[::2] for line in said.decode("utf-8", "replace").split("\0") if line)


def _addresses(settings: Mapping[str, str]) -> dict[str, str]:
    return {key[len("remote.") : -len(".url")]: value for key, value in settings.items() if key.startswith("remote.")}


def _followed(settings: Mapping[str, str], branch: str | None) -> str | None:
    addresses = _addresses(settings)
    wanted = (settings.get(f"branch.{branch}.remote", "origin"), "origin", *(addresses if len(addresses) == 1 else ()))
    return next((name for name in wanted if addresses.get(name)), None)

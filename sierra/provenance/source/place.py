"""Where a commit stands: its description, and the repository's address."""

from __future__ import annotations

from sierra.provenance.source.git import Git
from sierra.provenance.source.remote import without_credentials

DIGITS = 12
"""Of a commit in a description; git would choose how many by the size of this clone."""


def describe(git: Git, commit: str | None, *, dirty: bool) -> str | None:
    """As `git describe --always --dirty --tags` has it."""
    if commit is None:
        return None
    said = git("describe", "--always", "--tags", f"--abbrev={DIGITS}", commit, optional=True)
    return (said.decode("utf-8", "replace").strip() or commit[:DIGITS]) + ("-dirty" if dirty else "")


def remote(git: Git, branch: str | None) -> str | None:
    """The address of the remote that the branch follows, of `origin`, or of the only one there is; without credentials."""
    said = git("config", "-z", "--get-regexp", r"^(remote\..*\.url|branch\..*\.remote)$", optional=True)
    settings = dict(line.partition("\n")[::2] for line in said.decode("utf-8", "replace").split("\0") if line)
    addresses = {key[len("remote.") : -len(".url")]: value for key, value in settings.items() if key.startswith("remote.")}
    followed = settings.get(f"branch.{branch}.remote", "origin")
    only = next(iter(addresses.values())) if len(addresses) == 1 else None
    address = addresses.get(followed) or addresses.get("origin") or only
    return (without_credentials(address) or None) if address else None

"""The description of a commit, and the address of its repository, without credentials.

Git accepts a URL (`https://user:password@host/path`), the short form of ssh (`user@host:path`), a path, or the name of a
program (`ext::…`). A user may have left a password in any part of it, even in a form that git itself would not understand.
If a password cannot be separated from the address, too much is removed rather than too little. The user name `git` is not a
secret.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

from sierra.provenance.source.git import Git
from sierra.util.lazy_definitions import regex

DIGITS = 12
"""Digits of a commit in a description; by default, git would choose their number by the size of the clone."""
URL = regex(r"(?s)(?P<scheme>(?:[\w.+-]+::)?[\w.+-]+://)(?P<rest>.*)")
OF_REMOTES = regex(r"(?s)remote\..*\.url|branch\..*\.remote")
HOST = regex(r"(?:\[[0-9A-Fa-f:.%]*\]|[^\s:@/]*)(?::\d*)?(?=/|\Z)")


def describe(git: Git, commit: str | None, *, dirty: bool) -> str | None:
    """Return a description like that of `git describe --always --dirty --tags`."""
    if commit is None:
        return None
    output = git("describe", "--always", "--tags", f"--abbrev={DIGITS}", commit, optional=True)
    return (output.decode("utf-8", "replace").strip() or commit[:DIGITS]) + ("-dirty" if dirty else "")


def remote(git: Git, branch: str | None) -> str | None:
    """Return the address of the default remote (see `default_remote`), without credentials; None if there is none."""
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
    pairs = (line.decode("utf-8", "replace").partition("\n")[::2] for line in git.settings)
    return {name: value for name, value in pairs if OF_REMOTES.fullmatch(name)}


def _addresses(settings: Mapping[str, str]) -> dict[str, str]:
    return {key[len("remote.") : -len(".url")]: value for key, value in settings.items() if key.startswith("remote.")}


def _followed(settings: Mapping[str, str], branch: str | None) -> str | None:
    addresses = _addresses(settings)
    wanted = (settings.get(f"branch.{branch}.remote", "origin"), "origin", *(addresses if len(addresses) == 1 else ()))
    return next((name for name in wanted if addresses.get(name)), None)


def without_credentials(address: str) -> str:
    """Return an address in a form that can be recorded."""
    if url := URL.fullmatch(address):
        return url["scheme"] + _place(re.split(r"[?#;]", url["rest"], maxsplit=1)[0])
    if program := re.match(r"[\w.+-]+::", address):
        return program[0]
    if address.startswith(("/", "./", "../", "~")):
        return address
    return _short(address)


def _place(rest: str) -> str:
    """Return the host and the path of a URL, without anything before them."""
    authority, slash, path = rest.partition("/")
    rest = authority.rpartition("@")[2] + slash + path
    while "@" in rest and (not HOST.match(rest) or re.search(r":[^/@]*@", rest)):
        rest = rest.partition("@")[2]
    return rest


def _short(address: str) -> str:
    """Return `user@host:path` without a user other than `git`. A password is removed with everything up to its last @."""
    user, at, rest = address.partition("@")
    if not at or "/" in user:
        return address
    if ":" not in user and not re.match(r"[^/]*@[^/:]+:", rest):
        return address if user == "git" else rest
    return re.sub(r"^[^/]*@", "", address)

"""Addresses of repositories without credentials: passwords, tokens and query strings are removed.

Git accepts a URL (`https://user:password@host/path`), the short form of ssh (`user@host:path`), a path, or the name of a
program (`ext::…`). A user may have left a password in any part of it, even in a form that git itself would not understand.
If a password cannot be separated from the address, too much is removed rather than too little. The user name `git` is not a
secret.
"""

from __future__ import annotations

import re

URL = re.compile(r"(?s)(?P<scheme>(?:[\w.+-]+::)?[\w.+-]+://)(?P<rest>.*)")
HOST = re.compile(r"(?:\[[0-9A-Fa-f:.%]*\]|[^\s:@/]*)(?::\d*)?(?=/|\Z)")


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
    """Return `user@host:path` without the user, unless the user is `git`.

    If there is a password, everything up to its last @ is removed.
    """
    user, at, rest = address.partition("@")
    if not at or "/" in user:
        return address
    if ":" not in user and not re.match(r"[^/]*@[^/:]+:", rest):
        return address if user == "git" else rest
    return re.sub(r"^[^/]*@", "", address)

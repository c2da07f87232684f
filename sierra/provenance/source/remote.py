"""Addresses of repositories without what opens them: passwords, tokens, queries.

Git takes a URL (`https://user:password@host/path`), the short form of ssh (`user@host:path`), a path, or the name of a
program (`ext::…`). Who writes it may have left a password in any place, also one that git itself would not understand; where
it cannot be told apart from the address, rather too much is taken away. The name `git` is no secret.
"""

from __future__ import annotations

import re

URL = re.compile(r"(?s)(?P<scheme>(?:[\w.+-]+::)?[\w.+-]+://)(?P<rest>.*)")
HOST = re.compile(r"(?:\[[0-9A-Fa-f:.%]*\]|[^\s:@/]*)(?::\d*)?(?=/|\Z)")


def without_credentials(address: str) -> str:
    """An address as it may be recorded."""
    if url := URL.fullmatch(address):
        return url["scheme"] + _place(re.split(r"[?#;]", url["rest"], maxsplit=1)[0])
    if program := re.match(r"[\w.+-]+::", address):
        return program[0]
    if address.startswith(("/", "./", "../", "~")):
        return address
    return _short(address)


def _place(rest: str) -> str:
    """Host and path of a URL, whatever stands before them."""
    authority, slash, path = rest.partition("/")
    rest = authority.rpartition("@")[2] + slash + path
    while "@" in rest and (not HOST.match(rest) or re.search(r":[^/@]*@", rest)):
        rest = rest.partition("@")[2]
    return rest


def _short(address: str) -> str:
    """`user@host:path`: the user goes, unless it is git; where there is a password, all up to the last @ of it."""
    user, at, rest = address.partition("@")
    if not at or "/" in user:
        return address
    if ":" not in user and not re.match(r"[^/]*@[^/:]+:", rest):
        return address if user == "git" else rest
    return re.sub(r"^[^/]*@", "", address)

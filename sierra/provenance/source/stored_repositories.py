"""Nested repositories and files of git-lfs, restored from a store without git. Each part is found by the hash that proves it.

The store of a package has more than the files of a source: the commit of a nested repository by its id, the list of the files
of its tree by the tree's id, and the data of a file of git-lfs by the SHA-256 in its pointer.
"""

from __future__ import annotations

import re
from collections.abc import Callable

from sierra.errors import Damaged
from sierra.provenance.source.lfs import POINTER
from sierra.provenance.source.manifest import Files, git_hash, read, tree_hash
from sierra.util.hashing import sha256
from sierra.util.lazy_definitions import regex

ReadBlob = Callable[[str], bytes | None]
OID = regex(rb"^oid sha256:([0-9a-f]{64})$", re.MULTILINE)


def nested(thing: str, read_blob: ReadBlob) -> Files | None:
    """Return the files of a nested repository by its commit or tree; None if the store does not have them.

    Raises Damaged if what the store has under that id is something else.
    """
    stored = read_blob(thing)
    tree = thing
    if stored is not None and is_commit(stored, thing):
        tree = tree_of_commit(stored)
        stored = read_blob(tree)
    if stored is None:
        return None
    if not _is_tree(stored, tree):
        raise Damaged(f"the store has other files for the nested repository {thing[:12]}")
    return read(stored)


def data(content: bytes, read_blob: ReadBlob) -> bytes:
    """Return the data of a file of git-lfs for its pointer, if the store has it; any other file as it is."""
    oid = pointed(content)
    stored = read_blob(oid) if oid else None
    return stored if stored is not None and sha256(stored) == oid else content


def proves(content: bytes, thing: str) -> bool:
    """Return True if the content has this id: a commit, the files of a tree, or the data of a file of git-lfs."""
    return sha256(content) == thing or is_commit(content, thing) or _is_tree(content, thing)


def _is_tree(content: bytes, tree: str) -> bool:
    try:
        return tree_hash(read(content)) == tree
    except ValueError:  # it is no list of files
        return False


def pointed(content: bytes) -> str:
    """Return the SHA-256 in a pointer of git-lfs; "" for any other file."""
    oid = OID.search(content) if content.startswith(POINTER) else None
    return oid[1].decode() if oid else ""


def is_commit(content: bytes, commit: str) -> bool:
    """Return True if this is the content of a commit."""
    return git_hash(b"commit", content, "sha1" if len(commit) == 40 else "sha256") == commit


def tree_of_commit(content: bytes) -> str:
    """Return the id of the tree of a commit."""
    return content.partition(b"\n")[0].removeprefix(b"tree ").decode("ascii", "replace")

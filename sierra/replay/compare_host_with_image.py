"""Check of this machine's programs before it executes runs that were recorded in an image.

It checks the same things that are recorded without an image (see `sierra.provenance.fingerprint_programs`): programs, the
libraries that they load, and the distributions of a Python. Everything that the image does not have as the same file at the
same path is reported before anything executes.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from sierra.containers.images.image_contents import Contents
from sierra.execution import commands
from sierra.model import RunSpec
from sierra.provenance import fingerprint_programs
from sierra.provenance.dependency_model import Kind, Program
from sierra.util.hashing import short
from sierra.util.text import few

SHOWN = 3


def unlike(spec: RunSpec, inside: Contents, root: Path) -> Iterator[str]:
    """Yield a line with those of this machine's programs that differ from the image's, if any; the code is in `root`.

    Raises Missing for a program that is not on this machine.
    """
    words, variables = commands.on_host(spec, inside.image, root)
    found = fingerprint_programs.find(words, variables, root)
    other = [line for one in found.all if (line := _other(one, inside, root))]
    if other:
        yield f"not executed in a container, and with other programs than in image {inside.image.name}: {few(other, SHOWN)}"


def _other(one: Program, inside: Contents, root: Path) -> str | None:
    """Return the difference between one program or file here and in the image; None if they are the same."""
    if one.kind == Kind.DISTRIBUTIONS:
        lines = set((one.version or "").splitlines())
        lacking = sorted(lines - set(inside.packages.get("python", ())))
        return f"{one.name}: {lacking[0]} is not in the image" if lacking else None
    if Path(one.path).is_relative_to(root):
        return None
    there = inside.sha256(one.path)
    if there == one.sha256:
        return None
    return f"{one.path} is {short(one.sha256)} here, {short(there) if there else 'nothing'} in the image"

"""Processors by the names that Linux gives them (`uname -m`). They are the values of `{arch}`."""

from __future__ import annotations

import platform

OCI = {
    "x86_64": "amd64",
    "i686": "386",
    "aarch64": "arm64",
    "armv7l": "arm/v7",
    "armv6l": "arm/v6",
    "riscv64": "riscv64",
    "ppc64le": "ppc64le",
    "s390x": "s390x",
    "loongarch64": "loong64",
}
"""All known processors, with the names that images have for them."""
NAMES = tuple(OCI)
ARCH = "{arch}"
"""The placeholder for the processor of the host that executes a run."""
OTHER_NAMES = {
    **{oci: name for name, oci in OCI.items()},
    **dict.fromkeys(("i386", "i486", "i586", "x86"), "i686"),
    **dict.fromkeys(("armv8l", "arm", "armhf"), "armv7l"),
}
EXECUTES = {"x86_64": ("i686",), "aarch64": ("arm",)}
"""Programs for other processors that a processor can execute too."""


def name_of(text: str) -> str:
    """Return the name of a processor that may be given by another name (`amd64`); an unknown one stays as it is."""
    return OTHER_NAMES.get(text, text)


def here() -> str:
    """Return the processor of this machine."""
    return name_of(platform.machine())


def can_execute(host: str, program: str) -> bool:
    """Return False if a processor cannot execute a program for another one, as `worker.processor_of` names it.

    A host with an unknown processor may execute anything.
    """
    own = "arm" if host.startswith("armv") else host
    return host not in OCI or program in (own, *EXECUTES.get(host, ()))

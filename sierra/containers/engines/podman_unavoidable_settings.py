"""The settings of podman's configuration that affect all containers and that no option of a single container can remove.

The files are read as podman reads them (containers.conf(5)): a later file overrides an earlier one. If a variable names a file,
only that file is used.
"""

from __future__ import annotations

import os
import tomllib
from collections.abc import Iterator
from pathlib import Path

KEYS = ("volumes", "mounts", "devices")
NAME = "containers.conf"


def trouble() -> str:
    """Return why runs would have access to things that are not recorded, and the remedy; empty if they have no such access."""
    found: dict[str, Path] = {}
    for file in _files():
        try:
            said = tomllib.loads(file.read_text("utf-8")).get("containers", {})
        except (OSError, ValueError):  # podman reports this error itself
            continue
        for key in KEYS:
            if key in said:
                found.pop(key, None)
                found |= {key: file} if said[key] else {}
    for key, file in found.items():
        return (
            f"{file} gives {key} to all containers, so runs would have unrecorded host access; list them in [container] of "
            f"sierra.toml instead, and set CONTAINERS_CONF to a file without them"
        )
    return ""


def _files() -> Iterator[Path]:
    if only := os.environ.get("CONTAINERS_CONF"):
        yield Path(only)
    else:
        own = Path(os.environ.get("XDG_CONFIG_HOME") or Path(os.environ.get("HOME", "/"), ".config"), "containers")
        for folder in (Path("/usr/share/containers"), Path("/etc/containers"), *([own] if os.geteuid() else [])):
            yield folder / NAME
            yield from sorted((folder / f"{NAME}.d").glob("*.conf"))
    if last := os.environ.get("CONTAINERS_CONF_OVERRIDE"):
        yield Path(last)

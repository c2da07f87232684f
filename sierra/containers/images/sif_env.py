"""The environment variables and labels of a SIF, read from files in it.

Apptainer writes the variables of an OCI image as shell code, one `export NAME="${NAME:-"value"}"` or `export NAME="value"` per
line. Only lines of that form are read, and only if a shell would expand nothing in the value; other lines are ignored.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping

ENVIRONMENT, LABELS = ".singularity.d/env/10-docker2singularity.sh", ".singularity.d/labels.json"
EXPORT = re.compile(r'export ([A-Za-z_]\w*)="(?:\$\{\1:-"?)?([^"$`\\]*)"?\}?"')
MOST = 1 << 20


def wanted(path: str) -> int:
    return MOST if path in (ENVIRONMENT, LABELS) else 0


def of(kept: Mapping[str, bytes]) -> dict[str, str]:
    """Return the variables by name."""
    lines = kept.get(ENVIRONMENT, b"").decode("utf-8", "replace").splitlines()
    return {read[1]: read[2] for line in lines if (read := EXPORT.fullmatch(line.strip()))}


def labels(kept: Mapping[str, bytes]) -> dict[str, str]:
    try:
        said = json.loads(kept.get(LABELS, b"{}"))
    except (ValueError, RecursionError):
        return {}
    return {str(name): str(value) for name, value in said.items()} if isinstance(said, dict) else {}

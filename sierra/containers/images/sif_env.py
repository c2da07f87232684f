"""What a SIF sets for its programs, and its labels, as files in it say.

Apptainer writes what an OCI image sets as shell code, `export NAME="${NAME:-"value"}"` a line, or `export NAME="value"`. Only
lines of that form, whose value holds nothing that a shell would expand, are understood; others are passed over.
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
    """The variables, by name."""
    lines = kept.get(ENVIRONMENT, b"").decode("utf-8", "replace").splitlines()
    return {read[1]: read[2] for line in lines if (read := EXPORT.fullmatch(line.strip()))}


def labels(kept: Mapping[str, bytes]) -> dict[str, str]:
    try:
        said = json.loads(kept.get(LABELS, b"{}"))
    except (ValueError, RecursionError):
        return {}
    return {str(name): str(value) for name, value in said.items()} if isinstance(said, dict) else {}

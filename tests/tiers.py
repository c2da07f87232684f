"""Tiers of tests: `make test`, `make slow`, and `make nightly` for what takes too long for each change."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def at_night(values: Iterable[Any]) -> list[Any]:
    """Return these values of a parameter, sorted and marked for `make nightly`."""
    return [pytest.param(value, marks=pytest.mark.nightly) for value in sorted(values)]

"""Fixtures for the tests with real simulators."""

from __future__ import annotations

from tests.simulators import installed, made, started

__all__ = ["installed", "made", "started"]

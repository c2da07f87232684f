"""Figures for a two-column paper."""

from __future__ import annotations

from sierra.deliverables.figures.base import draw, rendered

__all__ = ["draw", "rendered"]

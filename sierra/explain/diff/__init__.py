"""Differences between two recorded batches, experiments, runs or executions."""

from __future__ import annotations

from sierra.explain.diff.compare import compare, made_other

__all__ = ["compare", "made_other"]
